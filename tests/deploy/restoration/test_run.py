"""Files restored in tiles: the pixels of the whole image's result bit for bit, and the metadata."""

import logging
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
import rasterio
import tifffile

from beers_deploy.model.raster.compression import Compression
from beers_deploy.profiles.errors import BeersError, ImageError, MachineError, OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.session import open_session, run
from beers_deploy.restoration import runtime
from beers_deploy.restoration.runtime import Infer, open_runtime
from beers_deploy.restoration.tiles.exposures import restore_window
from beers_deploy.restoration.tiles.missing import fill_from_nearest
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import noise, restored
from tests.shipped import shipped_pair

RADIUS_PX = 5
SHAPES = [(61, 83), (17, 130), (1, 40), (40, 1), (29, 29), (3, 5)]


def by_file(
    folder: Path, pixels: np.ndarray, tags: dict[str, Any] | None = None, **options: Any
) -> tuple[np.ndarray, Row]:
    """Write, restore and read again, and check that no other file is left."""
    result = restored(folder, pixels, tags, **options)
    assert sorted(p.name for p in folder.iterdir()) == ["in.tif", "out.tif"]
    return result


def whole_image(model: Path, pixels: np.ndarray) -> np.ndarray:
    """Return the result without any tiling, float32."""
    return restore_window(pixels, partial(run, open_session(load_onnx(model))))


@pytest.mark.parametrize("shape", SHAPES)
def test_tiled_equals_whole_bit_for_bit(
    shape: tuple[int, int], model: Path, tmp_path: Path
) -> None:
    pixels = noise(*shape)
    tags = {"tile": (16, 16), "compression": "zlib"}
    result, _ = by_file(tmp_path, pixels, tags, network=model, tile=23)
    assert result.dtype == np.uint16
    np.testing.assert_array_equal(result, np.rint(whole_image(model, pixels)).astype(np.uint16))
    floats, _ = by_file(tmp_path, pixels.astype(np.float32), network=model, tile=23)
    assert floats.dtype == np.float32
    np.testing.assert_array_equal(floats, whole_image(model, pixels))


def test_one_pixel_less_than_the_radius_gives_seams_that_are_measured(
    model: Path, tmp_path: Path
) -> None:
    pixels = noise(61, 83).astype(np.float32)
    result, row = by_file(tmp_path, pixels, network=model, tile=23, halo=RADIUS_PX - 1)
    assert (result != whole_image(model, pixels)).any()
    largest = row.figures["seam error max"]
    mean = row.figures["seam error mean"]
    assert largest.value is not None
    assert mean.value is not None
    assert largest.value > mean.value > 0
    assert largest.mode == "measured"


def test_the_seam_error_is_that_of_the_tile_in_the_middle(model: Path, tmp_path: Path) -> None:
    pixels = noise(60, 60).astype(np.float32)
    result, row = by_file(tmp_path, pixels, network=model, tile=24, halo=2)
    # Tiles of 23 pixels keep rows 0 to 20, 21 to 39 and 40 to 59.
    middle = np.s_[21:40, 21:40]
    error = np.abs(result.astype(np.float64) - whole_image(model, pixels))[middle]
    assert row.figures["seam error max"].value == pytest.approx(error.max())
    assert row.figures["seam error mean"].value == pytest.approx(error.mean())


@pytest.mark.parametrize("layout", [{"planarconfig": "separate"}, {"planarconfig": "contig"}])
def test_bands_are_restored_one_by_one(layout: dict[str, str], model: Path, tmp_path: Path) -> None:
    bands = noise(3, 41, 35)
    pixels = bands if layout["planarconfig"] == "separate" else np.moveaxis(bands, 0, 2)
    tags = {"photometric": "rgb", **layout}
    results, row = by_file(tmp_path, pixels, tags, network=model, tile=23)
    for band, result in zip(bands, results, strict=True):
        np.testing.assert_array_equal(result, np.rint(whole_image(model, band)))
    assert row.figures["tiles"].value == 3 * 3 * 2


def test_full_scale_is_what_the_network_sees_as_one(model: Path, tmp_path: Path) -> None:
    pixels = noise(40, 30)
    options: dict[str, Any] = {"network": model, "tile": 23}
    twelve, _ = by_file(tmp_path, pixels, **options)
    fourteen, _ = by_file(tmp_path, pixels * 4, **options, full_scale=4095 * 4)
    # Rounding moves the result of 12 bits by up to 0.5, and that of 14 bits by up to 0.5 / 4.
    assert np.abs(fourteen / 4 - twelve.astype(float)).max() <= 0.625
    shares = (pixels / 4095).astype(np.float32)
    unit, _ = by_file(tmp_path, shares, **options, full_scale=1)
    assert np.abs(unit * 4095 - twelve.astype(float)).max() <= 0.51


