"""Finished rows beside the output, so that a run killed at any moment goes on where it stopped.

`.OUT.part/` holds rows.raw, the pixels, and journal.json, what the run is about and how many rows are finished. Rows
reach the disk before the journal counts them, and the journal is replaced in one step: it never claims too much.
"""

import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from deploy.tiling import Span
from profiles.errors import MachineError, OptionError, sizes
from profiles.text import read_json


def part_folder(out: Path) -> Path:
    """Where a run keeps what it needs for `out`."""
    return out.with_name(f".{out.name}.part")


class Spool:
    """The rows of a (bands, height, width) image, finished from the top."""

    def __init__(
        self, out: Path, shape: tuple[int, int, int], dtype: np.dtype[Any], job: Mapping[str, object], resume: bool
    ) -> None:
        """Begin, or go on with what an earlier run left.

        Args:
            out: the image to write in the end.
            shape: (bands, height, width).
            dtype: of the pixels.
            job: all that decides the pixels; a run is resumed only by one of the same job.
            resume: go on; where nothing was left, begin.

        Raises:
            MachineError: no room for the rows.
            OptionError: what was left belongs to another job.
        """
        self.out, self.shape, self.dtype = out, shape, dtype
        self.folder = part_folder(out)
        self._job = dict(job)
        self.rows, self.known = self._left() if resume else (0, 0)
        with self.disk():
            if not self.rows:
                self.remove()
            out.parent.mkdir(parents=True, exist_ok=True)
            self._require_room()
            self.folder.mkdir(exist_ok=True)
            (self.folder / "rows.raw").touch()

    def append(self, span: Span, pixels: np.ndarray, known: int) -> None:
        """Keep the rows `span.keep_start` to `span.keep_stop`, of whose pixels so many are known.

        Raises:
            MachineError: the disk is full or gone.
        """
        with self.disk():
            with (self.folder / "rows.raw").open("r+b") as stream:
                for plane in range(self.shape[0]):
                    stream.seek(self._offset(plane, span.keep_start))
                    stream.write(np.ascontiguousarray(pixels[plane]).data)
                stream.flush()
                os.fsync(stream.fileno())
            self.rows, self.known = span.keep_stop, self.known + known
            self._write_journal()

    def read(self, plane: int, start: int, stop: int) -> np.ndarray:
        """Finished rows of one band, (rows, width)."""
        count = (stop - start) * self.shape[2]
        path, offset = self.folder / "rows.raw", self._offset(plane, start)
        return np.fromfile(path, self.dtype, count, offset=offset).reshape(-1, self.shape[2])

    def remove(self) -> None:
        """Throw the rows away; the journal first, so that nothing is left that counts on them."""
        for name in ("journal.json", "journal.new", "rows.raw", "out.tif"):
            (self.folder / name).unlink(missing_ok=True)

    @contextmanager
    def disk(self) -> Iterator[None]:
        """One sentence for what a disk may do.

        Raises:
            MachineError: full, gone, or not ours to write to.
        """
        try:
            yield
        except OSError as error:
            remedy = f"mend that, and go on with --resume from row {self.rows} of {self.shape[1]}"
            got = error.strerror or str(error)
            raise MachineError(str(self.out), expected="a disk to write to", got=got, remedy=remedy) from error

    def _left(self) -> tuple[int, int]:
        path = self.folder / "journal.json"
        if not path.is_file():
            return 0, 0
        with suppress(ValueError, KeyError, TypeError, OSError):
            journal: Any = read_json(path)
            rows, known = int(journal["rows"]), int(journal["known"])
            if journal["job"] == self._job and 0 <= rows <= self.shape[1] and 0 <= known <= math.prod(self.shape):
                return rows, known
        raise OptionError(
            "--resume",
            expected="the image, the model and the options of the run that was stopped",
            got=f"others, or a damaged {path}",
            remedy="run it as before, or start afresh without --resume",
        )

    def _write_journal(self) -> None:
        path, fresh = self.folder / "journal.json", self.folder / "journal.new"
        with fresh.open("w", encoding="utf-8") as stream:
            json.dump({"job": self._job, "rows": self.rows, "known": self.known}, stream)
            stream.flush()
            os.fsync(stream.fileno())
        fresh.replace(path)
        sync_folder(self.folder)

    def _offset(self, plane: int, row: int) -> int:
        return (plane * self.shape[1] + row) * self.shape[2] * self.dtype.itemsize

    def _require_room(self) -> None:
        bands, height, width = self.shape
        needed = bands * (height - self.rows) * width * self.dtype.itemsize
        free = shutil.disk_usage(self.out.parent).free
        if needed > free:
            (wanted, left), remedy = sizes(needed, free), "free some space or write elsewhere"
            raise MachineError(str(self.out), expected=f"{wanted} of disk", got=f"{left} free", remedy=remedy)


def sync_folder(folder: Path) -> None:
    """Make a renaming in `folder` last; not every system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
