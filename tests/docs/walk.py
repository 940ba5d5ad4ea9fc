"""Follow a page as a reader would: write its files, run its commands and compare their output.

These fences of a page count, in order:

- any fence with a title, such as ```toml title="my-sensor.toml": it is written to that file;
- ```bash: commands of the programs in `PROGRAMS`, one a line. They run without a shell, so also on
  Windows. Each command of ours starts a process the first time. Later it runs within this process,
  where all is imported already;
- ```text: the output of the commands before it. Its lines must be printed in this order. `...`
  stands for any text, blanks and rules of tables may have any length, and numbers must agree within
  2 %, because processors differ.

Comments of the page state where a test differs from a reader:

- `<!-- test: A -> B -->`: B replaces A in all later commands, at most once a line;
- `<!-- test: figures vary -->`: the numbers of the next output depend on the machine, so only their
  places are compared;
- `<!-- test: exits 1 -->`: the next commands end with this exit code instead of 0.
"""

import math
import os
import re
import shlex
import subprocess
import sys
from contextlib import chdir
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from tests.project_files import ROOT

PYTHON = [sys.executable]
OURS = "beers-deploy"
PROGRAMS = {
    OURS: [*PYTHON, "-c", "from beers_deploy.cli.commands import app; app()"],
    "python": PYTHON,
    "python3": PYTHON,
    "rio": [*PYTHON, "-c", "from rasterio.rio.main import main_group; main_group()"],
}
PART = re.compile(
    r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$|^<!-- test: (.+?) -->$', re.MULTILINE | re.DOTALL
)
NUMBER = re.compile(r"(?<![\w.])-?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")
RELATIVE = 0.02
Done = subprocess.CompletedProcess[str]
"""A finished command: its exit code, and stdout and stderr as a terminal shows them."""
STARTED = {"tradeoff"}
"""Commands that a test has started in a process of their own.

`tradeoff` always runs within this process, because only here can its study be made small.
"""


class PageError(AssertionError):
    """A page states something false, or something that this module does not understand."""


@dataclass
class Walk:
    """One run of a page, in a folder of its own.

    Attributes:
        folder: where the commands run.
        printed: the output of each command, by the command as the page shows it.
        shorter: the current substitutions, each with whether a command contained it.
        started: commands that run within this process, because one run has started them already.
    """

    folder: Path
    printed: dict[str, str] = field(default_factory=dict)
    shorter: dict[tuple[str, str], bool] = field(default_factory=dict)
    started: set[str] = field(default_factory=lambda: STARTED)
    _code: int = 0
    _vary: bool = False
    _last: str = ""

    def page(self, text: str) -> None:
        """Run a whole page.

        Raises:
            PageError: if a command ends with another code or prints something else, or if a comment
                has no effect.
        """
        for language, title, body, comment in PART.findall(text):
            if comment:
                self._note(comment)
            elif title:
                path = self.folder / title
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(body, encoding="utf-8")
            elif language == "bash":
                self._run_all(body)
            elif language == "text":
                self._compare(body)
        unused = [f"{long} -> {short}" for (long, short), used in self.shorter.items() if not used]
        if unused or self._code or self._vary:
            raise PageError(
                f"comments that no command or output follows: {unused or 'exits, or figures vary'}"
            )

    def _note(self, comment: str) -> None:
        if " -> " in comment:
            long, short = comment.split(" -> ")
            self.shorter[long, short] = False
        elif comment == "figures vary":
            self._vary = True
        elif match := re.fullmatch(r"exits (\d)", comment):
            self._code = int(match[1])
        else:
            raise PageError(f"no such comment: {comment}")

    def _run_all(self, block: str) -> None:
        expected = self._code
        self._code = 0
        self._last = ""
        for command in block.replace("\\\n", " ").splitlines():
            process = self.run(command)
            if process.returncode != expected:
                raise PageError(
                    f"{command}\nended with {process.returncode}, not {expected}:\n{process.stdout}"
                )
            self.printed[command] = process.stdout
            self._last += process.stdout

    def run(self, command: str) -> Done:
        """Run one command with its substitutions.

        Raises:
            PageError: if the program is not in `PROGRAMS`.
        """
        short = command
        for pair in self.shorter:
            self.shorter[pair] |= pair[0] in short
            short = short.replace(*pair, 1)
        words = shlex.split(short)
        if not words or words[0] not in PROGRAMS:
            raise PageError(f"{command}\nis no command of {' or '.join(PROGRAMS)}")
        if words[0] == OURS and self.started.issuperset(words[1:2]):
            return self._within(words[1:])
        self.started.update(words[1:2] if words[0] == OURS else ())
        return self._started(words)

    def _within(self, words: list[str]) -> Done:
        with chdir(self.folder):
            result = CliRunner().invoke(app, words, prog_name=OURS, env=environment(self.folder))
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise PageError(f"{words} ended with a traceback") from result.exception
        return Done(words, result.exit_code, result.output)

    def _started(self, words: list[str]) -> Done:
        system_variables = {
            name: os.environ[name] for name in ("SYSTEMROOT", "TEMP") if name in os.environ
        }
        ours = {
            "PYTHONPATH": str(ROOT),
            "PYTHONUNBUFFERED": "1",
            "PYTHONUTF8": "1",
            "OMP_NUM_THREADS": "1",
        }
        return subprocess.run(
            [*PROGRAMS[words[0]], *words[1:]],
            cwd=self.folder,
            env=system_variables | ours | environment(self.folder),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
        )

    def _compare(self, page_text: str) -> None:
        lines = iter(plain(self._last))
        vary = self._vary
        self._vary = False
        for line in plain(page_text):
            if line != "..." and not any(
                agrees(line, printed_line, vary) for printed_line in lines
            ):
                raise PageError(
                    f"not printed, or not in this place:\n{line}\nwhat was printed:\n{self._last}"
                )


def environment(folder: Path) -> dict[str, str]:
    """Return variables that name a home of its own, and a PATH without programs."""
    return {"PATH": "", "HOME": str(folder), "USERPROFILE": str(folder)}


def plain(text: str) -> list[str]:
    """Return the lines that are not empty, with blanks and rules of tables of one length."""
    return [
        line for raw in text.splitlines() if (line := re.sub(r"([\s━─])\1*", r"\1", raw.strip()))
    ]


def agrees(expected_line: str, printed_line: str, vary: bool) -> bool:
    """Return True if a page and a command have the same words and close numbers in a line.

    Args:
        expected_line: the line of the page, where `...` stands for any text.
        printed_line: the line of the command.
        vary: whether numbers may differ.
    """
    parts = expected_line.split("...")
    texts = (
        re.escape(NUMBER.sub("\0", part)).replace("\0", f"({NUMBER.pattern})") for part in parts
    )
    match = re.fullmatch(".*?".join(texts), printed_line)
    if match is None or vary:
        return match is not None
    page_numbers = chain.from_iterable(map(NUMBER.findall, parts))
    pairs = zip(page_numbers, match.groups(), strict=True)
    numbers = ([float(number.replace(",", "")) for number in pair] for pair in pairs)
    return all(math.isclose(*pair, rel_tol=RELATIVE) for pair in numbers)
