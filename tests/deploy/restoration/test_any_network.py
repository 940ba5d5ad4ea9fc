"""Users' networks, with strides, larger results and several bands: tiles give the pixels of the
whole image, bit for bit.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tifffile
from onnx import helper

from beers_deploy.profiles.errors import MachineError, ModelError, OptionError
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.session import open_session, tensors_of
from beers_deploy.quant.tiling.receptive_field import Tiling, tiling_of
from beers_deploy.restoration.plan import make_plan
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import restored, stopped_after
from tests.quant.tiling.small_networks import (
    espcn,
    ffdnet,
    float_unet,
    four_bands,
    graph,
    half_resolution,
    int8_half_resolution,
    plain_int8_unet,
)

NETWORKS: dict[str, tuple[Callable[[], onnx.ModelProto], Tiling]] = {
    "U-Net": (float_unet, Tiling(6, 2)),
    "INT8 U-Net": (plain_int8_unet, Tiling(16, 8)),
    "ESPCN": (espcn, tiling_of(espcn())),
    "FFDNet": (ffdnet, Tiling(6, 2)),
    "half resolution": (half_resolution, Tiling(10, 2)),
    "INT8 half resolution": (int8_half_resolution, Tiling(10, 2)),
    "4 bands": (four_bands, Tiling(2, 1, tiling_of(four_bands()).scale, 4, 4)),
    "4 bands to 2": (lambda: four_bands(2), Tiling(2, 1, tiling_of(four_bands()).scale, 4, 2)),
}
SIZE = 141, 107


@pytest.fixture(params=NETWORKS)
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return the file of a network."""
    return saved(NETWORKS[request.param][0](), tmp_path)


def saved(model: onnx.ModelProto, folder: Path) -> Path:
    (folder / "models").mkdir(exist_ok=True)
    save_onnx(model, folder / "models" / "network.onnx")
    return folder / "models" / "network.onnx"


def noise(path: Path, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Return an image (bands, H, W) uint16, or (H, W), with the bands that the network accepts."""
    bands = tiling_of(load_onnx(path)).channels_in
    shape = (bands, *size) if bands > 1 else size
    return np.random.default_rng(4).integers(0, 4096, shape).astype(np.uint16)


def whole(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Return the result without the engine: the image is extended by copies of its last row and
    column, and cut again.
    """
    model = load_onnx(path)
    height, width = pixels.shape[-2:]
    tiling = tiling_of(model)
    bands = pixels.reshape(-1, height, width)
    more = [-side % tiling.lattice_px for side in (height, width)]
    image = np.pad(bands, ((0, 0), (0, more[0]), (0, more[1])), mode="edge").astype(np.float32)
    (result,) = tensors_of(open_session(model, 1), None, image[None] / np.float32(4095))
    scale = int(tiling.scale)
    cut = result[0, :, : height * scale, : width * scale] * np.float32(4095)
    return np.asarray(np.rint(np.clip(cut, 0, 4095)).squeeze())


def by_file(
    pixels: np.ndarray, folder: Path, path: Path, tile: int, extratags: Any = (), **options: Any
) -> np.ndarray:
    """Restore a file by a network, and return the pixels that were written."""
    tags: dict[str, Any] = {"photometric": "minisblack", "extratags": extratags}
    if pixels.ndim == 3:
        tags["planarconfig"] = "separate"
    return restored(folder, pixels, tags, network=path, tile=tile, **options)[0]


@pytest.mark.parametrize("name", NETWORKS)
def test_the_tiling_of_each_network_is_found(name: str) -> None:
    make, tiling = NETWORKS[name]
    assert tiling_of(make()) == tiling


@pytest.mark.parametrize("tile_px", [56, 83])
def test_tiled_is_whole_at_an_odd_size(tile_px: int, path: Path, tmp_path: Path) -> None:
    pixels = noise(path)
    expected = whole(path, pixels)
    assert len(np.unique(expected)) > 50
    np.testing.assert_array_equal(by_file(pixels, tmp_path, path, tile_px, threads=1), expected)
    in_memory = restore(pixels, network=path, tile=tile_px, threads=1)
    np.testing.assert_array_equal(in_memory, expected)


def test_one_lattice_less_of_halo_shows_seams(path: Path, tmp_path: Path) -> None:
    tiling = tiling_of(load_onnx(path))
    pixels = noise(path)
    halo = tiling.halo_px - tiling.lattice_px
    result = by_file(pixels, tmp_path, path, 56, halo=halo, threads=1)
    assert (result != whole(path, pixels)).any()


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (47, 2)])
def test_tiny_images_are_extended_too(size: tuple[int, int], path: Path, tmp_path: Path) -> None:
    pixels = noise(path, size)
    result = by_file(pixels, tmp_path, path, 83, threads=1)
    np.testing.assert_array_equal(result.squeeze(), whole(path, pixels))


