"""Tests that integer operators sum exactly, also on processors whose fast kernels saturate.

The exact graphs are forced, so that every processor tests them. As a control, the plain graphs
fail where the kernels saturate (`test_plain_graphs_saturate_where_the_processor_does`). Channels
of zeros that are added to a network change no number.
"""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import QuantFormat, QuantType
from torch.nn.functional import conv2d

from beers_deploy.model.processor import int8_adds_exactly
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant import session
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.kernels import (
    FEWEST_OUTPUTS,
    INT16,
    cannot_saturate,
    with_exact_sums,
    with_wide_convolutions,
)
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.session import open_session, run
from tests.quant.quick import quantized_freely, uniform
from tests.quant.simplify.networks import parsed
from tests.shipped import shipped_pair

SHAPES = [(1, 1, 1), (3, 5, 3), (4, 6, 1), (16, 16, 3), (5, 33, 3), (32, 8, 2), (17, 32, 3)]
"""(outputs, inputs, kernel) of convolutions; odd numbers do not fill the blocks of a kernel."""
GROUPED = [(12, 3, 3, 2), (12, 1, 3, 6)]
"""The same for one group, and then the number of groups."""


def convolution(
    weight: np.ndarray,
    kind: type[np.uint8 | np.int8],
    groups: int = 1,
    per_channel: bool = False,
    middle: int = 3,
) -> onnx.ModelProto:
    """Return an asymmetric QLinearConv with a bias.

    Its images (N, C, H, W) have 8 bits, and its weights (O, C / groups, k, k) are int8.
    """
    outputs = len(weight)
    terms = weight[0].size
    unit = 2.0 ** -np.ceil(np.log2(terms * 127))
    constants = {
        "unit": np.float32(1),
        "middle": np.asarray(100 if kind is np.uint8 else -7, kind),
        "weight": weight,
        "weight_unit": 2.0 ** (np.arange(outputs) % 3).astype(np.float32)
        if per_channel
        else np.float32(1),
        "weight_middle": np.zeros(outputs, np.int8) if per_channel else np.int8(middle),
        "result_unit": np.float32(1 / unit / 4),
        "bias": np.arange(outputs, dtype=np.int32) * 1001 - 7,
    }
    element = kind.__name__
    return parsed(
        f"""[convolution] result = QLinearConv<group={groups}>(image, unit, middle,
            weight, weight_unit, weight_middle, result_unit, middle, bias)""",
        f"{element}[N,C,H,W] image => {element}[N,C2,H2,W2] result",
        constants=constants,
    )


