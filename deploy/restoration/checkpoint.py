"""The finished rows of a run on the disk, so that a run that is killed at any moment can continue.

A run with `resume` trusts nothing that it finds on the disk. The journal has a digest of its own,
and each row of tiles is compared with the journal's digest for it.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt
from pydantic import StrictInt, TypeAdapter

from beers_deploy.model.io.files import require_regular
from beers_deploy.model.io.lock import part_folder
from beers_deploy.model.raster.writer import padded_px
from beers_deploy.profiles.errors import MachineError, OptionError, sizes
from beers_deploy.profiles.user_files.json_text import read_json
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.tiles.rows import RestoredRow

PLAIN = "out.tif"
COG = "cog.tif"
"""Files of a checkpoint in which the output is written before it is renamed into place."""
ROWS_FILES = ("journal.json", "journal.new", "rows.raw")
"""Files of a checkpoint. The journal is the first, because it refers to the rows."""


@dataclass(frozen=True)
class FinishedRow:
    """The journal's entry on one restored row of tiles whose pixels are on the disk.

    Attributes:
        rows_px: the height of the row of tiles in pixels, the same for each band.
        sha256: the hex digest of the pixels of all bands, band after band.
        tally: counts and sums over these pixels and their raw ones.
    """

    rows_px: Annotated[StrictInt, Gt(0)]
    sha256: str
    tally: Tally


FINISHED = TypeAdapter(list[FinishedRow])
"""Checks the entries of a journal, which may be forged."""


def journal_text(job: Mapping[str, object], finished: Sequence[FinishedRow]) -> str:
    """Return the JSON text of a journal, the file by which a later run knows the finished rows.

    Args:
        job: all parameters that determine the pixels, by name.
        finished: the stored rows of tiles, from the top.
    """
    content = {"job": job, "finished": [asdict(row) for row in finished]}
    return json.dumps(content | {"sha256": _digest(content)})


def _digest(content: Mapping[str, object]) -> str:
    """Return the hex digest of a journal's content except its own digest."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


