"""Tests that each pass can be left out, and that each one has an effect."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import onnx
import pytest

from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.quantize import quantize_model
from tests.quant.quick import patches_of, run_model
from tests.quant.test_odd_networks import SAME, VALID, sketch

pytestmark = pytest.mark.slow

Results = Callable[[Passes], list[np.ndarray]]


def waves(phase: int) -> np.ndarray:
    """Return an image (1, 1, H, W) of waves with few bright points, which are cheap to clip."""
    rows, columns = np.mgrid[:48, :36] / 40
    image = 0.3 + 0.1 * np.sin(7 * rows + phase) * np.cos(5 * columns)
    image[5::16, 7::12] = 1.0
    return np.asarray(image, np.float32)[None, None]


DISTILLING = sketch(
    f"""head = {SAME}(in, head_w, head_b)
    refined = {SAME}(head, refined_w, refined_b)
    sum = Add(refined, head)
    active = LeakyRelu<alpha=0.1015625>(sum)
    smooth = {SAME}(active, smooth_w, smooth_b)
    deep = Add(smooth, head)
    tail = {SAME}(deep, tail_w, tail_b)
    out = Add(in, tail)""",
    sizes={"tail": 0.1},
    head=(4, 1, 3, 3),
    refined=(4, 4, 3, 3),
    smooth=(4, 4, 3, 3),
    tail=(1, 4, 3, 3),
)
"""A distillation network of one step: an activation behind a sum, and a long skip."""


@pytest.fixture(scope="module")
def results(float_onnx: onnx.ModelProto) -> Results:
    """Return a function that quantises three networks and returns their results.

    One adds to the image, one computes the whole image, and one is a distillation network.
    """
    patches = patches_of([waves(phase) for phase in range(3)])

    def of_passes(passes: Passes) -> list[np.ndarray]:
        networks = (float_onnx, VALID["dead channels"], DISTILLING)
        files = [quantize_model(network, patches, {}, passes=passes).host for network in networks]
        return [run_model(file, waves(0)) for file in files]

    return of_passes


@pytest.fixture(scope="module")
def with_all(results: Results) -> list[np.ndarray]:
    return results(ALL)


@pytest.mark.parametrize("name", [field.name for field in fields(Passes)])
def test_each_pass_can_be_left_out_and_has_an_effect(
    name: str, results: Results, with_all: list[np.ndarray]
) -> None:
    """At least one of the networks must change, because no pass serves all of them."""
    without = results(replace(ALL, **{name: False}))
    assert any((one != other).any() for one, other in zip(with_all, without, strict=True))
