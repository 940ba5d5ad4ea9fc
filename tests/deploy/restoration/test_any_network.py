"""Tests that users' networks give the same pixels in tiles as on the whole image, bit for bit.

The networks have strides, larger results and several bands.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.session import open_session, tensors_of
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from beers_deploy.restoration.plan import make_plan
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import PLANES, marked, restored, stopped_after
from tests.quant.quick import fix_sizes
from tests.quant.tiling.small_networks import (
    espcn,
    ffdnet,
    float_unet,
    four_bands,
    half_resolution,
    int8_half_resolution,
    network,
    plain_int8_unet,
)

pytestmark = pytest.mark.usefixtures("unchecked")

SIZE = 141, 107


def saved(model: onnx.ModelProto, folder: Path) -> Path:
    (folder / "models").mkdir(exist_ok=True)
    save_onnx(model, folder / "models" / "network.onnx")
    return folder / "models" / "network.onnx"


NETWORKS: dict[str, Callable[[], onnx.ModelProto]] = {
    "U-Net": float_unet,
    "INT8 U-Net": plain_int8_unet,
    "ESPCN": espcn,
    "FFDNet": ffdnet,
    "half resolution": half_resolution,
    "INT8 half resolution": int8_half_resolution,
    "4 bands": four_bands,
    "4 bands to 2": partial(four_bands, 2),
}


@pytest.fixture(params=NETWORKS)
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return the file of a network."""
    return saved(NETWORKS[request.param](), tmp_path)


