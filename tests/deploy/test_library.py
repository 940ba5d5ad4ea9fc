"""An array is restored to the pixels that `restore` writes of the same image in a file."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from beers_deploy.profiles.errors import ImageError, ModelError, OptionError
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import noise
from tests.deploy.two_workers import local_cluster
from tests.quant.tiling.small_networks import espcn
from tests.shipped import shipped_pair

SHAPES = [(61, 83), (17, 130), (1, 40), (29, 29), (3, 5), (3, 41, 35), (1, 50, 20)]


@pytest.fixture(scope="module")
def da() -> Any:
    return pytest.importorskip("dask.array", reason="the extra 'dask' is not installed")


def of_file(
    folder: Path, pixels: np.ndarray, nodata: float | None = None, **options: Any
) -> np.ndarray:
    """Restore the same pixels by way of files.

    Args:
        folder: of the files.
        pixels: of the image.
        nodata: value of missing pixels, which the file states.
        options: of `restore`.
    """
    tags = [] if nodata is None else [(42113, "s", 0, f"{nodata:g}", True)]
    planes: dict[str, Any] = (
        {"photometric": "rgb", "planarconfig": "separate"} if pixels.shape[0] == 3 else {}
    )
    plane = pixels if pixels.ndim == 2 or planes else pixels[0]
    tifffile.imwrite(
        folder / "in.tif", plane, extratags=tags, **(planes if pixels.ndim == 3 else {})
    )
    restore(folder / "in.tif", folder / "out.tif", overwrite=True, **options)
    return tifffile.imread(folder / "out.tif").reshape(pixels.shape)


@pytest.mark.parametrize("halo", ["exact", 2])
@pytest.mark.parametrize("shape", SHAPES)
def test_an_array_gives_the_pixels_of_the_file(
    shape: tuple[int, ...], halo: int | str, model: Path, tmp_path: Path
) -> None:
    for pixels in (noise(*shape), noise(*shape).astype(np.float32)):
        expected = of_file(tmp_path, pixels, network=model, tile=23, halo=halo)
        restored = restore(pixels, network=model, tile=23, halo=halo)
        assert restored.dtype == expected.dtype
        np.testing.assert_array_equal(restored, expected)


def test_the_shipped_int8_network_is_the_default(da: Any, tmp_path: Path) -> None:
    expected = of_file(tmp_path, noise(97, 110), network=shipped_pair(sensor=BLIND)[1], tile=64)
    np.testing.assert_array_equal(restore(noise(97, 110), tile=64), expected)
    lazy = restore(da.from_array(noise(97, 110), chunks=50), tile=64)
    np.testing.assert_array_equal(lazy.compute(), expected)


@pytest.mark.parametrize("kind", ["nan", "value"])
def test_missing_pixels_stay_as_in_a_file(kind: str, da: Any, model: Path, tmp_path: Path) -> None:
    pixels = noise(70, 90)
    nodata = None if kind == "nan" else 7.0
    pixels[20:60, 30:75] = pixels[3, 5] = 7
    pixels = np.where(pixels == 7, np.nan, pixels).astype(np.float32) if kind == "nan" else pixels
    expected = of_file(tmp_path, pixels, nodata, network=model, tile=23)
    np.testing.assert_array_equal(restore(pixels, network=model, tile=23, nodata=nodata), expected)
    lazy = restore(da.from_array(pixels, chunks=31), network=model, tile=23, nodata=nodata)
    np.testing.assert_array_equal(lazy.compute(), expected)
    np.testing.assert_array_equal(restore(pixels * np.nan, network=model), pixels * np.nan)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(1, 50), st.integers(1, 50), st.integers(2, 50), st.integers(2, 50), st.booleans()
)
def test_a_dask_array_of_any_chunks_gives_the_same(
    da: Any, model: Path, height: int, width: int, down: int, across: int, planes: bool
) -> None:
    pixels = noise(2, height, width) if planes else noise(height, width)
    chunks = (1, down, across) if planes else (down, across)
    lazy = restore(da.from_array(pixels, chunks=chunks), network=model, tile=23)
    assert lazy.shape == pixels.shape
    assert lazy.dtype == np.uint16
    np.testing.assert_array_equal(lazy.compute(), restore(pixels, network=model, tile=23))


def test_only_the_chunks_that_are_needed_are_read(da: Any, model: Path) -> None:
    chunks_read: list[tuple[int, ...]] = []

    def counted(block: np.ndarray, block_info: Any = None) -> np.ndarray:
        chunks_read.append(block_info[0]["chunk-location"])
        return block

    pixels = noise(200, 200)
    chunks = da.from_array(pixels, chunks=50).map_blocks(
        counted, dtype=np.uint16, meta=np.empty((0, 0), np.uint16)
    )
    lazy = restore(chunks, network=model, tile=40)
    assert chunks_read == []
    corner = lazy[:30, :30].compute(scheduler="synchronous")
    np.testing.assert_array_equal(corner, restore(pixels, network=model, tile=40)[:30, :30])
    assert chunks_read == [(0, 0)]


@pytest.mark.slow
def test_two_processes_compute_the_same(da: Any, model: Path) -> None:
    distributed = pytest.importorskip("distributed")
    pixels = noise(150, 120)
    lazy = restore(da.from_array(pixels, chunks=64), network=model, tile=40)
    with local_cluster(2) as local, distributed.Client(local) as client:
        computed = client.compute(lazy).result()
    np.testing.assert_array_equal(computed, restore(pixels, network=model, tile=40))


def test_openvino_serves_dask_s_threads(da: Any, model: Path) -> None:
    pytest.importorskip("openvino")
    pixels = noise(150, 120)
    lazy = restore(da.from_array(pixels, chunks=64), network=model, tile=40, runtime="openvino")
    computed = lazy.compute(scheduler="threads", num_workers=8)
    np.testing.assert_array_equal(
        computed, restore(pixels, network=model, tile=40, runtime="openvino")
    )


@pytest.mark.parametrize("lazy", [False, True])
def test_a_data_array_keeps_its_labels(lazy: bool, da: Any, model: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pixels = noise(1, 60, 50)
    pixels[0, 10:20, 10:20] = 9
    data = da.from_array(pixels, chunks=(1, 32, 32)) if lazy else pixels
    places = {"y": np.arange(60.0), "x": np.arange(50.0), "band": [1], "spatial_ref": 0}
    attributes = {"_FillValue": 9, "units": "DN"}
    image = xarray.DataArray(
        data, dims=("band", "y", "x"), coords=places, attrs=attributes, name="scene"
    )
    restored = restore(image, network=model, tile=23)
    assert hasattr(restored.data, "__dask_graph__") == lazy
    np.testing.assert_array_equal(
        restored.values, restore(pixels, network=model, tile=23, nodata=9)
    )
    assert (restored.values[0, 10:20, 10:20] == 9).all()
    xarray.testing.assert_identical(restored.coords.to_dataset(), image.coords.to_dataset())
    assert (restored.attrs, restored.name, restored.dims) == (image.attrs, image.name, image.dims)
    other = restore(image, network=model, tile=23, nodata=4000)
    assert (other.values != restored.values).any()


def test_a_data_array_of_more_pixels_has_their_places(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    save_onnx(espcn(), tmp_path / "twice.onnx")
    places = {"y": 99 - 2 * np.arange(20), "x": np.arange(30.0), "band": [1], "spatial_ref": 0}
    image = xarray.DataArray(noise(1, 20, 30), dims=("band", "y", "x"), coords=places, name="scene")
    image.coords["spatial_ref"].attrs["GeoTransform"] = "of the pixels before"
    restored = restore(image, network=tmp_path / "twice.onnx")
    assert restored.shape == (1, 40, 60)
    np.testing.assert_array_equal(restored.y, 99.5 - np.arange(40))
    np.testing.assert_array_equal(restored.x, np.arange(60) / 2 - 0.25)
    assert restored.spatial_ref.attrs == {}
    assert (restored.name, list(restored.band)) == ("scene", [1])


def test_values_beyond_full_scale_are_refused_at_once_or_when_computed(
    da: Any, model: Path
) -> None:
    pixels = noise(60, 50)
    pixels[40, 30] = 60000
    with pytest.raises(ImageError, match=r"60000.*full_scale"):
        restore(pixels, network=model, tile=23)
    lazy = restore(da.from_array(pixels, chunks=20), network=model, tile=23)
    np.testing.assert_array_equal(
        lazy[:10].compute(), restore(pixels[:30], network=model, tile=23)[:10]
    )
    with pytest.raises(ImageError, match=r"60000 in rows \d+ to \d+"):
        lazy.compute()


def test_an_unknown_full_scale_is_refused(da: Any, model: Path) -> None:
    shares = (noise(60, 50) / 4095).astype(np.float32)
    eight = (noise(60, 50) // 16).astype(np.uint8)
    for image in (shares, eight, da.from_array(eight, chunks=20)):
        with pytest.raises(ImageError, match=r"^The image has .*`full_scale`"):
            restore(image, network=model, tile=23)
    lazy = restore(da.from_array(shares, chunks=20), network=model, tile=23)
    with pytest.raises(ImageError, match=r"^The image has .*`full_scale`"):
        lazy.compute()
    for image, full_scale in ((shares, 1), (eight, 255)):
        expected = restore(image, network=model, tile=23, full_scale=full_scale)
        assert expected.max() <= full_scale
        lazy = restore(
            da.from_array(image, chunks=20), network=model, tile=23, full_scale=full_scale
        )
        np.testing.assert_array_equal(lazy.compute(), expected)


@pytest.mark.parametrize(
    "image",
    [
        np.ones(5, np.uint16),
        np.ones((2, 2, 2, 2), np.uint16),
        np.ones((0, 5), np.uint16),
        np.ones((5, 5), bool),
        np.ones((5, 5), complex),
    ],
)
def test_other_arrays_than_images_are_refused(image: Any, model: Path) -> None:
    with pytest.raises(ImageError, match=r"^(`image`|The image) must"):
        restore(image, network=model)


def test_a_dask_array_of_unknown_size_is_refused(da: Any, model: Path) -> None:
    array = da.from_array(noise(20, 20))
    with pytest.raises(ImageError, match="of known size"):
        restore(array[array[:, 0] > 2000], network=model)
    with pytest.raises(ImageError, match="a masked Dask array"):
        restore(da.ma.masked_equal(da.zeros((9, 9)), 0), network=model)


def test_options_and_models_are_refused_before_anything_is_computed(
    da: Any, model: Path, tmp_path: Path
) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"runtime": "tensorrt"}, "`runtime` must be one of 'onnxruntime', 'openvino'"),
        ({"tile": 10}, "`tile` must be at least 16"),
        ({"tile": 16, "halo": 8}, "`tile` must be more than twice the halo"),
        ({"halo": -1}, "`halo` must be 'exact' or a number of pixels"),
    ]
    for image in (noise(40, 40), da.from_array(noise(40, 40), chunks=20)):
        for options, words in cases:
            with pytest.raises(OptionError, match=f"^{words}"):
                restore(image, network=model, **options)
        with pytest.raises(ModelError, match="no such file"):
            restore(image, network=tmp_path / "none.onnx")


def test_importing_it_loads_no_optional_package() -> None:
    names = ("torch", "dask", "distributed", "xarray", "matplotlib", "skimage")
    code = (
        f"import sys; from beers_deploy import restore; print([m for m in {names} if "
        "m in sys.modules])"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == "[]"