def test_missing_pixels_stay_and_corrupt_no_others(path: Path, tmp_path: Path) -> None:
    """Some lie at the last row and column, which the extension copies."""
    pixels = np.maximum(noise(path), 1)
    pixels[..., 60:90, 40:60] = 0
    pixels[..., -3:, -5:] = 0
    pixels[(0, 5, 5) if pixels.ndim == 3 else (5, 5)] = 0
    nodata = [(42113, "s", 0, "0", True)]
    tiled, untiled = (
        by_file(pixels, tmp_path, path, side, threads=1, extratags=nodata) for side in (56, 500)
    )
    np.testing.assert_array_equal(tiled, untiled)
    tiling = tiling_of(load_onnx(path))
    missing = pixels == 0
    if tiling.channels_in != tiling.channels_out:
        missing = np.broadcast_to(missing.any(axis=0), (tiling.channels_out, *SIZE))
    scale = int(tiling.scale)
    np.testing.assert_array_equal(tiled == 0, missing.repeat(scale, -2).repeat(scale, -1))


def test_a_lazy_array_gives_the_same(path: Path) -> None:
    da = pytest.importorskip("dask.array")
    pixels = noise(path)
    lazy = restore(da.from_array(pixels, chunks=40), network=path, tile=56)
    expected = whole(path, pixels)
    assert lazy.shape == expected.shape
    np.testing.assert_array_equal(lazy.compute(scheduler="synchronous"), expected)


def test_a_run_that_was_stopped_is_resumed_to_the_same_bytes(path: Path, tmp_path: Path) -> None:
    files = tmp_path / "in.tif", tmp_path / "out.tif"
    options: dict[str, Any] = {"network": path, "tile": 56, "threads": 1}
    by_file(noise(path), tmp_path, path, 56, threads=1)
    expected = files[1].read_bytes()
    files[1].unlink()
    with stopped_after(4, MachineError("The machine has no power. Wait.")):
        restore(*files, **options)
    (row,) = restore(*files, **options, resume=True).rows
    assert files[1].read_bytes() == expected
    assert row.figures["tiles"].value


REFUSED: dict[str, tuple[Callable[[], onnx.ModelProto], type[Exception], str]] = {
    "classifier": (
        lambda: graph(
            [helper.make_node("GlobalAveragePool", ["image"], ["restored"], name="head")]
        ),
        ModelError,
        "GlobalAveragePool head reads the whole image",
    ),
    "segmentation": (
        lambda: graph(
            [
                helper.make_node(
                    "MaxPool", ["image"], ["restored"], kernel_shape=[2, 2], strides=[2, 2]
                )
            ]
        ),
        ModelError,
        "size of the image or a multiple of it, but it has 1/2",
    ),
    "4 bands": (
        four_bands,
        OptionError,
        "restores 4 bands together, but the number of bands of the image is 1",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_restored_is_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    make, error, sentence = REFUSED[name]
    path = saved(make(), tmp_path)
    with pytest.raises(error, match=sentence):
        by_file(np.ones((30, 30), np.uint16), tmp_path, path, 20)
    assert not (tmp_path / "out.tif").exists()


def test_halos_and_tiles_off_the_lattice_are_refused_or_rounded() -> None:
    tiling = Tiling(8, 4)
    with pytest.raises(
        OptionError, match=r"`halo` must be a multiple of 4 px.*got 7 px.*8 px is exact"
    ):
        make_plan((1, 100, 100), 40, 7, tiling)
    with pytest.raises(OptionError, match="at least 20 px, got 19 px"):
        make_plan((1, 100, 100), 19, 8, tiling)
    assert make_plan((1, 101, 99), 31, 8, tiling).tile_shape[0] % 4 == 0


def test_a_result_of_another_shape_than_the_file_says_is_refused(tmp_path: Path) -> None:
    model = espcn()
    model.graph.output[0].type.tensor_type.shape.dim[1].dim_value = 2
    path = saved(model, tmp_path)
    with pytest.raises(
        ModelError, match="a result of 1 x 60 x 60, but its file states 2 x 60 x 60"
    ):
        by_file(np.ones((30, 30), np.uint16), tmp_path, path, 40)


def test_a_larger_file_has_its_tags(tmp_path: Path) -> None:
    path = saved(espcn(), tmp_path)
    polynomials = tuple(float(k) for k in range(92))
    tags: Any = [
        (33550, 12, 3, (2.0, 2.0, 0.0), True),
        (33922, 12, 6, (0.0, 0.0, 0.0, 700.0, 900.0, 0.0), True),
        (50844, 12, 92, polynomials, True),
    ]
    by_file(np.ones((31, 30), np.uint16), tmp_path, path, 20, extratags=tags)
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        page: Any = file.pages[0]
        assert page.shape == (62, 60)
        assert page.tags[33550].value == (1.0, 1.0, 0.0)
        assert page.tags[50844].value[:9] == (0.0, 1.0, 4.5, 6.5, 4.0, 5.0, 6.0, 14.0, 16.0)


def test_a_one_band_network_restores_bands_one_by_one(tmp_path: Path) -> None:
    path = saved(espcn(), tmp_path)
    bands = np.random.default_rng(1).integers(0, 4096, (3, 41, 35)).astype(np.uint16)
    result = by_file(bands, tmp_path, path, 23)
    assert result.shape == (3, 82, 70)
    for band, restored_band in zip(bands, result, strict=True):
        np.testing.assert_array_equal(restored_band, whole(path, band))
