"""Tests that a file restored in tiles equals the whole image's result, bit for bit."""

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import maximum_filter

from beers_deploy.profiles.errors import BeersError, ImageError, MachineError, OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.session import open_session, run
from beers_deploy.restoration import runtime
from beers_deploy.restoration.runtime import Infer, open_runtime
from beers_deploy.restoration.tiles.exposures import restore_window
from beers_deploy.verbs.restore import restore
from tests.deploy.restoration.runs import marked, names, noise, restored
from tests.shipped import shipped_pair

RADIUS_PX = 5
NODATA = 7
SHAPES: dict[tuple[int, int], type] = {
    (61, 83): np.uint16,
    (29, 29): np.float32,
    (17, 130): np.float32,
    (1, 40): np.uint16,
    (40, 1): np.float32,
    (3, 5): np.uint16,
}
"""Images of several tiles, of one tile in one or both directions, and smaller than the radius."""


def by_file(
    folder: Path, pixels: np.ndarray, tags: dict[str, Any] | None = None, **options: Any
) -> tuple[np.ndarray, Row]:
    """Write, restore and read again, and check that no other file is left."""
    result = restored(folder, pixels, tags, **options)
    assert names(folder) == ["in.tif", "out.tif"]
    return result


def whole_image(model: Path, pixels: np.ndarray) -> np.ndarray:
    """Return the result without any tiling, float32."""
    infer = partial(run, open_session(load_onnx(model)))
    return np.asarray(restore_window(pixels[None], infer, 4095)[0])


@pytest.mark.parametrize(("shape", "dtype"), SHAPES.items())
def test_tiled_equals_whole_bit_for_bit_in_files_and_arrays(
    shape: tuple[int, int], dtype: type, model: Path, tmp_path: Path
) -> None:
    pixels: np.ndarray = noise(*shape).astype(dtype)
    whole = whole_image(model, pixels)
    expected = np.rint(whole).astype(dtype) if dtype is np.uint16 else whole
    tags = {"tile": (16, 16), "compression": "zlib"}
    result, _ = by_file(tmp_path, pixels, tags, network=model, tile=23)
    for way in (result, restore(pixels, network=model, tile=23)):
        assert way.dtype == dtype
        assert_array_equal(way, expected)
    # Only integers are compressed as differences, because floats would not become smaller.
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert file.pages.first.predictor == (2 if dtype is np.uint16 else 1)


def test_the_seam_error_is_that_of_the_tile_in_the_middle(model: Path, tmp_path: Path) -> None:
    pixels = noise(60, 60).astype(np.float32)
    result, row = by_file(tmp_path, pixels, network=model, tile=24, halo=2)
    # Tiles of 23 pixels keep rows 0 to 20, 21 to 39 and 40 to 59.
    middle = np.s_[21:40, 21:40]
    error = np.abs(result.astype(np.float64) - whole_image(model, pixels))[middle]
    assert row.figures["seam error max"].value == pytest.approx(error.max())
    assert row.figures["seam error max"].mode == "measured"
    assert error.max() > 0
    assert row.figures["seam error mean"].value == pytest.approx(error.mean())


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


def test_one_bright_row_at_the_end_makes_floats_digital_numbers(
    model: Path, tmp_path: Path
) -> None:
    dark = np.full((70, 37), 0.5, np.float32)
    dark[-1, 3] = 900
    assumed, row = by_file(tmp_path, dark, network=model, tile=23)
    scaled, _ = by_file(tmp_path, dark, network=model, tile=23, full_scale=4095)
    assert_array_equal(assumed, scaled)
    assert row.text["full scale"] == "4095"


