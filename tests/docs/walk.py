"""Walks a page as a reader would: writes its files, runs its commands in order, and holds them to
what it shows.

Of a page's fences these count, in order:

- any with a title, as ```toml title="my-sensor.toml": a file, written as it stands;
- ```bash: commands, a line each, of the programs known here (`PROGRAMS`), run without a shell (so
  also on Windows), ours within this process, where all is imported already, but for the first time
  that each command comes up;
- ```text: what the commands before it print. Each of its lines must come, in this order; `...`
  stands for anything, blanks and rules of tables have any length, and a number must be within 2 %,
  for processors differ.

Comments of the page say where a test differs from a reader:

- `<!-- test: A -> B -->`: from here on commands have B in the place of A, once each at most in a
  line;
- `<!-- test: figures vary -->`: of the next output the numbers are another machine's: only their
  place is compared;
- `<!-- test: exits 1 -->`: the next commands end with this code, not with 0.
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

ROOT = Path(__file__).resolve().parents[2]
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
"""A command that ended: its code, and both streams as a terminal shows them."""
STARTED = {"tradeoff"}
"""Commands that have been started as a shell starts them; a study is small in
this process alone.
"""


class PageError(AssertionError):
    """The page says what does not hold, or what this module does not understand."""


@dataclass
class Walk:
    """One walk through a page, in a folder of its own.

    Attributes:
        folder: where the commands run.
        printed: what each command printed, by the command as the page has it.
        shorter: substitutions in force, each with whether a command had it.
        started: commands that need not be started as a shell starts them, because one walk did.
    """

    folder: Path
    printed: dict[str, str] = field(default_factory=dict)
    shorter: dict[tuple[str, str], bool] = field(default_factory=dict)
    started: set[str] = field(default_factory=lambda: STARTED)
    _code: int = 0
    _vary: bool = False
    _last: str = ""

    def page(self, text: str) -> None:
        """Walk through a whole page.

        Raises:
            PageError: a command ends with another code, prints something else, or a comment is of
                no use.
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
        """One command with its substitutions.

        Raises:
            PageError: of a program that is not known here.
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
            check=False,
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
    """A home of its own, and no other program."""
    return {"PATH": "", "HOME": str(folder), "USERPROFILE": str(folder)}


def plain(text: str) -> list[str]:
    """The lines that are not empty; blanks and rules of tables have one length."""
    return [
        line for raw in text.splitlines() if (line := re.sub(r"([\s━─])\1*", r"\1", raw.strip()))
    ]


def agrees(expected_line: str, printed_line: str, vary: bool) -> bool:
    """Whether a line of the page is what a command printed: the same words, and numbers that are
    close.

    Args:
        shown: the page's, where `...` stands for anything.
        found: the command's.
        vary: numbers may be any.
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
