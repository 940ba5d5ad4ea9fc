"""Write docs/reference/commands.md: `python docs/make/commands.py`.

The text is that of the verbs' signatures and docstrings. A test keeps the page fresh.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from inspect import Parameter
from pathlib import Path
from typing import Literal, get_args, get_origin

from beers_deploy.cli.commands import COMMANDS
from beers_deploy.cli.generate import (
    Command,
    in_options,
    metavar_of,
    read_as,
    spellings_of,
    text_for_command,
)
from beers_deploy.profiles.shipped import board_names, npu_names

TARGET = Path(__file__).parents[1] / "reference" / "commands.md"
OPENING = """# Commands

`beers-deploy NAME --help` and, for each command but `profiles`, `help(bd.NAME)` print the same text.

Parentheses have the values that an option accepts and its default; `--help` also has its range. An option that would
have no effect next to others is refused with exit code 2. An output is a regular file or a new name, and is written
whole or not at all; an input, another output, a link, a pipe or a device is refused. Every command accepts `-q`, `-v`
and, where it reports figures, `--json`.

## Options of several commands

A board is {boards}, or your .toml file ([boards](boards.md)); where nothing is
predicted also {npus}. A sensor is the name of a profile, or your .toml file ([sensors](sensor-profile.md)).
"""
SEVERAL = 2
"""From this number of commands with the same line for an option, it is described once."""
NAMED = ": name or .toml file"
"""The naming of boards and sensors, which the opening explains once."""


def reference() -> str:
    """Return the command reference as Markdown."""
    lines = {name: _lines(command) for name, command in COMMANDS.items()}
    counted = Counter[str]()
    for entries in lines.values():
        counted.update(entries.values())
    options = (line for line in counted if line.startswith("- `-"))
    once = {line for line in options if counted[line] >= SEVERAL}
    opening = OPENING.format(boards=", ".join(board_names()), npus=", ".join(npu_names()))
    parts = [opening, *sorted(once), ""]
    for name, command in COMMANDS.items():
        parts += _section(command, lines[name], once)
    return "\n".join(parts)


def _section(command: Command, lines: Mapping[str, str], once: Collection[str]) -> Iterator[str]:
    example = f"    beers-deploy {command.name} {command.example}"
    yield f"## {command.name}\n\n{in_options(command.help, command.verb)}\n\n{example}\n"
    yield from (line for line in lines.values() if line not in once)
    also = [f"`{label}`" for label, line in lines.items() if line in once]
    yield f"\nAlso {', '.join(also)}.\n" if also else ""


def _lines(command: Command) -> dict[str, str]:
    """Return the line of each argument and option of a command, by its name."""
    texts = {entry.arg_name: entry.description or "" for entry in command.doc.params}
    lines = {}
    for parameter in command.parameters:
        text = text_for_command(texts[parameter.name], command.verb).replace(NAMED, "")
        label = _label(parameter)
        about = _about(parameter)
        lines[label] = f"- `{label}`{f' ({about})' if about else ''}: {text}"
    return lines


def _label(parameter: Parameter) -> str:
    if parameter.kind is Parameter.POSITIONAL_OR_KEYWORD:
        return metavar_of(parameter)
    return ", ".join(spellings_of(parameter))


def _about(parameter: Parameter) -> str:
    """Return the values that a parameter accepts, and its default."""
    words = []
    hint, repeated = read_as(parameter.annotation)
    if get_origin(hint) is Literal:
        words.append(", ".join(map(str, get_args(hint))))
    default = parameter.default
    if default is Parameter.empty:
        words.append("required")
    elif not repeated and default is not None and not isinstance(default, bool):
        words.append(f"`{default}`")
    return "; ".join(words)


if __name__ == "__main__":
    TARGET.write_text(reference(), encoding="utf-8", newline="\n")
    print(f"wrote {TARGET}")