def test_floats_of_about_0_to_1_are_refused_until_their_scale_is_named(
    model: Path, tmp_path: Path
) -> None:
    shares = (noise(61, 37) / 4095).astype(np.float32)
    shares[5:9] = np.nan
    options: dict[str, Any] = {"network": model, "tile": 23}
    refused(tmp_path, shares, ImageError, "floats of at most 1", "`full_scale`", **options)
    refused(tmp_path, shares * 1.9, ImageError, "`full_scale`", **options)
    (tmp_path / "out.tif").unlink()
    result, _ = by_file(tmp_path, shares, **options, full_scale=1)
    assert 0 < np.nanmean(result) < np.nanmax(result) <= 1


def test_one_bright_row_at_the_end_makes_floats_digital_numbers(
    model: Path, tmp_path: Path
) -> None:
    dark = np.full((70, 37), 0.5, np.float32)
    dark[-1, 3] = 900
    assumed, row = by_file(tmp_path, dark, network=model, tile=23)
    scaled, _ = by_file(tmp_path, dark, network=model, tile=23, full_scale=4095)
    np.testing.assert_array_equal(assumed, scaled)
    assert row.text["full scale"] == "4095"


def test_nodata_settles_no_scale(model: Path, tmp_path: Path) -> None:
    shares = (noise(40, 37) / 4095).astype(np.float32)
    shares[3:7] = -9999
    tifffile.imwrite(tmp_path / "in.tif", shares, extratags=[(42113, "s", 0, "-9999", True)])
    with pytest.raises(ImageError, match="full_scale"):
        restore(tmp_path / "in.tif", tmp_path / "out.tif", network=model, tile=23)


def test_georeference_and_rpcs_are_kept(model: Path, tmp_path: Path) -> None:
    # GeoTIFF's tags begin with 33 and 34, GDAL's with 42; 50844 holds the rational polynomials.
    tags = [
        (33550, "d", 3, (0.5, 0.5, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, 3e5, 4.8e6, 0.0), True),
        (34735, "H", 12, (1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32631), True),
        (42113, "s", 0, "0", True),
        (50844, "d", 92, tuple(np.linspace(-1, 1, 92)), True),
    ]
    by_file(tmp_path, noise(20, 20), {"extratags": tags}, network=model)
    with (
        tifffile.TiffFile(tmp_path / "in.tif") as before,
        tifffile.TiffFile(tmp_path / "out.tif") as after,
    ):
        for code, *_ in tags:
            if code != 34735:
                stored = [file.pages.first.tags[code].value for file in (before, after)]
                np.testing.assert_allclose(
                    np.array(stored[1], float), np.array(stored[0], float), rtol=1e-14
                )
    with rasterio.open(tmp_path / "out.tif") as file:
        assert file.crs == rasterio.CRS.from_epsg(32631)


@pytest.mark.parametrize("kind", ["nan", "tag"])
def test_missing_pixels_stay_and_corrupt_no_others(kind: str, model: Path, tmp_path: Path) -> None:
    ground = noise(70, 90).astype(np.float32)
    missing = np.zeros((70, 90), bool)
    missing[20:60, 30:75] = missing[3, 5] = True
    if kind == "nan":
        pixels = np.where(missing, np.nan, ground).astype(np.float32)
        tags = []
    else:
        pixels = np.where(missing, 7, np.where(ground == 7, 8, ground)).astype(np.uint16)
        tags = [(42113, "s", 0, "7", True)]
    results = [
        by_file(tmp_path, pixels, {"extratags": tags}, network=model, tile=tile_px)[0]
        for tile_px in (19, 31, 640)
    ]
    np.testing.assert_array_equal(results[0], results[2])
    np.testing.assert_array_equal(results[1], results[2])
    np.testing.assert_array_equal(results[0][missing], pixels[missing])
    other = np.where(missing, 999, ground).astype(pixels.dtype)
    filled, _ = by_file(tmp_path, other, network=model)
    differs = (results[0] != filled) & ~missing
    rows, columns = np.nonzero(missing)
    for row, column in np.argwhere(differs):
        assert np.maximum(np.abs(rows - row), np.abs(columns - column)).min() <= RADIUS_PX
    assert not (results[0][~missing] == 7).any() or kind == "nan"


