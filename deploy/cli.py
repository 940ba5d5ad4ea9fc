"""The command line: from here each verb leads to one file under `deploy/commands/`.

    sensor profile -> simulate -> train -> export -> quantize -> gate -> check -> bench -> restore

Exit codes: 0 done, 1 a gate or check failed, 2 bad input (one sentence on standard error, nothing half-written).
"""

import io
import sys
from collections.abc import Callable, Iterator
from typing import Any

import typer
from typer.core import TyperGroup

from beers_deploy import __version__
from beers_deploy.commands import (
    bench,
    characterise,
    check,
    compare,
    demo,
    detect,
    evaluate,
    export,
    gate,
    info,
    profiles,
    quantize,
    restore,
    simulate,
    stress,
    tradeoff,
    train,
)
from beers_deploy.profiles.errors import BeersError


class Group(TyperGroup):
    """Turns what a user can correct into one sentence and exit code 2."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except BeersError as error:
            message = str(error)
        except MemoryError:
            message = "memory: expected enough for this input, got none left; give a smaller image or tile."
        typer.echo(f"beers-deploy: {message}", err=True)
        raise typer.Exit(2)


app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Satellite image restoration from training to board: simulate, train, quantise, check, predict, restore.",
)


def _print_any_name() -> None:
    """Print what the terminal's encoding lacks as an escape: not every one is UTF-8, and a name must end no run."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@app.callback(invoke_without_command=True)
def main(
    context: typer.Context,
    version: bool = typer.Option(False, "--version", help="Print the version."),
    verbose: bool = typer.Option(
        False, "--verbose", help="With --version: what it runs on, and what was asked of it."
    ),
) -> None:
    """Check the installation before any command runs."""
    _print_any_name()
    if version or context.invoked_subcommand is None:
        typer.echo(f"beers-deploy {__version__}" if version else context.get_help())
        for line in _installation() if version and verbose else ():
            typer.echo(line)
        raise typer.Exit


def _installation() -> Iterator[str]:
    """What this installation runs on: its system, its runtimes, and what its kernels were asked, a line each."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as version_of

    from beers_deploy.model.processor import int8_adds_exactly
    from beers_deploy.results import host

    int8_adds_exactly()
    for key, value in host().items():
        shown = value if isinstance(value, dict) else {key: value}
        yield from (f"{name.replace('_', ' ')}: {each}" for name, each in shown.items())
    for package in ("onnxruntime", "onnx", "torch", "numpy", "openvino"):
        try:
            yield f"{package}: {version_of(package)}"
        except PackageNotFoundError:
            yield f"{package}: not installed"


def example(text: str) -> str:
    """The example that ends a command's help."""
    return f"Example:  [bold]beers-deploy {text}[/bold]"


COMMANDS: dict[str, tuple[Callable[..., None], str]] = {
    "demo": (demo.demo, demo.EXAMPLE),
    "profiles": (profiles.profiles, profiles.EXAMPLE),
    "characterise": (characterise.characterise, characterise.EXAMPLE),
    "simulate": (simulate.simulate, simulate.EXAMPLE),
    "train": (train.train, train.EXAMPLE),
    "export": (export.export, export.EXAMPLE),
    "quantize": (quantize.quantize, quantize.EXAMPLE),
    "gate": (gate.gate, gate.EXAMPLE),
    "check": (check.check, check.EXAMPLE),
    "bench": (bench.bench, bench.EXAMPLE),
    "info": (info.info, info.EXAMPLE),
    "restore": (restore.restore, restore.EXAMPLE),
    "evaluate": (evaluate.evaluate, evaluate.EXAMPLE),
    "detect": (detect.detect, detect.EXAMPLE),
    "stress": (stress.stress, stress.EXAMPLE),
    "tradeoff": (tradeoff.tradeoff, tradeoff.EXAMPLE),
    "compare": (compare.compare, compare.EXAMPLE),
}
for name, (function, text) in COMMANDS.items():
    app.command(name, epilog=example(text))(function)
