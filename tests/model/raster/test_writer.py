"""Tests that written files are read back, and that a file with other pixels is an error."""

import errno
import os
import warnings
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from rasterio.enums import ColorInterp

from beers_deploy.model.raster.compression import Compression
from beers_deploy.model.raster.facts import MaskKind, Raster
from beers_deploy.model.raster.writer import ArrayPixels, require_equal, write_raster, write_tiff
from beers_deploy.profiles.errors import MachineError


class Masked(ArrayPixels):
    """Pixels of which the first three columns are missing."""

    def read_mask(self, start: int, stop: int) -> np.ndarray:
        mask = super().read_mask(start, stop)
        mask[:, :3] = 0
        return mask


PIXELS = np.random.default_rng(0).integers(0, 4096, (1, 300, 280)).astype(np.uint16)


@settings(max_examples=25)
@given(
    st.sampled_from(get_args(Compression)),
    st.sampled_from(["uint8", "int16", "uint16", "float32"]),
    st.integers(1, 3),
    st.integers(1, 300),
    st.integers(4, 300),
    st.sampled_from(["", "mask", "alpha"]),
)
def test_every_type_and_compression_is_read_back(
    tmp_path_factory: pytest.TempPathFactory,
    compression: Compression,
    kind: str,
    bands: int,
    height_px: int,
    width_px: int,
    mask_kind: MaskKind,
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.tif"
    rng = np.random.default_rng(height_px)
    pixels = rng.integers(0, 100, (bands, height_px, width_px)).astype(kind)
    raster = Raster(bands, height_px, width_px, pixels.dtype, mask_kind=mask_kind)
    write_raster(path, raster, Masked(pixels), compression)
    with warnings.catch_warnings(action="ignore"), rasterio.open(path) as file:
        assert_array_equal(file.read()[:bands], pixels)
        # GDAL treats alpha as a mask only if there are one or three bands.
        is_alpha = file.colorinterp[-1] is ColorInterp.alpha
        missing = (file.read(bands + 1) if is_alpha else file.dataset_mask()) == 0
    assert is_alpha == (mask_kind == "alpha")
    assert missing[:, :3].all() == bool(mask_kind)
    assert not missing[:, 3:].any()


@pytest.mark.parametrize("compression", ["none", "zlib"])
def test_a_file_that_differs_from_what_was_written_is_an_error(
    compression: Compression, tmp_path: Path
) -> None:
    raster = Raster(1, 300, 280, PIXELS.dtype)
    path = tmp_path / "a.tif"
    write_raster(path, raster, ArrayPixels(PIXELS), compression)
    content = bytearray(path.read_bytes())
    content[20_000] ^= 1
    for damaged in (content, content[: len(content) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(OSError, match=r"\w"):
            require_equal(path, raster, ArrayPixels(PIXELS))


@pytest.mark.parametrize("mask_kind", ["mask", "alpha"])
def test_a_mask_that_differs_from_what_was_written_is_an_error(
    mask_kind: MaskKind, tmp_path: Path
) -> None:
    raster = Raster(1, 300, 280, PIXELS.dtype, mask_kind=mask_kind)
    path = tmp_path / "a.tif"
    write_raster(path, raster, Masked(PIXELS), "zlib")
    with pytest.raises(OSError, match="other pixels"):
        require_equal(path, raster, ArrayPixels(PIXELS))


@pytest.mark.parametrize("limit_bytes", [1000, 40_000, 100_000])
def test_a_file_that_cannot_grow_is_an_error_with_its_cause(
    limit_bytes: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A limit on the size of files simulates a full disk."""
    resource = pytest.importorskip("resource", reason="Windows has no such limit")
    raster = Raster(1, 300, 280, PIXELS.dtype)
    cause = os.strerror(errno.EFBIG)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        with pytest.raises(OSError, match=cause):
            write_raster(tmp_path / "a.tif", raster, ArrayPixels(PIXELS), "zlib")
        capfd.readouterr()
        with pytest.raises(MachineError, match=rf"b\.tif cannot be written: {cause}\. Choose"):
            write_tiff(tmp_path / "b.tif", PIXELS[0])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    # libtiff prints nothing in addition to the sentence.
    assert capfd.readouterr().err == ""
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


def test_a_small_image_is_read_back(tmp_path: Path) -> None:
    dn = np.arange(35, dtype=np.uint16).reshape(5, 7)
    write_tiff(tmp_path / "a.tif", dn)
    with warnings.catch_warnings(action="ignore"), rasterio.open(tmp_path / "a.tif") as file:
        assert_array_equal(file.read(1), dn)
        assert file.tags()["TIFFTAG_SOFTWARE"] == "beers-deploy"
