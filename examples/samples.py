"""Draw the samples on which the example networks are trained, calibrated and evaluated: images, and
the expected outputs.

    python -m examples.samples unet --count 64 --out samples.npz

Networks that restore get pairs of `pleiades-degraded` and its reference, from drawn scenes or from
the photographs of a folder. The segmentation network finds bright areas in them. The script writes
a .npz file as `beers-deploy quantize --samples` reads it: `image` (N, C, H, W) in [0, 1] and, for
networks that restore, `reference`.
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import islice, product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from beers_deploy.model.io.files import require_writable, whole_file
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.training.looks import Look
from beers_deploy.model.training.passes import Pass, Visited, detected, folded_signals, prepare
from beers_deploy.model.training.patches import PatchRecipe, draw_turn
from beers_deploy.model.training.source import PatchSource, cut, turned
from beers_deploy.profiles.errors import BeersError, ImageError, OptionError
from beers_deploy.profiles.sensor import Sensor
from examples.networks import NETWORKS

BATCH = 8
"""The number of images in a batch."""
PATCH_PX = 64
"""Side of an image."""
RECIPE = PatchRecipe(Sensor.load("pleiades-degraded"), Sensor.load("pleiades-reference"), PATCH_PX)

GAINS = (0.7, 0.9, 1.0, 1.2)
"""The relative brightness of four bands of one ground."""
BRIGHT = 0.2
"""A pixel is bright if the mean of the square around it, in the reference, is above this share of
full scale.
"""
AROUND_PX = 9
"""Side of that square."""
MIXED = 4
"""The number of passes over scenes whose patches of four bands are mixed."""
MOST = 64
"""The largest number of patches from one of these passes."""

Batch = tuple[Tensor, Tensor]
"""The input of a network, (N, C, H, W) in [0, 1], and its target: images of the output's shape, or
classes of pixels.
"""


def batches(name: str, scenes: Sequence[Scene], seed: int) -> Iterator[Batch]:
    """Return an endless iterator over batches for the network of that name. The same seed gives the
    same batches.
    """
    example = NETWORKS[name]
    if example.inputs == len(GAINS):
        return banded(scenes, np.random.default_rng(seed))
    pairs = (batch[:2] for batch in PatchSource(list(scenes), RECIPE, BATCH, seed).batches())
    if name == "segment":
        return ((image, bright(reference)) for image, reference in pairs)
    if example.scale > 1:
        return (
            (functional.avg_pool2d(reference, example.scale), reference) for _, reference in pairs
        )
    return ((image, reference) for image, reference in pairs)


def bright(reference: Tensor) -> Tensor:
    """Return the class of each pixel, (N, H, W): 1 where the reference (N, 1, H, W) is bright
    around it, else 0.
    """
    mean = functional.avg_pool2d(
        reference, AROUND_PX, stride=1, padding=AROUND_PX // 2, count_include_pad=False
    )
    return (mean[:, 0] > BRIGHT).long()


def banded(scenes: Sequence[Scene], generator: np.random.Generator) -> Iterator[Batch]:
    """Yield batches of pairs of four bands, (N, 4, P, P), endlessly. The bands share ground and
    phase, and each has its own gain and noise.
    """
    ready = [prepare(scene, math.lcm(*RECIPE.oversamplings)) for scene in scenes]
    passes = [pair for pair in product(ready, RECIPE.oversamplings) if _fits(*pair)]
    if not passes:
        raise ImageError(
            f"None of the training images is large enough for a patch of {PATCH_PX} target pixels. "
            "Give larger images."
        )
    while True:
        mixed = [passes[generator.integers(len(passes))] for _ in range(MIXED)]
        pieces = [
            _mixed(_acquire_bands(scene, ratio, generator), generator)[:MOST]
            for scene, ratio in mixed
        ]
        for patches in torch.split(_mixed(torch.cat(pieces), generator), BATCH):
            yield patches[:, : len(GAINS)], patches[:, len(GAINS) :]


def _fits(scene: Visited, ratio: int) -> bool:
    return bool(min(scene.sides) // ratio >= PATCH_PX + 2 * RECIPE.margin_px)


def _mixed(patches: Tensor, generator: np.random.Generator) -> Tensor:
    """Return patches (N, C, P, P) in random order."""
    return patches[torch.from_numpy(generator.permutation(len(patches)))]


def _acquire_bands(scene: Visited, ratio: int, generator: np.random.Generator) -> Tensor:
    """Return the patches of one pass over a scene, (N, 8, P, P) in [0, 1]: four degraded bands,
    then their references.
    """
    phase_y, phase_x = (float(offset) for offset in generator.uniform(-ratio / 2, ratio / 2, 2))
    look = Look(float(generator.uniform(*RECIPE.looks.exposures)))
    sensors = RECIPE.degraded.draw(generator), RECIPE.reference.draw(generator)
    signals = folded_signals(
        scene, sensors, Pass(ratio, (phase_y, phase_x), look, RECIPE.margin_px)
    )
    images = []
    for signal, sensor, role in zip(signals, sensors, ("degraded", "reference"), strict=True):
        images += [detected(signal * gain, sensor, role, generator) for gain in GAINS]
    return turned(
        cut(torch.stack(images), PATCH_PX, generator), *draw_turn(generator, quarters=True)
    )


def batches_of(name: str, folder: Path | None, seed: int) -> Iterator[Batch]:
    """Return `batches` from the photographs of a folder, or from drawn scenes."""
    return batches(name, load_scenes(folder, RECIPE.degraded.nominal(), seed), seed)


def positive(text: str) -> int:
    """Parse a positive count from the command line."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 on, got {text}")
    return int(text)


def reported(work: Callable[[], None]) -> int:
    """Run some work and return the exit code: 2, with one sentence, if the input is at fault."""
    try:
        work()
    except BeersError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw and write the samples, print a summary, and return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("--count", type=positive, default=64, metavar="N")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")
    parser.add_argument(
        "--images", type=Path, metavar="DIR", help="photographs in place of drawn scenes"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    return reported(
        lambda: write_samples(
            options.network, options.count, options.out, options.images, options.seed
        )
    )


def write_samples(name: str, count: int, out: Path, folder: Path | None, seed: int) -> None:
    """Write `count` samples for the network of that name, with references if it restores."""
    if out.suffix != ".npz":
        raise OptionError(f"--out must be a name that ends in .npz, got {out.name}.")
    require_writable(out)
    batches = list(islice(batches_of(name, folder, seed), -(-count // BATCH)))
    image, reference = (
        torch.cat(tensors)[:count].numpy() for tensors in zip(*batches, strict=True)
    )
    restores = NETWORKS[name].restores
    with whole_file(out) as temporary, temporary.open("wb") as file:
        if restores:
            np.savez(file, image=image, reference=reference)
        else:
            np.savez(file, image=image)
    shape = " x ".join(map(str, image.shape))
    sys.stdout.write(f"wrote {out}: {shape}{', with references' if restores else ''}\n")


if __name__ == "__main__":
    sys.exit(main())
