"""Tests that `restore` gives the pixels of the integer reference for any tiles and threads."""

import numpy as np
import pytest

from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.verbs.restore import restore
from tests.shipped import shipped_pair

MAX_DN = np.float32(4095)


def raw(height: int, width: int) -> np.ndarray:
    """Return digital numbers (H, W) of every size, smooth on the left and rough on the right."""
    y, x = np.mgrid[:height, :width]
    smooth = 2048 + 1500 * np.sin(y / 9) * np.cos(x / 7)
    rough = np.random.default_rng(4).normal(0, 600, (height, width)) * (x > width // 2)
    return np.asarray(np.clip(np.rint(smooth + rough), 0, 4095), np.uint16)


def by_reference(dn: np.ndarray, name: str) -> np.ndarray:
    """Restore digital numbers (H, W) with the integer reference."""
    core = read_core(load_onnx(shipped_pair(name)[1]))
    image = (dn.astype(np.float32) / MAX_DN)[None, None]
    tensors, _ = run_core(core, core.host_part.encode(image), half_even=True)
    restored = np.clip(image + merged_correction(core, tensors), 0, 1)[0, 0] * MAX_DN
    return np.asarray(np.rint(restored), np.uint16)


@pytest.mark.parametrize("name", ["convbeers-xs", "convbeers-s"])
def test_an_array_has_the_pixels_of_the_integer_reference(name: str) -> None:
    dn = raw(61, 97)
    model = shipped_pair(name)[1]
    expected = by_reference(dn, name)
    assert (expected != dn).mean() > 0.5
    for tile_px, threads in ((640, 1), (48, 2)):
        np.testing.assert_array_equal(
            restore(dn, network=model, tile=tile_px, threads=threads), expected
        )
