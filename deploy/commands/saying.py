"""What commands print besides tables."""

import typer

from profiles.errors import visible


def say(text: str, err: bool = False) -> None:
    """Print lines on standard output, or on standard error, in characters that a terminal shows and does not obey."""
    typer.echo(visible(text), err=err)
