import math

import numpy as np
import pytest
import skimage.data
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio

from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.profiles.errors import ImageError


def noisy_pair(seed: int, sigma_dn: float) -> tuple[np.ndarray, np.ndarray]:
    reference = skimage.data.camera()[100:213, 80:201].astype(np.float64) * 16
    noise = np.random.default_rng(seed).standard_normal(reference.shape) * sigma_dn
    return np.clip(np.rint(reference + noise), 0, 4095).astype(np.float32), reference.astype(
        np.float32
    )


@given(st.integers(0, 100), st.floats(1, 300))
def test_psnr_agrees_with_scikit_image(seed: int, sigma_dn: float) -> None:
    image, reference = noisy_pair(seed, sigma_dn)
    assert psnr_db(image, reference, 4095) == pytest.approx(
        peak_signal_noise_ratio(reference.astype(float), image.astype(float), data_range=4095),
        abs=1e-9,
    )


def test_identical_images_and_those_smaller_than_the_window() -> None:
    image, _ = noisy_pair(0, 20)
    assert psnr_db(image, image, 4095) == math.inf
    assert ssim(image, image, 4095) == pytest.approx(1.0, abs=1e-12)
    with pytest.raises(ImageError, match="11 pixels"):
        ssim(image[:10], image[:10], 4095)


def test_flat_bright_images_keep_ssim_within_its_range() -> None:
    rng = np.random.default_rng(0)
    flat = np.full((33, 41), 4000.0)
    first, second = (flat + 0.5 * rng.standard_normal(flat.shape) for _ in range(2))
    assert -1 <= ssim(first.astype(np.float32), second.astype(np.float32), 1.0) <= 1
