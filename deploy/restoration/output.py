"""What a run leaves: finished rows in a checkpoint, so that one killed at any moment goes on; at
the end one TIFF.
"""

import hashlib
import io
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import accumulate, chain
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from isal import isal_zlib

from beers_deploy.model.io.files import TIFF_SUFFIXES, require_regular
from beers_deploy.model.io.lock import part_folder
from beers_deploy.model.io.tiff import MASK
from beers_deploy.profiles.errors import (
    ImageError,
    MachineError,
    MissingExtraError,
    OptionError,
    sizes,
)
from beers_deploy.restoration.georeference import enlarged_tags
from beers_deploy.restoration.journal import FinishedRow, journal_text, read_journal
from beers_deploy.restoration.options import Compression
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.source import BIG_TIFF_SUFFIXES, RESTORED, RGB_BANDS, Source, strips
from beers_deploy.restoration.tiles.rows import RestoredRow

ROWS_FILES = ("journal.json", "journal.new", "rows.raw")
"""Files of a checkpoint; the journal first, because it counts on the rows."""


class Checkpoint:
    """The finished rows of a restored image (bands, height, width), from the top, and a journal of
    their digests.

    Attributes:
        rows: how many are finished.
        tally: what was seen of them.
        damaged_rows: how many an earlier run finished that no longer match its journal, and those
            below them.
    """

    def __init__(
        self,
        out: Path,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        job: Mapping[str, object],
        resume: bool,
        cog_bytes: int = 0,
        row_ends: Sequence[int] = (),
    ) -> None:
        """Begin, or go on with what an earlier run left.

        Args:
            out: the image to write in the end.
            shape: (bands, height, width).
            dtype: of the pixels.
            job: all that decides the pixels; a run is resumed only by one of the same job.
            resume: go on; where nothing was left, begin.
            cog_bytes: of disk that the output takes beside the rows and the plain TIFF.
            row_ends: at which row of pixels each row of tiles ends; a journal of other rows is
                refused.
        """
        self.out = out
        self.shape = shape
        self.dtype = dtype
        self.folder = part_folder(out)
        for name in ROWS_FILES:
            require_regular(self.folder / name)
        self._job = dict(job)
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
            self._require_room(cog_bytes)
            self.folder.mkdir(exist_ok=True)
            (self.folder / "rows.raw").touch()

    def append(self, row: RestoredRow) -> None:
        """Keep a row of tiles, which must follow those that are kept."""
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
            self._finished.append(
                FinishedRow(rows_px, row.pixels.nbytes, digest.hexdigest(), row.tally)
            )
            self.rows = self.rows + rows_px
            self.tally = self.tally + row.tally
            self._write_journal()

    def read(self, band: int, start: int, stop: int) -> np.ndarray:
        """Finished rows `start` to `stop` (excluded) of one band, (rows, width) as they will be
        written.
        """
        count = (stop - start) * self.shape[2]
        pixels = np.fromfile(
            self.folder / "rows.raw", self.dtype, count, offset=self._offset(band, start)
        )
        return pixels.reshape(-1, self.shape[2])

    def require_known(self, name: str) -> None:
        """Refuse an image, `name` in messages, that has no pixels with values."""
        if not self.tally.known:
            got = "NaN or nodata everywhere"
            remedy = "check that it is the right file"
            raise ImageError(name, expected="some pixels with values", got=got, remedy=remedy)

    def remove(self) -> None:
        """Throw the rows away; the journal first, so that nothing is left that counts on them."""
        # The journal is the first of these, because it counts on the rows.
        for name in ROWS_FILES:
            (self.folder / name).unlink(missing_ok=True)
        self._remove_outputs()

    @contextmanager
    def disk(self) -> Iterator[None]:
        """One sentence for what a disk may do."""
        try:
            yield
        except OSError as error:
            advice = (
                f"go on with `resume` from row {self.rows} of {self.shape[1]}"
                if self.rows
                else "run it again: no row is left to `resume` from"
            )
            remedy = f"correct that, and {advice}"
            got = error.strerror or str(error)
            raise MachineError(
                str(self.out), expected="a disk to write to", got=got, remedy=remedy
            ) from error

    def _left(self) -> list[FinishedRow]:
        """Return the rows of tiles that an earlier run of this job finished, by its journal."""
        path = self.folder / "journal.json"
        if not path.is_file():
            return []
        with suppress(ValueError, LookupError, TypeError, AttributeError, OSError):
            finished = read_journal(path, self._job)
            ends = list(accumulate(row.rows_px for row in finished))
            planned = not self._row_ends or ends == self._row_ends[: len(ends)]
            if planned and max(ends, default=0) <= self.shape[1]:
                return finished
        expected = "the image, the model and the options of the run that was stopped"
        got = f"others, or a damaged {path}"
        remedy = "run it as before, or start afresh without `resume`"
        raise OptionError("resume", expected=expected, got=got, remedy=remedy)

    def _matching(self, finished: list[FinishedRow]) -> list[FinishedRow]:
        """Return the rows of tiles down to the first one whose pixels are not those that the
        journal states.
        """
        matching = list[FinishedRow]()
        top = 0
        for row in finished:
            if self._stored(top, row.rows_px) != (row.size_bytes, row.sha256):
                break
            matching.append(row)
            top += row.rows_px
        return matching

    def _stored(self, top: int, rows_px: int) -> tuple[int, str]:
        """Return the size in bytes and the digest of rows of pixels that are stored; fewer bytes
        where it ends.
        """
        size_bytes = 0
        digest = hashlib.sha256()
        with suppress(OSError), (self.folder / "rows.raw").open("rb") as stream:
            for band in range(self.shape[0]):
                stream.seek(self._offset(band, top))
                pixels = stream.read(rows_px * self.shape[2] * self.dtype.itemsize)
                size_bytes += len(pixels)
                digest.update(pixels)
        return size_bytes, digest.hexdigest()

    def _write_journal(self) -> None:
        path = self.folder / "journal.json"
        fresh = self.folder / "journal.new"
        with fresh.open("w", encoding="utf-8") as stream:
            stream.write(journal_text(self._job, self._finished))
            stream.flush()
            os.fsync(stream.fileno())
        # A run that is killed here leaves the old journal or the new one, never half of one.
        fresh.replace(path)
        sync_folder(self.folder)

    def _offset(self, band: int, row: int) -> int:
        return (band * self.shape[1] + row) * self.shape[2] * self.dtype.itemsize

    def _remove_outputs(self) -> None:
        (self.folder / PLAIN).unlink(missing_ok=True)
        # GDAL writes overviews into a file beside the COG first.
        for path in self.folder.glob(f"{COG}*"):
            path.unlink()

    def _require_room(self, cog_bytes: int) -> None:
        bands, height, width = self.shape
        rows_bytes = bands * (height - self.rows) * width * self.dtype.itemsize
        # How well the pixels pack is not known yet, so nothing is assumed to be packed.
        needed = rows_bytes + padded_px(self.shape, TILE_PX) * self.dtype.itemsize + cog_bytes
        free = shutil.disk_usage(self.out.parent).free
        if needed > free:
            needed_size, free_size = sizes(needed, free)
            expected = f"{needed_size} of disk (nothing packed)"
            got = f"{free_size} free"
            remedy = "free some space or write elsewhere"
            raise MachineError(str(self.out), expected=expected, got=got, remedy=remedy)


