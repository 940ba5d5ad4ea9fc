"""The command line: from here each verb leads to one file under `deploy/commands/`.

    sensor profile -> simulate -> train -> export -> quantize -> gate -> check -> bench -> restore

Exit codes: 0 done, 1 a gate or check failed, 2 bad input (one sentence on standard error, nothing
half-written), 70 a fault of this program, 130 interrupted.
"""

import inspect
import io
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext, suppress
from functools import wraps
from itertools import pairwise
from typing import Annotated, Any, TextIO, cast

import typer
from typer.core import TyperGroup

from beers_deploy import __version__
from beers_deploy.commands import (
    bench,
    check,
    demo,
    detect,
    evaluate,
    export,
    gate,
    golden,
    profiles,
    quantize,
    restore,
    simulate,
    stress,
    tradeoff,
    train,
)
from beers_deploy.commands.shared import results_to, running
from beers_deploy.model.progress import reporting
from beers_deploy.profiles.errors import (
    CRASHED,
    BeersError,
    OptionError,
    OutsideRangeWarning,
    missing_extra,
    one_line,
    visible,
)

INTERRUPTED = 130
"""Exit code of Ctrl-C."""

PIPES_RESULTS = "beers_deploy.pipes_results"
"""Key in the context of a command line: True if the results are asked for on standard output."""

Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Show no progress.")]
Verbose = Annotated[
    bool, typer.Option("-v", "--verbose", help="Show where in the program an error arose.")
]


class Stream:
    """Standard output or error that ends no run: what cannot be written is left out, and `lost`
    says why.

    A stream that was closed at the start takes everything and loses nothing, as nobody asked for
    it.
    """

    def __init__(self, stream: Any) -> None:
        self.stream = stream or open(os.devnull, "w")  # noqa: PTH123, SIM115 - as long as the process
        self.lost = ""
        if isinstance(self.stream, io.TextIOWrapper):
            # A name that a terminal cannot show must end no run either.
            self.stream.reconfigure(errors="backslashreplace")

    def write(self, text: str) -> int:
        """Write and flush, or leave it out."""
        if not self.lost:
            try:
                self.stream.write(text)
                self.stream.flush()
            except OSError as error:
                self.lost = error.strerror or str(error)
                # Buffered text must not be tried once more when Python ends.
                with suppress(OSError, ValueError):
                    os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())
        return len(text)

    def flush(self) -> None:
        """Nothing is left to be flushed."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class Group(TyperGroup):
    """Prints warnings as lines, and keeps standard output for results where they are asked for
    there.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Note whether the results go to standard output, in which case all else goes to standard
        error.
        """
        # Once parsed, Click keeps the words in an attribute that has another name in each of its
        # versions.
        ctx.meta[PIPES_RESULTS] = ("--json", "-") in pairwise(args) or "--json=-" in args
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command; what was lost on standard output ends it with 70 when all is
        done.
        """
        closed = sys.stdout is None
        out = cast(Any, Stream(sys.stdout))
        sys.stdout = out
        sys.stderr = cast(TextIO, Stream(sys.stderr))
        result = self._invoke(ctx)
        if out.lost or (closed and ctx.meta[PIPES_RESULTS]):
            typer.echo(
                f"beers-deploy: standard output: {out.lost or 'closed'}; all else is done", err=True
            )
            ctx.exit(CRASHED)
        return result

    def _invoke(self, ctx: Any) -> Any:
        with (
            warnings.catch_warnings(),
            results_to(sys.stdout) if ctx.meta[PIPES_RESULTS] else nullcontext(),
        ):
            warnings.simplefilter("always", OutsideRangeWarning)
            warnings.showwarning = _print_warning
            return super().invoke(ctx)


def command(function: Callable[..., None]) -> Callable[..., None]:
    """A command with the options that every one has, and one sentence for whatever ends it.

    What a user can correct ends it with code 2, anything else with 70: a failed gate alone ends
    with 1.
    """

    @wraps(function)
    def run(*arguments: Any, quiet: bool = False, verbose: bool = False, **options: Any) -> None:
        try:
            with reporting(False if quiet else None), running(options):
                _require_values(options)
                function(*arguments, **options)
        except (typer.Exit, typer.Abort):
            raise
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - no fault must look like a failed gate
            message, code = ending(error, function)
            if verbose or code == CRASHED:
                traceback.print_exc()
            typer.echo(f"beers-deploy: {visible(message)}", err=True)
            raise typer.Exit(code) from None

    signature = inspect.signature(function)
    more = {"quiet": Quiet, "verbose": Verbose}
    kind = inspect.Parameter.KEYWORD_ONLY
    extra = [
        inspect.Parameter(name, kind, default=False, annotation=hint) for name, hint in more.items()
    ]
    own = [*signature.parameters.values(), *extra]
    run.__signature__ = signature.replace(parameters=own)  # type: ignore[attr-defined]
    run.__annotations__ = {**function.__annotations__, **more}
    return run


def _require_values(options: Mapping[str, object]) -> None:
    """Refuse an option that is given without a value, such as that of an unset variable: it would
    count as none.
    """
    for name, value in options.items():
        if value == "":
            raise OptionError(
                name, expected="a value", got="an empty one", remedy="give one, or leave it out"
            )


