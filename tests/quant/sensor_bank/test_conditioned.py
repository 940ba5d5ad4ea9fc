"""Tests of the INT8 network that is quantised once and conditioned on each sensor."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from numpy.testing import assert_allclose

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.reading import sized_graph
from beers_deploy.model.bank import LARGEST, bank_of_vector
from beers_deploy.model.convbeers import BankedConvBEERS, Rounding, initialise
from beers_deploy.model.io.tensors import Weights
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.core import IntConv, IntCore, shift_faults
from beers_deploy.quant.encodings import (
    SENSOR_BIASES,
    board_model,
    encoding_faults,
    host_model,
    read_core,
)
from beers_deploy.quant.integer.reference import merged_correction, run_core
from beers_deploy.quant.sensor_bank.calibrate import bank_results, map_steps, quantize_behind_bank
from beers_deploy.quant.sensor_bank.conditioned import (
    ConditionedCore,
    delta_of_file,
    required_conditioned_core,
    with_delta,
)
from beers_deploy.quant.session import open_session, run
from beers_deploy.quant.tiling.receptive_field import tiling_of
from beers_deploy.studies.stress.faults import with_ops
from tests.model.networks import condition_of
from tests.quant.quick import assert_within_bounds
from tests.quant.sensor_bank.test_filters import textured
from tests.quant.tiling.small_networks import check_tiles

TEXTURE = 0.3 + 0.3 * textured(46, 58, 9)
"""An image that stays within eight units of the quietest sensor, where INT8 ends."""
SENSORS = [
    (0.2, 0.1, -0.3, -0.2),
    (-0.9, -0.8, 0.4, 0.5),
    (0.6, 0.3, 0.8, 0.9),
    (-0.2, -0.4, -0.7, -0.9),
]
EACH_SENSOR = pytest.mark.parametrize("vector", SENSORS)


def network(scale: int) -> BankedConvBEERS:
    created = BankedConvBEERS(Variant(2, 8, scale))
    generator = torch.Generator().manual_seed(scale)
    initialise(created, generator)
    with torch.no_grad():
        for parameter in created.parameters():
            parameter.add_(0.04 * torch.randn(parameter.shape, generator=generator))
    return created.eval()


def weights_of(network: BankedConvBEERS) -> Weights:
    return Weights(
        {name: value.numpy() for name, value in network.state_dict().items()}, network.variant, {}
    )


@pytest.fixture(scope="module", params=[1, 2])
def pair(request: pytest.FixtureRequest) -> "Pair":
    float_network = network(request.param)
    scale = int(request.param)
    images = [
        bank_results(textured(48, 48, k), bank_of_vector(vector), vector, scale)
        for k, vector in enumerate(SENSORS)
    ]
    middle = bank_of_vector((0.0, 0.0, 0.0, 0.0))
    return float_network, quantize_behind_bank(weights_of(float_network), middle, images)


@pytest.fixture
def conditioned(pair: "Pair") -> ConditionedCore:
    return pair[1]


Pair = tuple[BankedConvBEERS, ConditionedCore]
Image = np.ndarray


def core_of(conditioned: ConditionedCore, vector: tuple[float, ...]) -> IntCore:
    return conditioned.for_sensor(bank_of_vector(vector), vector)


def file_of(conditioned: ConditionedCore, vector: tuple[float, ...]) -> onnx.ModelProto:
    """Return the INT8 file of a sensor, named by its vector."""
    about = {SENSOR_BIASES: conditioned.biases_to_json(), "sensor": str(vector)}
    return host_model(core_of(conditioned, vector), about)


def in_int8(conditioned: ConditionedCore, vector: tuple[float, ...], image: Image) -> Image:
    return run(open_session(file_of(conditioned, vector)), image)


def in_float(network: BankedConvBEERS, vector: tuple[float, ...], image: Image) -> Image:
    with torch.inference_mode():
        result = network(torch.from_numpy(image), condition_of(torch.tensor([vector])))
    return np.asarray(result.clamp(0, 1).numpy())


def rms(values: Image) -> float:
    return float(np.sqrt(np.square(values).mean()))


@EACH_SENSOR
def test_int8_is_near_the_float_network_for_every_sensor(
    pair: Pair, vector: tuple[float, ...]
) -> None:
    float_network, conditioned = pair
    expected = in_float(float_network, vector, TEXTURE)
    unit = bank_of_vector(vector).unit
    assert rms(in_int8(conditioned, vector, TEXTURE) - expected) < 0.05 * unit
    assert rms(TEXTURE - expected) > 0.1 * unit


@EACH_SENSOR
def test_points_and_saturated_edges_are_corrected_as_far_as_in_float(
    pair: Pair, vector: tuple[float, ...]
) -> None:
    """At blurred sensors this holds although the analytic restoration's fine copies saturate."""
    float_network, conditioned = pair
    image = np.full((1, 1, 46, 58), 0.1, np.float32)
    image[..., 10:30, 20:40] = 1.0
    image[..., 38, 8] = 0.5
    expected = in_float(float_network, vector, image)
    actual = in_int8(conditioned, vector, image)
    bank = bank_of_vector(vector)
    most = np.abs(expected - image).max()
    reach = LARGEST * bank.unit / bank.gain
    assert vector != SENSORS[0] or most > 1.3 * reach
    assert np.abs(actual - expected).max() < 0.3 * most
    assert np.abs(actual - image).max() > 0.9 * most


