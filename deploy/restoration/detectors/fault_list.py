"""A list of faulty detectors, as a file.

The list is a CSV file, `column,row` or `column,row,band`, as `restore --fix-detectors` writes and
reads it. Columns and rows count from 0, bands from 1. A line without a band applies to all bands. A
row of `*` stands for the whole column, and a column of `*` for the whole row.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from beers_deploy.model.io.files import write_text
from beers_deploy.model.raster.facts import Raster
from beers_deploy.profiles.errors import OptionError, printable

LINES = "Write lines 'column,row', counted from 0, with '*' as the row for a whole column."
FOUND = "found"
HEADER = ("column", "row", "band")
ALL = "*"
DIGITS = 9
"""The largest number of digits in a number, because no image is larger."""


@dataclass(frozen=True, order=True)
class Fault:
    """A faulty pixel, column or row.

    Attributes:
        column: of the image, from 0; -1 for all of a row.
        row: of the image, from 0; -1 for all of a column.
        band: from 1; 0 for all bands.
    """

    column: int
    row: int
    band: int = 0

    @property
    def line(self) -> str:
        """The line in a file that describes this fault."""
        numbers = [ALL if place < 0 else str(place) for place in (self.column, self.row)]
        return ",".join([*numbers, *([str(self.band)] if self.band else [])])


@dataclass(frozen=True)
class FaultList:
    """The faults of an image's detectors, sorted and without duplicates."""

    faults: tuple[Fault, ...]

    @property
    def text(self) -> str:
        """The list as the content of a file."""
        header = HEADER if any(fault.band for fault in self.faults) else HEADER[:2]
        return "\n".join([",".join(header), *(fault.line for fault in self.faults), ""])

    @property
    def sha256(self) -> str:
        """The hex digest of the content."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def words(self) -> str:
        """The number of pixels, columns and rows, in words."""
        columns = sum(fault.row < 0 for fault in self.faults)
        rows = sum(fault.column < 0 for fault in self.faults)
        counts = {"pixel": len(self.faults) - columns - rows, "column": columns, "row": rows}
        words = [
            f"{count} {name}{'s' if count > 1 else ''}" for name, count in counts.items() if count
        ]
        return ", ".join(words) or "none"

    def mask(self, raster: Raster, start: int, stop: int) -> np.ndarray:
        """Return a mask of the faulty pixels in rows `start` to `stop` (excluded), bool (bands,
        rows, width).
        """
        flags = np.zeros((raster.bands, stop - start, raster.width_px), bool)
        columns, rows, bands = self._numbers.T
        single = (columns >= 0) & (start <= rows) & (rows < stop)
        for band, plane in enumerate(flags, 1):
            here = (bands == 0) | (bands == band)
            plane[:, columns[here & (rows < 0)]] = True
            plane[rows[here & (columns < 0) & (start <= rows) & (rows < stop)] - start] = True
            plane[rows[here & single] - start, columns[here & single]] = True
        return flags

    @cached_property
    def _numbers(self) -> np.ndarray:
        """Column, row and band of each fault, (n, 3)."""
        places = [(fault.column, fault.row, fault.band) for fault in self.faults]
        return np.array(places, np.int64).reshape(-1, 3)


def list_beside(out: Path, source: str) -> Path | None:
    """Return the path of the list of found faults next to the restored image, or None if no faults
    are searched for.
    """
    return out.with_name(f"{out.stem}.detectors.csv") if source == FOUND else None


def write_list(faults: FaultList, path: Path | None) -> None:
    """Write the faults that were found, if any, unless the path is None."""
    if path is not None and faults.faults:
        write_text(path, faults.text)


def read_list(path: Path, raster: Raster) -> FaultList:
    """Read a list of faults, and raise an error if one does not fit the image.

    Args:
        path: the path of the file.
        raster: of the image.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise OptionError(
            f"`fix_detectors` must be '{FOUND}' or a list of faulty detectors, but {path} cannot "
            f"be read: {error.strerror or error}. {LINES}"
        ) from error
    except UnicodeDecodeError as error:
        raise OptionError(
            f"`fix_detectors` must be '{FOUND}' or a list of faulty detectors, but {path} is not "
            f"a text file. {LINES}"
        ) from error
    faults = []
    for number, line in enumerate(lines, 1):
        cells = tuple(cell.strip() for cell in line.split(","))
        # Files of all bands have no column for the band, and so a shorter header.
        if not any(cells) or line.startswith("#") or cells in (HEADER, HEADER[:2]):
            continue
        faults.append(_fault(path, number, line, raster))
    if not faults:
        raise OptionError(
            f"`fix_detectors` must be '{FOUND}' or a list of faulty detectors, but {path} lists "
            f"none. {LINES}"
        )
    return FaultList(tuple(sorted(set(faults))))


def _fault(path: Path, number: int, line: str, raster: Raster) -> Fault:
    """Return the fault of one line, the `number`-th of the file."""
    sizes = raster.width_px, raster.height_px, raster.bands + 1
    numbers = [_number(cell.strip()) for cell in line.split(",")]
    # Bands count from 1, and no band may be '*': a line without a band holds for all.
    if (
        len(numbers) not in (2, 3)
        or None in numbers
        or numbers[:2] == [-1, -1]
        or numbers[2:] in ([-1], [0])
    ):
        raise OptionError(
            f"Line {number} of {path} must be column,row or column,row,band, got {line[:40]!r}. "
            "Correct or delete the line."
        )
    placed = [value for value in numbers if value is not None]
    # A line without a band has two numbers for the three sizes.
    if any(value >= size for value, size in zip(placed, sizes, strict=False)):
        raise OptionError(
            f"Line {number} of {path} ({printable(line.strip())}) lies outside the image of "
            f"{raster.width_px} columns, {raster.height_px} rows and {raster.bands} bands. Count "
            "columns and rows from 0."
        )
    return Fault(*placed)


def _number(cell: str) -> int | None:
    """Return the number in a cell, -1 for `*`, or None for anything else."""
    if cell == ALL:
        return -1
    # `isdecimal` alone accepts the digits of every script.
    return int(cell) if cell.isascii() and cell.isdecimal() and len(cell) <= DIGITS else None
