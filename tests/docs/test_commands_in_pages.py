"""Tests that the command line accepts every command that a page shows, without running it."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperGroup
from typer.main import get_command

from beers_deploy.cli.commands import app
from tests.project_files import ROOT

PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
GENERATED_FROM_IT = "commands.md"
NAME = "beers-deploy"
UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""The error of Click, of which Typer may bring its own copy."""


def commands(text: str) -> Iterator[str]:
    """Yield the commands in fenced and indented blocks, and in code within a sentence.

    Lines that end in a backslash are joined.
    """
    for line in re.sub(r"\\\n\s*", "", text).splitlines():
        if re.match(rf"(    |\$ )?(\S+/)?{NAME} ", line):
            yield line.strip()
        else:
            yield from re.findall(rf"`({NAME} [^`]+)`", line)


def words_of(line: str) -> list[str]:
    """Return the words after the program's name, up to a comment or the next program."""
    line = line.replace("`", "").replace(r"\|", "|")
    words = shlex.split(line[line.index(NAME) :], comments=True)[1:]
    ends = [place for place, word in enumerate(words) if word in {"&&", "|", ">", "..."}]
    return words[: ends[0]] if ends else words


def context_of(line: str) -> Any:
    """Return Click's context of a command, with the value of each parameter."""
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    name, *words = words_of(line)
    return group.commands[name].make_context(name, words)


def refusal(line: str) -> str:
    """Return the error message of the command line, which is empty for a valid command."""
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    name, *words = words_of(line) or ["--help"]
    if name in {"--help", "--version", "--verbose"}:
        return ""
    if name not in group.commands:
        return f"{line}: no command {name}"
    if not words:
        # Within a sentence this is only the name of a command.
        return ""
    try:
        context_of(line)
    except typer.Exit:
        return ""
    except UsageError as error:
        return f"{line}: {error}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_is_accepted_by_the_command_line(page: Path) -> None:
    lines = [] if page.name == GENERATED_FROM_IT else [*commands(page.read_text(encoding="utf-8"))]
    assert [message for message in map(refusal, lines) if message] == []
