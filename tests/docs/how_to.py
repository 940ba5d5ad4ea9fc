"""The commands of the how-to pages: how to find and shorten them, what they need and write.

A command stands in a shell fence, in an indented block, in a cell of a table, or as code within a
sentence. The commands of one block are a session: each uses the files of those before it. Within a
sentence `beers-deploy check` only names a command. In a table, where a reader copies it, it is a
command.
"""

import json
import re
import shlex
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from tests.deploy.test_outputs import outputs_of
from tests.docs.test_commands_in_pages import NAME, context_of
from tests.project_files import ROOT

PAGES = sorted((ROOT / "docs/how-to").glob("*.md"))
TUTORIALS = (ROOT / "docs/tutorials").glob("*.md")
COMMANDS = "".join(page.read_text(encoding="utf-8") for page in TUTORIALS)
STARTED = set(re.findall(rf"^{NAME} (\w+)", COMMANDS, re.MULTILINE))
"""Commands that the tests of the tutorials start in a process of their own."""
PROGRAMS = {NAME, "python", "python3", "pip", "pytest", "rio", "xdputil"}
SHELLS = {"console", "bash", "sh"}
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^ {4}\S.*\n?)+", re.MULTILINE)

Session = tuple[str, ...]

LEFT_OUT = {
    "pip install '.[notebook,dask]' rioxarray": "fetches from a registry",
    "xdputil query": "is a program of the board",
    "xdputil benchmark core.xmodel 3": "is a program of the board",
    "beers-deploy golden results --compare kit/golden": "compares what a board wrote",
    (
        "beers-deploy evaluate --pairs pairs/ --sensor mine.toml --methods mine.onnx "
        "--calibrate mine-calibrated.onnx"
    ): "needs pairs of several places, which the tests of `calibrate` make",
    (
        "beers-deploy restore raw.tif restored.tif --network mine-calibrated.onnx "
        "--sensor mine.toml --interval 90"
    ): "needs the file that the command above writes",
    (
        "beers-deploy train --recipe convbeers-xs --images aerial-train/ --images aerial-train2/ "
        "--out runs/convbeers-xs"
    ): "takes hours",
}
"""Commands that are not run, and why."""

SHORTER = {
    r"--provider Vitis\S+ --option \S+": "--provider CPUExecutionProvider --tile 64",
    r"--frames 300": "--frames 4",
    r"(\.kit\(.*)'\)": r"\1', tile=64)",
    # The command bench accepts only runs of a board.
    r"--out board\.json": "--out processor.json",
    r"(beers-deploy gate)": r"\1 --patches 4",
    r"(training\.py .*)$": r"\1 --steps 4",
    r"(benchmarks\.characterize .*)--sensors 10": r"\1--sensors 1",
    r"raw1\.tif:412,300,28,34": "raw1.tif:114,82,28,34",
    r"raw1\.tif:440,330,34,28": "raw1.tif:140,114,34,28",
    r"IMAGE OUT": "raw.tif restored.tif",
    r"(beers-deploy evaluate)": r"\1 --methods degraded",
}
"""Patterns in a command and their replacements, so that a test takes seconds."""

NEEDED = {
    r"--stac": "pystac",
    r"rio cogeo": "rio_cogeo",
}
"""Patterns in a command, and the optional package that it needs."""


def sessions(text: str) -> Iterator[Session]:
    """Yield the sessions of a page.

    A command within a sentence or a table is a session of its own.
    """
    text = re.sub(r"\\\n\s*", "", text)
    blocks = [body for language, body in FENCE.findall(text) if language in SHELLS]
    prose = FENCE.sub("", text)
    blocks += [block for block in INDENTED.findall(prose) if not _is_json(block)]
    yield from (
        tuple(line.strip().removeprefix("$ ") for line in block.splitlines()) for block in blocks
    )
    for line in prose.splitlines():
        if not line.startswith("    "):
            yield from (
                (code,) for code in re.findall(r"`([^`]+)`", line) if _is_command(code, line)
            )


def _is_command(code: str, line: str) -> bool:
    words = code.split()
    names_command = words[0] == NAME and len(words) == 2 and not line.startswith("|")
    return words[0] in PROGRAMS and len(words) > 1 and not names_command


def _is_json(block: str) -> bool:
    with suppress(ValueError):
        json.loads(block)
        return True
    return False


def shortened(command: str) -> str:
    """Return the command as the test runs it."""
    for pattern, short in SHORTER.items():
        command = re.sub(pattern, short, command)
    return command


def packages(session: Session) -> set[str]:
    """Return the optional packages that a session needs."""
    return {
        package for pattern, package in NEEDED.items() if re.search(pattern, "\n".join(session))
    }


def outputs(command: str) -> list[Path]:
    """Return the output files of a command, relative to its folder; one file of each folder."""
    if not command.startswith(NAME):
        return [Path(name) for name in re.findall(r"--out (\S+)", command)]
    name = shlex.split(command)[1]
    values = context_of(command).params
    return [Path(values[key]) / inside for key, inside in outputs_of(name).items() if values[key]]