@EACH_SENSOR
def test_a_float_network_with_the_rounding_of_its_file_errs_as_the_file_does(
    pair: Pair, vector: tuple[float, ...]
) -> None:
    float_network, conditioned = pair
    image = torch.from_numpy(TEXTURE)
    condition = condition_of(torch.tensor([vector]))
    stream, *inner = (
        torch.from_numpy(values)[:, None, None]
        for values in map_steps(conditioned, weights_of(float_network))
    )
    with torch.inference_mode():
        plain = float_network(image, condition)
        steps = Rounding(stream, tuple(inner)).steps(condition.gains)
        rounded = float_network(image, condition, steps=steps)
    error = in_int8(conditioned, vector, TEXTURE) - in_float(float_network, vector, TEXTURE)
    ratio = np.linalg.norm((rounded - plain).numpy()) / np.linalg.norm(error)
    # Only the file rounds weights, the bank and the last sum, so the ratio is not 1.
    assert 0.4 < ratio < 1.1


def test_the_steps_of_maps_turn_float_weights_into_those_of_the_file(
    pair: Pair,
) -> None:
    float_network, conditioned = pair
    stream, *inner = map_steps(conditioned, weights_of(float_network))
    convolutions = {op.name: op for op in conditioned.core.convolutions}
    # These layers were not used to find the steps.
    for k, read_steps in enumerate(inner):
        op = convolutions[f"body.{k}.second"]
        weight = float_network.state_dict()[f"body.{k}.second.weight"].numpy()
        bits = (
            op.weight_frac_bits
            + conditioned.core.frac_bits[op.input]
            - conditioned.core.frac_bits[op.output]
        )
        expected = (weight * (read_steps * 2.0**bits / stream[:, None])[:, :, None, None]).clip(
            -128, 127
        )
        # One step of 127 is allowed. Without equalisation the error would be tens of steps.
        assert np.sqrt(np.square(op.weight - expected).mean()) < 1


def test_the_file_matches_its_integers_and_the_reference(conditioned: ConditionedCore) -> None:
    core = core_of(conditioned, SENSORS[0])
    image = textured(30, 34, 5)
    file = host_model(core, {"precision": "int8 legal"})
    assert encoding_faults(file) == []
    core_again = read_core(file)
    host_part = core_again.host_part
    tensors, _ = run_core(core_again, host_part.encode(image), half_even=True)
    mine = host_part.finish(image, merged_correction(core_again, tensors))
    assert_allclose(mine, run(open_session(file), image), atol=1e-7)


def test_a_sensor_changes_the_first_layer_biases_and_the_unit_alone(
    conditioned: ConditionedCore,
) -> None:
    first, second = (core_of(conditioned, vector) for vector in SENSORS[:2])
    assert first.frac_bits == second.frac_bits
    assert first.host_part.unit != second.host_part.unit
    for one, other in zip(first.ops, second.ops, strict=True):
        if isinstance(one, IntConv) and isinstance(other, IntConv):
            assert np.array_equal(one.weight, other.weight) == (one.name != "bank")
            reweighted = replace(one, weight=other.weight, weight_frac_bits=other.weight_frac_bits)
            assert (
                replace(reweighted, bias=other.bias, bias_frac_bits=other.bias_frac_bits) == other
                or one.name != "bank"
            )