def open_exact(model: onnx.ModelProto, optimise: bool = True) -> ort.InferenceSession:
    """Open a model as on a processor whose int8 kernels saturate."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(session, "int8_adds_exactly", lambda: False)
        return open_session(model, 1, optimise)


def by_definition(model: onnx.ModelProto, image: np.ndarray) -> np.ndarray:
    """Compute such a convolution in float64, without padding, half to even."""
    values = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    groups = model.graph.node[0].attribute[0].i
    shifted = image.astype(np.int64) - int(values["middle"])
    middle = values["weight_middle"].astype(np.int64).ravel()[0]
    weight = values["weight"].astype(np.int64) - middle
    # Sums of these integers are exact in float64.
    pixels, taps = (torch.from_numpy(array.astype(np.float64)) for array in (shifted, weight))
    sums = conv2d(pixels, taps, groups=groups).numpy()
    scale = values["weight_unit"].astype(np.float64).reshape(-1, 1, 1) / float(
        values["result_unit"]
    )
    result = np.rint((sums + values["bias"][:, None, None]) * scale) + int(values["middle"])
    limits = np.iinfo(image.dtype)
    return np.asarray(np.clip(result, limits.min, limits.max), image.dtype)


@given(
    shape=st.sampled_from([*((*shape, 1) for shape in SHAPES), *GROUPED]),
    kind=st.sampled_from([np.uint8, np.int8]),
    per_channel=st.booleans(),
    large=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60)
def test_any_convolution_sums_exactly(
    shape: tuple[int, int, int, int],
    kind: type[np.uint8 | np.int8],
    per_channel: bool,
    large: bool,
    seed: int,
) -> None:
    generator = np.random.default_rng(seed)
    outputs, inputs, kernel, groups = shape
    weight = generator.integers(-128, 128, (outputs, inputs, kernel, kernel)).astype(np.int8)
    # Weights at the ends of INT8 make the sums as large as they can be.
    if large:
        weight = np.where(weight > 0, np.int8(127), np.int8(-128))
    limits = np.iinfo(kind)
    image = generator.choice([limits.min, limits.max, 0], (2, inputs * groups, 7, 9)).astype(kind)
    model = convolution(weight, kind, groups, per_channel)
    for optimise in (False, True):
        session = open_exact(model, optimise)
        assert np.array_equal(session.run(None, {"image": image})[0], by_definition(model, image))


def test_plain_graphs_saturate_where_the_processor_does() -> None:
    """As a control, a plain graph is wrong on such a processor, and right on any other."""
    image = np.full((1, 32, 5, 5), 255, np.uint8)
    weight = np.full((16, 32, 3, 3), 127, np.int8)
    model = convolution(weight, np.uint8)
    result = as_written(model, image)
    assert np.array_equal(result, by_definition(model, image)) == int8_adds_exactly()


@given(
    inputs=st.integers(1, 6),
    kernel=st.integers(1, 2),
    largest=st.sampled_from([127, 255]),
    seed=st.integers(0, 2**32 - 1),
    size=st.sampled_from([63, 70, 128]),
)
@settings(max_examples=200)
def test_the_proof_holds_for_the_worst_activations(
    inputs: int, kernel: int, largest: int, seed: int, size: int
) -> None:
    """A kernel sums pairs of neighbouring channels, and across taps if their number is odd."""
    generator = np.random.default_rng(seed)
    weight = np.clip(
        generator.integers(-size, size + 1, (3, inputs, kernel, kernel)), -128, 127
    ).astype(np.int8)
    line = np.moveaxis(weight.reshape(3, inputs, -1), 1, 2).reshape(3, -1).astype(np.int64)
    line = np.pad(line, ((0, 0), (0, line.shape[1] % 2)))
    pairs = line.reshape(3, -1, 2)
    worst = [largest * np.where(sign * pairs > 0, pairs, 0).sum(-1) for sign in (1, -1)]
    if cannot_saturate("QLinearConv", weight, largest):
        assert worst[0].max() <= INT16.max
        assert worst[1].min() >= INT16.min
    elif inputs % 2 == 0:
        assert worst[0].max() > INT16.max or worst[1].min() < INT16.min


SMALL = [shipped_pair(name)[1] for name in ("convbeers-xs", "convbeers-s")]


@pytest.mark.parametrize("path", SMALL, ids=lambda path: path.stem)
@pytest.mark.parametrize("optimise", [False, True])
def test_shipped_networks_equal_the_integer_reference(path: Path, optimise: bool) -> None:
    model = load_onnx(path)
    generator = np.random.default_rng(5)
    core = read_core(model)
    images = generator.random((1, 1, 37, 53)), generator.integers(0, 2, (1, 1, 24, 41))
    for image in (pixels.astype(np.float32) for pixels in images):
        tensors, _ = run_core(core, core.host_part.encode(image), half_even=True)
        expected = np.clip(image + merged_correction(core, tensors), 0, 1)
        assert np.array_equal(run(open_exact(model, optimise), image), expected)


@pytest.mark.parametrize("path", SMALL, ids=lambda path: path.stem)
def test_behind_a_relu_no_weights_saturate(path: Path) -> None:
    """The largest convolutions, at least a third, keep the fast kernels.

    This keeps INT8 faster than float32.
    """
    weights = weights_of(with_exact_sums(load_onnx(path)))
    int8 = {name for name, weight in weights.items() if weight.data_type == TensorProto.INT8}
    behind_relus = {name for name in weights if name.endswith(".second")}
    assert behind_relus
    assert behind_relus <= int8
    assert len(int8) >= len(weights) / 3


def weights_of(model: onnx.ModelProto) -> dict[str, onnx.TensorProto]:
    """Return the weights of each integer convolution by its name."""
    tensors = {tensor.name: tensor for tensor in model.graph.initializer}
    nodes = [node for node in model.graph.node if node.op_type == "QLinearConv"]
    return {node.name: tensors[node.input[3]] for node in nodes}


def test_a_relu_that_is_an_output_is_left_alone() -> None:
    """An output is stored as the file states."""
    model = load_onnx(SMALL[0])
    relu = next(node.output[0] for node in model.graph.node if node.op_type == "Max")
    model.graph.output.append(helper.make_tensor_value_info(relu, TensorProto.UINT8, None))
    image = uniform(1, 1, 13, 21)
    sessions = open_exact(model), open_session(model, 1)
    lowest = {each.run([relu], {"image": image})[0].min() for each in sessions}
    assert lowest == {128}


def test_matrix_products_sum_exactly_too() -> None:
    generator = np.random.default_rng(1)
    weight = generator.choice([-128, 127], (33, 17)).astype(np.int8)
    image = generator.choice([0, 255], (5, 33)).astype(np.uint8)
    model = parsed(
        "sums = MatMulInteger(image, weight)",
        "uint8[N,C] image => int32[N,C2] sums",
        constants={"weight": weight},
    )
    sums = open_exact(model).run(None, {"image": image})[0]
    assert np.array_equal(sums, image.astype(np.int64) @ weight.astype(np.int64))


def test_weights_that_are_computed_are_refused_in_a_sentence() -> None:
    model = convolution(np.full((4, 4, 1, 1), 3, np.int8), np.uint8)
    stored = next(tensor for tensor in model.graph.initializer if tensor.name == "weight")
    model.graph.initializer.remove(stored)
    model.graph.input.append(
        helper.make_tensor_value_info("weight", TensorProto.INT8, [4, 4, 1, 1])
    )
    with pytest.raises(ModelError, match=r"QLinearConv 'convolution' .* has computed weights"):
        open_exact(model)


@pytest.mark.parametrize("activations", [QuantType.QUInt8, QuantType.QInt8])
@pytest.mark.parametrize("per_channel", [False, True])
@pytest.mark.parametrize("form", [QuantFormat.QOperator, QuantFormat.QDQ])
def test_files_of_other_quantizers_give_the_same_numbers(
    form: QuantFormat,
    per_channel: bool,
    activations: QuantType,
    float_onnx: onnx.ModelProto,
) -> None:
    """Activations are asymmetric, scales float; the runtime fuses QDQ into integer operators."""
    options = {
        "quant_format": form,
        "per_channel": per_channel,
        "activation_type": activations,
        "weight_type": QuantType.QInt8,
    }
    theirs = quantized_freely(float_onnx, **options)
    exact = with_exact_sums(theirs)
    assert exact.graph.node != theirs.graph.node
    image = np.random.default_rng(1).integers(0, 2, (1, 1, 31, 45)).astype(np.float32)
    result = run(open_exact(theirs), image)
    if form is QuantFormat.QOperator:
        assert np.array_equal(result, run(open_exact(theirs, optimise=False), image))
    if int8_adds_exactly():
        assert np.array_equal(result, run(open_session(theirs, 1), image))


def shapes_of_weights(model: onnx.ModelProto) -> list[tuple[int, ...]]:
    return [tuple(weight.dims) for weight in weights_of(model).values()]


def as_written(model: onnx.ModelProto, image: np.ndarray) -> np.ndarray:
    """Run a model in a plain session of onnxruntime, for which it is not rewritten."""
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {"image": image})[0])


@pytest.mark.parametrize("path", [shipped_pair()[1], SMALL[0]], ids=lambda path: path.stem)
def test_no_convolution_stays_narrow_and_the_numbers_are_the_same(path: Path) -> None:
    model = load_onnx(path)
    generator = np.random.default_rng(0)
    wider = with_wide_convolutions(model)
    onnx.checker.check_model(wider)
    for old, new in zip(shapes_of_weights(model), shapes_of_weights(wider), strict=True):
        assert new[0] == max(old[0], FEWEST_OUTPUTS)
        assert new[1] % 4 == 0
        assert new[1] - old[1] < 4
    for shape in ((4, 4), (37, 53), (64, 41)):
        image = generator.random((1, 1, *shape), np.float32)
        assert np.array_equal(as_written(wider, image), as_written(model, image))


@pytest.mark.parametrize(
    ("middle", "opset", "shape"),
    [(0, 17, (FEWEST_OUTPUTS, 4, 1, 1)), (3, 17, (1, 2, 1, 1)), (0, 10, (1, 2, 1, 1))],
)
def test_one_output_is_padded_where_a_stored_zero_is_a_weight_of_zero(
    middle: int, opset: int, shape: tuple[int, ...]
) -> None:
    """Its bias has one number, as a scale per tensor may have. Older opsets cannot be padded."""
    model = convolution(np.array([[[[1]], [[-2]]]], np.int8), np.uint8, middle=middle)
    model.opset_import[0].version = opset
    image = np.random.default_rng(0).integers(0, 256, (1, 2, 3, 5)).astype(np.uint8)
    wider = with_wide_convolutions(model)
    assert shapes_of_weights(wider) == [shape]
    assert np.array_equal(as_written(wider, image), as_written(model, image))
