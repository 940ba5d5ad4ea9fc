"""A list of faulty detectors, as a file.

The list is a CSV file, `column,row` or `column,row,band`, as `restore --fix-detectors` writes and
reads it. Columns and rows count from 0, bands from 1. A line without a band applies to all bands. A
row of `*` stands for the whole column, and a column of `*` for the whole row.
"""

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from beers_deploy.model.raster.facts import Raster
from beers_deploy.profiles.errors import OptionError, counted
from beers_deploy.profiles.user_files.whole import read_whole, unreadable

FOUND = "found"
HEADER = ("column", "row", "band")
ALL = "*"
HEADER_LINE = re.compile(r"\s*column\s*,\s*row\s*(,\s*band\s*)?")
NO_FAULT = re.compile(rf"\s*|#.*|{HEADER_LINE.pattern}")
"""Lines of a list that are skipped: empty ones, comments and the header."""
FAULT = re.compile(
    r"(?!\s*\*\s*,\s*\*)\s*(\d{1,9}|\*)\s*,\s*(\d{1,9}|\*)\s*(?:,\s*0*([1-9]\d{0,8})\s*)?",
    re.ASCII,
)
"""A line with a fault: column and row, not both '*', and perhaps a band. No image has more than 9
digits.
"""
LIST_BYTES = 1 << 26
"""The largest size of a list."""


@dataclass(frozen=True, order=True)
class Fault:
    """One fault of an image's detectors: a pixel, a whole column or a whole row.

    Attributes:
        column: the column of the image, counted from 0; -1 if the fault is a whole row.
        row: the row of the image, counted from 0; -1 if the fault is a whole column.
        band: the band of the image, counted from 1; 0 for all bands.
    """

    column: int
    row: int
    band: int = 0

    @property
    def line(self) -> str:
        """The line of a CSV list that describes this fault, such as "17,*" for column 17."""
        numbers = [ALL if place < 0 else str(place) for place in (self.column, self.row)]
        return ",".join([*numbers, *([str(self.band)] if self.band else [])])


@dataclass(frozen=True)
class FaultList:
    """The list of an image's faulty detectors, as a file states it or as they were detected.

    Attributes:
        faults: the faults, sorted and without duplicates; empty for none.
    """

    faults: tuple[Fault, ...]

    @property
    def text(self) -> str:
        """The list as the content of a CSV file, with a header line."""
        header = HEADER if any(fault.band for fault in self.faults) else HEADER[:2]
        return "\n".join([",".join(header), *(fault.line for fault in self.faults), ""])

    @property
    def sha256(self) -> str:
        """The SHA-256 of `text` as hex. A run is resumed only if it is the same."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def words(self) -> str:
        """The number of faults of each kind in words, such as "3 pixels, 1 column", or "none"."""
        columns = sum(fault.row < 0 for fault in self.faults)
        rows = sum(fault.column < 0 for fault in self.faults)
        counts = {"pixel": len(self.faults) - columns - rows, "column": columns, "row": rows}
        words = [counted(count, name) for name, count in counts.items() if count]
        return ", ".join(words) or "none"

    def mask(self, raster: Raster, start: int, stop: int) -> np.ndarray:
        """Return a mask of the faulty pixels in rows `start` to `stop` (excluded) of an image.

        Args:
            raster: the description of the image, which states the number of bands and the width.
            start: the first row.
            stop: the row after the last one.

        Returns:
            The mask, bool (bands, rows, width).
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


def found_list_path(out: Path, source: str) -> Path | None:
    """Return the path at which a run writes the faults that it detected, next to its result.

    Args:
        out: the path of the restored image.
        source: the value of the option `fix_detectors`.

    Returns:
        The path of the CSV file; None unless `source` is "found", because only then faults are
        searched for.
    """
    return out.with_name(f"{out.stem}.detectors.csv") if source == FOUND else None


def read_list(path: Path, raster: Raster) -> FaultList:
    """Read the list of faulty detectors that a user gives for an image.

    Args:
        path: the path of the CSV file.
        raster: the description of the image.

    Raises:
        OptionError: the file cannot be read or has neither faults nor a header, or a line is no
            fault or lies outside the image.
    """
    reason = "lists none"
    lines = list[str]()
    try:
        lines = read_whole(path, LIST_BYTES).decode("utf-8-sig").splitlines()
    except (OSError, ValueError):
        reason = f"cannot be read: {unreadable(path) or 'it is not a text file'}"
    faults = set[Fault]()
    for number, line in enumerate(lines, 1):
        if NO_FAULT.fullmatch(line):
            continue
        match = FAULT.fullmatch(line)
        if match is None:
            raise OptionError(
                f"Line {number} of {path} must be column,row or column,row,band, got {line[:40]!r}."
                " Correct or delete the line."
            )
        column, row, band = (-1 if cell == ALL else int(cell or 0) for cell in match.groups())
        if column >= raster.width_px or row >= raster.height_px or band > raster.bands:
            raise OptionError(
                f"Line {number} of {path} ({line.strip()}) lies outside the image, which has "
                f"{raster.width_px} columns, {raster.height_px} rows and "
                f"{counted(raster.bands, 'band')}. Count columns and rows from 0, and bands from 1."
            )
        faults.add(Fault(column, row, band))
    # If a run finds no faults, its list has only a header.
    if not faults and not any(HEADER_LINE.fullmatch(line) for line in lines):
        raise OptionError(
            f"`fix_detectors` must be '{FOUND}' or a list of faulty detectors, but {path} {reason}."
            " Write lines 'column,row', counted from 0, with '*' as the row for a whole column."
        )
    return FaultList(tuple(sorted(faults)))
