"""Helpers of the quantiser's tests: images, patches, changed copies, and a fast search."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import onnx
from onnx import numpy_helper
from onnxruntime.quantization import CalibrationDataReader, quantize_static

from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.bounds import layer_bounds
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Activation,
    Conv,
    Graph,
    Op,
    graph_to_onnx,
    same,
)
from beers_deploy.quant.host_part import ONE_CHANNEL, HostPart
from beers_deploy.quant.integer.reference import INT32_BITS, run_core
from beers_deploy.quant.quantize import Quantized, quantize_model
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.samples.simulated import draw_patches
from beers_deploy.quant.session import open_session, planes_of, result_of
from tests.quant.simplify.networks import parsed


def image(height: int = 37, width: int = 53, seed: int = 0, channels: int = 1) -> np.ndarray:
    """Return noise of digital numbers of 12 bits, (1, C, height, width) float32 in [0, 1]."""
    dn = np.random.default_rng(seed).integers(0, 4096, (1, channels, height, width))
    return dn.astype(np.float32) / np.float32(4095)


def uniform(*shape: int, seed: int = 0) -> np.ndarray:
    """Return random values in [0, 1), float32."""
    return np.random.default_rng(seed).random(shape, np.float32)


def waves(count: int = 3) -> list[np.ndarray]:
    """Return smooth images (1, 1, 40, 40)."""
    rows, columns = np.mgrid[:40, :40] / 40
    images = [0.4 + 0.3 * np.sin(9 * rows + k) * np.cos(7 * columns) for k in range(count)]
    return [each.astype(np.float32)[None, None] for each in images]


def patches_of(images: list[np.ndarray]) -> Patches:
    """Return patches of these images, each its own reference."""
    return Patches([(image, image) for image in images], images)


def without_references(patches: Patches) -> Patches:
    nothing = np.empty(0, np.float32)
    return Patches([(image, nothing) for image in patches.degraded], patches.degraded)


def drawn(count: int, seed: int, scene: int = 1, patch_px: int = 128) -> Patches:
    """Return patches of one procedural scene, through the usual sensors."""
    ground = procedural_scene(900, 960, np.random.default_rng(scene))
    sensors = Sensor.load("pleiades-degraded"), Sensor.load("pleiades-reference")
    return draw_patches([ground], *sensors, count, seed, patch_px=patch_px)


def with_relu6(size: float) -> Graph:
    """Build convolutions with ReLU6, one of them depthwise; a larger `size` clips more."""
    generator = np.random.default_rng(0)
    shapes = {"a": (5, 3, 3, 3), "b": (5, 1, 3, 3), "c": (4, 5, 1, 1), CORRECTION: (1, 4, 3, 3)}
    graph = list[Op]()
    source = PLANES
    for name, shape in shapes.items():
        weight = (size * generator.normal(0.2, 1, shape)).astype(np.float32)
        bias = generator.normal(0, 1, shape[0]).astype(np.float32)
        groups = 5 if name == "b" else 1
        activation = Activation.none if name == CORRECTION else Activation.relu6
        graph.append(Conv(name, source, name, weight, bias, activation, same(weight), groups))
        source = name
    return tuple(graph)


def random_conv(
    generator: np.random.Generator,
    source: str,
    output: str,
    shape: tuple[int, ...],
    activation: Activation = Activation.none,
) -> Conv:
    """Return a convolution of random weights and biases that preserves the size."""
    weight = generator.normal(0, 0.5, shape).astype(np.float32)
    bias = generator.normal(0, 0.5, shape[0]).astype(np.float32)
    return Conv(f"{output}.conv", source, output, weight, bias, activation, same(weight))


def in_float(
    graph: Graph, image: np.ndarray, host_part: HostPart = ONE_CHANNEL, name: str = CORRECTION
) -> np.ndarray:
    """Run a float graph that reads planes, and return its correction or another tensor."""
    session = open_session(graph_to_onnx(graph, [name], host_part.planes))
    return np.asarray(session.run(None, {PLANES: planes_of(image, host_part)})[0])


def run_model(model: onnx.ModelProto, image: np.ndarray) -> np.ndarray:
    """Return the result of a model for an image, of whatever shape it is."""
    return result_of(open_session(model), image)


def assert_same(
    model: onnx.ModelProto,
    other: onnx.ModelProto,
    image: np.ndarray,
    rtol: float = 0.0,
    atol: float = 0.0,
) -> None:
    """Check that two models compute the same from an image, exactly if no tolerance is given."""
    expected = run_model(model, image)
    np.testing.assert_allclose(run_model(other, image), expected, rtol=rtol, atol=atol)


def assert_within_bounds(core: IntCore, planes: np.ndarray) -> None:
    """Check that no result and no accumulator leaves the bounds that are proven for any image."""
    tensors, reports = run_core(core, planes)
    for op, bound, report in zip(core.ops, layer_bounds(core), reports, strict=True):
        assert max(bound.low, INT8_MIN) <= tensors[op.output].min(), op.name
        assert tensors[op.output].max() <= min(bound.high, INT8_MAX), op.name
        assert report.peak_bits <= report.proven_bits, op.name
        assert report.peak_bits <= bound.bits < INT32_BITS, op.name
        assert bound.saturates or report.saturated == 0, op.name


def behind_conv(nodes: str, **constants: Any) -> onnx.ModelProto:
    """Return a 1 x 1 convolution from `image` to `x`, and nodes from `x` to `restored`."""
    return parsed(
        f"x = Conv(image, first) {nodes}",
        "float[N,1,H,W] image => float[N,C,P,Q] restored",
        constants={"first": np.ones((2, 1, 1, 1)), **constants},
    )


def fix_sizes(value: onnx.ValueInfoProto, *sizes: int) -> None:
    """Fix the last sizes of an input or output: height and width, or those before them as well."""
    dims = value.type.tensor_type.shape.dim
    for dim, size in zip(dims[-len(sizes) :], sizes, strict=True):
        dim.dim_value = size


def copied(model: onnx.ModelProto) -> onnx.ModelProto:
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    return copy


def change(model: onnx.ModelProto, name: str, by: Callable[[np.ndarray], np.ndarray]) -> None:
    """Give a weight or a bias another value of its own type."""
    tensor = next(t for t in model.graph.initializer if t.name == name)
    value = numpy_helper.to_array(tensor)
    tensor.CopyFrom(numpy_helper.from_array(np.asarray(by(value.copy()), value.dtype), name))


def changed(
    model: onnx.ModelProto, name: str, by: Callable[[np.ndarray], np.ndarray]
) -> onnx.ModelProto:
    """Return a copy with one weight or bias changed."""
    copy = copied(model)
    change(copy, name, by)
    return copy


@contextmanager
def one_guess() -> Iterator[None]:
    """Replace the search that equalises channels by one guess."""
    guess: dict[str, Any] = {"GAMMAS": (0.5,), "HEADROOM": (1.0,)}
    with (
        patch.multiple("beers_deploy.quant.passes.equalize", STEPS=(), **guess),
        patch.multiple("beers_deploy.quant.passes.equalize_single", **guess),
    ):
        yield


def quickly(model: onnx.ModelProto, patches: Patches, **more: Any) -> Quantized:
    with one_guess():
        return quantize_model(model, patches, {}, **more)


class Calibration(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime has no types
    """A reader of images for onnxruntime's quantiser."""

    def __init__(self, images: list[np.ndarray]) -> None:
        self._images = iter(images)

    def get_next(self) -> dict[str, np.ndarray] | None:
        return next(({"image": image} for image in self._images), None)


def quantized_freely(model: onnx.ModelProto, **options: Any) -> onnx.ModelProto:
    """Return a float network as onnxruntime quantises it, calibrated on noise."""
    noise = list(uniform(2, 1, 1, 32, 32))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "free.onnx"
        quantize_static(copied(model), path, Calibration(noise), **options)
        return onnx.load(path)
