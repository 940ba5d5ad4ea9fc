"""`stress --bit-flips`: what bit flips cost, and what guards buy back and cost.

Flips are injected into weights, shifts, feature maps or the image, one kind of memory at a time; the DPU's arithmetic
then runs in whole numbers.
"""

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import exp
from pathlib import Path

import numpy as np

from deploy.bench.tables import predict_file
from deploy.dpu.board import Dpu, load_dpu
from deploy.dpu.cost.latency import Prediction
from deploy.dpu.cost.model import Constants
from deploy.report.plots import Curve, Panel, curves_svg
from deploy.restoration.options import TILE_PX
from deploy.studies.stress.faults import (
    INT8_BITS,
    PIXEL_BITS,
    SHIFT_BITS,
    Guards,
    Shifts,
    as_stored,
    bits_apart,
    checksums,
    flip_bits,
    flip_count,
    flip_shifts,
    flip_weights,
    guarded,
    learn_guards,
    map_channels,
    scrubbed,
    shifts_of,
    voted,
    weight_bits,
)
from deploy.studies.stress.networks import Subject
from model.io.images import MAX_DN
from model.metrics.fidelity import psnr_db
from model.progress import steps
from profiles.figures import Figure, Row, measured, predicted
from quant.calibration import HELD_OUT_SEED, Calibration
from quant.core import IntCore
from quant.graph import Activation
from quant.integer import SOUND, Faults, merged_correction, run_core

CALIBRATION_PATCHES = 16


@dataclass(frozen=True)
class FlipRequest:
    """What to inject faults into, and how often.

    Attributes:
        sensor: profile of the degraded patches.
        images: folder of scenes; drawn ones where there is none.
        target: board whose cost model prices the guards.
        draws: injections into each kind of memory at each rate.
        size_px: side of a patch.
        seed: of patches and injections.
    """

    sensor: str
    images: Path | None
    target: str
    draws: int
    size_px: int
    seed: int


def flip_rows(subject: Subject, request: FlipRequest) -> list[Row]:
    """The rows of the whole study: quality against flips, and what guards cost.

    Raises:
        ModelError: no INT8 file, or one whose whole numbers cannot be told.
        BeersError: no such target, sensor or images.
    """
    _ = subject.core  # refused before anything is drawn
    dpu = load_dpu(request.target, None)
    prediction = predict_file(subject.paths[-1], dpu, TILE_PX)
    dpu.limit("cpu", "clock_ghz")  # and so is a board that cannot price the guards
    target = make_target(subject, request)
    return [*curve_rows(target, request.draws, request.seed), *price_rows(target, prediction, dpu)]


@dataclass(frozen=True)
class FaultTarget:
    """What faults are injected into.

    Attributes:
        core: the network as the board stores it.
        guards: learnt from calibration patches.
        pairs: patches that it restores, degraded and reference, (1, 1, H, W) in [0, 1] each.
    """

    core: IntCore
    guards: Guards
    pairs: Sequence[tuple[np.ndarray, np.ndarray]]

    @cached_property
    def shifts(self) -> Shifts:
        """The shifts of every operation, free of faults."""
        return shifts_of(self.core)


def make_target(subject: Subject, request: FlipRequest) -> FaultTarget:
    """The core as the board stores it, guards that calibration patches teach, and other patches to try it on."""
    core = as_stored(subject.core)
    taught, tried = (
        Calibration(request.sensor, request.images, count, request.size_px, seed).drawn
        for seed, count in ((request.seed, CALIBRATION_PATCHES), (request.seed + HELD_OUT_SEED, request.draws))
    )
    guards = learn_guards(core, (core.ends.split(image) for image in taught.degraded))
    return FaultTarget(core, guards, list(tried.pairs))


@dataclass(frozen=True)
class Injected:
    """A network and an image after an injection.

    Attributes:
        core: with the weights as they are now.
        faults: what else is wrong.
        image: (1, 1, H, W), as it is now.
        flips: how many bits were flipped.
    """

    core: IntCore
    faults: Faults
    image: np.ndarray
    flips: int


def restored(target: FaultTarget, injected: Injected, clamped: bool = False) -> np.ndarray:
    """The restored image (1, 1, H, W) in [0, 1]; `clamped` turns the ReLU6 and the limit of the correction on."""
    faults = guarded(injected.faults, target.guards) if clamped else injected.faults
    tensors, _ = run_core(injected.core, injected.core.ends.split(injected.image), faults=faults)
    correction = merged_correction(injected.core, tensors)
    correction = target.guards.limit(correction) if clamped else correction
    return np.asarray(injected.core.ends.finished(injected.image, correction), np.float32)


def _quality_db(target: FaultTarget, injected: Injected, reference: np.ndarray, clamped: bool) -> float:
    return psnr_db(restored(target, injected, clamped), reference, 1.0)


