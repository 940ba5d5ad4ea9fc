"""Damage files by the hundred thousand: `python -m tests.fuzz.campaign --executions 200000 --seed 1 --out FOLDER`.

Each execution is drawn from the seed, its parser and its number, so a finding can be made again from these three. One
process does the work; this one watches it, keeps the file that killed or stopped it, and starts it behind that.
"""

import json
import multiprocessing
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated
from zlib import crc32

import numpy as np
import typer

from tests.fuzz.execution import Finding, execute, limit_memory, little_memory
from tests.fuzz.mutation import damaged
from tests.fuzz.parsers import PARSERS, Parser

STUCK_S = 300
"""Without a new execution for so long, the process is taken to hang in a library. Pauses of both do not count."""


def content_of(parser: Parser, seeds: list[bytes], seed: int, number: int) -> bytes:
    """The damaged file of one execution."""
    rng = np.random.default_rng([seed, crc32(parser.name.encode()), number])
    return damaged(seeds[int(rng.integers(len(seeds)))], seeds, parser.meaning, rng)


def work(parser: Parser, seed: int, first: int, stop: int, out: Path) -> None:
    """In a process of its own: executions `first` to `stop` of one parser; findings become files."""
    with TemporaryDirectory() as name, TemporaryDirectory() as seeding, little_memory():
        seeds, path = parser.seeds(Path(seeding)), Path(name) / "in" / f"file{parser.suffix}"
        for content in seeds:
            found = execute(parser.parse, content, path)
            if isinstance(found, Finding):
                raise ValueError(f"{parser.name}: a valid file gave {found.kind}\n{found.detail}")
        limit_memory()
        read = int((out / "at").read_text().split()[1])
        for number in range(first, stop):
            (out / "at").write_text(f"{number} {read}")
            content = content_of(parser, seeds, seed, number)
            found = execute(parser.parse, content, path)
            read += found == "read"
            if isinstance(found, Finding):
                keep(out, parser, number, content, found.kind, found.detail)
        (out / "at").write_text(f"{stop} {read}")


def keep(out: Path, parser: Parser, number: int, content: bytes, kind: str, detail: str) -> None:
    """A finding as three files: what it is, the damaged file, and the traceback."""
    stem = f"{parser.name.replace(' ', '-').replace(',', '')}-{number}"
    (out / f"{stem}{parser.suffix}").write_bytes(content)
    (out / f"{stem}.txt").write_text(f"{parser.name}, execution {number}: {kind}\n\n{detail}\n", errors="replace")


def watch(parser: Parser, seed: int, executions: int, out: Path) -> int:
    """Run one parser's executions, whatever happens to the process that does; how many files were read."""
    first, read, at = 0, 0, out / "at"
    while first < executions:
        at.write_text(f"{first} {read}")
        process = multiprocessing.get_context("fork").Process(
            target=work, args=(parser, seed, first, executions, out)
        )
        process.start()
        seen, waited_s = 0, 0
        while process.is_alive() and waited_s < STUCK_S:
            process.join(1.0)
            now = at.stat().st_mtime_ns
            seen, waited_s = now, waited_s + 1 if now == seen else 0
        hung = process.is_alive()
        if hung:
            process.kill()
            process.join()
        number, read = map(int, at.read_text().split())
        if process.exitcode == 0:
            break
        if process.exitcode == 1:
            raise SystemExit(1)
        with TemporaryDirectory() as seeding:
            content = content_of(parser, parser.seeds(Path(seeding)), seed, number)
        keep(out, parser, number, content, "hang" if hung else f"signal {-(process.exitcode or 0)}", "")
        first = number + 1
    return read


def campaign(
    executions: Annotated[int, typer.Option(help="In all; a parser's share depends on what it costs.")] = 200_000,
    seed: Annotated[int, typer.Option(help="Of the damage.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for findings and counts.json.")] = Path("fuzz-out"),
    only: Annotated[str, typer.Option(help="Parsers whose name holds this.")] = "",
) -> None:
    """Run every parser on damaged files; exit code 1 where something was found."""
    out.mkdir(parents=True, exist_ok=True)
    chosen = [parser for parser in PARSERS if only in parser.name]
    total, counts = sum(parser.share for parser in chosen), dict[str, dict[str, int]]()
    for parser in chosen:
        count, started = round(executions * parser.share / total), time.time()
        before = len(list(out.glob("*.txt")))
        read = watch(parser, seed, count, out)
        found = len(list(out.glob("*.txt"))) - before
        counts[parser.name] = {"executions": count, "read": read, "findings": found}
        typer.echo(f"{parser.name}: {counts[parser.name]} in {time.time() - started:.0f} s")
        (out / "counts.json").write_text(json.dumps({"seed": seed, "parsers": counts}, indent=1) + "\n")
    found = len(list(out.glob("*.txt")))
    typer.echo(f"{sum(count['executions'] for count in counts.values())} executions, {found} findings")
    raise typer.Exit(1 if found else 0)


if __name__ == "__main__":
    typer.run(campaign)
