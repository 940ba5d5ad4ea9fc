"""Measure which errors the self-check of `restore` finds, and which it misses.

    python -m benchmarks.self_check --images aerial-test/ [--flips 200] [--networks ...] [--sweep]

The script prints three tables, measured on simulated acquisitions of the images:

1. Correct restorations at 1, 1/4 and 1/20 of the radiance, with `--sweep` also under every sensor
   of the sweep: the number of blocks, of decidable ones, and of those outside the bound.
2. A file for another sensor, whose MTF at Nyquist is 30 % too low or too high.
3. Single bit flips in the weights of INT8 networks: the share that is found of those that cost a
   block more than 0.5 dB, and of these blocks by their sharpening. A drawn tile, which a kit
   restores on a board beside each image, shows more of them than the residual does.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.self_check import BLOCK_PX, Judged, SelfCheck
from beers_deploy.model.simulator.procedural import load_scenes
from beers_deploy.network import Network
from beers_deploy.profiles.errors import BeersError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.encodings import host_model, read_core
from beers_deploy.restoration.method import Restore, network_restore
from beers_deploy.restoration.steps import BOTH, Around
from beers_deploy.studies.evaluation.methods import profile_of
from beers_deploy.studies.evaluation.pairs import NamedPair, scenes_at, simulate_pairs
from beers_deploy.studies.evaluation.sweep import conditions
from beers_deploy.studies.stress.faults import flip_weights

WRONG = (0.7, 1.3)
RADIANCES = (1.0, 0.25, 0.05)
COSTLY_DB = 0.5
CLASSES = (0, 10, 20, 30, 40, 60, 100, np.inf)
"""The limits of the classes of sharpening in the tables."""
LOSSES_DB = (COSTLY_DB, 1, 2, 5, np.inf)
"""The limits of the classes of a block's loss."""
PEAK_DN = 4095
SEED = 0
KNOWN = np.random.default_rng(0).random((64, 64), np.float32) * PEAK_DN
"""The drawn tile, whose restoration must not change."""

NOMINAL = Sensor.load("pleiades-degraded")
REFERENCE = Sensor.load("pleiades-reference").nominal()


def judged(check: SelfCheck, raw: np.ndarray, restored: np.ndarray) -> Judged:
    """Check a whole image."""
    return check.judge(raw, restored, *(Placed(side, 0, 0, side) for side in raw.shape))


def restorer(name: str, sensor: Instrument) -> Restore:
    """Return a function that restores digital numbers by a shipped network conditioned on a
    sensor.
    """
    profile = profile_of(sensor, NOMINAL)
    return network_restore(Network.load(name, sensor=profile), profile, REFERENCE, BOTH)


def pairs_at(images: Path, sensor: Instrument, radiance: float = 1.0) -> list[NamedPair]:
    """Simulate acquisitions of the images."""
    scenes = scenes_at(radiance, load_scenes(images, REFERENCE, SEED))
    return simulate_pairs(scenes, sensor, REFERENCE.in_units_of(sensor), SEED)[0]


def flat(parts: list[Judged]) -> Judged:
    """Return the known blocks of several images in one row."""
    chi2, sharpening = (
        np.concatenate([getattr(part, name).ravel() for part in parts])
        for name in ("chi2", "sharpening")
    )
    finite = np.isfinite(chi2)
    return Judged(chi2[finite], sharpening[finite])


def by_class(blocks: Judged) -> str:
    """Return the share of blocks outside the bound, by class of sharpening."""
    return shares(blocks.outside, blocks.sharpening, CLASSES)


def shares(outside: np.ndarray, values: np.ndarray, limits: tuple[float, ...]) -> str:
    """Return the share of blocks outside the bound, by class of a value of each block."""
    words = []
    for low, high in pairwise(limits):
        inside = (values >= low) & (values < high)
        if inside.any():
            words.append(f"{low:g}-{high:g}: {outside[inside].mean():.1%} of {inside.sum()}")
    return ", ".join(words)


def right(images: Path, names: list[str], *, sweep: bool) -> Iterator[str]:
    """Yield a line for each network: the blocks of correct restorations that are flagged."""
    instrument = NOMINAL.nominal()
    cases = [(instrument, radiance) for radiance in RADIANCES]
    if sweep:
        others = conditions(instrument, NOMINAL).values()
        cases += [(sensor, 1.0) for sensor in others if sensor != instrument]
    for name in names:
        parts = []
        for sensor, radiance in cases:
            check = SelfCheck.of(sensor, REFERENCE.in_units_of(sensor))
            restore = restorer(name, sensor)
            raws = [pair.degraded for pair in pairs_at(images, sensor, radiance)]
            parts += [judged(check, raw, restore(raw)) for raw in raws]
        blocks = flat(parts)
        yield (
            f"{name}: {blocks.chi2.size} blocks, {np.count_nonzero(blocks.decidable)} decidable, "
            f"{np.count_nonzero(blocks.outside)} outside; {by_class(blocks)}"
        )