def _weights(target: FaultTarget, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Injected:
    flips = flip_count(weight_bits(target.core), per_megabit, generator)
    return Injected(flip_weights(target.core, flips, generator), SOUND, image, flips)


def _shifts(target: FaultTarget, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Injected:
    wrong = _flip_copy(target, per_megabit, generator)
    return Injected(target.core, Faults(wrong), image, bits_apart(wrong, target.shifts))


def _maps(target: FaultTarget, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Injected:
    """Faults enter every tensor once, between the operation that writes it and those that read it."""
    places, channels = image[0, 0].size // target.core.ends.place_px**2, map_channels(target.core)
    counts = {name: flip_count(INT8_BITS * places * n, per_megabit, generator) for name, n in channels.items()}
    seed = int(generator.integers(2**63))
    # The same bits whenever it runs, clamped or not.
    seeds = {name: [seed, number] for number, name in enumerate(counts)}

    def touch(name: str, tensor: np.ndarray) -> np.ndarray:
        if not counts.get(name):
            return tensor
        return flip_bits(tensor, counts[name], np.random.default_rng(seeds[name]))

    return Injected(target.core, Faults({}, touch), image, sum(counts.values()))


def _image(target: FaultTarget, image: np.ndarray, per_megabit: float, generator: np.random.Generator) -> Injected:
    flips = flip_count(PIXEL_BITS * image.size, per_megabit, generator)
    dn = flip_bits(np.rint(image * MAX_DN).astype(np.uint16), flips, generator, PIXEL_BITS)
    return Injected(target.core, SOUND, (dn / np.float32(MAX_DN)).astype(np.float32), flips)


def _flip_copy(target: FaultTarget, per_megabit: float, generator: np.random.Generator) -> Shifts:
    flips = flip_count(SHIFT_BITS * len(target.shifts), per_megabit, generator)
    return flip_shifts(target.shifts, flips, generator)


@dataclass(frozen=True)
class Memory:
    """One kind of memory, and how faults are injected into it.

    Attributes:
        inject: an injection at a rate.
        rates: bit flips in a megabit, of 10^6, that are tried.
        times: so many times the draws asked for, where few of them flip a bit; those that do not cost nothing.
        kept: whether it lives longer than a tile, so that scrubbing has something to compare it with.
    """

    inject: Callable[[FaultTarget, np.ndarray, float, np.random.Generator], Injected]
    rates: tuple[float, ...] = (0.1, 1.0, 10.0, 100.0, 1000.0)
    times: int = 1
    kept: bool = False


MEMORIES = {
    "weights": Memory(_weights, kept=True),
    # There are too few shifts to be hit at rates that matter elsewhere.
    "shifts": Memory(_shifts, (10.0, 100.0, 1000.0, 10_000.0), 10, kept=True),
    "maps": Memory(_maps),
    "image": Memory(_image, times=5),
}
SETS = ("no guard", "clamped", "all guards")


def name_of(memory: str, rate: float) -> str:
    """The name of the row for a kind of memory and a rate."""
    return f"{memory}, {rate:g} in a megabit"


Quality = tuple[float, float, float]
"""PSNR in dB with each set of guards."""


def curve_rows(target: FaultTarget, draws: int, seed: int) -> list[Row]:
    """A row without flips, and one for every kind of memory and rate."""
    clean = [_clean_db(target, number) for number in range(len(target.pairs))]
    rows = [_curve_row("none", [(0, quality) for quality in clean], "patches")]
    with steps("turning bits over", sum(len(m.rates) * m.times * draws for m in MEMORIES.values())) as bar:
        for name, memory in MEMORIES.items():
            for rate in memory.rates:
                found = []
                for draw in range(memory.times * draws):
                    found.append(_drawn(target, name, rate, draw, seed, clean[draw % len(clean)]))
                    bar.advance()
                rows.append(_curve_row(name_of(name, rate), found, "draws"))
    return rows


def _clean_db(target: FaultTarget, number: int) -> Quality:
    """Of a pair without flips."""
    image, reference = target.pairs[number]
    bare, clamped = (_quality_db(target, Injected(target.core, SOUND, image, 0), reference, c) for c in (False, True))
    return bare, clamped, clamped


def _drawn(target: FaultTarget, name: str, rate: float, draw: int, seed: int, clean: Quality) -> tuple[int, Quality]:
    """The bits that one injection into a memory flipped, and what is left of the quality."""
    (image, reference), memory = target.pairs[draw % len(target.pairs)], MEMORIES[name]
    # Keyed by what is drawn, so that a draw is the same whatever else runs.
    generator = np.random.default_rng([seed, draw, list(MEMORIES).index(name), memory.rates.index(rate)])
    injected = memory.inject(target, image, rate, generator)
    # No flip, no change: the fault-free figures stand, at no cost.
    if injected.flips == 0:
        return 0, clean
    bare, clamped = (_quality_db(target, injected, reference, c) for c in (False, True))
    if not memory.kept:
        return injected.flips, (bare, clamped, clamped)
    corrected = _corrected(target, injected, rate, generator)
    whole = clean[1] if _is_sound(target, corrected) else _quality_db(target, corrected, reference, clamped=True)
    return injected.flips, (bare, clamped, whole)


def _corrected(
    target: FaultTarget, injected: Injected, per_megabit: float, generator: np.random.Generator
) -> Injected:
    """The network as scrubbing and triple modular redundancy leave it before the next image.

    The other two copies of the shifts suffer flips at the same rate, each on its own.
    """
    core = scrubbed(injected.core, target.core, target.guards.checksums)
    # The copy that the injection hit is the first of the three.
    first = {**target.shifts, **injected.faults.shifts}
    second, third = (_flip_copy(target, per_megabit, generator) for _ in range(2))
    shifts = voted((first, second, third)) if injected.faults.shifts else {}
    return replace(injected, core=core, faults=replace(injected.faults, shifts=shifts))


def _is_sound(target: FaultTarget, injected: Injected) -> bool:
    """Whether no fault is left in weights and shifts."""
    meant = {**target.shifts, **injected.faults.shifts} == target.shifts
    return meant and checksums(injected.core) == target.guards.checksums


def _curve_row(name: str, draws: Sequence[tuple[int, Quality]], kind: str) -> Row:
    source = f"integer reference, mean and range of {len(draws)} {kind}"
    flips = measured(float(np.mean([count for count, _ in draws])), "bits", source)
    figures = {each: _mean([quality[k] for _, quality in draws], source) for k, each in enumerate(SETS)}
    return Row("bit flips", name, {"flips": flips, **figures})


def _mean(values: Sequence[float], source: str) -> Figure:
    # Exact before it is rounded once: the mean of the same values is the same, however often each stands there.
    return measured(statistics.mean(values), "dB", source, (min(values), max(values)))


FUSED = "fused into the convolution (UG1414 3.5)"
INSTRUCTED = "two instructions of 16 values, one a cycle of the host's slowest clock (assumed)"
READ = (
    "bytes over the rate at which the host hands them to the DPU "
    "(fitted, docs/explanation/cost-model.md; assumed to hold here)"
)
AT_ONCE, INSTRUCTIONS = 16, 2


def price_rows(target: FaultTarget, prediction: Prediction, dpu: Dpu) -> list[Row]:
    """A row a guard and one for all of them, at work for every tile of 640 x 640."""
    relus = sum(op.activation is Activation.relu for op in target.core.convolutions)
    rate = Constants.of(dpu).host_in_bytes_per_s * dpu.whole("cpu", "cores")  # fitted for one core
    clock_hz = 1e9 * dpu.limit("cpu", "clock_ghz").low
    limit_s = INSTRUCTIONS * target.core.ends.gains * TILE_PX**2 / AT_ONCE / clock_hz
    scrubbing_s = weight_bits(target.core) / INT8_BITS / rate
    copies_s = 3 * len(target.shifts) / rate
    spread = exp(dpu.value("cost", "width_outside"))
    guards = {
        f"ReLU6 at {len(target.guards.relu6)} of {relus} ReLUs": (0.0, FUSED),
        f"limit of the correction, {target.guards.limit_dn:g} DN": (limit_s, INSTRUCTED),
        "scrubbing of all weights": (scrubbing_s, READ),
        "triple modular redundancy of the shifts": (copies_s, READ),
        "all guards": (limit_s + scrubbing_s + copies_s, f"{INSTRUCTED}; {READ}"),
    }
    return [_price_row(name, time_s, source, prediction, spread) for name, (time_s, source) in guards.items()]


def _price_row(name: str, time_s: float, source: str, prediction: Prediction, spread: float) -> Row:
    tile_s = prediction.batch_time_s / prediction.batch
    slow, fast = prediction.fps_interval
    # The host prepares the next tile while the DPU runs: only what does not fit beside it costs frames.
    before_s, beside_s = max(tile_s, prediction.host_s), max(tile_s, prediction.host_s + time_s)
    times_s, most = (time_s / spread, time_s * spread), 100 * time_s * spread * fast
    figures = {
        "time": predicted(1e3 * time_s, "ms/tile", (1e3 * times_s[0], 1e3 * times_s[1]), source),
        "of a tile, if nothing hides": predicted(100 * time_s / tile_s, "%", (100 * times_s[0] * slow, most), source),
        "frame rate lost beside the DPU": predicted(100 * (1 - before_s / beside_s), "%", (0.0, most), source),
    }
    return Row("guards", name, figures)


def flip_curves_svg(networks: Mapping[str, Sequence[Row]]) -> str:
    """PSNR against bit flips, with all guards and with none; rows by the network's name."""
    panels = [Panel(memory, _curves(networks, memory)) for memory in MEMORIES]
    return curves_svg(panels, "bit flips in a megabit", "PSNR, dB (measured)")


def _curves(networks: Mapping[str, Sequence[Row]], memory: str) -> list[Curve]:
    curves = []
    for colour, (name, rows) in enumerate(networks.items()):
        by_name = {row.name: row.figures for row in rows if row.table == "bit flips"}
        for guards in ("all guards", "no guard"):
            rates = MEMORIES[memory].rates
            values = ((rate, by_name[name_of(memory, rate)][guards].value) for rate in rates)
            points = tuple((rate, value) for rate, value in values if value is not None)
            curves.append(Curve(f"{name}, {guards}", colour, guards == "no guard", points))
    return curves