@EACH_SENSOR
def test_a_body_with_a_gain_computes_the_same_as_with_a_gain_of_one(
    conditioned: ConditionedCore, vector: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Image, filters and biases agree on the gain, so that results differ by rounding alone.

    The image is far from the ends of int8.
    """
    image = 0.4 + 0.02 * textured(46, 58, 3)
    bank = bank_of_vector(vector)
    own = in_int8(conditioned, vector, image)
    monkeypatch.setattr("beers_deploy.model.bank.GAINS", (1.0, 1.0))
    assert rms(own - in_int8(conditioned, vector, image)) < 0.05 * bank.unit
    assert bank.gain == 1


@pytest.mark.parametrize("offset", [0.0, 0.02])
@EACH_SENSOR
def test_a_dark_image_that_was_multiplied_is_restored_with_smaller_steps(
    pair: Pair, vector: tuple[float, ...], offset: float
) -> None:
    """The error of INT8 falls by at least a quarter if the image is doubled, except at its border.

    There the network reads zeros, which stand for another brightness than in float.
    """
    float_network, conditioned = pair
    image = (offset + 0.05 + 0.02 * textured(46, 58, 3)).astype(np.float32)
    expected = in_float(float_network, vector, image)
    finer = conditioned.for_sensor(bank_of_vector(vector), vector, 2, offset)
    session = open_session(host_model(finer, {}))
    dark = np.float32(offset)
    restored = (run(session, 2 * (image - dark) + dark) - dark) / 2 + dark
    inner = (..., slice(12, -12), slice(12, -12))
    coarse = rms((in_int8(conditioned, vector, image) - expected)[inner])
    assert rms((restored - expected)[inner]) < 0.75 * coarse


def test_any_sensors_file_becomes_another_to_the_byte(conditioned: ConditionedCore) -> None:
    """The biases in its metadata suffice for this, and so does a delta."""
    first, second = (file_of(conditioned, vector) for vector in SENSORS[:2])
    stored = required_conditioned_core(first)
    expected = second.SerializeToString(deterministic=True)
    assert file_of(stored, SENSORS[1]).SerializeToString(deterministic=True) == expected
    delta = delta_of_file(second)
    assert len(delta) < 3000
    core, name = with_delta(stored.core, delta)
    rebuilt = host_model(core, {SENSOR_BIASES: stored.biases_to_json(), "sensor": name})
    assert rebuilt.SerializeToString(deterministic=True) == expected


@pytest.mark.parametrize(
    "change", [lambda d: d[:-9], lambda d: d[:0], lambda d: b"x" + d, lambda d: d[:40] + d[41:]]
)
def test_a_damaged_delta_and_one_of_another_network_are_refused(
    conditioned: ConditionedCore, change: Callable[[bytes], bytes]
) -> None:
    core = core_of(conditioned, SENSORS[1])
    delta = delta_of_file(file_of(conditioned, SENSORS[1]))
    for other, content in ((core, change(delta)), (replace(core, ops=core.ops[1:]), delta)):
        with pytest.raises(ModelError, match=r"^The delta is damaged or .*network \(.*--delta"):
            with_delta(other, content)


def test_a_delta_does_not_fit_a_network_of_the_same_layers(conditioned: ConditionedCore) -> None:
    core = core_of(conditioned, SENSORS[1])
    delta = delta_of_file(file_of(conditioned, SENSORS[1]))
    last = core.convolutions[-1]
    other = with_ops(core, [replace(last, weight=last.weight[::-1].copy())])
    with pytest.raises(ModelError, match=r"belongs to another network .*other weights"):
        with_delta(other, delta)


def test_biases_of_another_network_are_refused(conditioned: ConditionedCore) -> None:
    core = core_of(conditioned, SENSORS[0])
    with pytest.raises(ModelError, match="cannot be conditioned"):
        required_conditioned_core(host_model(core, {}))
    for words in ("[]", '{"head": [[0, 0, 0, 0, 0]]}', '{"other": []}', "{"):
        with pytest.raises(ModelError, match="the INT8 network"):
            required_conditioned_core(host_model(core, {SENSOR_BIASES: words}))


def test_tiles_give_the_whole_images_result(pair: Pair) -> None:
    """Mirrored borders reach no farther inside than the halo."""
    file = file_of(pair[1], SENSORS[1])
    alignment_px = tiling_of(file).alignment_px
    assert alignment_px == pair[0].variant.scale
    check_tiles(file, textured(96, 80, 6), (32 // alignment_px,))


def test_no_image_leaves_the_bounds_that_are_proven(conditioned: ConditionedCore) -> None:
    core = core_of(conditioned, SENSORS[3])
    checkerboard = (np.indices((24, 28)).sum(0) % 2).astype(np.float32)[None, None]
    for image in (checkerboard, textured(24, 28, 4), np.ones_like(checkerboard)):
        assert_within_bounds(core, core.host_part.encode(image))


def test_the_dpu_runs_every_operation(pair: Pair) -> None:
    core = core_of(pair[1], SENSORS[2])
    assert shift_faults(core) == []
    board = board_model(core, {}, 64)
    placed = place(sized_graph(board, 64), load_dpu("vck190", "C32B6"))
    assert [node.op.name for node in placed.nodes if node.broken] == []
    size = board.graph.input[0].type.tensor_type.shape.dim[2].dim_value
    assert size == (70 if core.host_part.place_px == 1 else 36)
    # The DPU works on groups of 16 channels.
    assert len(core.convolutions[0].weight) == 16 * pair[0].variant.pixels
