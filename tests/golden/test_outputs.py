"""What users see does not change: see `outputs.py`, which writes the stored outputs."""

import json
from typing import Any

import numpy as np
import pytest

from tests.golden.outputs import OTHER, SHIPPED, STORED, Outputs, outputs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Outputs:
    return outputs(tmp_path_factory.mktemp("golden"))


def stored(part: str) -> dict[str, Any]:
    document: dict[str, dict[str, Any]] = json.loads(
        STORED.with_suffix(".json").read_text(encoding="utf-8")
    )
    return document[part]


def test_images_and_integers_are_those_that_were_stored(made: Outputs) -> None:
    with np.load(STORED.with_suffix(".npz")) as arrays:
        assert made.arrays.keys() == set(arrays.files)
        for name, wanted in arrays.items():
            array = made.arrays[name]
            assert (array.shape, array.dtype) == (wanted.shape, wanted.dtype), name
            # Float sums differ in their last bits between processors, and so may what is fitted to
            # them: the integers of the networks that are quantised here, and a few pixels. Shipped
            # integers are the same everywhere.
            if name.startswith(f"{SHIPPED}, ") and "float32," not in name:
                np.testing.assert_array_equal(array, wanted, err_msg=name)
            elif "float32," in name:
                np.testing.assert_allclose(array, wanted, rtol=0, atol=1.01, err_msg=name)
            elif "int8," in name:
                assert np.nanmean(np.abs(array.astype(float) - wanted)) <= 8, name
            else:
                difference = np.abs(array - wanted)
                # A bias lies between two that its shift allows: one of eight may go to the other.
                # Its image is compared above.
                spared = difference.max() if name.endswith("biases") else 0
                # The search for this network ends at other scales on some processors: the same code
                # gives weights that differ by 3.3 %, biases by 4.7 %, pixels by 5.9 DN in the mean.
                share = 0.06 if name.startswith(f"{OTHER}, ") else 0.01
                assert difference.sum() - spared <= share * np.abs(wanted).sum(), name


def test_figures_are_those_that_were_stored(made: Outputs) -> None:
    figures = stored("figures")
    assert sorted(made.figures) == sorted(figures)
    for name, value in figures.items():
        rel = 0.05 if name.startswith("gate, ") else 1e-3
        if isinstance(value, float):
            assert made.figures[name] == pytest.approx(value, rel=rel, abs=1e-6, nan_ok=True), name
        else:
            assert made.figures[name] == value, name


def test_shipped_int8_files_have_the_stored_digests(made: Outputs) -> None:
    assert made.digests == stored("digests")


@pytest.mark.parametrize("name", stored("layouts"))
def test_a_layout_is_restored_or_refused_as_before(name: str, made: Outputs) -> None:
    assert made.layouts[name] == stored("layouts")[name]


@pytest.mark.parametrize("words", stored("wrong calls"))
def test_a_wrong_call_is_answered_as_before(words: str, made: Outputs) -> None:
    assert made.answers[words] == stored("wrong calls")[words]