def wrong(images: Path, names: list[str]) -> Iterator[str]:
    """Yield a line for each network and wrong MTF: the share that is found, by sharpening."""
    sensor = NOMINAL.nominal()
    check = SelfCheck.of(sensor, REFERENCE.in_units_of(sensor))
    pairs = pairs_at(images, sensor)
    for name in names:
        for factor in WRONG:
            restore = restorer(name, replace(sensor, mtf_nyquist=factor * sensor.mtf_nyquist))
            parts = [judged(check, pair.degraded, restore(pair.degraded)) for pair in pairs]
            yield f"{name}, MTF x {factor:g}: {by_class(flat(parts))}"


def block_means(pixels: np.ndarray, side_px: int) -> np.ndarray:
    """Return the mean of each whole block of `side_px` pixels a side."""
    rows, columns = (size // side_px for size in pixels.shape)
    whole = pixels[: rows * side_px, : columns * side_px]
    return np.asarray(whole.reshape(rows, side_px, columns, side_px).mean((1, 3)))


def block_db(restored: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the PSNR of each whole block in dB."""
    squared = np.square(restored - truth, dtype=np.float64)
    return np.asarray(10 * np.log10(PEAK_DN**2 / block_means(squared, BLOCK_PX)))


def flips(images: Path, name: str, count: int) -> str:
    """Return a line: the share that is found of the flips that cost a block too much."""
    sensor = NOMINAL.nominal()
    reference = REFERENCE.in_units_of(sensor)
    check = SelfCheck.of(sensor, reference)
    profile = profile_of(sensor, NOMINAL)
    network = Network.load(name, sensor=profile)
    core = read_core(network.model)
    pairs = pairs_at(images, sensor)
    around = Around(exposure=False)
    sound = network_restore(network, profile, REFERENCE, around)
    known = sound(KNOWN)
    hurt_blocks = []
    losses_db = []
    costly = 0
    detected = 0
    other_tiles = 0
    costly_other_tiles = 0
    before: dict[int, np.ndarray] = {}
    for draw in range(count):
        generator = np.random.default_rng([SEED, draw])
        flipped = host_model(flip_weights(core, 1, generator), {})
        number = draw % len(pairs)
        pair = pairs[number]
        assert pair.noise_free is not None  # noqa: S101 - simulated here
        if number not in before:
            before[number] = block_db(sound(pair.degraded), pair.noise_free)
        method = network_restore(replace(network, model=flipped), profile, REFERENCE, around)
        is_other_tile = not np.array_equal(method(KNOWN), known)
        other_tiles += is_other_tile
        restored = method(pair.degraded)
        loss_db = before[number] - block_db(restored, pair.noise_free)
        if not (loss_db > COSTLY_DB).any():
            continue
        blocks = judged(check, pair.degraded, restored)
        rows, columns = loss_db.shape
        chi2 = blocks.chi2[:rows, :columns]
        is_hurt = (loss_db > COSTLY_DB) & np.isfinite(chi2)
        hurt = Judged(chi2[is_hurt], blocks.sharpening[:rows, :columns][is_hurt])
        hurt_blocks.append(hurt)
        losses_db.append(loss_db[is_hurt])
        if not hurt.decidable.any():
            continue
        costly += 1
        detected += bool((hurt.decidable & hurt.outside).any())
        costly_other_tiles += is_other_tile
    line = f"{name}: {count} flips, of which {other_tiles} change the known tile"
    if not costly:
        return f"{line}; none costs a decidable block more than {COSTLY_DB:g} dB"
    hurt = flat(hurt_blocks)
    decidable = hurt.decidable
    by_loss = shares(hurt.outside[decidable], np.concatenate(losses_db)[decidable], LOSSES_DB)
    return (
        f"{line}; {costly} cost a "
        f"decidable block more than {COSTLY_DB:g} dB, of which {costly_other_tiles} change the "
        f"known tile and {detected} are found without it; by the loss of decidable blocks in dB: "
        f"{by_loss}; by the sharpening of all blocks that lose as much: {by_class(hurt)}"
    )


def main() -> None:
    """Print the three tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--networks", default="convbeers-xs,convbeers-xs-int8,convbeers-s-int8")
    parser.add_argument("--flips", type=int, default=200, help="0 to skip the third table")
    parser.add_argument("--sweep", action="store_true")
    arguments = parser.parse_args()
    names = arguments.networks.split(",")
    try:
        for line in wrong(arguments.images, names):
            print(line, flush=True)
        for name in names:
            if arguments.flips and name.endswith("-int8"):
                print(flips(arguments.images, name, arguments.flips), flush=True)
        for line in right(arguments.images, names, sweep=arguments.sweep):
            print(line, flush=True)
    except BeersError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
