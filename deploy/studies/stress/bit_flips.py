"""`stress --bit-flips`: measure the cost of bit flips, and the benefit and cost of guards.

Flips are injected into weights, shifts, feature maps or the image, one kind of memory at a time.
Then the DPU's arithmetic runs in integers.
"""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import exp

import numpy as np

from beers_deploy.dpu.board import Dpu, dpu_of
from beers_deploy.dpu.cost.latency import Prediction
from beers_deploy.dpu.cost.model import Constants
from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.model.progress import steps
from beers_deploy.model.self_check import SelfCheck
from beers_deploy.performance.swath import predict_network
from beers_deploy.profiles.figures import Row, measured, predicted, unavailable
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.graph import Activation
from beers_deploy.quant.integer.reference import NO_FAULTS
from beers_deploy.quant.samples.simulated import HELD_OUT_SEED, Calibration
from beers_deploy.report.plots import Curve, curves_svg
from beers_deploy.results import Table
from beers_deploy.studies.stress import faults
from beers_deploy.studies.stress.networks import Subject

CALIBRATION_PATCHES = 16


HEADINGS = {
    "bit flips": "Quality against bit flips",
    "guards": "What guards cost on the board",
}
CURVE_NOTE = (
    "PSNR, mean and range over patches and injections; one kind of memory at a time. clamped: "
    "ReLU6 and the limit of the correction. all guards: scrubbing and triple modular redundancy "
    "too, before the image; what flips in the weights after that stays for this tile."
)
GUARD_NOTE = (
    "ReLU6 only where calibration stays below 96 units. Three of the guards are the host's time; "
    "the DPU is busy meanwhile, so nothing is lost while the host has time left."
)


def flip_table(subject: Subject, source: Calibration, board: TargetProfile) -> Table:
    """Measure the loss of quality by bit flips, and predict the cost of guards against them, as
    `stress --bit-flips` reports both.

    Args:
        subject: the networks under test, of which the INT8 one is used.
        source: the simulated patches on which flips are tried. Their number is also the number of
            injections into each kind of memory at each rate.
        board: the board whose cost model predicts the cost of the guards.

    Raises:
        ModelError: there is no INT8 network, or it has no integer core as the board stores it.
        BeersError: the board states no constants for the prediction.
    """
    # A file without an integer core is refused before anything is drawn.
    _ = subject.core
    dpu = dpu_of(board)
    prediction = predict_network(subject.quantized.source, dpu, TILE_PX)
    # A board that cannot predict the cost of the guards is refused as well.
    dpu.limit("cpu", "clock_ghz")
    target = make_target(subject, source)
    curves = curve_rows(target, source.patches, source.seed)
    return Table(
        command="stress",
        inputs=subject.inputs,
        rows=(*curves, *guard_rows(target, prediction, dpu)),
        notes=(CURVE_NOTE, GUARD_NOTE),
        headings=HEADINGS,
    )


@dataclass(frozen=True)
class FaultTarget:
    """A network prepared for the injection of bit flips, and the patches on which they are tried.

    Attributes:
        core: the integer operations of the network, with weights as the board stores them.
        guards: the bounds and checksums that protect the network, learnt from calibration patches.
        pairs: the degraded and the reference image of each patch, (1, 1, H, W) in [0, 1] each.
        checks: for each patch the self-check of its sensor, which compares the restored patch,
            blurred as the sensor blurs, with the degraded one.
    """

    core: IntCore
    guards: faults.Guards
    pairs: Sequence[tuple[np.ndarray, np.ndarray]]
    checks: Sequence[SelfCheck]


def make_target(subject: Subject, source: Calibration) -> FaultTarget:
    """Prepare a network for the injection of bit flips: stored integers, guards, patches and
    self-checks.

    Args:
        subject: the networks under test, of which the INT8 one is used.
        source: the simulated patches. The guards are learnt from patches of this seed, and flips
            are tried on patches of another seed, so that the guards are not evaluated on the data
            that they were learnt from.

    Raises:
        ModelError: there is no INT8 network, or it has no integer core as the board stores it.
    """
    core = faults.as_stored(subject.core)
    calibration = replace(source, patches=CALIBRATION_PATCHES)
    held_out = replace(source, seed=source.seed + HELD_OUT_SEED)
    guards = faults.learn_guards(
        core, (core.host_part.encode(image) for image in calibration.drawn.degraded)
    )
    patches = held_out.drawn
    aim = source.sensor.reference.nominal()
    checks = [SelfCheck.of(view.degraded, aim, full_scale=1.0) for view in patches.views]
    return FaultTarget(core, guards, list(patches.pairs), checks)


SETS = ("no guard", "clamped", "all guards")


def name_of(memory: str, rate: float) -> str:
    """Return the name of the row of results for a kind of memory and a rate.

    Args:
        memory: the kind of memory, one of `faults.MEMORIES`.
        rate: the mean number of bit flips in a megabit of 10^6 bits.
    """
    return f"{memory}, {rate:g} in a megabit"


