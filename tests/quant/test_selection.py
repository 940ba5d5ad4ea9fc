"""Each pass can be left out by an argument, and each one has an effect."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import onnx
import pytest

from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.quantize import quantize_model
from beers_deploy.quant.session import open_session, result_of
from tests.quant.quick import patches_of
from tests.quant.test_odd_networks import Sketch, dead_channels

pytestmark = pytest.mark.slow

Results = Callable[[Passes], list[np.ndarray]]


def waves(phase: int) -> np.ndarray:
    """An image (1, 1, H, W) of waves with few bright points: to clip these costs least."""
    rows, columns = np.mgrid[:48, :36] / 40
    image = 0.3 + 0.1 * np.sin(7 * rows + phase) * np.cos(5 * columns)
    image[5::16, 7::12] = 1.0
    return np.asarray(image, np.float32)[None, None]


@pytest.fixture(scope="module")
def results(float_onnx: onnx.ModelProto) -> Results:
    """What two networks restore once quantised: one adds to the image, through the other it passes
    itself.
    """
    patches = patches_of([waves(phase) for phase in range(3)])

    def of_passes(passes: Passes) -> list[np.ndarray]:
        networks = (float_onnx, dead_channels(Sketch()))
        files = [quantize_model(network, patches, {}, passes=passes).host for network in networks]
        return [result_of(open_session(file), waves(0)) for file in files]

    return of_passes


@pytest.fixture(scope="module")
def with_all(results: Results) -> list[np.ndarray]:
    return results(ALL)


@pytest.mark.parametrize("name", [field.name for field in fields(Passes)])
def test_each_pass_can_be_left_out_and_then_the_integers_are_others(
    name: str, results: Results, with_all: list[np.ndarray]
) -> None:
    """On one of two networks at least: no pass serves both."""
    without = results(replace(ALL, **{name: False}))
    assert any((one != other).any() for one, other in zip(with_all, without, strict=True))
