"""The verbs that are commands, and the entry point of the program."""

import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from importlib import import_module
from itertools import pairwise
from typing import Any, cast

import typer
from typer.core import TyperGroup
from typer.main import get_command

from beers_deploy import __version__
from beers_deploy.cli.generate import Command, generated
from beers_deploy.cli.run import run
from beers_deploy.cli.streams import lasting_streams
from beers_deploy.profiles.errors import CRASHED

EXAMPLES = {
    "restore": "raw.tif restored.tif",
    "demo": "--out demo",
    "export": "--network convbeers-s --out float.onnx",
    "quantize": "float.onnx --target zcu104 --sensor pleiades-degraded --out int8.onnx",
    "gate": "float.onnx int8.onnx --max-mae 0.0007",
    "check": "network.onnx --target zcu102 --dpu B4096",
    "golden": "int8.onnx --tile 64 --out golden",
    "bench": "--target vck190-model --size 13600x9016 --dpu C32B3",
    "evaluate": "--images aerial/ --methods degraded,traditional,convbeers-s --out report/",
    "tradeoff": "--images aerial/ --out study/ --budget 'latency<=20s'",
    "stress": "float.onnx int8.onnx --out stability.md",
    "profiles": "pleiades-degraded",
    "characterize": "raw1.tif raw2.tif --bits 12 --out my-sensor.toml",
    "simulate": "--images aerial/ --sensor pleiades-degraded --out pairs",
    "train": "--variant convbeers-s --images aerial/ --out runs/s --steps 20000",
}
"""The verbs that are commands, each with words of a command line."""
COMMANDS = {
    name: Command(getattr(import_module(f"beers_deploy.verbs.{name}"), name), example)
    for name, example in EXAMPLES.items()
}
"""The commands by name, in the order of the help."""

SPELLINGS = {"characterise": "characterize"}
"""Other spellings of commands, which the help does not list."""

CONTEXT_SETTINGS = {"help_option_names": ["-h", "--help"]}


@lru_cache
def command_of(spelling: str) -> Any:
    """Build the command that the user names on the command line.

    Args:
        spelling: the name of a command, or another spelling of it such as "characterise".

    Returns:
        The Click command that Typer makes from the verb.

    Raises:
        KeyError: there is no command of this name or spelling.
    """
    command = COMMANDS[SPELLINGS.get(spelling, spelling)]
    alone = typer.Typer(
        add_completion=False, rich_markup_mode=None, context_settings=CONTEXT_SETTINGS
    )
    alone.command(
        spelling,
        short_help=command.doc.short_description,
        epilog=f"Example:  beers-deploy {command.name} {command.example}",
        hidden=spelling in SPELLINGS,
    )(generated(command, partial(run, command)))
    return get_command(alone)


class Commands(Mapping[str, Any]):
    """A read-only mapping from the spelling of each command to the Click command.

    A command is built when it is looked up, because building all of them takes a third of the time
    of `restore --help`.
    """

    def __getitem__(self, spelling: str) -> Any:
        return command_of(spelling)

    def __iter__(self) -> Iterator[str]:
        return iter((*COMMANDS, *SPELLINGS))

    def __len__(self) -> int:
        return len(COMMANDS) + len(SPELLINGS)


class Group(TyperGroup):
    """The command `beers-deploy`, which has all others as subcommands.

    With `--json -`, it reserves standard output for the results document.

    Attributes:
        results_on_stdout: True if the user asks for the results document on standard output.
    """

    results_on_stdout = False

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.commands = cast(Any, Commands())

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line as Click does, and set `results_on_stdout`.

        An empty word is refused, because it would be read as the path of the working folder.
        """
        for before, word in pairwise(["", *args]):
            if not word:
                name = before if before.startswith("-") else "an argument"
                raise typer.BadParameter(f"{name} is empty. Give a value, or leave it out.")
        # After parsing, Click stores the words in an attribute whose name differs between its
        # versions.
        self.results_on_stdout = ("--json", "-") in pairwise(args) or "--json=-" in args
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command. Exit with 70 if some of its standard output was lost."""
        closed = sys.stdout is None
        with lasting_streams(self.results_on_stdout) as out:
            try:
                result = super().invoke(ctx)
            except typer.BadParameter as error:
                error.message = with_value(error)
                raise
        if out.lost or (closed and self.results_on_stdout):
            reason = out.lost or "closed"
            typer.echo(f"beers-deploy: standard output: {reason}; all else is done", err=True)
            ctx.exit(CRASHED)
        return result


def with_value(error: typer.BadParameter) -> str:
    """Return the message on a value that an option does not accept, with that value.

    Args:
        error: Typer's error, which pydantic caused in most cases.
    """
    faults: list[Any] = getattr(error.__cause__, "errors", list)()
    if not faults:
        return error.message
    reason = faults[0]["msg"].removeprefix("Value error, ").partition(", unable to parse")[0]
    reason = reason.replace("Input should be", "it must be")
    value = repr(faults[0]["input"])
    return reason if value in reason else f"{reason}, got {value}."


app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    # Plain help is drawn in half the time, and leaves its texts more room on 80 columns.
    rich_markup_mode=None,
    context_settings=CONTEXT_SETTINGS,
    help="Satellite image restoration from training to board: simulate, train, quantise, check, "
    "predict, restore.",
)


@app.callback(invoke_without_command=True)
def main(
    context: typer.Context,
    version: bool = typer.Option(False, "--version", help="Print the version."),
    verbose: bool = typer.Option(
        False, "-v", "--verbose", help="With --version: the system and the libraries too."
    ),
) -> None:
    """Print the version, or the help if no command is given."""
    if version or context.invoked_subcommand is None:
        typer.echo(f"beers-deploy {__version__}" if version else context.get_help())
        for line in _installation() if version and verbose else ():
            typer.echo(line)
        raise typer.Exit


def _installation() -> Iterator[str]:
    """Yield a line for each fact about the system, the libraries and their kernels."""
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