Quality = tuple[float, float, float]
"""PSNR in dB with each set of guards."""
COSTLY_DB = 0.5
"""A flip that costs an unguarded patch more than this should be found by the self-check."""


@dataclass(frozen=True)
class Injection:
    """The effect of the bit flips of one injection on one patch.

    Attributes:
        flips: the number of flipped bits.
        quality: the PSNR in dB of the restored patch with each of the `SETS` of guards.
        costly: True if the flips cost more than COSTLY_DB without a guard, and the self-check could
            show it, because the patch has blocks that are not too smooth.
        detected: True if the self-check finds that the unguarded result contradicts the patch.
    """

    flips: int
    quality: Quality
    costly: bool = False
    detected: bool = False


def curve_rows(target: FaultTarget, draws: int, seed: int) -> list[Row]:
    """Measure the PSNR of restored patches without bit flips, and with flips in each kind of memory
    at each rate.

    Args:
        target: the network, its guards and the patches.
        draws: the number of injections for each kind of memory and rate. Kinds that are seldom hit
            get a multiple of it.
        seed: the seed of the flips.

    Returns:
        The rows of the table "bit flips": for each set of guards the mean PSNR in dB and its range,
        and the share of costly injections that the self-check found.
    """
    clean = []
    for image, reference in target.pairs:
        intact = faults.Injected(target.core, NO_FAULTS, image, 0)
        bare, clamped = (_quality_db(intact, guards, reference) for guards in (None, target.guards))
        clean.append((bare, clamped, clamped))
    rows = [_curve_row("none", [Injection(0, quality) for quality in clean], "patches")]
    count = sum(len(memory.rates) * memory.times for memory in faults.MEMORIES.values()) * draws
    with steps("flipping bits", count) as bar:
        for name, memory in faults.MEMORIES.items():
            for rate in memory.rates:
                injections = []
                for draw in range(memory.times * draws):
                    injections.append(
                        _drawn(target, name, rate, draw, seed, clean[draw % len(clean)])
                    )
                    bar.advance()
                rows.append(_curve_row(name_of(name, rate), injections, "draws"))
    return rows


def _quality_db(
    injected: faults.Injected, guards: faults.Guards | None, reference: np.ndarray
) -> float:
    """Return the PSNR in dB of a patch that is restored with faults.

    Args:
        injected: the network and the patch after an injection.
        guards: the bounds that are applied; None applies none.
        reference: the reference image of the patch, (1, 1, H, W) in [0, 1].
    """
    return psnr_db(faults.restored(injected, guards), reference, 1.0)


def _drawn(
    target: FaultTarget, name: str, rate: float, draw: int, seed: int, clean: Quality
) -> Injection:
    """Flip bits of a memory once, and return the effect.

    Args:
        target: the network, its guards and the patches.
        name: the name of the kind of memory.
        rate: flips in a megabit.
        draw: number of the injection, which also chooses the patch.
        seed: the seed of the flips.
        clean: PSNR in dB of the same patch without faults, with each set of guards.
    """
    image, reference = target.pairs[draw % len(target.pairs)]
    memory = faults.MEMORIES[name]
    # Keyed by what is drawn, so that a draw is the same whatever else runs.
    key = [seed, draw, list(faults.MEMORIES).index(name), memory.rates.index(rate)]
    generator = np.random.default_rng(key)
    injected = memory.inject(target.core, image, rate, generator)
    # No flip, no change: the fault-free figures stand, at no cost.
    if injected.flips == 0:
        return Injection(0, clean)
    unguarded = faults.restored(injected)
    bare = psnr_db(unguarded, reference, 1.0)
    clamped = _quality_db(injected, target.guards, reference)
    guarded = clamped
    if memory.persistent:
        repaired = faults.corrected(injected, target.core, target.guards, rate, generator)
        guarded = _quality_db(repaired, target.guards, reference)
    sides = (Placed(side, 0, 0, side) for side in image.shape[2:])
    check = target.checks[draw % len(target.pairs)]
    blocks = check.judge(injected.image[0, 0].astype(np.float32), unguarded[0, 0], *sides)
    return Injection(
        injected.flips,
        (bare, clamped, guarded),
        costly=clean[0] - bare > COSTLY_DB and bool(blocks.decidable.any()),
        detected=bool(blocks.outside.any()),
    )