def test_missing_pixels_stay_and_corrupt_no_others(model: Path, tmp_path: Path) -> None:
    missing = np.zeros((70, 90), bool)
    missing[20:60, 30:75] = missing[3, 5] = True
    ground = noise(70, 90)
    ground[ground == NODATA] += 1
    pixels = np.where(missing, NODATA, ground).astype(np.uint16)
    tiled, untiled = (
        by_file(tmp_path, pixels, marked(NODATA), network=model, tile=tile_px)[0]
        for tile_px in (19, 640)
    )
    assert_array_equal(tiled, untiled)
    # No other pixel becomes one that is missing.
    assert_array_equal(tiled == NODATA, missing)
    filled, _ = by_file(tmp_path, np.where(missing, 999, ground).astype(np.uint16), network=model)
    reached = maximum_filter(missing, 2 * RADIUS_PX + 1)
    assert_array_equal(tiled[~reached], filled[~reached])


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
    assert names(folder) == ["in.tif", "out.tif"]


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        # The value above full scale is in the last row.
        (np.pad(noise(89, 40), ((0, 1), (0, 0)), constant_values=60000), ("60000", "full_scale")),
        (-noise(90, 40).astype(np.float32), ("-4", "Add the offset")),
        (np.full((20, 20), np.inf, np.float32), ("inf", "Write NaN")),
        (np.full((60, 40), np.nan, np.float32), ("NaN",)),
        ((noise(61, 37) / 4095).astype(np.float32), ("floats of at most 1", "`full_scale`")),
    ],
)
def test_invalid_values_leave_the_old_output(
    pixels: np.ndarray, words: tuple[str, ...], model: Path, tmp_path: Path
) -> None:
    refused(tmp_path, pixels, ImageError, *words, network=model, tile=23)


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        ("`tile` must be more than twice the halo", {"tile": 16, "halo": 8}),
        ("`halo` must be 'exact' or a number of pixels", {"halo": "wide"}),
        ("`full_scale`", {"full_scale": 0.5}),
    ],
)
def test_invalid_options_are_refused(
    words: str, changes: dict[str, Any], model: Path, tmp_path: Path
) -> None:
    options = {"network": model, "tile": 23, **changes}
    refused(tmp_path, noise(40, 40), OptionError, words, **options)


def test_a_budget_that_does_not_suffice_is_refused_before_the_run(
    model: Path, tmp_path: Path
) -> None:
    words = "1.00 kB", "smaller `tile`", "TILED=YES"
    refused(tmp_path, noise(40, 40), MachineError, *words, network=model, memory=1e-6)


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


@pytest.mark.parametrize(("dtype", "most_dn"), [(np.uint16, 0), (np.float32, 0.01)])
def test_openvino_gives_the_numbers_of_onnxruntime(
    dtype: type, most_dn: float, model: Path, tmp_path: Path
) -> None:
    """An INT8 network gives the same numbers, a float one nearly the same."""
    pytest.importorskip("openvino")
    pixels = np.concatenate([noise(70, 83), np.linspace(0, 4095, 4150).reshape(50, 83)])
    network = shipped_pair()[1] if dtype is np.uint16 else model
    options: dict[str, Any] = {"network": network, "tile": 64}
    expected, _ = by_file(tmp_path, pixels.astype(dtype), **options)
    result, row = by_file(tmp_path, pixels.astype(dtype), **options, runtime="openvino")
    assert_allclose(result, expected, rtol=0, atol=most_dn)
    assert row.text["runtime"].startswith("openvino")


def test_openvino_gives_the_same_on_processors_whose_kernels_saturate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The network is rewritten as on such a processor.

    The image has only the two extreme values, which give the largest sums.
    """
    pytest.importorskip("openvino")
    image = np.random.default_rng(3).integers(0, 2, (1, 1, 41, 67)).astype(np.float32)
    model = load_onnx(shipped_pair()[1])
    monkeypatch.setattr(runtime, "_adds_exactly", lambda _: False)
    restored = runtime.open_openvino(model, 1)[0](image)
    assert_array_equal(restored, run(open_session(model), image))


def test_a_missing_openvino_is_one_sentence(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(MachineError, match=r"pip install 'beers-deploy\[openvino\]'"):
        open_runtime("openvino", load_onnx(model), 1)
