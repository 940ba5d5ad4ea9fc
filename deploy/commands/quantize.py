"""`beers-deploy quantize`: float ONNX to static INT8 under the DPU's rules."""

from pathlib import Path
from typing import Annotated, Any

import typer

from beers_deploy.commands.shared import (
    RULED,
    Json,
    Seed,
    arguments,
    board_for,
    refuse,
    save,
    save_core,
    say,
)
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.errors import OptionError, optional
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import DEFAULT_TARGET

TITLES = {
    "integer layers": "integer layers",
    "rounding": "tie rounding",
    "gate": "float against INT8, on patches that calibration did not see",
}
"""Of the tables that are shown, by the rows' own."""


def quantize(
    context: typer.Context,
    model: Annotated[
        Path,
        typer.Argument(
            help="Float ONNX or weights, or a shipped network's name, then for --sensor."
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="INT8 ONNX for stock onnxruntime.")],
    target: Annotated[str, typer.Option(help=f"Whose rules to obey: {RULED}.")] = DEFAULT_TARGET,
    sensor: Annotated[
        str, typer.Option(help="Profile that calibration patches are drawn from.")
    ] = SENSOR,
    board_file: Annotated[
        Path | None,
        typer.Option(
            help="Also write the core in the board's encoding: QDQ ONNX, of an NPU VINT8."
        ),
    ] = None,
    tile: Annotated[
        int | None,
        typer.Option(
            min=16, max=8192, help="Fix --board-file to one tile of this side, as an NPU's must be."
        ),
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="Folder of scenes for calibration; drawn ones if none.")
    ] = None,
    samples: Annotated[
        Path | None,
        typer.Option(
            help="Your own samples in place of simulated patches: .npy or .npz (N, C, H, W), or "
            "a folder."
        ),
    ] = None,
    patches: Annotated[int, typer.Option(min=1, max=100_000, help="Calibration patches.")] = 64,
    patch: Annotated[
        int, typer.Option(min=32, max=2048, help="Side of a calibration patch in pixels.")
    ] = 128,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Folder for report.html and report.json: which layers and patches err, and how."
        ),
    ] = None,
    finetune: Annotated[
        str,
        typer.Option(
            help="Steps that train the INT8 numbers on --images or --samples; 'auto': minutes, "
            "while it helps."
        ),
    ] = "0",
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Quantise to int8 with power-of-two scales: the correction on the DPU, the add on the host.

    Taken is any network that a DPU computes; see docs/reference/any-network.md, and ask 'check'
    about a float file. Prints each integer layer: bits of its accumulator, seen and proven, and the
    share of saturated results.
    """
    from beers_deploy.baseline import data_inputs
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.profiles.figures import by_table
    from beers_deploy.quant.encodings import read_core
    from beers_deploy.quant.onnx_file import metadata, require_onnx_name
    from beers_deploy.quant.sample_range import recorded_range
    from beers_deploy.quantise import losses_of, sensitivity_report
    from beers_deploy.quantise import quantize as quantised
    from beers_deploy.report.page import write_report
    from beers_deploy.results import Table, print_rows

    page, figures = _report_files(report, model)
    _refuse_unused(context, board_file, samples)
    inputs = (model, images, samples, *map(Path, (target, sensor)))
    require_writable(out, board_file, json, page, figures, inputs=inputs)
    require_onnx_name(out, board_file)
    board = board_for(target, board_file, tile, inputs)
    profile = Sensor.load(sensor)
    calibration: dict[str, Any] = {
        "sensor": profile,
        "images": images,
        "patches": patches,
        "seed": seed,
    }
    network = quantised(
        model, samples, board=board, patch_px=patch, finetune=finetune, **calibration
    )
    # Both are made before the first is written: a core that is refused leaves no file.
    core = network.core(board, tile) if board_file else None
    network.save(out)
    summary = (
        f", {network.quantised.relus} ReLUs kept" if network.quantised else f", told {profile.name}"
    )
    say(f"wrote {out}: {len(read_core(network.model).ops)} integer operations{summary}")
    save_core(core, board_file, board)
    covered = recorded_range(metadata(network.model))
    if covered is not None:
        say(f"calibration: {covered}")
    if network.quantised:
        say(losses_of(network, samples, patch_px=patch, **calibration))
    rows = list(network.layers)
    for title, part in by_table(rows).items():
        print_rows(TITLES[title], part)
    if page is not None:
        error_rows, error_report = sensitivity_report(
            network, samples, rows, patch_px=patch, **calibration
        )
        write_report(error_report, page)
        say(f"wrote {page}: {error_report.headline}")
        rows = [*error_rows, *rows]
    origin = network.origin.input if network.origin else model
    document = Table(
        "quantize", arguments(), (origin, out, *data_inputs(images, samples)), tuple(rows)
    )
    for path in (figures, json):
        save(document, path)


def _refuse_unused(context: typer.Context, board_file: Path | None, samples: Path | None) -> None:
    """Refuse options that would do nothing."""
    if board_file is None:
        refuse(context, ["tile"], expected="--board-file beside it")
    if samples is not None:
        unused = ("images", "patches", "patch", "seed")
        refuse(context, unused, expected="none together with --samples", got="one")


def _report_files(folder: Path | None, model: Path) -> tuple[Path, Path] | tuple[None, None]:
    """The page and the figures of --report, which matplotlib draws."""
    from beers_deploy.network_files import conditioned

    if folder is None:
        return None, None
    if conditioned(model):
        expected = "a network that is calibrated by itself"
        remedy = "leave it out"
        raise OptionError("--report", expected=expected, got="one behind a bank", remedy=remedy)
    # A missing package is refused before the network is calibrated.
    optional("matplotlib", "--report")
    return folder / "report.html", folder / "report.json"
