"""Test that arrays of NumPy, Dask and xarray are restored to the same pixels, or refused."""

from errno import EACCES
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from beers_deploy.profiles.errors import ImageError, MachineError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.verbs.restore import restore
from beers_deploy.verbs.verb import verb
from tests.deploy.restoration.runs import noise
from tests.deploy.two_workers import local_cluster
from tests.quant.tiling.small_networks import espcn


@pytest.fixture(scope="module")
def da() -> Any:
    return pytest.importorskip("dask.array", reason="the extra 'dask' is not installed")


def test_a_path_that_may_not_be_read_is_one_sentence() -> None:
    """An administrator may read every file, so that the error is raised here."""

    @verb
    def reading() -> None:
        raise PermissionError(EACCES, "Permission denied", "a.tif")

    with pytest.raises(MachineError, match=r"a\.tif cannot be read or written: Permission"):
        reading()


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
    assert_array_equal(lazy.compute(), restore(pixels, network=model, tile=23))


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
    assert_array_equal(corner, restore(pixels, network=model, tile=40)[:30, :30])
    assert chunks_read == [(0, 0)]


@pytest.mark.slow
def test_a_dask_array_is_computed_by_other_processes(da: Any, model: Path) -> None:
    distributed = pytest.importorskip("distributed")
    pixels = noise(150, 120)
    lazy = restore(da.from_array(pixels, chunks=64), network=model, tile=40)
    with local_cluster(2) as local, distributed.Client(local) as client:
        computed = client.compute(lazy).result()
    assert_array_equal(computed, restore(pixels, network=model, tile=40))


def test_a_dask_array_of_shares_is_refused_when_it_is_computed(da: Any, model: Path) -> None:
    shares = (noise(60, 50) / 4095).astype(np.float32)
    shares[5:9] = np.nan
    options: dict[str, Any] = {"network": model, "tile": 23}
    lazy = restore(da.from_array(shares, chunks=20), **options)
    with pytest.raises(ImageError, match=r"^The image has .*`full_scale`"):
        lazy.compute()
    lazy = restore(da.from_array(shares, chunks=20), **options, full_scale=1)
    assert_array_equal(lazy.compute(), restore(shares, **options, full_scale=1))
    assert np.isnan(restore(shares * np.nan, **options)).all()


def test_a_dask_array_has_the_full_scale_of_its_sensor(da: Any, model: Path) -> None:
    sensor = Sensor.load("pleiades-degraded").replace(bits=14)
    pixels = noise(60, 90) * 4
    options: dict[str, Any] = {"network": model, "tile": 23, "sensor": sensor}
    lazy = restore(da.from_array(pixels, chunks=50), **options)
    assert_array_equal(lazy.compute(), restore(pixels, **options))


def test_openvino_runs_in_dasks_threads(da: Any, model: Path) -> None:
    pytest.importorskip("openvino")
    pixels = noise(150, 120)
    lazy = restore(da.from_array(pixels, chunks=64), network=model, tile=40, runtime="openvino")
    computed = lazy.compute(scheduler="threads", num_workers=8)
    assert_array_equal(computed, restore(pixels, network=model, tile=40, runtime="openvino"))


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
    assert_array_equal(restored.values, restore(pixels, network=model, tile=23, nodata=9))
    assert (restored.values[0, 10:20, 10:20] == 9).all()
    xarray.testing.assert_identical(restored.coords.to_dataset(), image.coords.to_dataset())
    assert (restored.attrs, restored.name, restored.dims) == (image.attrs, image.name, image.dims)
    other = restore(image, network=model, tile=23, nodata=4000)
    assert (other.values != restored.values).any()


@pytest.mark.parametrize(
    "dims", [("x", "y", "band"), ("y", "time", "x"), ("lon", "lat", "t"), ("band", "row", "column")]
)
def test_the_order_of_named_dimensions_changes_no_pixel(dims: tuple[str, ...], model: Path) -> None:
    """A network and a sensor treat rows and columns differently, in whatever order they lie."""
    xarray = pytest.importorskip("xarray")
    pixels = noise(2, 40, 30)
    sizes = {"y": 1, "lat": 1, "row": 1, "x": 2, "lon": 2, "column": 2}
    axes = [sizes.get(dim, 0) for dim in dims]
    image = xarray.DataArray(pixels.transpose(axes), dims=dims)
    restored = restore(image, network=model, tile=23)
    assert restored.dims == dims
    assert_array_equal(restored.values, restore(pixels, network=model, tile=23).transpose(axes))


def test_arrays_of_other_libraries_are_read_as_numpy_s(model: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pixels = noise(40, 30)
    frame = restore(pandas.DataFrame(pixels), network=model, tile=23)
    assert_array_equal(frame, restore(pixels, network=model, tile=23))


def test_what_numpy_does_not_read_is_refused(model: Path) -> None:
    torch = pytest.importorskip("torch")
    tensor = torch.full((40, 30), 800.0)
    for image in (tensor.bfloat16(), tensor.to_sparse(), tensor.to("meta")):
        with pytest.raises(ImageError, match="`image` has a tensor that NumPy does not read"):
            restore(image, network=model)
    with pytest.raises(ImageError, match="BytesIO"):
        restore(BytesIO(b"II*"), network=model)


def test_a_data_array_of_more_pixels_has_their_places(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    save_onnx(espcn(), tmp_path / "twice.onnx")
    places = {"y": 99 - 2 * np.arange(20), "x": np.arange(30.0), "band": [1], "spatial_ref": 0}
    image = xarray.DataArray(noise(1, 20, 30), dims=("band", "y", "x"), coords=places, name="scene")
    image.coords["spatial_ref"].attrs["GeoTransform"] = "of the pixels before"
    restored = restore(image, network=tmp_path / "twice.onnx")
    assert restored.shape == (1, 40, 60)
    assert_array_equal(restored.y, 99.5 - np.arange(40))
    assert_array_equal(restored.x, np.arange(60) / 2 - 0.25)
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
    assert_array_equal(lazy[:10].compute(), restore(pixels[:30], network=model, tile=23)[:10])
    with pytest.raises(ImageError, match=r"60000 in rows \d+ to \d+"):
        lazy.compute()


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
