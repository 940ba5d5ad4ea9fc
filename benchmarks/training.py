"""Patches a second of a training run, against a bare torch loop over tensors made beforehand, in one run.

    python benchmarks/training.py --variant convbeers-s

What the ratio lacks of 1 is what simulating, guarding, averaging and logging cost. The two take turns, so that what
else the machine does falls on both.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch import Tensor

from model.convbeers import VARIANTS, ConvBEERS
from model.simulator.procedural import procedural_scene
from model.training.losses import LossWeights, RestorationLoss
from model.training.patches import PatchRecipe, PatchSource
from model.training.recipe import TrainingRecipe
from model.training.trainer import MixedPrecision, Trainer
from profiles import load_sensor

BATCH, PATCH_PX, TURNS = 8, 96, 5
LOSS = LossWeights(lpips=0.0)


def main() -> None:
    """Print the rates of the two ways and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", choices=VARIANTS, default="convbeers-s")
    parser.add_argument("--steps", type=int, default=48)
    arguments = parser.parse_args()
    profiles = load_sensor("pleiades-variable"), load_sensor("pleiades-reference")
    scenes = [procedural_scene(1200, 1600, np.random.default_rng(seed)) for seed in range(4)]
    source = PatchSource(scenes, PatchRecipe(*profiles, patch_px=PATCH_PX), BATCH, 0)
    recipe = TrainingRecipe(steps=(TURNS + 1) * arguments.steps, batch=BATCH, loss=LOSS)
    trainer, bare_network = (Trainer(VARIANTS[arguments.variant], recipe) for _ in range(2))
    made, batches = list(islice(source.batches(), arguments.steps)), source.batches()
    bare, whole = [], []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(TURNS + 1):
            bare.append(rate(arguments.steps, lambda: bare_loop(bare_network.network, made)))
            whole.append(rate(arguments.steps, lambda: run(trainer, batches, arguments.steps, Path(folder) / "c")))
    ratios = [ours / theirs for ours, theirs in zip(whole[1:], bare[1:], strict=True)]  # the first warms up
    rates = f"bare loop {median(bare[1:]):.1f} patches/s, training run {median(whole[1:]):.1f}"
    print(f"{arguments.variant}: {rates}, ratio {median(ratios):.2f}")


def rate(steps: int, work: Callable[[], None]) -> float:
    """Patches a second."""
    started = time.perf_counter()
    work()
    return steps * BATCH / (time.perf_counter() - started)


def bare_loop(network: ConvBEERS, batches: list[tuple[Tensor, Tensor]]) -> None:
    """What anybody would write: forward, loss, backward, step."""
    forward, loss = MixedPrecision(network), RestorationLoss(LOSS)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-4)
    for degraded, reference in batches:
        degraded = degraded.to(memory_format=torch.channels_last)
        total, _ = loss(forward(degraded), reference)
        optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        optimiser.step()


def run(trainer: Trainer, batches: Iterator[tuple[Tensor, Tensor]], steps: int, checkpoint: Path) -> None:
    """So many further steps of a run, simulation included, and a checkpoint."""
    for degraded, reference in islice(batches, steps):
        trainer.train_step(degraded, reference)
    trainer.save(checkpoint)


if __name__ == "__main__":
    main()
