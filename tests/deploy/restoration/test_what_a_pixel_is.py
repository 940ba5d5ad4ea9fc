"""Tests that masks and alpha mark missing pixels, and that pixels other than light are refused."""

import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import tifffile
from numpy.testing import assert_array_equal
from rasterio.enums import ColorInterp, MaskFlags

from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import PLANES, marked, names, noise
from tests.model.raster import formats
from tests.quant.tiling.small_networks import network

NODATA = 7
HIDDEN = np.zeros((61, 83), bool)
HIDDEN[:9] = True
HIDDEN[20:33, 40:] = True
HIDDEN[50, 3] = True


def restored(path: Path, model: Path, **options: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Restore a file, and return the pixels and the mask of the result."""
    restore(path, path.with_name("out.tif"), network=model, tile=23, overwrite=True, **options)
    with warnings.catch_warnings(action="ignore"), rasterio.open(path.with_name("out.tif")) as file:
        pixels = file.read()
        has_mask = MaskFlags.per_dataset in file.mask_flag_enums[0]
        mask = file.dataset_mask() if has_mask else None
    return pixels if len(pixels) > 1 else pixels[0], mask


def by_nodata(folder: Path, pixels: np.ndarray, model: Path) -> np.ndarray:
    """Restore the image with a nodata value in its hidden pixels only."""
    hidden = np.where(HIDDEN, NODATA, np.where(pixels == NODATA, NODATA + 1, pixels)).astype(
        pixels.dtype
    )
    path = folder / "nodata.tif"
    tifffile.imwrite(path, hidden, **marked(NODATA))
    return restored(path, model)[0]


def pixels_of_test() -> np.ndarray:
    pixels = noise(61, 83)
    pixels[pixels == NODATA] += 1
    return pixels


@pytest.mark.parametrize(("is_sidecar", "cog"), [(False, False), (True, False), (True, True)])
def test_a_mask_marks_missing_pixels_and_is_copied(
    is_sidecar: bool, cog: bool, model: Path, tmp_path: Path
) -> None:
    pixels = pixels_of_test()
    with tifffile.TiffWriter(tmp_path / "in.tif") as file:
        file.write(pixels, metadata=None)
        if not is_sidecar:
            layout: dict[str, Any] = {"tile": (16, 32), "compression": "zlib", "metadata": None}
            file.write(~HIDDEN, subfiletype=4, photometric="mask", **layout)
    if is_sidecar:
        formats.write_mask(tmp_path / "in.tif", ~HIDDEN)
    result, result_mask = restored(tmp_path / "in.tif", model, cog=cog)
    assert_array_equal(result[HIDDEN], pixels[HIDDEN])
    assert_array_equal(result[~HIDDEN], by_nodata(tmp_path, pixels, model)[~HIDDEN])
    assert result_mask is not None
    assert_array_equal(result_mask == 0, HIDDEN)


def test_a_nodata_value_beyond_float32_becomes_infinite(model: Path, tmp_path: Path) -> None:
    lowest = float(np.finfo(np.float64).min)
    pixels = pixels_of_test().astype(np.float64)
    tifffile.imwrite(tmp_path / "nan.tif", np.where(HIDDEN, np.nan, pixels))
    expected, _ = restored(tmp_path / "nan.tif", model)
    tifffile.imwrite(tmp_path / "in.tif", np.where(HIDDEN, lowest, pixels), **marked(lowest))
    result, _ = restored(tmp_path / "in.tif", model, view=tmp_path / "view.html")
    assert_array_equal(result, np.where(HIDDEN, -np.inf, expected))
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert file.pages.first.tags[42113].value == "-inf"


@pytest.mark.parametrize("nodata", [0.0, 1.0])
def test_gdal_reads_no_restored_float_as_missing(
    nodata: float, model: Path, tmp_path: Path
) -> None:
    """The network returns many pixels at 0 and at full scale."""
    shares = np.clip(pixels_of_test() / 4095, 0.01, 0.99).astype(np.float32)
    tifffile.imwrite(tmp_path / "in.tif", np.where(HIDDEN, nodata, shares), **marked(nodata))
    result, _ = restored(tmp_path / "in.tif", model, full_scale=1)
    assert np.isclose(result[~HIDDEN], nodata).mean() > 0.1
    with warnings.catch_warnings(action="ignore"), rasterio.open(tmp_path / "out.tif") as file:
        assert_array_equal(file.dataset_mask() == 0, HIDDEN)


def test_sidecar_files_of_gdal_count(model: Path, tmp_path: Path) -> None:
    image = tmp_path / "in.tif"
    auxiliary = tmp_path / "in.tif.aux.xml"
    pixels = np.where(HIDDEN, NODATA, pixels_of_test()).astype(np.uint16)
    tifffile.imwrite(image, pixels)
    band = "<PAMDataset><PAMRasterBand band='1'>{}</PAMRasterBand></PAMDataset>"
    auxiliary.write_text(band.format("<NoDataValue>7</NoDataValue>"))
    assert_array_equal(restored(image, model)[0], by_nodata(tmp_path, pixels, model))
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert file.pages.first.tags[42113].value == "7"
    for text, words in (
        (band.format("<Offset>500</Offset>"), "0 is no light"),
        ("<", "as GDAL writes"),
    ):
        auxiliary.write_text(text)
        with pytest.raises(ImageError, match=words):
            restored(image, model)
    auxiliary.unlink()
    tifffile.imwrite(tmp_path / "in.tif.msk", HIDDEN)
    with pytest.raises(ImageError, match="so that GDAL does not read it"):
        restored(image, model)
    (tmp_path / "in.tif.msk").unlink()
    of_files = ("out.tif.msk", "out.tif.aux.xml", "out.tif.ovr", "map.tif.aux.xml")
    of_places = ("out.tfw", "out.tifw", "out.wld", "OUT.TAB", "out.RPB", "out_RPC.TXT")
    for sidecar in (*of_files, *of_places):
        (tmp_path / sidecar).touch()
        with pytest.raises(OptionError, match=f"{sidecar} exists already"):
            restored(image, model, self_check=tmp_path / "map.tif")
        (tmp_path / sidecar).unlink()


@pytest.mark.parametrize(
    ("bands", "planes", "cog"),
    [(1, "separate", True), (3, "separate", False), (3, "contig", True)],
)
def test_alpha_is_copied(
    planes: Any,
    bands: int,
    cog: bool,
    model: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    pixels = pixels_of_test()
    alpha = np.where(HIDDEN, 0, 4095).astype(np.uint16)
    layout: dict[str, Any] = {"photometric": "rgb" if bands == 3 else "minisblack"}
    layout |= {"planarconfig": planes, "extrasamples": ["unassalpha"], "metadata": None}
    stacked = np.stack([pixels] * bands + [alpha], axis=0 if planes == "separate" else 2)
    tifffile.imwrite(tmp_path / "in.tif", stacked, **layout)
    with caplog.at_level(logging.INFO, "beers_deploy"):
        result, _ = restored(tmp_path / "in.tif", model, cog=cog)
    assert any(f"band {bands + 1} is alpha" in message for message in caplog.messages)
    with warnings.catch_warnings(action="ignore"), rasterio.open(tmp_path / "out.tif") as file:
        assert file.colorinterp[-1] == ColorInterp.alpha
        assert (file.colorinterp[0] == ColorInterp.red) == (bands == 3)
    assert_array_equal(result[-1], alpha)
    expected = by_nodata(tmp_path, pixels, model)
    for band in result[:-1]:
        assert_array_equal(band, np.where(HIDDEN, pixels, expected))


def alpha_before_light(path: Path, pixels: np.ndarray) -> None:
    three = np.stack([pixels] * 3)
    tifffile.imwrite(path, three, **PLANES, extrasamples=["unassalpha", "unspecified"])


def with_offset(path: Path, pixels: np.ndarray) -> None:
    metadata = (
        '<GDALMetadata><Item name="OFFSET" sample="0" role="offset">-1000</Item></GDALMetadata>'
    )
    tifffile.imwrite(path, pixels, extratags=[(42112, "s", 0, metadata, True)])


def palette(path: Path, pixels: np.ndarray) -> None:
    table = np.zeros((3, 256), np.uint16)
    tifffile.imwrite(path, (pixels % 256).astype(np.uint8), photometric="palette", colormap=table)


REFUSED: dict[str, tuple[Callable[[Path, np.ndarray], object], str]] = {
    "alpha before light": (alpha_before_light, "alpha as the last band"),
    "white is zero": (
        lambda path, pixels: tifffile.imwrite(path, pixels, photometric="miniswhite"),
        "MINISWHITE",
    ),
    "palette": (palette, "palette"),
    "offset": (with_offset, "offset of -1000"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_other_pixels_than_plain_light_are_refused(case: str, model: Path, tmp_path: Path) -> None:
    write, word = REFUSED[case]
    write(tmp_path / "in.tif", noise(61, 83))
    with pytest.raises(ImageError, match=word):
        restored(tmp_path / "in.tif", model)
    assert names(tmp_path) == ["in.tif"]


def test_an_image_is_restored_once_unless_forced(model: Path, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", noise(61, 83))
    first, _ = restored(tmp_path / "in.tif", model)
    (tmp_path / "out.tif").rename(tmp_path / "once.tif")
    with pytest.raises(ImageError, match="force"):
        restored(tmp_path / "once.tif", model)
    second, _ = restored(tmp_path / "once.tif", model, force=True)
    assert (second != first).any()


def linear(path: Path, factor: float, offset: float) -> Path:
    """Write a network that multiplies each pixel by a factor, and adds an offset."""
    nodes = "product = Mul(image, factor) restored = Add(product, offset)"
    save_onnx(network(nodes, {"factor": factor, "offset": offset}), path)
    return path


@pytest.mark.parametrize("sensor", [BLIND, "pleiades-degraded"])
@pytest.mark.parametrize("how", [(0.0, 0.3), (1.0, 0.6), (400.0, -136.8)])
def test_an_implausible_result_is_refused(
    tmp_path: Path, how: tuple[float, float], sensor: str
) -> None:
    """The results are constant, far brighter, or half 0 and half full scale.

    With a sensor the consistency step follows, which must not hide this.
    """
    rows, columns = np.mgrid[:61, :83]
    tifffile.imwrite(tmp_path / "in.tif", (900 + 10 * rows + 5 * columns).astype(np.uint16))
    path = linear(tmp_path / "linear.onnx", *how)
    words = "force" if sensor == BLIND else r"before the consistency step.*force"
    with pytest.raises(ImageError, match=words):
        restored(tmp_path / "in.tif", path, sensor=sensor)
    assert names(tmp_path) == ["in.tif", "linear.onnx"]
    restored(tmp_path / "in.tif", path, force=True, sensor=sensor)
