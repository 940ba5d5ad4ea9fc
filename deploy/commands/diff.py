"""`beers-deploy diff`: what changed between two runs, and whether a CI job should fail for it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beers_deploy.commands.shared import Json, arguments, save, say

if TYPE_CHECKING:
    from collections.abc import Mapping


def diff(
    before: Annotated[
        Path, typer.Argument(metavar="A.json", help="What a command wrote with --json.")
    ],
    after: Annotated[Path, typer.Argument(metavar="B.json", help="What it wrote later.")],
    fail_on: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CHANGE",
            help="NAME>CHANGE or NAME<CHANGE, in the figure's unit or in %; repeatable.",
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Show which figures of two results documents differ; exit code 1 beyond --fail-on.

    A figure named by --fail-on that the second document lacks fails too.
    """
    from beers_deploy.differences import broken, change_rows, changes, parse_limit, read_document
    from beers_deploy.model.io.files import require_writable
    from beers_deploy.profiles.errors import OptionError
    from beers_deploy.results import Table, print_rows

    require_writable(json, inputs=(before, after))
    limits = [parse_limit(text) for text in fail_on or ()]
    documents = read_document(before), read_document(after)
    comparison = changes(*documents)
    if not comparison.both:
        expected = "documents that share a figure"
        remedy = "give two results of one command"
        raise OptionError(str(after), expected=expected, got="none in both", remedy=remedy)
    rows = change_rows(comparison.changed)
    if rows:
        print_rows(f"{before.name} -> {after.name}", rows)
    counts = f"{len(rows)} changed, {len(comparison.gone)} gone, {len(comparison.new)} new"
    say(f"{len(comparison.both)} figures in both, {counts}")
    for note in differing(*documents):
        say(note)
    save(Table("diff", arguments(), (before, after), tuple(rows)), json)
    failed = broken(comparison, limits)
    for line in failed:
        say(f"FAILED {line}")
    if failed:
        raise typer.Exit(1)


def differing(before: "Mapping[str, object]", after: "Mapping[str, object]") -> list[str]:
    """What besides the code differs between two runs, a sentence each."""
    words = {
        "command": f"another command: {before['command']}, {after['command']}",
        "arguments": "other arguments",
    }
    notes = [f"note: {text}" for key, text in words.items() if before[key] != after[key]]
    digests = [[entry["sha256"] for entry in document["inputs"]] for document in (before, after)]  # type: ignore[attr-defined]
    if digests[0] != digests[1]:
        notes.append("note: other input files")
    hosts: list[Mapping[str, object]] = [before["host"], after["host"]]  # type: ignore[list-item]
    if any(hosts[0][key] != hosts[1][key] for key in ("machine", "cpus", "memory_gb")):
        notes.append("note: another machine: measured times do not compare")
    return notes
