"""Interleaved timing: calls run round by round, so that whatever else the machine does meets them alike."""

from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")
Call = Callable[[], object]


def interleaved(
    calls: Sequence[Call], measure: Callable[[Call], T], enough: Callable[[Sequence[Sequence[T]]], bool]
) -> list[list[T]]:
    """Run every call once a round until there are enough rounds, and so compare them fairly.

    Args:
        calls: what is timed, already warmed up.
        measure: runs one call and says what it took.
        enough: asked after each round, with what was measured so far of each call, in the order of `calls`.

    Returns:
        What was measured of each call, round by round.
    """
    found: list[list[T]] = [[] for _ in calls]
    while True:
        for call, taken in zip(calls, found, strict=True):
            taken.append(measure(call))
        if enough(found):
            return found
