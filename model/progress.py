"""Long work: its progress is shown, and Ctrl-C waits for a good moment.

`steps` is a bar for work whose length is known, `progress` names one step after the other where it is not. On a
terminal both are rich's, elsewhere plain lines, always on standard error. An interrupt arrives between
two steps, never within one: a half-made update cannot be resumed.
"""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

Log = Callable[[str], None]
"""Is told a sentence, or the name of a step, as the work goes on."""

LINE_EVERY_S = 5.0


def no_log(_: str) -> None:
    """Tell nobody."""


def once(log: Log) -> Log:
    """Tells each sentence the first time alone: several networks of one sensor have the same to say."""
    told = set[str]()

    def tell(sentence: str) -> None:
        if sentence not in told:
            told.add(sentence)
            log(sentence)

    return tell


class Steps:
    """Counts steps of one piece of work."""

    def __init__(self, label: str, total: int, bar: Progress | None) -> None:
        self.label, self.total, self.done, self._bar = label, total, 0, bar
        self._task = bar.add_task(label, total=total) if bar else None
        self._printed = time.monotonic()

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Report that so many further steps are done."""
        self.done += steps
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=self.done, description=f"{self.label} {note}".strip())
        elif time.monotonic() - self._printed > LINE_EVERY_S or self.done >= self.total:
            self._printed = time.monotonic()
            sys.stderr.write(f"{self.label}: {self.done}/{self.total} {note}".rstrip() + "\n")


@contextmanager
def steps(label: str, total: int) -> Iterator[Steps]:
    """Show the progress of `total` steps while the block runs."""
    if not sys.stderr.isatty():
        yield Steps(label, total, None)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        yield Steps(label, total, bar)


@contextmanager
def progress(label: str) -> Iterator[Log]:
    """Show the name of each step that is begun while the block runs, and on a terminal the time since it began."""
    if not sys.stderr.isatty():

        def line(step: str) -> None:
            sys.stderr.write(f"{label}: {step}\n")

        yield line
        return
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task(label, total=None)
        yield lambda step: shown.update(task, description=f"{label}: {step}")


class Interrupt:
    """Whether somebody asked to stop."""

    asked = False


@contextmanager
def held_back() -> Iterator[Interrupt]:
    """Note the first Ctrl-C (or SIGTERM) instead of raising it; a second one raises at once.

    Does nothing outside the main thread, where signals do not arrive.
    """
    interrupt = Interrupt()
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
