"""Tests that a pattern of two pixels is found with its size, even if it changes its sign."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.model.metrics.detector_phases import (
    PATTERNS,
    Pattern,
    judge_phases,
    measure_phases,
)

LEAST = 0.003


def judged(image: np.ndarray, side_px: int = 64) -> dict[str, Pattern]:
    parts = [
        image[top : top + side_px, left : left + side_px].astype(np.float32)
        for top, left in product(*(range(0, size, side_px) for size in image.shape))
    ]
    return {
        pattern.name: pattern
        for pattern in judge_phases([measure_phases(p, np.isfinite(p)) for p in parts], LEAST)
    }


def signs(name: str, shape: tuple[int, int]) -> np.ndarray:
    rows, columns = np.indices(shape)
    return 1 - 2.0 * (
        {"alternate columns": columns, "alternate rows": rows, "checkerboard": rows + columns}[name]
        % 2
    )


@settings(max_examples=20)
@given(st.integers(0, 2**20), st.sampled_from(PATTERNS), st.floats(0.005, 0.2), st.booleans())
def test_a_pattern_is_found_with_its_size(
    seed: int, name: str, difference: float, turns: bool
) -> None:
    shape = (192, 256)
    size = np.linspace(-1, 1, shape[0])[:, None] * np.sqrt(3) if turns else 1.0
    image = 500 * (1 + difference / 2 * size * signs(name, shape))
    patterns = judged(image + np.random.default_rng(seed).normal(0, 4, shape))
    assert patterns[name].significant
    assert patterns[name].difference == pytest.approx(difference, rel=0.2, abs=0.0005)
    assert not any(pattern.significant for other, pattern in patterns.items() if other != name)


@settings(max_examples=15)
@given(st.integers(0, 2**20), st.integers(20, 150), st.integers(20, 150))
def test_noise_has_no_pattern(seed: int, height: int, width: int) -> None:
    image = np.random.default_rng(seed).normal(500, 20, (height, width))
    assert not any(pattern.significant for pattern in judged(image).values())


@pytest.mark.parametrize("shape", [(1, 1), (15, 40), (40, 15), (16, 16), (64, 17)])
@pytest.mark.parametrize("value", [0.0, 5.0, np.nan])
def test_small_constant_or_missing_images_have_none(shape: tuple[int, int], value: float) -> None:
    assert not any(pattern.significant for pattern in judged(np.full(shape, value)).values())