def sync_folder(folder: Path) -> None:
    """Make a renaming in `folder` last; not every system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


TILE_PX = 256
PLAIN_LIMIT_BYTES = 4_000_000_000
"""Offsets of a plain TIFF end at 2^32; above this many bytes of pixels, compressed or not, it is a
BigTIFF.
"""
BUFFER_BYTES = 1 << 25
FAST_LEVEL = 1
HORIZONTAL = 2
"""TIFF's predictor of integers: what is packed is each pixel's difference from
the one on its left.
"""


def require_tiff_name(path: Path) -> None:
    """Refuse a name under which no program would look for a TIFF."""
    if path.suffix.lower() not in TIFF_SUFFIXES | BIG_TIFF_SUFFIXES:
        remedy = "name it so; other programs turn a TIFF into what you need"
        raise OptionError(
            "OUT", expected="a TIFF's name, such as restored.tif", got=path.name, remedy=remedy
        )
    if (mask := path.with_name(f"{path.name}.msk")).exists():
        remedy = (
            "remove it, or choose another name: readers would take it for the mask of the new image"
        )
        raise OptionError("OUT", expected="no mask of that name", got=mask.name, remedy=remedy)


def require_codec(compression: Compression) -> None:
    """Find out before the run that a compression needs a package which is not installed."""
    try:
        tifffile.imwrite(io.BytesIO(), np.zeros((16, 16), np.uint16), compression=compression.value)
    except (ValueError, KeyError, ImportError) as error:
        # Any other error is a fault of the writer, whatever is installed.
        if not isinstance(error, ImportError) and "imagecodecs" not in str(error):
            raise
        got = " ".join(str(error).split())
        remedy = "pip install 'beers-deploy[codecs]' or use zlib"
        raise MissingExtraError(
            "compression", expected="an installed codec", got=got, remedy=remedy
        ) from error


PLAIN = "out.tif"
COG = "cog.tif"
ToCog = Callable[[Path, Path], None]
"""Writes a TIFF again, cloud-optimised."""


def write_output(
    checkpoint: Checkpoint,
    source: Source,
    compression: Compression,
    to_cog: ToCog | None = None,
) -> None:
    """Write the checkpoint's rows to the output, rename it into place, remove the checkpoint.

    Args:
        checkpoint: with every row.
        source: the image, whose alpha or mask is written beside its bands as it is.
        compression: of the TIFF; none where it is on its way to be cloud-optimised.
        to_cog: writes the TIFF again, cloud-optimised; None leaves it as it is.
    """
    fresh = checkpoint.folder / PLAIN
    bands = checkpoint.shape[0]
    planes = bands + source.raster.has_alpha
    plain_bytes = padded_px((planes, *checkpoint.shape[1:]), TILE_PX) * checkpoint.dtype.itemsize
    with checkpoint.disk():
        with tifffile.TiffWriter(fresh, bigtiff=plain_bytes > PLAIN_LIMIT_BYTES) as file:
            file.write(
                shape=(planes, *checkpoint.shape[1:]) if planes > 1 else checkpoint.shape[1:],
                photometric="rgb"
                if source.raster.colour and bands == len(RGB_BANDS)
                else "minisblack",
                planarconfig="separate" if planes > 1 else None,
                extrasamples=(source.raster.veil,) if source.raster.has_alpha else None,
                software=RESTORED,
                extratags=enlarged_tags(
                    source.raster.tags, checkpoint.shape[2] // source.raster.width_px
                ),
                **_squares_of(_strips(checkpoint, source), checkpoint.dtype, compression),
            )
            if source.raster.veil == "mask":
                mask = _squares_of(_veil(checkpoint, source), np.dtype(bool), compression)
                file.write(shape=checkpoint.shape[1:], photometric="mask", subfiletype=MASK, **mask)
        if to_cog is not None:
            plain = fresh
            fresh = checkpoint.folder / COG
            to_cog(plain, fresh)
        with fresh.open("r+b") as stream:
            os.fsync(stream.fileno())
        fresh.replace(checkpoint.out)
        sync_folder(checkpoint.out.parent)
        checkpoint.remove()


def _squares_of(
    rows: Iterator[np.ndarray], dtype: np.dtype[Any], compression: Compression
) -> dict[str, Any]:
    """What tifffile is told of a page's pixels, given as rows of squares."""
    # tifffile packs the bits of a mask itself.
    by_zlib = compression is Compression.zlib and dtype.kind != "b"
    return {
        "data": _packed(rows) if by_zlib else chain.from_iterable(map(_squares, rows)),
        "dtype": dtype,
        "tile": (TILE_PX, TILE_PX),
        "compression": compression.value,
        "predictor": HORIZONTAL if by_zlib and dtype.kind == "u" else None,
        # tifffile's own choice is half of the cores.
        "maxworkers": os.cpu_count(),
        "metadata": None,
        "buffersize": BUFFER_BYTES,
    }