def ending(error: BaseException, function: Callable[..., None]) -> tuple[str, int]:
    """What a command says of an error that ends it, and its exit code."""
    if isinstance(error, ImportError) and not isinstance(error, BeersError):
        error = missing_extra(error, function.__name__)
    if isinstance(error, BeersError):
        return in_options(str(error), function), 2
    if isinstance(error, MemoryError):
        return (
            "memory: expected enough for this input, got none left; give a smaller image or tile.",
            2,
        )
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", INTERRUPTED
    at_fault = " or of ".join(["this program", *_library_of(error)])
    return f"a fault of {at_fault}, please report it: {error!r}", CRASHED


def _library_of(error: BaseException) -> list[str]:
    """Return name and version of the library in which an error arose; nothing if it arose in this
    program.
    """
    from importlib.metadata import packages_distributions, version

    distributions = packages_distributions()
    for frame, _ in reversed(list(traceback.walk_tb(error.__traceback__))):
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        if package == __package__:
            return []
        # The standard library belongs to no distribution.
        if package in distributions:
            name = distributions[package][0]
            return [f"{name} {version(name)}"]
    return []


def in_options(message: str, function: Callable[..., None]) -> str:
    """A message of the library, whose parameters are named as a command's options.

    Args:
        message: begins with the parameter at fault, or names parameters in backquotes.
        function: of the command.
    """

    def option(match: re.Match[str]) -> str:
        is_option = (
            match[1] in parameters and parameters[match[1]].default is not inspect.Parameter.empty
        )
        return f"--{match[1].replace('_', '-')}" if is_option else match[1]

    parameters = inspect.signature(function).parameters
    return re.sub(r"`(\w+)`", option, re.sub(r"^(\w+)(?=:)", option, message))


def _print_warning(message: Warning | str, *_: object, **__: object) -> None:
    typer.echo(one_line(str(message)), err=True)


app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Satellite image restoration from training to board: simulate, train, quantise, check, "
    "predict, restore.",
)


@app.callback(invoke_without_command=True)
def main(
    context: typer.Context,
    version: bool = typer.Option(False, "--version", help="Print the version."),
    verbose: bool = typer.Option(
        False, "-v", "--verbose", help="With --version: what it runs on, and what was asked of it."
    ),
) -> None:
    """Say what this is, where no command is asked for."""
    if version or context.invoked_subcommand is None:
        typer.echo(f"beers-deploy {__version__}" if version else context.get_help())
        for line in _installation() if version and verbose else ():
            typer.echo(line)
        raise typer.Exit


def _installation() -> Iterator[str]:
    """What this installation runs on: its system, its runtimes, and what its kernels were asked, a
    line each.
    """
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as version_of

    from beers_deploy.model.processor import int8_adds_exactly
    from beers_deploy.results import host

    int8_adds_exactly()
    for key, value in host().items():
        values = value if isinstance(value, dict) else {key: value}
        yield from (f"{name.replace('_', ' ')}: {text}" for name, text in values.items())
    for package in ("onnxruntime", "onnx", "torch", "numpy", "openvino"):
        try:
            yield f"{package}: {version_of(package)}"
        except PackageNotFoundError:
            yield f"{package}: not installed"


RESTORE = "Restore"
INT8 = "Quantise and judge"
BOARDS = "Boards"
STUDY = "Study"
TRAIN = "Sensors and training"
"""Panels of the help."""

COMMANDS: dict[str, tuple[Callable[..., None], str, str]] = {
    "restore": (restore.restore, "raw.tif restored.tif", RESTORE),
    "demo": (demo.demo, "--out demo", RESTORE),
    "export": (export.export, "--network convbeers-s --out float.onnx", INT8),
    "quantize": (
        quantize.quantize,
        "float.onnx --target zcu104 --sensor pleiades-degraded --out int8.onnx",
        INT8,
    ),
    "gate": (gate.gate, "float.onnx int8.onnx --max-mae 0.0007", INT8),
    "check": (check.check, "network.onnx --target zcu102 --dpu B4096", BOARDS),
    "golden": (golden.golden, "int8.onnx --tile 64 --out golden", BOARDS),
    "bench": (bench.bench, "--target vck190-model --size 13600x9016 --dpu C32B3", BOARDS),
    "evaluate": (
        evaluate.evaluate,
        (
            "--images aerial/ --methods degraded,traditional,convbeers-s,convbeers-s-int8 --out "
            "report/"
        ),
        STUDY,
    ),
    "tradeoff": (tradeoff.tradeoff, "--images aerial/ --out study/ --budget 'latency<=20s'", STUDY),
    "stress": (stress.stress, "float.onnx int8.onnx --out stability.md", STUDY),
    "detect": (
        detect.detect,
        "--images DIOR/ --split test --detector yolo11n.onnx --sensor dior-medium --out detection/",
        STUDY,
    ),
    "profiles": (profiles.profiles, "pleiades-degraded", TRAIN),
    "characterise": (
        profiles.characterise,
        "raw1.tif raw2.tif --bits 12 --out my-sensor.toml",
        TRAIN,
    ),
    "simulate": (simulate.simulate, "aerial.png --sensor pleiades-degraded --out pairs", TRAIN),
    "train": (
        train.train,
        "--variant convbeers-s --images aerial/ --out runs/s --steps 20000",
        TRAIN,
    ),
}
"""Of each verb its function, the words of an example, and its panel."""

for name, (function, words, panel) in COMMANDS.items():
    epilog = f"Example:  [bold]beers-deploy {name} {words}[/bold]"
    app.command(name, epilog=epilog, rich_help_panel=panel)(command(function))
