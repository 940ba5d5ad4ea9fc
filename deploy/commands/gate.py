"""`beers-deploy gate`: does INT8 stay close enough to float? Exit code 1 when it does not."""

from contextlib import suppress
from functools import partial
from math import isnan
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from deploy.commands.shared import BOARDS, say
from model.processor import SEEDS
from model.shipped import SENSOR
from profiles.target import DEFAULT_TARGET

EXAMPLE = "gate float.onnx int8.onnx --max-mae 0.0007"
UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""An unknown option, a missing value: what the parser finds before the command runs."""


class GateCommand(TyperCommand):
    """Tells a usage error where a CI job looks for the verdict, as other bad input is."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words of the command line."""
        words = list(args)
        try:
            return super().parse_args(ctx, args)
        except UsageError as error:
            _tell_usage(words, str(error))
            raise


def _tell_usage(words: list[str], message: str) -> None:
    """Write the reports that the words ask for, but over nothing that another word may mean."""
    from deploy.gate import Reports
    from model.io.files import claim_outputs
    from profiles.errors import BeersError, OptionError

    plain = [part for word in words for part in (word.split("=", 1) if word.startswith("--") else [word])]
    places = [plain.index(option) + 1 for option in ("--summary", "--junit", "--outputs") if option in plain[:-1]]
    named = {plain[place - 1].removeprefix("--"): Path(plain[place]) for place in places}
    others = [Path(part) for place, part in enumerate(plain) if place not in places]
    reports = Reports(named.get("summary"), named.get("junit"), named.get("outputs"))
    with suppress(BeersError):
        claim_outputs(*named.values(), inputs=others)
        with reports.of_bad_input("INT8 gate"):
            remedy = "see 'beers-deploy gate --help'"
            raise OptionError("command line", expected="what gate takes", got=message, remedy=remedy)


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
    summary: Annotated[Path | None, typer.Option(help="Add the verdict to this file as Markdown.")] = None,
    junit: Annotated[Path | None, typer.Option(help="Write the verdict here as JUnit XML.")] = None,
    outputs: Annotated[
        Path | None, typer.Option(help="Add mae=, drop= (PSNR drop in dB) and verdict= to this file, a line each.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write verdict, checks and figures here.")] = None,
) -> None:
    """Compare a float and an INT8 network on simulated pairs neither was calibrated on.

    Also checked: what saturates inside, the DPU's rules, that no ReLU was lost, and that onnxruntime's optimisations
    change no bit.
    """
    from deploy.gate import Reports, Request, files_or_shipped, run_gate, sentence
    from deploy.results import print_rows
    from model.io.files import claim_outputs, require_writable
    from quant.gate import read_limits

    read = (float_model, int8_model, config, baseline, images, data, *map(Path, (target, sensor)))
    claim_outputs(json, junit, summary, outputs, inputs=read)  # before bad input is told there
    reports = Reports(summary, junit, outputs)
    with reports.of_bad_input("INT8 gate"):
        require_writable(json)
        limits = read_limits(config, max_mae)
        files = files_or_shipped(float_model, int8_model, variant, sensor, partial(say, err=True))
        request = Request(*files, limits, baseline, target, sensor, images, patches, seed, data)
        outcome = run_gate(request)
    print_rows("float against INT8", [outcome.row])
    for check in outcome.checks:
        say(f"{'ok    ' if check.passed else 'FAILED'} {check}")
    figures = {"mae": outcome.result.mae, "drop": outcome.result.drop_db}
    outcome.document(request, config).write(json)
    reports.write(f"INT8 gate of {files[1].name}", outcome.checks, figures)
    drop = "" if isnan(figures["drop"]) else f", PSNR drop {figures['drop']:.2f} dB"
    shown = f"MAE {figures['mae']:.3g} of full scale{drop}"
    say(f"gate {sentence(outcome.checks, shown)}")
    if not outcome.passed:
        raise typer.Exit(1)
