"""What every reader of labels hands on: boxes with the names of their classes, in pixels of the image's file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from profiles.errors import OptionError
from profiles.toml import read_whole

LABEL_BYTES = 1 << 23
"""Of the labels of one image: a box takes some 300 bytes of XML, so that 25 000 of them fit."""


@dataclass(frozen=True)
class NamedBox:
    """A labelled box.

    Attributes:
        corners: left, top, right and bottom in px, pixel i covering [i, i + 1).
        name: of the class, as it is spelled there.
        ignored: whether it was labelled as one that need not be found.
    """

    corners: tuple[float, float, float, float]
    name: str
    ignored: bool = False


@dataclass(frozen=True)
class FileLabels:
    """What is labelled on one image.

    Attributes:
        image: its file.
        boxes: on it.
        size_px: height and width that the labels were made for, where they say so.
        source: the file of the labels, for messages.
    """

    image: Path
    boxes: Sequence[NamedBox]
    source: Path
    size_px: tuple[int, int] | None = field(default=None)


def read_labels(path: Path, limit_bytes: int = LABEL_BYTES) -> bytes:
    """The bytes of a file of labels, or of what stands beside them.

    Raises:
        OptionError: missing, not readable, or larger than such a file is.
    """
    try:
        return read_whole(path, limit_bytes)
    except (OSError, ValueError) as error:
        got = getattr(error, "strerror", None) or str(error)
        raise faulty(path, "a file of labels", got) from error


def numbers(texts: Sequence[str], path: Path, where: str) -> tuple[float, ...]:
    """Finite numbers of their texts.

    Raises:
        OptionError: one is none.
    """
    try:
        found = tuple(float(text) for text in texts)
    except ValueError:
        found = (math.nan,)
    if not all(map(math.isfinite, found)):
        raise faulty(path, f"numbers as {where}", repr(" ".join(texts))[:80])
    return found


def enclosing(points: Sequence[float]) -> tuple[float, float, float, float]:
    """The upright box around the corners x, y, x, y, ... of a polygon."""
    x, y = points[0::2], points[1::2]
    return min(x), min(y), max(x), max(y)


def faulty(path: Path, expected: str, got: str, remedy: str = "correct the labels") -> OptionError:
    """One sentence about a file of labels."""
    return OptionError(str(path), expected=expected, got=got, remedy=remedy)
