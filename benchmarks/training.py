"""Measure how many patches a second a training run simulates, and how many it trains on.

    python benchmarks/training.py --variant convbeers-s

The simulated patches are those of photographs, varied as recipes vary them. The steps run on
patches simulated beforehand, in float32 and in bfloat16.
"""

import argparse
import time
from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from typing import get_args

import numpy as np
import torch

from beers_deploy.model.family import SensorFamily
from beers_deploy.model.processor import processor_name
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.training.checkpoint import TrainingRecipe
from beers_deploy.model.training.looks import Looks
from beers_deploy.model.training.losses import LossWeights
from beers_deploy.model.training.patches import PatchRecipe
from beers_deploy.model.training.source import Batch, PatchSource
from beers_deploy.model.training.trainer import Precision, Trainer
from beers_deploy.model.variants import VARIANTS
from beers_deploy.profiles.sensor import Sensor

BATCH = 8
PATCH_PX = 96


def patch_recipes() -> dict[str, PatchRecipe]:
    """Return recipes of patches for any sensor, by name."""
    sensors = Sensor.load("pleiades-degraded"), Sensor.load("pleiades-reference")
    family = SensorFamily(sensors[0].nominal())
    plain = PatchRecipe(*sensors, PATCH_PX, family=family)
    varied = replace(family, other_curves=0.4)
    looks = Looks(lit_share=0.4, calm_share=0.3, soft_share=0.3)
    return {
        "of photographs": plain,
        "varied": replace(
            plain,
            family=varied,
            looks=looks,
            noisy_reference=False,
        ),
    }


def timed(name: str, batches: Iterable[Batch]) -> None:
    """Print the number of patches per second of some batches."""
    started_s = time.perf_counter()
    count = sum(len(batch.degraded) for batch in batches)
    print(f"{name}: {count / (time.perf_counter() - started_s):.0f} patches a second", flush=True)


def main() -> None:
    """Print all rates."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variant", choices=VARIANTS, default="convbeers-s")
    parser.add_argument("--steps", type=int, default=48)
    arguments = parser.parse_args()
    print(f"{arguments.variant} on {processor_name()}, {torch.get_num_threads()} threads")
    scenes = [procedural_scene(1200, 1600, np.random.default_rng(seed)) for seed in range(4)]
    for name, patches in patch_recipes().items():
        # Batches are simulated ahead, so the clock starts before the first one.
        source = PatchSource(scenes, patches, BATCH, 0).batches()
        timed(f"simulated, {name}", islice(source, arguments.steps))
    variable = Sensor.load("pleiades-variable"), Sensor.load("pleiades-reference")
    source = PatchSource(scenes, PatchRecipe(*variable, PATCH_PX), BATCH, 0).batches()
    batches = list(islice(source, arguments.steps + 1))
    recipe = TrainingRecipe(len(batches), BATCH, loss=LossWeights(lpips=0.0))
    for precision in get_args(Precision):
        trainer = Trainer(VARIANTS[arguments.variant], recipe, precision=precision)
        trainer.train_step(batches[0])

        def trained(trainer: Trainer = trainer) -> Iterable[Batch]:
            for batch in batches[1:]:
                trainer.train_step(batch)
                yield batch

        timed(f"trained, {precision}", trained())


if __name__ == "__main__":
    main()
