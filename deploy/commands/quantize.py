"""`beers-deploy quantize`: float ONNX to static INT8 under the DPU's rules, or free of them."""

from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import BOARDS, say
from beers_deploy.model.processor import SEEDS
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles import load_sensor, load_target
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.target import DEFAULT_TARGET

EXAMPLE = "quantize float.onnx --target zcu104 --sensor pleiades-degraded --out int8.onnx"


class Regime(StrEnum):
    """Under the rules of the target's DPU, or without them."""

    legal = "legal"
    free = "free"


def quantize(
    model: Annotated[
        Path, typer.Argument(help="Float ONNX or weights, or a shipped network's name, then told --sensor.")
    ],
    out: Annotated[Path, typer.Option(help="INT8 ONNX for the host, runs on stock onnxruntime.")],
    target: Annotated[str, typer.Option(help=f"Whose rules to obey: {BOARDS}.")] = DEFAULT_TARGET,
    sensor: Annotated[str, typer.Option(help="Profile that calibration patches are drawn from.")] = SENSOR,
    regime: Annotated[
        Regime, typer.Option(help="legal: the DPU's rules; free: float scales, a channel's own for weights.")
    ] = Regime.legal,
    board: Annotated[Path | None, typer.Option(help="Also write the DPU's core in the board's encoding.")] = None,
    images: Annotated[Path | None, typer.Option(help="Folder of scenes for calibration; drawn ones if none.")] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Your own samples in place of simulated patches: .npy or .npz (N, C, H, W), or a folder."),
    ] = None,
    patches: Annotated[int, typer.Option(min=1, max=100_000, help="Calibration patches.")] = 64,
    patch: Annotated[int, typer.Option(min=32, max=2048, help="Side of a calibration patch in pixels.")] = 128,
    report: Annotated[
        Path | None,
        typer.Option(help="Folder for report.html and report.json: which layers and patches err, and how."),
    ] = None,
    finetune: Annotated[
        int,
        typer.Option(
            min=0, max=100_000, help="Steps that train the INT8 numbers on --images or --data; some 250, minutes."
        ),
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, max=SEEDS, help="Seed of the patches.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Quantise to int8 with power-of-two scales: the correction on the DPU, the 12-bit add on the host.

    Taken is any network that a DPU computes, of one band or several, with or without a global add; see
    docs/reference/any-network.md. 'check' says of a float file whether it is one of these.

    Prints each integer layer: bits of its accumulator, seen and proven, and the share of saturated results.
    """
    from beers_deploy.export import float_model
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.networks import conditioned, float_file
    from beers_deploy.results import Document, print_rows

    if regime is Regime.free and (board or report or finetune):
        remedy = "leave it out, or take --regime legal"
        expected = "no --board, --report or --finetune"
        raise OptionError("--regime free", expected=expected, got="one", remedy=remedy)
    page, figures = (report / "report.html", report / "report.json") if report else (None, None)
    read = (model, images, data, *map(Path, (target, sensor)))
    require_writable(out, board, json, page, figures, inputs=read)
    known, board_target, banked = load_sensor(sensor), load_target(target), conditioned(model)
    if banked and (regime is Regime.free or report or finetune or data):
        remedy = "leave it out: such a network is calibrated over the whole family of sensors at once"
        expected = "no --regime free, --report, --finetune or --data"
        raise OptionError("a network behind a bank", expected=expected, got="one", remedy=remedy)
    model = float_file(model, known, partial(say, err=True))
    network = float_model(model)

    # These take torch, seconds: what is wrong with the options or the files has been said by now.
    from beers_deploy.quant.calibration import Calibration
    from beers_deploy.quant.samples import samples_of
    from beers_deploy.quantise import quantise_banked_file, quantise_free_file, quantise_legal_file

    simulated = Calibration(sensor, images, patches, patch, seed)
    calibration = samples_of(network, data) or simulated
    if banked:
        rows = quantise_banked_file(banked, simulated, board_target, out, board, say, print_rows)
    elif regime is Regime.free:
        rows = quantise_free_file(network, calibration, out, say, print_rows)
    else:
        rows = quantise_legal_file(
            network, calibration, board_target, out, say, print_rows, board=board, page=page, finetune=finetune
        )
    arguments = {"target": target, "sensor": sensor, "images": images, "patches": patches, "patch": patch}
    arguments |= {"data": data}
    arguments |= {"regime": regime.value, "finetune": finetune, "seed": seed}
    document = Document("quantize", arguments, (model, out), tuple(rows))
    for path in (figures, json):
        document.write(path)
