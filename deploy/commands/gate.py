"""`beers-deploy gate`: does INT8 stay close enough to float? Exit code 1 when it does not."""

from functools import partial
from math import isnan
from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import BOARDS, say
from beers_deploy.model.processor import SEEDS
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles.target import DEFAULT_TARGET

EXAMPLE = "gate float.onnx int8.onnx --max-mae 0.0007"


def gate(
    float_model: Annotated[
        Path | None,
        typer.Argument(metavar="[FLOAT]", help="Float ONNX or weights, or a shipped name; a shipped pair if none."),
    ] = None,
    int8_model: Annotated[
        Path | None, typer.Argument(metavar="[INT8]", help="Its INT8 ONNX, or a shipped name.")
    ] = None,
    variant: Annotated[
        str | None, typer.Option(help="Shipped pair of this name, without files; convbeers-s if none.")
    ] = None,
    max_mae: Annotated[
        float | None, typer.Option(min=0, help="Largest mean absolute difference, of full scale; 0.0007 if none.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file of limits; see docs/how-to/gate.md.")] = None,
    baseline: Annotated[Path | None, typer.Option(help="What 'gate --json' wrote before: MAE may not grow.")] = None,
    target: Annotated[
        str, typer.Option(help=f"Board whose rules the INT8 file must keep: {BOARDS}.")
    ] = DEFAULT_TARGET,
    sensor: Annotated[
        str, typer.Option(help="Profile of the test patches, and what a shipped network is told.")
    ] = SENSOR,
    images: Annotated[Path | None, typer.Option(help="Folder of scenes; drawn ones if none.")] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Your own samples in their place: .npy or .npz (N, C, H, W), or a folder of images."),
    ] = None,
    patches: Annotated[int, typer.Option(min=1, max=100_000, help="Test patches of 128 x 128.")] = 32,
    seed: Annotated[int, typer.Option(min=0, max=SEEDS, help="Seed of the patches.")] = 0,
    junit: Annotated[Path | None, typer.Option(help="Write the verdict here as JUnit XML.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write verdict, checks and figures here.")] = None,
) -> None:
    """Compare a float and an INT8 network on simulated pairs neither was calibrated on.

    Also checked: what saturates inside, the DPU's rules, that no ReLU was lost, and that onnxruntime's optimisations
    change no bit.
    """
    from beers_deploy.gate import Request, files_or_shipped, junit_text, run_gate, sentence
    from beers_deploy.model.io.files import require_writable, write_text
    from beers_deploy.quant.gate import read_limits
    from beers_deploy.results import print_rows

    read = (float_model, int8_model, config, baseline, images, data, *map(Path, (target, sensor)))
    require_writable(json, junit, inputs=read)
    limits = read_limits(config, max_mae)
    files = files_or_shipped(float_model, int8_model, variant, sensor, partial(say, err=True))
    request = Request(*files, limits, baseline, target, sensor, images, patches, seed, data)
    outcome = run_gate(request)
    print_rows("float against INT8", [outcome.row])
    for check in outcome.checks:
        say(f"{'ok    ' if check.passed else 'FAILED'} {check}")
    outcome.document(request, config).write(json)
    if junit is not None:
        write_text(junit, junit_text(f"INT8 gate of {files[1].name}", outcome.checks))
    mae, drop_db = outcome.result.mae, outcome.result.drop_db
    drop = "" if isnan(drop_db) else f", PSNR drop {drop_db:.2f} dB"
    say(f"gate {sentence(outcome.checks, f'MAE {mae:.3g} of full scale{drop}')}")
    if not outcome.passed:
        raise typer.Exit(1)