def noise(path: Path, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Return an image (bands, H, W) uint16, or (H, W), with the bands that the network accepts."""
    bands = tiling_of(load_onnx(path)).channels_in
    shape = (bands, *size) if bands > 1 else size
    return np.random.default_rng(4).integers(1, 4096, shape).astype(np.uint16)


def whole(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Return the result without the engine: the image is extended by copies of its last row and
    column, and cut again.
    """
    model = load_onnx(path)
    height, width = pixels.shape[-2:]
    tiling = tiling_of(model)
    bands = pixels.reshape(-1, height, width)
    more = [-side % tiling.alignment_px for side in (height, width)]
    image = np.pad(bands, ((0, 0), (0, more[0]), (0, more[1])), mode="edge").astype(np.float32)
    (result,) = tensors_of(open_session(model, 1), None, image[None] / np.float32(4095))
    scale = int(tiling.scale)
    cut = result[0, :, : height * scale, : width * scale] * np.float32(4095)
    return np.asarray(np.rint(np.clip(cut, 0, 4095)).squeeze())


def by_file(
    pixels: np.ndarray, folder: Path, network: Path, tile: int, **options: Any
) -> np.ndarray:
    """Restore a file by a network, and return the pixels that were written."""
    tags = options.pop("tags", {}) | (PLANES if pixels.ndim == 3 else {})
    return restored(folder, pixels, tags, network=network, tile=tile, **options)[0]


@pytest.mark.parametrize(("size", "tile_px"), [(SIZE, 56), ((3, 50), 83), ((147, 1), 83)])
def test_tiles_equal_the_whole_image_in_files_arrays_and_lazy_arrays(
    size: tuple[int, int], tile_px: int, path: Path, tmp_path: Path
) -> None:
    pixels = noise(path, size)
    expected = whole(path, pixels)
    result = by_file(pixels, tmp_path, path, tile_px, threads=1)
    assert_array_equal(result.squeeze(), expected)
    in_memory = restore(pixels, network=path, tile=tile_px, threads=1)
    assert_array_equal(in_memory.squeeze(), expected)
    if tile_px == 56:
        assert len(np.unique(expected)) > 50
        da = pytest.importorskip("dask.array")
        lazy = restore(da.from_array(pixels, chunks=40), network=path, tile=tile_px)
        assert lazy.shape == expected.shape
        assert_array_equal(lazy.compute(scheduler="synchronous"), expected)


def test_a_halo_that_is_one_step_smaller_shows_seams(path: Path, tmp_path: Path) -> None:
    tiling = tiling_of(load_onnx(path))
    pixels = noise(path)
    halo = tiling.halo_px - tiling.alignment_px
    result = by_file(pixels, tmp_path, path, 56, halo=halo, threads=1)
    assert (result != whole(path, pixels)).any()


@pytest.mark.parametrize("path", ["ESPCN", "INT8 half resolution", "4 bands to 2"], indirect=True)
def test_missing_pixels_stay_and_corrupt_no_others(path: Path, tmp_path: Path) -> None:
    """Missing pixels are also in the last row and column, which the extension copies."""
    pixels = noise(path)
    pixels[..., 60:90, 40:60] = 0
    pixels[..., -3:, -5:] = 0
    pixels[(0, 5, 5) if pixels.ndim == 3 else (5, 5)] = 0
    tiled, untiled = (
        by_file(pixels, tmp_path, path, side, tags=marked(0), threads=1) for side in (56, 500)
    )
    assert_array_equal(tiled, untiled)
    tiling = tiling_of(load_onnx(path))
    missing = pixels == 0
    if tiling.channels_in != tiling.channels_out:
        missing = np.broadcast_to(missing.any(axis=0), (tiling.channels_out, *SIZE))
    scale = int(tiling.scale)
    assert_array_equal(tiled == 0, missing.repeat(scale, -2).repeat(scale, -1))


@pytest.mark.parametrize("path", ["ESPCN"], indirect=True)
def test_a_run_that_was_stopped_is_resumed_to_the_same_bytes(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.tif"
    options: dict[str, Any] = {"network": path, "tile": 56, "threads": 1}
    by_file(noise(path), tmp_path, **options)
    expected = out.read_bytes()
    with stopped_after(4):
        restore(tmp_path / "in.tif", out, **options, overwrite=True)
    restore(tmp_path / "in.tif", out, **options, overwrite=True, resume=True)
    assert out.read_bytes() == expected


def espcn_of_two_bands() -> onnx.ModelProto:
    """Return a network whose file states a wrong shape of its result."""
    model = espcn()
    model.graph.output[0].type.tensor_type.shape.dim[1].dim_value = 2
    return model


@pytest.mark.parametrize(
    ("make", "error", "sentence"),
    [
        (
            lambda: network("[head] restored = GlobalAveragePool(image)", {}),
            ModelError,
            "GlobalAveragePool head reads the whole image",
        ),
        (
            lambda: network("restored = MaxPool<kernel_shape=[2,2], strides=[2,2]>(image)", {}),
            ModelError,
            "size of the image or a multiple of it, but it has 1/2",
        ),
        (
            four_bands,
            OptionError,
            "restores 4 bands together, but the number of bands of the image is 1",
        ),
        (
            espcn_of_two_bands,
            ModelError,
            "a result of 1 x 60 x 60, but its file states 2 x 60 x 60",
        ),
    ],
)
def test_what_cannot_be_restored_is_refused_in_one_sentence(
    make: Callable[[], onnx.ModelProto], error: type[Exception], sentence: str, tmp_path: Path
) -> None:
    path = saved(make(), tmp_path)
    with pytest.raises(error, match=sentence):
        by_file(np.ones((30, 30), np.uint16), tmp_path, path, 40)
    assert not (tmp_path / "out.tif").exists()


def test_tiles_of_a_network_that_reads_its_whole_tile_are_independent(tmp_path: Path) -> None:
    """An image of one tile is restored as it is, a larger one only with a halo that is given.

    The network's own size is used where larger tiles are allowed, and smaller ones are refused.
    """
    nodes = "[pool] mean = GlobalAveragePool(image) sum = Add(image, mean)"
    model = network(f"{nodes} restored = Mul(sum, half)", {"half": 0.5})
    for value in (*model.graph.input, *model.graph.output):
        fix_sizes(value, 32, 32)
    path = saved(model, tmp_path)

    def halved(pixels: np.ndarray) -> np.ndarray:
        return np.asarray(np.rint((pixels + pixels.mean()) / 2))

    pixels = np.random.default_rng(3).integers(1, 4096, (70, 50)).astype(np.uint16)
    tile = pixels[:32, :32]
    assert_allclose(by_file(tile, tmp_path, path, 32), halved(tile), atol=1)
    for halo in ("exact", "x"):
        with pytest.raises(OptionError, match=r"pool reads the whole image.* give `halo`"):
            by_file(pixels, tmp_path, path, 32, halo=halo)
    for side_px, height_px in ((16, 70), (32, 31)):
        with pytest.raises(OptionError, match="fixed to tiles of 32 px"):
            by_file(pixels[:height_px], tmp_path, path, side_px, halo="4")
    result = by_file(pixels, tmp_path, path, 640, halo="4")
    assert_allclose(result[:28, :28], halved(tile)[:28, :28], atol=1)
    assert_allclose(result[52:, 28:], halved(pixels[38:, 18:])[14:, 10:], atol=1)


def test_halos_that_are_not_aligned_are_refused_and_tiles_rounded() -> None:
    tiling = Tiling(8, 4)
    with pytest.raises(
        OptionError, match=r"`halo` must be a multiple of 4 px.*got 7 px.*8 px is exact"
    ):
        make_plan((1, 100, 100), 40, 7, tiling)
    with pytest.raises(OptionError, match="at least 20 px, got 19 px"):
        make_plan((1, 100, 100), 19, 8, tiling)
    assert make_plan((1, 101, 99), 31, 8, tiling).tile_shape[0] % 4 == 0
