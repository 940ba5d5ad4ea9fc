"""Tests that the crops of a search contain what int8 clips: edges and the brightest ground."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from beers_deploy.quant.graph import CORRECTION, PLANES, Conv, same
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.passes.trial import BRIGHT, brightened, search_targets
from tests.quant.quick import waves


@given(st.integers(0, 2**32 - 1), st.sampled_from([(), ((0.0, 255.0), (-2.0, 2.0), (0.0, 0.4))]))
def test_bright_ground_has_the_details_of_its_crop(
    seed: int, ranges: tuple[tuple[float, float], ...]
) -> None:
    ends = np.array([high for _, high in ranges] or [1.0] * 3)[:, None, None]
    crop = ends * np.random.default_rng(seed).uniform(0, 0.5, (1, 3, 6, 11)).astype(np.float32)
    crop[:, 2] = 0.1
    bright = brightened(crop.astype(np.float32), ranges)
    assert_allclose(bright[:, :2].max((0, 2, 3)), ends[:2, 0, 0], rtol=1e-5)
    lift = bright - crop
    assert_allclose(lift, np.broadcast_to(lift[..., :1, :1], lift.shape), atol=1e-4)
    # A map of a noise level does not depend on the ground's brightness.
    assert_array_equal(bright[:, 2], crop[:, 2].astype(np.float32))


@pytest.mark.parametrize("brightens", [True, False])
def test_one_crop_in_several_is_added_in_full_light(brightens: bool) -> None:
    host_part = HostPart()
    shape = (1, host_part.planes, 3, 3)
    weight = np.random.default_rng(0).normal(0, 0.1, shape).astype(np.float32)
    last = Conv("last", PLANES, CORRECTION, weight, np.zeros(1, np.float32), window=same(weight))
    images = [np.rint(64 * image) / 128 for image in waves(16)]
    crops = [crop for crop, _, _ in search_targets((last,), host_part, images, 16, brightens)]
    originals = len(images)
    assert len(crops) == originals + brightens * (12 // BRIGHT)
    assert max(crop.max() for crop in crops[:originals]) < 0.5
    for crop in crops[originals:]:
        assert crop.max() == pytest.approx(1)
