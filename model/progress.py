"""Show the progress of long work, and delay Ctrl-C until a step is complete.

`steps` counts work whose length is known, `progress` names one step after the other if it is not,
and `step` names a step from within. On a terminal and in Jupyter they are one bar of rich,
elsewhere plain lines on standard error. An interrupt arrives between two steps, never within one,
because a half-made update cannot be resumed.
"""

import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING

from beers_deploy.profiles.errors import OptionError, one_line, printable

if TYPE_CHECKING:
    # Each command loads this module, also where it only prints its help.
    from rich.console import Console
    from rich.progress import Progress as Bar
    from rich.progress import TaskID

logger = logging.getLogger(__name__)

LINE_EVERY_S = 5.0


@dataclass(frozen=True)
class Step:
    """The progress of a piece of work.

    Attributes:
        what: description of the work.
        done: the number of steps that are done.
        total: the number of all steps, or None if unknown.
    """

    what: str
    done: int
    total: int | None


Progress = bool | Callable[[Step], None] | None
"""The form in which a caller gets progress: a function that is called; False for none; None or True
for a bar or plain lines.
"""

_sink: ContextVar[Progress] = ContextVar("progress", default=None)


@contextmanager
def reporting(callback: Progress) -> Iterator[None]:
    """Set how progress is reported inside the `with` block.

    Args:
        callback: a function that is called with each step, False for no report, True for a bar or
            plain lines. None leaves the setting of the surrounding block.

    Raises:
        OptionError: the callback is of another type.
    """
    if callback is not None and not isinstance(callback, bool) and not callable(callback):
        raise OptionError(
            f"`progress` must be a function, False or None, got {printable(repr(callback))}."
        )
    token = _sink.set(_sink.get() if callback is None else callback)
    try:
        yield
    finally:
        _sink.reset(token)


class Display:
    """The one bar that is drawn, on which all work that runs has a line."""

    bar: "Bar | None" = None


def live_console() -> "Console | None":
    """Return the console of the bar that is drawn now, or None: other lines go through it."""
    return Display.bar.console if Display.bar is not None else None


@contextmanager
def _task(label: str, total: int | None) -> "Iterator[TaskID | None]":
    """Add a line to the bar while a block runs; None where no bar is drawn."""
    if _sink.get() not in (None, True):
        yield None
        return
    from rich.console import Console

    console = Console(stderr=True)
    # A bar needs a terminal or a notebook to be drawn on.
    if not console.is_terminal and not console.is_jupyter:
        yield None
        return
    # Two bars at once would overwrite each other.
    outer = Display.bar
    bar = outer
    if bar is None:
        bar = Display.bar = _new_bar()
        bar.start()
    task = bar.add_task(one_line(label), total=total)
    try:
        yield task
    finally:
        if outer is None:
            Display.bar = None
            bar.stop()
        else:
            bar.remove_task(task)


def _new_bar() -> "Bar":
    from rich import progress as rich_progress
    from rich.console import Console

    return rich_progress.Progress(
        # Without markup a name in brackets is shown as it is.
        rich_progress.TextColumn("{task.description}", markup=False),
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeElapsedColumn(),
        rich_progress.TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )


class Steps:
    """Counts steps of one piece of work; `total` is None if their number is unknown."""

    def __init__(self, label: str, total: int | None, task: "TaskID | None", nested: bool) -> None:
        self.label = label
        self.total = total
        self.done = 0
        self._task = task
        self._nested = nested
        self._printed = time.monotonic()

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Report that further steps are done."""
        self.done += steps
        self.show(f"{self.label} {note}".strip(), f"{self.label}: {self.done}/{self.total} {note}")

    def show(self, text: str, line: str) -> None:
        """Show the present state of the work: as `text` on a bar or to the caller's function, or as
        a plain `line` now and then; nothing if progress is off.
        """
        sink = _sink.get()
        if callable(sink):
            sink(Step(text, self.done, self.total))
        elif self._task is not None and Display.bar is not None:
            Display.bar.update(self._task, completed=self.done, description=one_line(text))
        elif sink is not False:
            # A plain line is written from time to time, and at the end of outer work.
            now = time.monotonic()
            ends = self.total is None or (self.done >= self.total and not self._nested)
            if ends or now - self._printed > LINE_EVERY_S:
                self._printed = now
                sys.stderr.write(f"{one_line(line.rstrip())}\n")


_work: ContextVar[Steps | None] = ContextVar("work", default=None)
_nested: ContextVar[bool] = ContextVar("nested", default=False)


@contextmanager
def steps(label: str, total: int | None) -> Iterator[Steps]:
    """Show the progress of `total` steps while the block runs."""
    with _task(label, total) as task:
        nested = _nested.get()
        token = _nested.set(True)
        try:
            yield Steps(label, total, task, nested)
        finally:
            _nested.reset(token)


@contextmanager
def progress(label: str) -> Iterator[None]:
    """Show the steps that `step` names while the block runs."""
    with steps(label, None) as work:
        token = _work.set(work)
        try:
            yield
        finally:
            _work.reset(token)


def step(name: str) -> None:
    """Name the step that begins now, for the progress report of this work."""
    work = _work.get()
    if work is None or _sink.get() is False:
        logger.debug(name)
        return
    text = f"{work.label}: {name}"
    work.show(text, text)
    work.done += 1


class Interrupt:
    """A flag: `asked` is True if the user asked to stop."""

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
