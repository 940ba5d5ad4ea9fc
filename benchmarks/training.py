"""Patches a second of a training run, against a bare torch loop over tensors made beforehand, in
one run.

    python benchmarks/training.py --variant convbeers-s

Both are timed in float32 and in bfloat16; and how fast patches are simulated, as photographs show
them and varied as recipes vary them. What the ratio lacks of 1 is what simulating, guarding,
averaging and logging cost. All are interleaved, so that what else the machine does falls on each of
them.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice, product
from pathlib import Path
from statistics import median
from typing import get_args

import numpy as np
import torch

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.processor import processor_name
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.training.checkpoint import TrainingRecipe
from beers_deploy.model.training.looks import Looks
from beers_deploy.model.training.losses import LossWeights, RestorationLoss
from beers_deploy.model.training.patches import PatchRecipe
from beers_deploy.model.training.source import Batch, PatchSource
from beers_deploy.model.training.trainer import Precision, Trainer
from beers_deploy.model.variants import VARIANTS
from beers_deploy.profiles.sensor import Sensor

BATCH = 8
PATCH_PX = 96
TURNS = 5
SIMULATED = 256
LOSS = LossWeights(lpips=0.0)


def main() -> None:
    """Print the rates of the two ways and their ratio."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variant", choices=VARIANTS, default="convbeers-s")
    parser.add_argument("--steps", type=int, default=48)
    arguments = parser.parse_args()
    profiles = Sensor.load("pleiades-variable"), Sensor.load("pleiades-reference")
    scenes = [procedural_scene(1200, 1600, np.random.default_rng(seed)) for seed in range(4)]
    source = PatchSource(scenes, PatchRecipe(*profiles, patch_px=PATCH_PX), BATCH, 0)
    recipe = TrainingRecipe(steps=(TURNS + 1) * arguments.steps, batch=BATCH, loss=LOSS)
    variant = VARIANTS[arguments.variant]
    steps = arguments.steps
    trainers = {name: Trainer(variant, recipe, precision=name) for name in get_args(Precision)}
    batch_list = list(islice(source.batches(), steps))
    batches = source.batches()
    bare: dict[str, list[float]] = {name: [] for name in trainers}
    seconds: dict[str, list[float]] = {name: [] for name in trainers}
    with tempfile.TemporaryDirectory() as folder:
        for _, (name, trainer) in product(range(TURNS + 1), trainers.items()):
            bare[name].append(
                rate(
                    steps,
                    partial(bare_loop, Trainer(variant, recipe, precision=name), batch_list, name),
                )
            )
            seconds[name].append(
                rate(steps, partial(run, trainer, batches, steps, Path(folder) / "c"))
            )
    print(f"{arguments.variant} on {processor_name()}, {torch.get_num_threads()} threads")
    for kind, recipe_of_patches in kinds_of_patches().items():
        made_alone = PatchSource(scenes, recipe_of_patches, BATCH, 0).batches()
        next(made_alone)
        print(
            f"simulated alone, {kind}: "
            f"{rate(SIMULATED, partial(drawn, made_alone, SIMULATED)):.0f} patches/s"
        )
    for name in trainers:
        ratio = median(
            ours / theirs for ours, theirs in zip(seconds[name][1:], bare[name][1:], strict=True)
        )
        rates = (
            f"bare loop {median(bare[name][1:]):.1f} patches/s, training run "
            f"{median(seconds[name][1:]):.1f}"
        )
        # The first turn warms up and is left out.
        print(f"{name}: {rates}, ratio {ratio:.2f}")


def kinds_of_patches() -> dict[str, PatchRecipe]:
    """Recipes of patches for any sensor, by name."""
    degraded = Sensor.load("pleiades-degraded")
    reference = Sensor.load("pleiades-reference")
    plain = PatchRecipe(degraded, reference, PATCH_PX, family=SensorFamily(degraded.nominal()))
    family = SensorFamily(degraded.nominal(), other_curves=0.4)
    varied = Looks(lit_share=0.4, calm_share=0.3, soft_share=0.3)
    return {
        "ordinary": plain,
        "varied": replace(plain, family=family, looks=varied, noisy_reference=False),
    }


def drawn(batches: Iterator[Batch], count: int) -> None:
    """So many batches, and nothing else."""
    for _ in islice(batches, count):
        pass


def rate(steps: int, work: Callable[[], None]) -> float:
    """Patches a second."""
    started = time.perf_counter()
    work()
    return steps * BATCH / (time.perf_counter() - started)


def bare_loop(trainer: Trainer, batches: list[Batch], precision: Precision) -> None:
    """What anybody would write: forward, loss, backward, step."""
    loss = RestorationLoss(LOSS)
    optimiser = torch.optim.Adam(trainer.network.parameters(), lr=1e-4)
    for batch in batches:
        degraded = batch.degraded.to(memory_format=torch.channels_last)
        total, _ = loss(
            trainer.network(degraded, bfloat16=precision == "bfloat16"), batch.reference
        )
        optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        optimiser.step()


def run(trainer: Trainer, batches: Iterator[Batch], steps: int, checkpoint: Path) -> None:
    """So many further steps of a run, simulation included, and a checkpoint."""
    for batch in islice(batches, steps):
        trainer.train_step(batch)
    trainer.save(checkpoint)


if __name__ == "__main__":
    main()