def _curve_row(name: str, draws: Sequence[Injection], kind: str) -> Row:
    """Return the row of some injections: means of the flips and of the PSNR, and the number of
    those detected.

    Args:
        name: the name of the row.
        draws: the injections, at least one.
        kind: what is counted, such as "draws", for the source of the figures.
    """
    source = f"integer reference, mean and range of {len(draws)} {kind}"
    flips = measured(float(np.mean([draw.flips for draw in draws])), "bits", source)
    figures = {"flips": flips}
    by_guards = zip(*(draw.quality for draw in draws), strict=True)
    for guards, values in zip(SETS, by_guards, strict=True):
        # The sum is exact and rounded once, so the mean of equal values does not depend on their
        # number.
        figures[guards] = measured(
            statistics.mean(values), "dB", source, (min(values), max(values))
        )
    costly = [draw.detected for draw in draws if draw.costly]
    about = (
        f"{len(costly)} of {len(draws)} {kind} lost more than {COSTLY_DB:g} dB unguarded, in a "
        "patch that the self-check can decide"
    )
    if costly:
        figures["found by the self-check"] = measured(100 * float(np.mean(costly)), "%", about)
    elif name != "none":
        figures["found by the self-check"] = unavailable("%", about)
    return Row("bit flips", name, figures)


FUSED = "fused into the convolution (UG1414 3.5)"
INSTRUCTED = "two instructions of 16 values, one a cycle of the host's slowest clock (assumed)"
READ = (
    "bytes over the rate at which the host hands them to the DPU "
    "(fitted, docs/explanation/cost-model.md; assumed to hold here)"
)
AT_ONCE = 16
INSTRUCTIONS = 2


def guard_rows(target: FaultTarget, prediction: Prediction, dpu: Dpu) -> list[Row]:
    """Predict the cost of each guard against bit flips, and of all of them, on a board.

    Args:
        target: the network and its guards.
        prediction: the time that the cost model predicts for the network on the board.
        dpu: the DPU of the board, whose profile also states the clock and cores of the host.

    Returns:
        The rows of the table "guards": the time for each tile of 640 x 640 pixels, its share of the
        tile's time, and the loss of frame rate.
    """
    relus = sum(op.activation is Activation.relu for op in target.core.convolutions)
    # The rate is fitted for one core.
    rate = Constants.of(dpu).host_in_bytes_per_s * dpu.whole("cpu", "cores")
    clock_hz = 1e9 * dpu.limit("cpu", "clock_ghz").low
    copies = len(target.core.host_part.decoding.gains)
    limit_s = INSTRUCTIONS * copies * TILE_PX**2 / AT_ONCE / clock_hz
    scrubbing_s = faults.weight_bits(target.core) / faults.INT8_BITS / rate
    # A shift is read as one byte from each of the three copies.
    copies_s = 3 * len(faults.shifts_of(target.core)) / rate
    guards = {
        f"ReLU6 at {len(target.guards.relu6)} of {relus} ReLUs": (0.0, FUSED),
        f"limit of the correction, {target.guards.limit_dn:g} DN": (limit_s, INSTRUCTED),
        "scrubbing of all weights": (scrubbing_s, READ),
        "triple modular redundancy of the shifts": (copies_s, READ),
        "all guards": (limit_s + scrubbing_s + copies_s, f"{INSTRUCTED}; {READ}"),
    }
    error_factor = exp(dpu.value("cost", "width_outside"))
    tile_s = prediction.batch_time_s / prediction.batch
    slow, fast = prediction.fps_interval
    rows = []
    for name, (time_s, source) in guards.items():
        # The host prepares the next tile while the DPU runs. Only the time beyond that reduces the
        # frame rate.
        before_s = max(tile_s, prediction.host_s)
        beside_s = max(tile_s, prediction.host_s + time_s)
        low_s = time_s / error_factor
        high_s = time_s * error_factor
        # The share is largest at the highest frame rate, where a tile needs the least time.
        most = 100 * high_s * fast
        loss = 100 * (1 - before_s / beside_s)
        figures = {
            "time": predicted(1e3 * time_s, "ms/tile", (1e3 * low_s, 1e3 * high_s), source),
            "of a tile, if nothing hides": predicted(
                100 * time_s / tile_s, "%", (100 * low_s * slow, most), source
            ),
            "frame rate lost beside the DPU": predicted(loss, "%", (0.0, most), source),
        }
        rows.append(Row("guards", name, figures))
    return rows


def flip_curves_svg(networks: Mapping[str, Sequence[Row]]) -> str:
    """Draw PSNR against the rate of bit flips, with all guards and, dashed, with none.

    Args:
        networks: the rows that `curve_rows` returns for each network, by the name of the network.
            Rows of other tables are left out.

    Returns:
        The text of an SVG file with a panel for each kind of memory.
    """
    rows_of = {
        name: {row.name: row.figures for row in rows if row.table == "bit flips"}
        for name, rows in networks.items()
    }
    panels = []
    for memory, kind in faults.MEMORIES.items():
        curves = []
        for (colour, name), guards in product(enumerate(rows_of), ("all guards", "no guard")):
            figures = (rows_of[name][name_of(memory, rate)][guards] for rate in kind.rates)
            values = (figure.value or 0.0 for figure in figures)
            points = tuple(zip(kind.rates, values, strict=True))
            curves.append(Curve(f"{name}, {guards}", colour, guards == "no guard", points))
        panels.append((memory, curves))
    return curves_svg(panels, "bit flips in a megabit", "PSNR, dB (measured)")