def _packed(rows: Iterator[np.ndarray]) -> Iterator[bytes]:
    """Squares as zlib's streams, those of a strip packed side by side."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for strip in rows:
            yield from pool.map(_pack, _squares(strip))


def _pack(square: np.ndarray) -> bytes:
    """Integers as differences, packed by ISA-L: six times as fast as zlib's fastest way, and no
    larger (measured).

    On a noisy 12-bit photograph differences take 6 % less than the numbers themselves (measured).
    """
    if square.dtype.kind == "u":
        # Unsigned differences wrap around, as TIFF's predictor has them.
        square = np.diff(square, axis=1, prepend=square.dtype.type(0))
    return isal_zlib.compress(square.tobytes(), FAST_LEVEL)


def _squares(strip: np.ndarray) -> list[np.ndarray]:
    return np.hsplit(strip, strip.shape[1] // TILE_PX)


def _strips(checkpoint: Checkpoint, source: Source) -> Iterator[np.ndarray]:
    """Rows of squares, (TILE_PX, whole squares) of every band, and of the image's alpha."""
    for band in range(checkpoint.shape[0]):
        for top, bottom in strips(checkpoint.shape[1], TILE_PX):
            yield _whole_squares(checkpoint.read(band, top, bottom))
    if source.raster.has_alpha:
        yield from _veil(checkpoint, source)


def _veil(checkpoint: Checkpoint, source: Source) -> Iterator[np.ndarray]:
    """Rows of squares of the image's alpha as stored, or of its mask as bool, enlarged with the
    image.
    """
    scale = checkpoint.shape[2] // source.raster.width_px
    read_veil = source.veil
    if read_veil is None:
        raise ValueError("no veil")
    for top, bottom in strips(checkpoint.shape[1], TILE_PX):
        plane = read_veil(top // scale, -(-bottom // scale))
        plane = plane.repeat(scale, axis=0)[top % scale :][: bottom - top].repeat(scale, axis=1)
        yield _whole_squares(
            plane != 0 if source.raster.veil == "mask" else plane.astype(checkpoint.dtype)
        )


def _whole_squares(rows: np.ndarray) -> np.ndarray:
    strip = np.zeros((TILE_PX, _padded(rows.shape[1])), rows.dtype)
    strip[: len(rows), : rows.shape[1]] = rows
    return strip


def _padded(size_px: int, tile_px: int = TILE_PX) -> int:
    return -(-size_px // tile_px) * tile_px


def padded_px(shape: tuple[int, int, int], tile_px: int) -> int:
    """Pixels of an image (bands, height, width) in whole tiles."""
    bands, height, width = shape
    return bands * _padded(height, tile_px) * _padded(width, tile_px)
