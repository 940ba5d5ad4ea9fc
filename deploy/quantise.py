"""One float network quantised: the files, the tables and the report that the command `quantize` leaves.

Layer by layer in whole numbers, what each pass buys on patches that it has not seen, and which layers and patches
err.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import onnx

from deploy.networks import Conditioned, family_model, told_int8
from deploy.report.page import Report, write_report
from deploy.report.sensitivity_page import sensitivity_page
from model.progress import steps
from profiles import load_sensor
from profiles.errors import OptionError
from profiles.figures import Row
from profiles.target import TargetProfile, board_names
from quant.calibration import Calibration, Patches
from quant.core import Shifts, target_shifts
from quant.encodings import board_model, read_core
from quant.free import free_ticks, quantise_free
from quant.gate import compare, gate_row
from quant.integer import integer_rows
from quant.onnx_file import metadata, save_onnx
from quant.passes.tune import Tuning
from quant.quantise import Passes, Quantised, ablation_rows, ablations, quantise_model, ticks
from quant.samples import OwnSamples
from quant.sensitivity import WORST, headline, layer_error_rows, sizes_row, spread_of, worst_row
from quant.session import LAYER_PATCHES, open_any_size


def sensitivity_report(
    model: onnx.ModelProto, result: Quantised, held_out: Patches, more: list[Row], tick: Callable[[], None]
) -> tuple[list[Row], Report]:
    """Where INT8 errs on patches that calibration did not see: the rows, and the page with those of `more` after."""
    sessions = open_any_size(model), open_any_size(result.host)
    gate, spread = compare(*sessions, held_out.pairs), spread_of(*sessions, held_out.degraded)
    worst = spread.worst(WORST)
    layers = layer_error_rows(result, held_out, tick)
    rows = [gate_row(gate), *layers, *(worst_row(k, held_out, spread) for k in worst), sizes_row(spread)]
    return rows, sensitivity_page(headline(gate, layers), [*rows, *more], spread, held_out, sessions, worst)


Source = Calibration | OwnSamples
"""Where patches come from: simulated ones, or a user's own."""
Say = Callable[[str], None]
"""Tells a sentence as the work goes on."""
Show = Callable[[str, list[Row]], None]
"""Shows a table under its title as soon as it is made."""


@dataclass(frozen=True)
class Wanted:
    """What a run is to write and to show besides the INT8 file, and for how many steps to train its numbers."""

    board: Path | None
    ablate: bool
    page: Path | None
    finetune: int = 0


def quantise_free_file(model: onnx.ModelProto, calibration: Source, out: Path, say: Say, show: Show) -> list[Row]:
    """Write the INT8 file without the DPU's rules, and compare it with the float network."""
    with steps("calibrating", free_ticks(model, calibration.patches)) as bar:
        made = quantise_free(model, calibration.drawn, calibration.about, bar.advance)
    save_onnx(made, out)
    say(f"wrote {out}: float scales, for boards that are not the DPU")
    sessions, simulated = (open_any_size(model), open_any_size(made)), isinstance(calibration, Calibration)
    row = gate_row(compare(*sessions, calibration.unseen.pairs, simulated))
    show("float against INT8, on patches that calibration did not see", [row])
    return [row]


def quantise_legal_file(
    model: onnx.ModelProto,
    calibration: Source,
    target: TargetProfile,
    passes: Passes,
    out: Path,
    wanted: Wanted,
    say: Say,
    show: Show,
) -> list[Row]:
    """Write the INT8 file under the target's rules and whatever else is wanted; show each integer layer.

    Raises:
        OptionError: a target without a DPU.
    """
    shifts = _shifts_of(target)
    tuning = Tuning(calibration.for_tuning.pairs, wanted.finetune) if wanted.finetune else None
    with steps("calibrating", ticks(model, calibration.patches, passes) + wanted.finetune) as bar:
        about = {**calibration.about, "target": target.name}
        result = quantise_model(model, calibration.drawn, about, bar.advance, passes, shifts, tuning)
    save_onnx(result.host, out)
    say(f"wrote {out}: {len(result.core.ops)} integer operations, {result.relus} ReLUs kept")
    if wanted.board is not None:
        save_onnx(result.board, wanted.board)
        say(f"wrote {wanted.board}: the same numbers in the board's encoding")
    images = calibration.drawn.degraded
    layers, rounding = integer_rows(model, result.core, result.host, images)
    show("integer layers", layers)
    show("tie rounding", [rounding])
    rows = [*layers, rounding, *(_ablated(model, calibration, shifts, show) if wanted.ablate else [])]
    return _with_sensitivity(model, result, calibration, rows, wanted.page, say) if wanted.page else rows


def quantise_banked_file(
    network: Conditioned,
    calibration: Calibration,
    target: TargetProfile,
    out: Path,
    board: Path | None,
    say: Say,
    show: Show,
) -> list[Row]:
    """Write the INT8 file of a network behind a bank, told a sensor; show each integer layer on its patches.

    Args:
        network: of weights that 'train --conditioned' wrote.
        calibration: scenes and seed of the family's patches, and the sensor that is told.
        target: whose rules to obey.
        out: the host's file.
        board: the board's, or None.
        say: tells what was written.
        show: shows the tables.

    Raises:
        OptionError: a target without a DPU.
        ModelError: other weights.
    """
    sensor, made = load_sensor(calibration.sensor), {"target": target.name}
    family = family_model(network, calibration.images, calibration.seed, _shifts_of(target))
    host = told_int8(family, sensor, made, say)
    core = read_core(host)
    save_onnx(host, out)
    say(f"wrote {out}: {len(core.ops)} integer operations, for {sensor.name}; any sensor in range can be told to it")
    if board is not None:
        save_onnx(board_model(core, metadata(host)), board)
        say(f"wrote {board}: the same numbers in the board's encoding")
    model, patches = network.model(sensor, int8=False), calibration.drawn.degraded
    layers, rounding = integer_rows(model, core, host, patches)
    show("integer layers", layers)
    show("tie rounding", [rounding])
    return [*layers, rounding]


def _shifts_of(target: TargetProfile) -> Shifts:
    if not target.configurations:
        expected = f"a target with a DPU: {', '.join(board_names())}"
        remedy = "choose another, or take --regime free"
        raise OptionError("--target", expected=expected, got=repr(target.name), remedy=remedy)
    return target_shifts(target)


def _ablated(model: onnx.ModelProto, calibration: Source, shifts: Shifts, show: Show) -> list[Row]:
    with steps("ablating", len(ablations())) as bar:
        rows = ablation_rows(model, calibration.drawn, calibration.unseen, bar.advance, shifts)
    show("what each pass buys, on patches that calibration did not see", rows)
    return rows


def _with_sensitivity(
    model: onnx.ModelProto, result: Quantised, calibration: Source, rows: list[Row], page: Path, say: Say
) -> list[Row]:
    with steps("attributing errors", LAYER_PATCHES) as bar:
        found, written = sensitivity_report(model, result, calibration.unseen, rows, bar.advance)
    write_report(written, page)
    say(f"wrote {page}: {written.headline}")
    return [*found, *rows]
