"""One float network quantised: the files, the tables and the report that the command `quantize` leaves.

Layer by layer in whole numbers, and which layers and patches err.
"""

from collections.abc import Callable
from pathlib import Path

import onnx

from beers_deploy.model.progress import Log, progress
from beers_deploy.networks import Conditioned, family_model, told_int8
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.target import TargetProfile, board_names
from beers_deploy.quant.calibration import Calibration, Patches
from beers_deploy.quant.core import IntCore, Shifts, target_shifts
from beers_deploy.quant.encodings import board_model, read_core
from beers_deploy.quant.free import quantise_free
from beers_deploy.quant.gate import compare, gate_row
from beers_deploy.quant.integer import integer_rows
from beers_deploy.quant.onnx_file import metadata, save_onnx
from beers_deploy.quant.passes.tune import Tuning
from beers_deploy.quant.quantise import Quantised, quantise_model
from beers_deploy.quant.samples import OwnSamples
from beers_deploy.quant.sensitivity import WORST, headline, layer_error_rows, sizes_row, spread_of, worst_row
from beers_deploy.quant.session import open_any_size
from beers_deploy.report.page import Report, write_report
from beers_deploy.report.sensitivity_page import sensitivity_page


def sensitivity_report(
    model: onnx.ModelProto, result: Quantised, held_out: Patches, more: list[Row]
) -> tuple[list[Row], Report]:
    """Where INT8 errs on patches that calibration did not see: the rows, and the page with those of `more` after."""
    sessions = open_any_size(model), open_any_size(result.host)
    gate, spread = compare(*sessions, held_out.pairs), spread_of(*sessions, held_out.degraded)
    worst = spread.worst(WORST)
    layers = layer_error_rows(result, held_out)
    rows = [gate_row(gate), *layers, *(worst_row(k, held_out, spread) for k in worst), sizes_row(spread)]
    return rows, sensitivity_page(headline(gate, layers), [*rows, *more], spread, held_out, sessions, worst)


Source = Calibration | OwnSamples
"""Where patches come from: simulated ones, or a user's own."""
Show = Callable[[str, list[Row]], None]
"""Shows a table under its title as soon as it is made."""


def quantise_free_file(model: onnx.ModelProto, calibration: Source, out: Path, log: Log, show: Show) -> list[Row]:
    """Write the INT8 file without the DPU's rules, and compare it with the float network."""
    with progress("calibrating") as step:
        made = quantise_free(model, calibration.drawn, calibration.about, step)
    save_onnx(made, out)
    log(f"wrote {out}: float scales, for boards that are not the DPU")
    sessions, simulated = (open_any_size(model), open_any_size(made)), isinstance(calibration, Calibration)
    row = gate_row(compare(*sessions, calibration.unseen.pairs, simulated))
    show("float against INT8, on patches that calibration did not see", [row])
    return [row]


def quantise_legal_file(
    model: onnx.ModelProto,
    calibration: Source,
    target: TargetProfile,
    out: Path,
    log: Log,
    show: Show,
    *,
    board: Path | None = None,
    page: Path | None = None,
    finetune: int = 0,
) -> list[Row]:
    """Write the INT8 file under the target's rules; show each integer layer.

    Args:
        model: the float network.
        calibration: where its patches come from.
        target: whose rules to obey.
        out: the host's file.
        log: is told what was written.
        show: shows the tables.
        board: the board's file, or None.
        page: of the errors of layers and patches, or None.
        finetune: for how many steps the whole numbers are trained.

    Raises:
        OptionError: a target without a DPU.
    """
    shifts = _shifts_of(target)
    tuning = Tuning(calibration.for_tuning.pairs, finetune) if finetune else None
    with progress("calibrating") as step:
        about = {**calibration.about, "target": target.name}
        result = quantise_model(model, calibration.drawn, about, shifts, tuning, log=step)
    save_onnx(result.host, out)
    log(f"wrote {out}: {len(result.core.ops)} integer operations, {result.relus} ReLUs kept")
    if board is not None:
        save_onnx(result.board, board)
        log(f"wrote {board}: the same numbers in the board's encoding")
    rows = _layers(model, result.core, result.host, calibration.drawn, show)
    return _with_sensitivity(model, result, calibration, rows, page, log) if page else rows


def quantise_banked_file(
    network: Conditioned,
    calibration: Calibration,
    target: TargetProfile,
    out: Path,
    board: Path | None,
    log: Log,
    show: Show,
) -> list[Row]:
    """Write the INT8 file of a network behind a bank, told a sensor; show each integer layer on its patches.

    Args:
        network: of weights that 'train --conditioned' wrote.
        calibration: scenes and seed of the family's patches, and the sensor that is told.
        target: whose rules to obey.
        out: the host's file.
        board: the board's, or None.
        log: is told what was written.
        show: shows the tables.

    Raises:
        OptionError: a target without a DPU.
        ModelError: other weights.
    """
    sensor, made = load_sensor(calibration.sensor), {"target": target.name}
    family = family_model(network, calibration.images, calibration.seed, _shifts_of(target))
    host = told_int8(family, sensor, made, log)
    core = read_core(host)
    save_onnx(host, out)
    log(f"wrote {out}: {len(core.ops)} integer operations, for {sensor.name}; any sensor in range can be told to it")
    if board is not None:
        save_onnx(board_model(core, metadata(host)), board)
        log(f"wrote {board}: the same numbers in the board's encoding")
    return _layers(network.model(sensor, int8=False), core, host, calibration.drawn, show)


def _layers(model: onnx.ModelProto, core: IntCore, host: onnx.ModelProto, patches: Patches, show: Show) -> list[Row]:
    """Each integer layer, and what rounding ties up or to even makes of the result: shown, and returned."""
    layers, rounding = integer_rows(model, core, host, patches.degraded)
    show("integer layers", layers)
    show("tie rounding", [rounding])
    return [*layers, rounding]


def _shifts_of(target: TargetProfile) -> Shifts:
    if not target.configurations:
        expected = f"a target with a DPU: {', '.join(board_names())}"
        remedy = "choose another, or take --regime free"
        raise OptionError("--target", expected=expected, got=repr(target.name), remedy=remedy)
    return target_shifts(target)


def _with_sensitivity(
    model: onnx.ModelProto, result: Quantised, calibration: Source, rows: list[Row], page: Path, log: Log
) -> list[Row]:
    found, written = sensitivity_report(model, result, calibration.unseen, rows)
    write_report(written, page)
    log(f"wrote {page}: {written.headline}")
    return [*found, *rows]