class Checkpoint:
    """The finished rows of a restored image on the disk, from the top, and a journal of their
    digests, from which a later run continues.

    Attributes:
        out: the path of the restored image, next to which the rows are stored.
        shape: the shape of the restored image, (bands, height, width).
        dtype: the type of its pixels.
        folder: the folder of the rows and the journal.
        rows: the number of finished rows of pixels.
        tally: counts and sums over the finished rows and their raw pixels.
        job: all parameters that determine the pixels, by name.
        damaged_rows: the number of rows of pixels that an earlier run finished and that are
            restored again, because they, or rows above them, no longer match the journal.
    """

    def __init__(
        self,
        out: Path,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        job: Mapping[str, object],
        resume: bool,
        more_bytes: int = 0,
        row_ends: Sequence[int] = (),
    ) -> None:
        """Start a checkpoint, or continue the one of an earlier run.

        Args:
            out: the path of the image to write in the end.
            shape: the shape of the restored image, (bands, height, width).
            dtype: the dtype of the pixels.
            job: all parameters that determine the pixels, by name; a run is resumed only by one of
                the same job.
            resume: True to continue an earlier run, and to start if there is none.
            more_bytes: disk space that outputs need in addition to the rows and the plain TIFF.
            row_ends: the row of pixels at which each row of tiles ends; a journal of other rows is
                refused. Empty accepts any rows.

        Raises:
            OptionError: an earlier run was of another job, or its journal is damaged.
            MachineError: the disk is too full or cannot be written.
        """
        self.out = out
        self.shape = shape
        self.dtype = dtype
        self.folder = part_folder(out)
        for name in ROWS_FILES:
            require_regular(self.folder / name)
        self.job = dict(job)
        self._row_ends = list(row_ends)
        journal_rows = self._left() if resume else []
        self._finished = self._matching(journal_rows)
        self.rows = sum(row.rows_px for row in self._finished)
        self.tally = sum((row.tally for row in self._finished), Tally())
        self.damaged_rows = sum(row.rows_px for row in journal_rows) - self.rows
        with self.disk():
            if not self.rows:
                self.remove()
            # Outputs that a stop left half-written take room that this run needs.
            self._remove_outputs()
            out.parent.mkdir(parents=True, exist_ok=True)
            self._require_room(more_bytes)
            self.folder.mkdir(exist_ok=True)
            (self.folder / "rows.raw").touch()

    def append(self, row: RestoredRow) -> None:
        """Store a row of restored tiles on disk, directly below the rows stored before.

        The pixels and the journal are flushed to the disk before it returns, so that a power cut
        loses only rows that were not appended.

        Args:
            row: the restored rows of all bands.

        Raises:
            MachineError: the disk is full or cannot be written.
        """
        with self.disk():
            with (self.folder / "rows.raw").open("r+b") as stream:
                digest = hashlib.sha256()
                for band in range(self.shape[0]):
                    pixels = np.ascontiguousarray(row.pixels[band]).data
                    stream.seek(self._offset(band, self.rows))
                    stream.write(pixels)
                    digest.update(pixels)
                stream.flush()
                # After a power cut, the rows that the journal counts must be on the disk.
                os.fsync(stream.fileno())
            rows_px = row.pixels.shape[1]
            self._finished.append(FinishedRow(rows_px, digest.hexdigest(), row.tally))
            self.rows += rows_px
            self.tally += row.tally
            fresh = self.folder / "journal.new"
            with fresh.open("w", encoding="utf-8") as journal:
                journal.write(journal_text(self.job, self._finished))
                journal.flush()
                os.fsync(journal.fileno())
            # A run that is killed here leaves the old journal or the new one, never half of one.
            fresh.replace(self.folder / "journal.json")
            sync_folder(self.folder)

    def read(self, band: int, start: int, stop: int) -> np.ndarray:
        """Read finished rows `start` to `stop` (excluded) of one band from the disk.

        Returns:
            The pixels (rows, width) in the type of the output.
        """
        count = (stop - start) * self.shape[2]
        pixels = np.fromfile(
            self.folder / "rows.raw", self.dtype, count, offset=self._offset(band, start)
        )
        return pixels.reshape(-1, self.shape[2])

    def remove(self) -> None:
        """Delete the rows and half-written outputs, the journal first, so that no journal refers to
        missing rows.
        """
        # The journal is the first of these, because it counts on the rows.
        for name in ROWS_FILES:
            (self.folder / name).unlink(missing_ok=True)
        self._remove_outputs()

    @contextmanager
    def disk(self) -> Iterator[None]:
        """Raise MachineError instead of an OSError, such as of a full disk, within the context. Its
        message tells the user how to continue.
        """
        try:
            yield
        except OSError as error:
            raise MachineError(
                f"{self.out} cannot be written: {error.strerror or error}. Correct that, and go on "
                f"with `resume` from row {self.rows} of {self.shape[1]}."
            ) from error

    def _left(self) -> list[FinishedRow]:
        """Return the rows of tiles that an earlier run finished, as its journal states. Raise
        OptionError if the journal is damaged or of another job.
        """
        path = self.folder / "journal.json"
        if not path.is_file():
            return []
        # A damaged journal may lack a key, or hold a value of another type.
        with suppress(ValueError, LookupError, TypeError, AttributeError, OSError):
            document: Any = read_json(path)
            content: dict[str, Any] = dict(document)
            is_whole = content.pop("sha256") == _digest(content)
            finished = FINISHED.validate_python(content["finished"])
            ends = list(accumulate(row.rows_px for row in finished))
            planned = not self._row_ends or ends == self._row_ends[: len(ends)]
            inside = max(ends, default=0) <= self.shape[1]
            if is_whole and content["job"] == self.job and planned and inside:
                return finished
        raise OptionError(
            "`resume` needs the image, the model and the options of the run that was stopped, but "
            f"they differ, or {path} is damaged. Run it as before, or start afresh without "
            "`resume`."
        )

    def _matching(self, finished: list[FinishedRow]) -> list[FinishedRow]:
        """Return the rows of tiles above the first one whose pixels differ from the journal's
        digest.
        """
        matching = list[FinishedRow]()
        top = 0
        for row in finished:
            digest = hashlib.sha256()
            # A file that was cut off holds no whole row of pixels.
            with suppress(OSError, ValueError):
                for band in range(self.shape[0]):
                    digest.update(self.read(band, top, top + row.rows_px).data)
            if digest.hexdigest() != row.sha256:
                break
            matching.append(row)
            top += row.rows_px
        return matching

    def _offset(self, band: int, row: int) -> int:
        return (band * self.shape[1] + row) * self.shape[2] * self.dtype.itemsize

    def _remove_outputs(self) -> None:
        (self.folder / PLAIN).unlink(missing_ok=True)
        # GDAL first writes overviews into a file next to the COG.
        for path in self.folder.glob(f"{COG}*"):
            path.unlink()

    def _require_room(self, more_bytes: int) -> None:
        bands, height, width = self.shape
        rows_bytes = bands * (height - self.rows) * width * self.dtype.itemsize
        # The compression of the pixels is not known yet, so none is assumed.
        needed = rows_bytes + padded_px(self.shape) * self.dtype.itemsize + more_bytes
        free = shutil.disk_usage(self.out.parent).free
        if needed > free:
            needed_size, free_size = sizes(needed, free)
            raise MachineError(
                f"{self.out} may need {needed_size} of disk space before compression, but "
                f"{free_size} are free. Free some space, or write elsewhere."
            )


def sync_folder(folder: Path) -> None:
    """Flush the entries of a folder to the disk, so that a renaming in it survives a power cut.

    Systems that cannot flush a folder, such as Windows, skip this.
    """
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