def test_a_filled_pixel_is_the_nearest_known_one() -> None:
    pixels = np.arange(12.0).reshape(2, 6)
    missing = np.zeros((2, 6), bool)
    missing[0, 1:] = missing[1, :2] = True
    np.testing.assert_array_equal(
        fill_from_nearest(pixels, missing, 2), [[0, 0, 0, 9, 10, 11], [8, 8, 8, 9, 10, 11]]
    )
    assert fill_from_nearest(pixels, np.ones((2, 6), bool), 2).max() == 0


def refused(
    folder: Path, pixels: np.ndarray, error: type[BeersError], *words: str, **options: Any
) -> None:
    """Expect an error with these words, the old output as it was, and no other file."""
    tifffile.imwrite(folder / "in.tif", pixels, tile=(16, 16))
    (folder / "out.tif").write_bytes(b"the old one")
    with pytest.raises(error) as caught:
        restore(folder / "in.tif", folder / "out.tif", overwrite=True, **options)
    for word in words:
        assert word in str(caught.value)
    assert (folder / "out.tif").read_bytes() == b"the old one"
    assert sorted(p.name for p in folder.iterdir()) == ["in.tif", "out.tif"]


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        # The value above full scale is in the last row.
        (
            np.pad(noise(89, 40), ((0, 1), (0, 0)), constant_values=60000),
            ("60000", "full_scale"),
        ),
        (-noise(90, 40).astype(np.float32), ("-4", "Add the offset")),
        (np.full((20, 20), np.inf, np.float32), ("inf", "Write NaN")),
        (np.full((60, 40), np.nan, np.float32), ("NaN",)),
    ],
)
def test_invalid_values_leave_the_old_output(
    pixels: np.ndarray, words: tuple[str, ...], model: Path, tmp_path: Path
) -> None:
    refused(tmp_path, pixels, ImageError, *words, network=model, tile=23)


@pytest.mark.parametrize(
    ("word", "changes"),
    [
        ("`tile`", {"tile": 16, "halo": 8}),
        ("`tile`", {"tile": 15}),
        ("`halo`", {"halo": "wide"}),
        ("`full_scale`", {"full_scale": 0.5}),
        ("`compression`", {"compression": "jpeg"}),
        ("`runtime`", {"runtime": "tensorrt"}),
    ],
)
def test_invalid_options_are_refused(
    word: str, changes: dict[str, Any], model: Path, tmp_path: Path
) -> None:
    options = {"network": model, "tile": 23, **changes}
    refused(tmp_path, noise(40, 40), OptionError, word, **options)


def test_a_budget_that_does_not_suffice_is_refused_before_the_run(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = "memory", "1.00 kB", "Allow more memory than"
    refused(tmp_path, noise(40, 40), MachineError, *words, network=model, memory=1e-6)
    tifffile.imwrite(tmp_path / "in.tif", noise(1000, 3000), compression="zlib", rowsperstrip=1000)
    # What a process of many tests holds moves by more than the rows of the image.
    memory = SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=100_000_000))
    monkeypatch.setattr("beers_deploy.restoration.memory.psutil.Process", lambda: memory)
    with pytest.raises(MachineError, match="TILED=YES"):
        restore(
            tmp_path / "in.tif",
            tmp_path / "out.tif",
            network=model,
            tile=64,
            memory=0.108,
            overwrite=True,
        )


