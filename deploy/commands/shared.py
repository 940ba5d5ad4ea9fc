"""What all commands share: how they print besides tables, and how they refuse options that would do nothing."""

from collections.abc import Iterable

import typer

from beers_deploy.profiles.errors import OptionError, visible
from beers_deploy.profiles.target import board_names

BOARDS = f"{', '.join(board_names())}, or your .toml file"
"""What --target takes, for its help."""


def refuse(context: typer.Context, names: Iterable[str], *, expected: str, got: str, remedy: str) -> None:
    """Refuse the first of these parameters to which the command line gives a value; 0 asks for nothing.

    Args:
        context: of the command that runs.
        names: of its parameters, as Python spells them.
        expected: what must stand beside the option, or must not.
        got: what stands there.
        remedy: what the user can do.

    Raises:
        OptionError: one was given.
    """
    options = {parameter.name: parameter.opts[0] for parameter in context.command.params}
    for name in names:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE" and context.params[name]:
            raise OptionError(options[name], expected=expected, got=got, remedy=remedy)


def say(text: str, err: bool = False) -> None:
    """Print lines on standard output, or on standard error, in characters that a terminal shows and does not obey."""
    typer.echo(visible(text), err=err)
