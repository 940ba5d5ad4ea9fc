"""Tests that a run detects files that were damaged or replaced before or during it."""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.model.io.lock import part_folder
from beers_deploy.network import Network
from beers_deploy.profiles.errors import ImageError, ModelError, OptionError
from beers_deploy.restoration.checkpoint import Checkpoint
from beers_deploy.restoration.outcome import Tally
from beers_deploy.restoration.tiles.engine import Restorer
from beers_deploy.restoration.tiles.rows import RestoredRow
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import noise, stopped_after
from tests.model.raster import formats

pytestmark = pytest.mark.usefixtures("unchecked")

TILE_PX = 64
JOB: dict[str, object] = {"image": "a"}

Damage = Callable[[bytes], bytes]
DAMAGES = st.one_of(
    st.integers(0, 2**16).map(lambda at: lambda raw: raw[: at % (len(raw) + 1)]),
    st.integers(0, 2**19).map(lambda at: lambda raw: flipped(raw, at)),
    st.binary(max_size=64).map(lambda more: lambda raw: raw + more),
    st.binary(max_size=2048).map(lambda other: lambda _: other),
)
"""A file is truncated, extended or replaced, or one bit is flipped."""


def flipped(raw: bytes, bit: int) -> bytes:
    """Return bytes with one bit flipped."""
    changed = bytearray(raw)
    changed[bit // 8 % len(raw)] ^= 1 << bit % 8
    return bytes(changed)


def rows_of(pixels: np.ndarray, heights: list[int]) -> Iterator[RestoredRow]:
    """Yield pixels (bands, height, width) as rows of tiles."""
    top = 0
    for height in heights:
        part = pixels[:, top : top + height]
        yield RestoredRow(part, Tally(valid_results=part.size))
        top += height


@settings(max_examples=50)
@given(
    st.integers(1, 3),
    st.lists(st.integers(1, 5), min_size=1, max_size=4),
    st.integers(1, 9),
    st.sampled_from([np.uint8, np.uint16, np.float32]),
    DAMAGES,
)
def test_rows_that_match_their_digests_are_kept_and_no_others(
    bands: int, heights: list[int], width: int, kind: type, damage: Damage
) -> None:
    pixels: np.ndarray = noise(bands, sum(heights), width).astype(kind)
    with TemporaryDirectory() as name:
        out = Path(name) / "out.tif"
        shape = (bands, sum(heights) + 3, width)
        checkpoint = Checkpoint(out, shape, np.dtype(kind), JOB, resume=False)
        for row in rows_of(pixels, heights):
            checkpoint.append(row)
        raw = part_folder(out) / "rows.raw"
        raw.write_bytes(damage(raw.read_bytes()))
        resumed = Checkpoint(out, shape, np.dtype(kind), JOB, resume=True)
        assert resumed.rows + resumed.damaged_rows == sum(heights)
        assert resumed.rows in np.cumsum([0, *heights])
        assert resumed.tally.valid_results == bands * resumed.rows * width
        for band in range(bands):
            np.testing.assert_array_equal(
                resumed.read(band, 0, resumed.rows), pixels[band, : resumed.rows]
            )


@settings(max_examples=50)
@given(st.integers(0, 2**16))
def test_a_journal_with_a_flipped_bit_is_refused_or_read_as_before(bit: int) -> None:
    with TemporaryDirectory() as name:
        out = Path(name) / "out.tif"
        checkpoint = Checkpoint(out, (1, 8, 5), np.dtype(np.uint16), JOB, resume=False)
        for row in rows_of(noise(1, 6, 5), [2, 4]):
            checkpoint.append(row)
        journal = part_folder(out) / "journal.json"
        journal.write_bytes(flipped(journal.read_bytes(), bit))
        try:
            resumed = Checkpoint(out, (1, 8, 5), np.dtype(np.uint16), JOB, resume=True)
        except OptionError:
            return
        assert (resumed.rows, resumed.tally) == (checkpoint.rows, checkpoint.tally)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """Write an image whose middle is farther than 64 KiB from both ends of its file."""
    tifffile.imwrite(tmp_path / "in.tif", noise(700, 260), tile=(16, 16))
    return tmp_path / "in.tif"


def test_damaged_rows_are_restored_again_with_a_warning(
    image: Path, model: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    expected = tmp_path / "whole.tif"
    out = tmp_path / "out.tif"
    restore(image, expected, network=model, tile=TILE_PX)
    with stopped_after(40):
        restore(image, out, network=model, tile=TILE_PX)
    raw = part_folder(out) / "rows.raw"
    raw.write_bytes(raw.read_bytes()[:-2000])
    with caplog.at_level(logging.WARNING, "beers_deploy"):
        restore(image, out, network=model, tile=TILE_PX, resume=True)
    assert out.read_bytes() == expected.read_bytes()
    words = "do not match their digests: they are restored again"
    assert any(words in sentence for sentence in caplog.messages)
    assert not part_folder(out).exists()


def write_mask(hidden_rows: int, image: Path) -> None:
    known = np.ones((700, 260), bool)
    known[:hidden_rows] = False
    formats.write_mask(image, known)


def flip_the_middle(image: Path) -> None:
    image.write_bytes(flipped(image.read_bytes(), 8 * image.stat().st_size // 2))


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("in.tif", Path.touch, flip_the_middle),
        ("in.tif.msk", partial(write_mask, 300), partial(write_mask, 340)),
    ],
)
def test_a_run_is_not_resumed_after_its_image_or_mask_changed(
    name: str,
    before: Callable[[Path], None],
    after: Callable[[Path], None],
    image: Path,
    model: Path,
    tmp_path: Path,
) -> None:
    """The file has the same size and time as before."""
    out = tmp_path / "out.tif"
    run = partial(restore, network=model, tile=TILE_PX)
    before(image)
    with stopped_after(40):
        run(image, out)
    file = tmp_path / name
    stat = file.stat()
    content = file.read_bytes()
    after(image)
    assert file.stat().st_size == stat.st_size
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    with pytest.raises(OptionError, match="the image, the model and the options"):
        run(image, out, resume=True)
    assert not out.exists()
    file.write_bytes(content)
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    run(image, out, resume=True)
    run(image, tmp_path / "whole.tif")
    assert out.read_bytes() == (tmp_path / "whole.tif").read_bytes()


@pytest.mark.parametrize("touched", [False, True])
def test_an_image_that_is_replaced_while_it_is_read_is_refused(
    touched: bool, image: Path, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish = Restorer.finish
    other = tmp_path / "other.tif"
    tifffile.imwrite(other, noise(700, 260, seed=2), tile=(16, 16))

    def replacing(self: Restorer, *rest: object) -> object:
        if touched:
            image.touch()
        else:
            # Another thread may have replaced the image first.
            with suppress(FileNotFoundError):
                other.replace(image)
        return finish(self, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Restorer, "finish", replacing)
    if touched:
        restore(image, tmp_path / "out.tif", network=model, tile=TILE_PX)
        return
    with pytest.raises(ImageError, match="changed while it was read"):
        restore(image, tmp_path / "out.tif", network=model, tile=TILE_PX)
    assert not (tmp_path / "out.tif").exists()
    assert not part_folder(tmp_path / "out.tif").exists()


def test_a_network_that_is_replaced_while_it_is_read_is_refused(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "network.onnx"
    path.write_bytes(model.read_bytes())

    def replacing(path: Path) -> object:
        path.write_bytes(b"another")
        return object()

    monkeypatch.setattr("beers_deploy.network.float_model", replacing)
    with pytest.raises(ModelError, match="changed while it was read"):
        Network.load(path)
