"""Ctrl-C between two steps, never within one: a half-made update cannot be resumed."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


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
