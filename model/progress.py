"""Long work: its progress is shown, and Ctrl-C waits for a good moment.

`steps` is a bar for work whose length is known, `progress` names one step after the other where it
is not. On a terminal both are rich's, elsewhere plain lines, always on standard error. An interrupt
arrives between two steps, never within one: a half-made update cannot be resumed.
"""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from types import FrameType

from rich import progress as rich_progress
from rich.console import Console

from beers_deploy.profiles.errors import one_line

Log = Callable[[str], None]
"""Is told a sentence, or the name of a step, as the work goes on."""

LINE_EVERY_S = 5.0


@dataclass(frozen=True)
class Step:
    """How far a piece of work is: what is done, how many steps of it, and of how many (None where
    none can say).
    """

    what: str
    done: int
    total: int | None


Progress = bool | Callable[[Step], None] | None
"""How a caller wants to be told: a function, False for not at all, None or True for a bar or plain
lines.
"""

_sink: ContextVar[Progress] = ContextVar("progress", default=None)


@contextmanager
def reporting(wanted: Progress) -> Iterator[None]:
    """Report the work of this block as a caller wants; None leaves it as it is."""
    token = _sink.set(_sink.get() if wanted is None else wanted)
    try:
        yield
    finally:
        _sink.reset(token)


def _shows_bars() -> bool:
    """Whether there is a terminal or a notebook to draw on."""
    console = Console(stderr=True)
    return console.is_terminal or console.is_jupyter


def no_log(_: str) -> None:
    """Tell nobody."""


def once(log: Log) -> Log:
    """Tells each sentence the first time alone: several networks of one sensor have the same to
    say.
    """
    sentences = set[str]()

    def tell(sentence: str) -> None:
        if sentence not in sentences:
            sentences.add(sentence)
            log(sentence)

    return tell


class Steps:
    """Counts steps of one piece of work."""

    def __init__(self, label: str, total: int, bar: rich_progress.Progress | None) -> None:
        self.label = label
        self.total = total
        self.done = 0
        self._bar = bar
        self._task = bar.add_task(label, total=total) if bar else None
        self._printed = time.monotonic()

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Report that so many further steps are done."""
        self.done += steps
        sink = _sink.get()
        text = f"{self.label} {note}".strip()
        if callable(sink):
            sink(Step(text, self.done, self.total))
        elif self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=self.done, description=one_line(text))
        elif sink is not False and (
            time.monotonic() - self._printed > LINE_EVERY_S or self.done >= self.total
        ):
            self._printed = time.monotonic()
            _line(f"{self.label}: {self.done}/{self.total} {note}".rstrip())


@contextmanager
def steps(label: str, total: int) -> Iterator[Steps]:
    """Show the progress of `total` steps while the block runs."""
    if _sink.get() not in (None, True) or not _shows_bars():
        yield Steps(label, total, None)
        return
    columns = (
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeRemainingColumn(),
    )
    with _bar(*columns) as bar:
        yield Steps(label, total, bar)


@contextmanager
def progress(label: str) -> Iterator[Log]:
    """Show the name of each step that is begun while the block runs, and on a terminal the time
    since it began.
    """
    sink = _sink.get()
    if callable(sink):
        begun = iter(range(sys.maxsize))
        yield lambda step: sink(Step(f"{label}: {step}", next(begun), None))
    elif sink is False:
        yield no_log
    elif not _shows_bars():
        yield lambda step: _line(f"{label}: {step}")
    else:
        with _bar(rich_progress.TimeElapsedColumn()) as bar:
            task = bar.add_task(label, total=None)
            yield lambda step: bar.update(task, description=one_line(f"{label}: {step}"))


def _line(text: str) -> None:
    sys.stderr.write(f"{one_line(text)}\n")


def _bar(*columns: rich_progress.ProgressColumn) -> rich_progress.Progress:
    # Without markup a name in brackets is shown as it is.
    words = rich_progress.TextColumn("{task.description}", markup=False)
    return rich_progress.Progress(words, *columns, console=Console(stderr=True), transient=True)


class Interrupt:
    """Whether somebody asked to stop."""

    asked = False


@contextmanager
def held_back() -> Iterator[Interrupt]:
    """Note the first Ctrl-C (or SIGTERM) instead of raising it; a second one raises at once.

    Does nothing outside the main thread, where signals do not arrive.
    """
    interrupt = Interrupt()
    # Python delivers signals to the main thread, and accepts handlers there alone.
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return

    def note(_number: int, _frame: FrameType | None) -> None:
        if interrupt.asked:
            raise KeyboardInterrupt
        interrupt.asked = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