def test_memory_is_stated_before_anything_is_written(
    model: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    tifffile.imwrite(tmp_path / "in.tif", noise(80, 40))
    logged: list[tuple[str, bool]] = []

    def noting(record: logging.LogRecord) -> bool:
        logged.append((record.getMessage(), (tmp_path / "out.tif").exists()))
        return True

    monkeypatch.setattr(caplog.handler, "filters", [noting])
    with caplog.at_level(logging.INFO, "beers_deploy"):
        restore(tmp_path / "in.tif", tmp_path / "out.tif", network=model, tile=23)
    (plan, early), (memory, late), *_ = logged
    assert "work factor" in plan
    assert "memory" in memory
    assert not early
    assert not late


@pytest.mark.parametrize("compression", get_args(Compression))
def test_compressions_are_lossless(compression: str, model: Path, tmp_path: Path) -> None:
    result, _ = by_file(tmp_path, noise(40, 50), network=model, compression=compression)
    np.testing.assert_array_equal(result, np.rint(whole_image(model, noise(40, 50))))
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert file.pages.first.is_tiled
        assert (file.pages.first.compression == 1) == (compression == "none")


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
@pytest.mark.parametrize(("dtype", "predictor"), [(np.uint8, 2), (np.uint16, 2), (np.float32, 1)])
def test_integers_are_packed_as_differences_and_gdal_reads_them(
    dtype: type, predictor: int, model: Path, tmp_path: Path
) -> None:
    # The image is not square.
    pixels: np.ndarray = np.tile(noise(70, 90) // 20, (1, 4, 4)).astype(dtype)
    result, _ = by_file(tmp_path, pixels, network=model, full_scale=255)
    with rasterio.open(tmp_path / "out.tif") as file:
        np.testing.assert_array_equal(file.read(), result.reshape(-1, *result.shape[-2:]))
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert file.pages.first.predictor == predictor


def test_a_tile_without_known_pixels_costs_no_inference(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shapes: list[tuple[int, ...]] = []

    def counting(window: np.ndarray, infer: Infer, full_scale: float) -> np.ndarray:
        shapes.append(window.shape)
        return restore_window(window, infer, full_scale)

    monkeypatch.setattr("beers_deploy.restoration.tiles.exposures.restore_window", counting)
    pixels = noise(30, 300).astype(np.float32)
    pixels[:, 100:] = np.nan
    _, row = by_file(tmp_path, pixels, network=model, tile=30)
    assert row.figures["tiles"].value == 15
    # The first tile keeps 25 columns, those after it 20.
    assert len(shapes) == 5


def test_openvino_gives_the_same_int8_numbers(tmp_path: Path) -> None:
    pytest.importorskip("openvino")
    pixels = np.concatenate(
        [noise(100, 110), np.linspace(0, 4095, 11000).reshape(100, 110).astype(np.uint16)]
    )
    options: dict[str, Any] = {"network": shipped_pair()[1], "tile": 64}
    by_onnxruntime, _ = by_file(tmp_path, pixels, **options)
    by_openvino, row = by_file(tmp_path, pixels, **options, runtime="openvino")
    np.testing.assert_array_equal(by_openvino, by_onnxruntime)
    assert row.text["runtime"].startswith("openvino")


def test_openvino_gives_them_on_processors_whose_kernels_saturate_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The network is rewritten as on such a processor; the image has the two extreme values, whose
    sums are largest.
    """
    pytest.importorskip("openvino")
    image = np.random.default_rng(3).integers(0, 2, (1, 1, 41, 67)).astype(np.float32)
    model = load_onnx(shipped_pair()[1])
    monkeypatch.setattr(runtime, "_adds_exactly", lambda _: False)
    restored = runtime.open_openvino(model, 1)[0](image)
    np.testing.assert_array_equal(restored, run(open_session(model), image))


def test_openvino_gives_the_same_float_numbers_within_a_hundredth_of_a_dn(
    model: Path, tmp_path: Path
) -> None:
    pytest.importorskip("openvino")
    pixels = noise(61, 83).astype(np.float32)
    by_onnxruntime, _ = by_file(tmp_path, pixels, network=model, tile=30)
    by_openvino, _ = by_file(tmp_path, pixels, network=model, tile=30, runtime="openvino")
    untiled, _ = by_file(tmp_path, pixels, network=model, runtime="openvino")
    np.testing.assert_array_equal(by_openvino, untiled)
    assert np.abs(by_openvino - by_onnxruntime).max() < 0.01


def test_a_missing_openvino_is_one_sentence(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "openvino", None)
    with pytest.raises(MachineError, match=r"pip install 'beers-deploy\[openvino\]'"):
        open_runtime("openvino", load_onnx(model), 1)


def test_an_array_with_a_coordinate_system_is_no_file(model: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pixels = noise(40, 50)
    image = xarray.DataArray(pixels, dims=("y", "x"), attrs={"crs": "EPSG:32631"})
    result = restore(image, network=model)
    np.testing.assert_array_equal(result, np.rint(whole_image(model, pixels)))
    assert result.attrs == image.attrs
    with pytest.raises(OptionError, match="`compression` has no effect with an array"):
        restore(pixels, network=model, compression="none")
