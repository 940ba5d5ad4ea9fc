"""What commands share: options that several take, lines they print, how they refuse what does
nothing.
"""

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from beers_deploy.model.processor import SEEDS
from beers_deploy.profiles.errors import OptionError, one_line
from beers_deploy.profiles.target import TargetProfile, board_names, load_target, npu_names

if TYPE_CHECKING:
    from beers_deploy.network import Network
    from beers_deploy.results import Table

OR_YOURS = "or your .toml file"
BOARDS, RULED = (
    ", ".join([*names, OR_YOURS]) for names in (board_names(), board_names() + npu_names())
)
"""What --target takes, for its help: where something is predicted, and where rules alone are asked
for.
"""

Json = Annotated[
    Path | None, typer.Option(help="Write the results here as JSON; - is standard output.")
]
Seed = Annotated[int, typer.Option(min=0, max=SEEDS, help="Seed of every random draw.")]
Tile = Annotated[int, typer.Option(min=16, help="Longest side of a tile in pixels.")]
Restoring = Annotated[
    Path | None,
    typer.Option(help="ONNX network, or a shipped one's name; convbeers-s-int8 if none."),
]
FloatModel = Annotated[
    Path | None,
    typer.Argument(
        metavar="[FLOAT]", help="Float ONNX or weights; or a shipped name, convbeers-s if none."
    ),
]
Int8Model = Annotated[
    Path | None,
    typer.Argument(metavar="[INT8]", help="Its INT8 ONNX; that of a shipped name if none."),
]
Reference = Annotated[
    str | None,
    typer.Option(
        help="Profile of the reference images, in the sensor's DN; pleiades-reference if none."
    ),
]
Lpips = Annotated[
    Path | None,
    typer.Option(help="Weights of SqueezeNet 1.1 for LPIPS-squeeze, or a folder of backbones."),
]
Detector = Annotated[
    Path | None, typer.Option(help="ONNX as Ultralytics exports it; the embedded one if none.")
]
Classes = Annotated[
    str | None,
    typer.Option(help="Labelled classes under the detector's names: car=vehicle,minibus=vehicle."),
]


def refuse(
    context: typer.Context,
    names: Iterable[str],
    *,
    expected: str,
    got: str = "none",
    remedy: str = "leave it out",
) -> None:
    """Refuse the first of these parameters to which the command line gives a value; 0 asks for
    nothing.

    A switch with a name for off, such as --no-exposure, is refused under either name.

    Args:
        context: of the command that runs.
        names: of its parameters, as Python spells them.
        expected: what must stand beside the option, or must not.
        got: what stands there.
        remedy: what the user can do.
    """
    parameters = {parameter.name: parameter for parameter in context.command.params}
    for name in names:
        source = context.get_parameter_source(name)
        parameter = parameters[name]
        spellings = parameter.opts if context.params[name] else parameter.secondary_opts
        # A default asks for nothing, and a switch that is off may have no spelling for it.
        if source is not None and source.name == "COMMANDLINE" and spellings:
            raise OptionError(spellings[0], expected=expected, got=got, remedy=remedy)


STDOUT = Path("-")
"""What --json takes for standard output; tables and notes then go to standard error."""

_results: ContextVar[TextIO | None] = ContextVar("results", default=None)


@contextmanager
def results_to(stream: TextIO) -> Iterator[None]:
    """Keep a stream for results alone: what else is printed there goes to standard error."""
    token = _results.set(stream)
    # Whoever reads standard output as JSON must get nothing else.
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _results.reset(token)


# The default is shared by all contexts, so nobody may be able to change it.
_given: ContextVar[Mapping[str, object]] = ContextVar("given", default=MappingProxyType({}))
OUTPUTS = ("context", "json", "junit")
"""Parameters that decide no figure."""


@contextmanager
def running(given: Mapping[str, object]) -> Iterator[None]:
    """Keep what the command line gave while its command runs."""
    token = _given.set(given)
    try:
        yield
    finally:
        _given.reset(token)


def arguments(**settled: object) -> dict[str, object]:
    """What the command line gave, for its results; and what the command settled on where nothing
    was given.
    """
    plain = {
        name: ", ".join(map(str, v)) if isinstance(v, list) else v
        for name, v in _given.get().items()
    }
    return {name: value for name, value in {**plain, **settled}.items() if name not in OUTPUTS}


def save(table: "Table", path: Path | None) -> None:
    """Write results where --json asked for them: to a file, to standard output for `-`, nowhere for
    None.
    """
    if path == STDOUT:
        (_results.get() or sys.stdout).write(json.dumps(table.to_dict(), indent=1) + "\n")
    elif path is not None:
        table.save(path)


def board_for(
    target: str, core: Path | None, tile: int | None, inputs: Iterable[Path | None]
) -> TargetProfile:
    """The board of a core that is to be written: of an NPU a tile is asked for, and room for what
    its compiler reads.

    Args:
        target: as --target names it.
        core: the file; None where none is wanted.
        tile: its side in pixels, if it is fixed to one.
        inputs: what is read, and may not be written.
    """
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.quant.encodings import CONFIG, required_tile

    board = load_target(target)
    if core is not None and board.npu:
        required_tile(tile)
        require_writable(core.with_name(CONFIG), inputs=inputs)
    return board


def save_core(core: "Network | None", path: Path | None, board: TargetProfile) -> None:
    """Write a network's core for a board, where one is wanted, and beside it what the compiler of
    an NPU reads.
    """
    from beers_deploy.quant.encodings import save_config

    if core is None or path is None:
        return
    core.save(path)
    say(f"wrote {path}: the same numbers in the board's encoding")
    if board.npu:
        say(f"wrote {save_config(path, *board.npu['device'].value)}: what AMD's compiler is told")


def say(text: str, err: bool = False) -> None:
    """Print one line on standard output, or on standard error; a terminal shows its characters and
    obeys none.
    """
    typer.echo(one_line(text), err=err)
