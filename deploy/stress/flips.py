"""What is struck, and how: a copy of weights, shifts, feature maps or the image with bits turned over."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from deploy.stress.int8 import planes_of
from model.metrics.fidelity import psnr_db
from quant.core import IntCore
from quant.guards import Guards, checksums, guarded, reloaded, voted
from quant.integer import SOUND, Faults, merged_correction, run_core
from quant.planes import MAX_DN
from quant.upsets import (
    INT8_BITS,
    PIXEL_BITS,
    SHIFT_BITS,
    bits_apart,
    map_channels,
    shifts_of,
    turned_over,
    upset_count,
    upset_shifts,
    upset_weights,
    weight_bits,
)

Pair = tuple[np.ndarray, np.ndarray]
"""Degraded and reference, (1, 1, H, W) in [0, 1] each."""
Shifts = dict[tuple[str, str], int]


@dataclass(frozen=True)
class Patient:
    """A network under fire: its core as the board stores it, its guards, and what it is tried on."""

    core: IntCore
    guards: Guards
    pairs: Sequence[Pair]

    @cached_property
    def shifts(self) -> Shifts:
        """As they are meant."""
        return shifts_of(self.core)

    def healthy(self, number: int) -> "Struck":
        """A pair with nothing turned over."""
        return Struck(self.core, SOUND, self.pairs[number][0], 0)


@dataclass(frozen=True)
class Struck:
    """A network and an image as they are after a strike.

    Attributes:
        core: with the weights as they are now.
        faults: what else is wrong.
        image: (1, 1, H, W), as it is now.
        flips: how many bits were turned over.
    """

    core: IntCore
    faults: Faults
    image: np.ndarray
    flips: int


def restored(patient: Patient, struck: Struck, clamped: bool = False) -> np.ndarray:
    """The image (1, 1, H, W) that a struck network makes of a struck image."""
    faults = guarded(struck.faults, patient.guards) if clamped else struck.faults
    tensors, _ = run_core(struck.core, planes_of(struck.core, struck.image), faults=faults)
    correction = merged_correction(struck.core, tensors)
    correction = patient.guards.limit(correction) if clamped else correction
    return np.asarray(np.clip(struck.image + correction, 0, 1), np.float32)


def quality_db(patient: Patient, struck: Struck, reference: np.ndarray, clamped: bool = False) -> float:
    """PSNR of what it makes, on [0, 1]."""
    return psnr_db(restored(patient, struck, clamped), reference, 1.0)


def mended(patient: Patient, struck: Struck, per_megabit: float, generator: np.random.Generator) -> Struck:
    """What checksums and three copies make of it before the next image: the other copies are struck as well."""
    core = reloaded(struck.core, patient.core, patient.guards.checksums)
    first = {**patient.shifts, **struck.faults.shifts}
    second, third = (_upset_copy(patient, per_megabit, generator) for _ in range(2))
    shifts = voted((first, second, third)) if struck.faults.shifts else {}
    return replace(struck, core=core, faults=replace(struck.faults, shifts=shifts))


def is_mended(patient: Patient, struck: Struck) -> bool:
    """Whether weights and shifts are all as they are meant."""
    meant = {**patient.shifts, **struck.faults.shifts} == patient.shifts
    return meant and checksums(struck.core) == patient.guards.checksums


def _weights(patient: Patient, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Struck:
    flips = upset_count(weight_bits(patient.core), per_megabit, generator)
    return Struck(upset_weights(patient.core, flips, generator), SOUND, image, flips)


def _shifts(patient: Patient, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Struck:
    wrong = _upset_copy(patient, per_megabit, generator)
    return Struck(patient.core, Faults(wrong), image, bits_apart(wrong, patient.shifts))


def _maps(patient: Patient, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Struck:
    """Every tensor is struck once, between the operation that writes it and those that read it."""
    pixels, channels = image[0, 0].size, map_channels(patient.core)
    counts = {name: upset_count(INT8_BITS * pixels * n, per_megabit, generator) for name, n in channels.items()}
    return struck_maps(patient, image, counts, int(generator.integers(2**63)))


def struck_maps(
    patient: Patient, image: np.ndarray, counts: dict[str, int], seed: int, bit: int | None = None
) -> Struck:
    """So many bits of each tensor turned over, the same ones whenever it runs."""
    seeds = {name: [seed, number] for number, name in enumerate(counts)}

    def touch(name: str, tensor: np.ndarray) -> np.ndarray:
        if not counts.get(name):
            return tensor
        return turned_over(tensor, counts[name], np.random.default_rng(seeds[name]), INT8_BITS, bit)

    return Struck(patient.core, Faults({}, touch), image, sum(counts.values()))


def _image(patient: Patient, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Struck:
    flips = upset_count(PIXEL_BITS * image.size, per_megabit, generator)
    dn = turned_over(np.rint(image * MAX_DN).astype(np.uint16), flips, generator, PIXEL_BITS)
    return Struck(patient.core, SOUND, (dn / np.float32(MAX_DN)).astype(np.float32), flips)


def _upset_copy(patient: Patient, per_megabit: float, generator: np.random.Generator) -> Shifts:
    flips = upset_count(SHIFT_BITS * len(patient.shifts), per_megabit, generator)
    return upset_shifts(patient.shifts, flips, generator)


Strike = Callable[[Patient, np.ndarray, float, np.random.Generator], Struck]
MEMORIES: dict[str, Strike] = {"weights": _weights, "shifts": _shifts, "maps": _maps, "image": _image}
