"""Tests that the outputs that users see do not change. `outputs.py` writes the stored ones."""

import json
from typing import Any

import numpy as np
import pytest

from tests.golden.outputs import SHIPPED, STORED, Outputs, outputs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def current(tmp_path_factory: pytest.TempPathFactory) -> Outputs:
    return outputs(tmp_path_factory.mktemp("golden"))


def stored(part: str) -> dict[str, Any]:
    document: dict[str, dict[str, Any]] = json.loads(
        STORED.with_suffix(".json").read_text(encoding="utf-8")
    )
    return document[part]


def close(name: str, array: np.ndarray, expected: np.ndarray) -> bool:
    """Return True if an array that is fitted here equals the stored one up to float sums.

    Their last bits differ between processors.
    """
    if "float32," in name:
        return bool(np.allclose(array, expected, rtol=0, atol=1.01, equal_nan=True))
    if "int8," in name:
        return bool(np.nanmean(np.abs(array.astype(float) - expected)) <= 2)
    difference = np.abs(array - expected)
    # A bias is rounded to one of two values that its shift allows, so one of eight may differ. The
    # restored image is compared as well.
    spared = difference.max() if name.endswith("biases") else 0
    return bool(difference.sum() - spared <= 0.01 * np.abs(expected).sum())


def test_images_and_integers_equal_the_stored_ones(current: Outputs) -> None:
    with np.load(STORED.with_suffix(".npz")) as stored_arrays:
        arrays = dict(stored_arrays)
    assert current.arrays.keys() == arrays.keys()
    for name, expected in arrays.items():
        array = current.arrays[name]
        assert (array.shape, array.dtype) == (expected.shape, expected.dtype), name
        # Shipped integers are the same everywhere.
        if name.startswith(f"{SHIPPED}, ") and "float32," not in name:
            np.testing.assert_array_equal(array, expected, err_msg=name)
        else:
            assert close(name, array, expected), name


def test_figures_equal_the_stored_ones(current: Outputs) -> None:
    figures = stored("figures")
    assert sorted(current.figures) == sorted(figures)
    for name, value in figures.items():
        actual = current.figures[name]
        rel = 0.05 if name.startswith("gate, ") else 1e-3
        if isinstance(value, float):
            assert actual == pytest.approx(value, rel=rel, abs=1e-6, nan_ok=True), name
        else:
            assert actual == value, name


def test_shipped_int8_files_have_the_stored_digests(current: Outputs) -> None:
    assert current.digests == stored("digests")


@pytest.mark.parametrize("name", stored("layouts"))
def test_a_layout_is_restored_or_refused_as_before(name: str, current: Outputs) -> None:
    assert current.layouts[name] == stored("layouts")[name]


@pytest.mark.parametrize("words", stored("wrong calls"))
def test_a_wrong_call_is_answered_as_before(words: str, current: Outputs) -> None:
    assert current.answers[words] == stored("wrong calls")[words]
