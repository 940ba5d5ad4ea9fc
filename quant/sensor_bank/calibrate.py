"""Quantise a network behind a bank once for a whole range of sensors.

The body is calibrated on the results of the banks of many sensors, rounded as the core will round
them. Planes of a sensor's values stand for the sensor's share of the biases.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, repeat

import numpy as np

from beers_deploy.model.bank import FILTERS, UNIT_STEPS, Bank, network_bank
from beers_deploy.model.family import SensorFamily, sensor_vector
from beers_deploy.model.io.tensors import Weights
from beers_deploy.model.simulator.sampling import Scene
from beers_deploy.model.variants import SENSOR_VALUES, Kernels
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import REFERENCE
from beers_deploy.quant.core import SHIFTS, IntConv, IntCore, Shifts, quantize_bias
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Activation,
    Add,
    Concat,
    Conv,
    Graph,
    Op,
    Shuffle,
    Window,
    same,
)
from beers_deploy.quant.graph.split_network import renamed
from beers_deploy.quant.host_part import (
    ANALYTIC_COPIES,
    BANK_SLICES,
    BankSum,
    Direct,
    DualRange,
    HostPart,
)
from beers_deploy.quant.integer.arithmetic import convolve
from beers_deploy.quant.passes.effort import Effort
from beers_deploy.quant.passes.equalize_single import SingleTensors
from beers_deploy.quant.passes.residual_groups import residual_groups, single_tensors
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.plan import Plan, carry_out
from beers_deploy.quant.samples.patches import PATCH_PX, Regenerated
from beers_deploy.quant.samples.simulated import draw_patches
from beers_deploy.quant.sensor_bank.conditioned import BANK, ConditionedCore, bank_layer
from beers_deploy.quant.sensor_bank.filters import (
    BITS,
    COPIES,
    channels,
    coarse_copies,
    integer_bank,
    spread_over_a_step,
)

LIKE = "pleiades-degraded"
"""The profile whose gain and bits are used; all results are shares of full scale."""

ANALYTIC = "analytic"
BODY = "body.correction"
"""The parts of the core's result: the analytic restoration, and the body's correction of it."""


def _analytic(scale: int, result: int, shifts: Shifts, decoding: BankSum, inputs: int) -> IntConv:
    """Return the convolution that averages the bank's copies of the analytic restoration.

    Its fine results are rounded at other places of a step each; a coarse one is the coarse copy.

    Args:
        scale: the scale of the network.
        result: the fractional bits of the correction, which the results are stated to have as well.
        shifts: the smallest and largest shifts that the target allows.
        decoding: the decoding of the results.
        inputs: the number of the bank's channels of each pixel, the analytic restoration last.
    """
    pixels = scale**2
    fine = decoding.fine_copies
    copies = COPIES[2] - decoding.coarse_copies
    rows = range(pixels)
    # A single weight must hold what the weights of all fine copies add up to.
    shift = 6 if decoding.coarse_copies else int(np.floor(np.log2(127 * copies)))
    weight = np.zeros((ANALYTIC_COPIES, pixels, inputs, pixels, 1, 1), np.int8)
    # Differences of rounded-down multiples add up to the total exactly.
    edges = 2**shift * np.arange(copies + 1) // copies
    for k, share in enumerate(np.diff(edges)):
        weight[:fine, rows, inputs - COPIES[2] + k, rows] = share
    weight[fine:, rows, inputs - 1, rows] = 2**shift if decoding.coarse_copies else 0
    # Each copy is rounded at another place of a step, so that together they represent what one
    # cannot.
    offsets = spread_over_a_step(fine) + [0.0] * decoding.coarse_copies
    bias = quantize_bias(np.repeat(offsets, pixels) * 2.0**-result, shift + result, shifts)
    flat = weight.reshape(ANALYTIC_COPIES * pixels, -1, 1, 1)
    # These bits make the shift to int8 `shift`, whatever scale the result is stated to have.
    return IntConv("analytic", BANK, ANALYTIC, flat, shift + result - BITS, *bias)


def body_graph(weights: Weights) -> Graph:
    """Return the float operations behind a sensor's filter bank, which compute the correction of
    the image.

    They read the results of the bank's filters, and four planes that hold the values of the sensor
    vector. The correction is in the bank's unit (`Bank.unit`).

    Args:
        weights: the trained weights of a `BankedConvBEERS`.
    """
    variant = weights.variant
    tensors = weights.tensors
    graph: list[Op] = [_head(weights)]

    def conv(name: str, source: str, output: str, activation: Activation = Activation.none) -> None:
        weight = tensors[f"{name}.weight"]
        bias = tensors[f"{name}.bias"]
        graph.append(Conv(name, source, output, weight, bias, activation, window=same(weight)))

    group = "head"
    for k in range(variant.blocks):
        conv(f"body.{k}.first", group, f"body.{k}.relu", Activation.relu)
        conv(f"body.{k}.second", f"body.{k}.relu", f"body.{k}.second")
        graph.append(Add(f"body.{k}.add", (group, f"body.{k}.second"), f"body.{k}.add"))
        group = f"body.{k}.add"
    conv("body_end", group, "body_end")
    graph.append(Add("deep", ("head", "body_end"), "deep"))
    conv("tail", "deep", CORRECTION)
    return tuple(graph)


def _head(weights: Weights) -> Conv:
    """Return the head, which reads all copies of a bank's results and the sensor's values.

    It reads the planes of the sensor's values at its middle tap only.
    """
    variant = weights.variant
    trained = weights.tensors["head.weight"].reshape(
        variant.features, 1 + FILTERS, variant.pixels, 3, 3
    )
    # A filter's result of 1 is 128 steps here, where the trained weights count `UNIT_STEPS` as 1.
    units = 2.0**BITS / UNIT_STEPS
    copies = [(0, COPIES[0], 1.0), *((1 + k, COPIES[1], units) for k in range(FILTERS))]
    # Copies are averaged, so each gets an equal share of the weights of the result it copies.
    of_copies = chain.from_iterable(
        repeat(trained[:, kernel] * (unit / count), count) for kernel, count, unit in copies
    )
    # The body does not read the analytic restoration, the coarse copy among it.
    of_analytic = np.zeros((variant.features, COPIES[2] * variant.pixels, 3, 3))
    of_values = np.zeros((variant.features, SENSOR_VALUES, 3, 3))
    # The planes of a sensor's values hold half of each.
    of_values[:, :, 1, 1] = 2 * weights.tensors["bias.weight"]
    weight = np.concatenate([*of_copies, of_analytic, of_values], 1).astype(np.float32)
    return Conv("head", PLANES, "head", weight, weights.tensors["head.bias"], window=same(weight))


def bank_host_part(scale: int, decoding: BankSum) -> HostPart:
    """Return the host's pre- and post-processing for a network whose first layer is a sensor's
    filter bank.

    Args:
        scale: the side in pixels of the square of the image that is one pixel of the network's
            maps.
        decoding: how the host combines the copies of the correction and of the analytic
            restoration.
    """
    pixels = scale**2
    back = (Shuffle("shuffle", "", "", scale, True, False),) if scale > 1 else ()
    front = tuple(replace(shuffle.inverse, name="unshuffle") for shuffle in back)
    return HostPart(pixels, pixels, front=front, back=back, encoding=BANK_SLICES, decoding=decoding)


def bank_results(
    image: np.ndarray, bank: Bank, vector: Sequence[float], scale: int, kernels: Kernels = "fitted"
) -> np.ndarray:
    """Compute what the layers behind a sensor's filter bank read for an image.

    Args:
        image: (1, 1, H, W) in [0, 1].
        bank: the filters of the sensor.
        vector: (4,) the sensor vector: MTF across and along the track and noise at two
            brightnesses, each scaled to [-1, 1].
        scale: S, the side in pixels of the square of the image that is one pixel of the network's
            maps.
        kernels: how the filters got 7 x 7 weights: "fitted" to that size, or "cut" in older
            networks.

    Returns:
        (1, C, H / S, W / S) float32: the int8 results of the filters divided by 128, at a gain of
        1, then four planes of half of each value of the sensor vector.
    """
    integers = integer_bank(bank, scale, 1, kernels)
    planes = bank_host_part(scale, BankSum()).encode(image)
    sums = convolve(planes, integers.weight, Window())
    # Rounded half up and saturated as in the core, so that calibration meets these errors.
    raw = sums / 2.0**integers.frac_bits + integers.offsets[:, None, None]
    results = np.floor(raw + 0.5).clip(-128, 127)
    # Half of a value in [-1, 1] fits int8 at the bank's scale, which ends just below 1.
    vector_planes = np.ones((1, SENSOR_VALUES, *results.shape[2:]))
    vector_planes = vector_planes * np.asarray(vector)[:, None, None] / 2
    return np.concatenate([results / 2.0**BITS, vector_planes], 1).astype(np.float32)


def quantize_behind_bank(
    weights: Weights,
    bank: Bank,
    images: Sequence[np.ndarray],
    shifts: Shifts = SHIFTS,
    passes: Passes = ALL,
    effort: Effort = Effort.normal,
) -> ConditionedCore:
    """Quantise the layers behind a sensor's filter bank once for all sensors.

    Args:
        weights: the trained weights of a `BankedConvBEERS`.
        bank: the filters of the sensor in the middle of the range.
        images: calibration inputs of these layers, as `bank_images` returns them.
        shifts: the smallest and largest shifts that the target allows.
        passes: the passes that reduce the error.
        effort: the effort of the search for equalisation factors.

    Returns:
        The core for the sensor in the middle of the range, and the biases from which it is
        conditioned on any other sensor.
    """
    graph = body_graph(weights)
    scale = weights.variant.scale
    width = len(channels()) * scale**2 + SENSOR_VALUES
    host_part = HostPart(width, scale**2, adds_image=False, encoding=Direct(), decoding=DualRange())
    inner = tuple(single_tensors(graph))
    singles = SingleTensors(inner, (weights.variant.features,) * len(inner), by_channel=False)
    groups = residual_groups(graph)
    plan = Plan(graph, host_part, groups, singles, shifts, passes, effort)
    body, _ = carry_out(plan, images)
    biases = {}
    behind_bank = []
    for op in body.ops:
        layer = op
        if isinstance(op, IntConv):
            biases[op.name] = op.float_bias[:, None]
        if isinstance(op, IntConv) and op.input == PLANES:
            # A sensor's values are constant, so their planes, which hold half of each, become part
            # of the biases.
            values = op.weight[:, -SENSOR_VALUES:, 1, 1] * 2.0 ** -(op.weight_frac_bits + 1)
            biases[op.name] = np.concatenate([biases[op.name], values], 1)
            layer = replace(op, weight=op.weight[:, :-SENSOR_VALUES])
        # The body reads the bank's results as `PLANES`.
        behind_bank.append(renamed(layer, {PLANES: BANK, CORRECTION: BODY}))
    result = body.frac_bits[CORRECTION]
    # A concat has one scale for its inputs and its output.
    joined = Concat("joined", (BODY, ANALYTIC), CORRECTION)
    frac_bits = dict(body.frac_bits) | {BANK: BITS, BODY: result, ANALYTIC: result}
    kernels = weights.kernels
    decoding = BankSum(coarse_copies=coarse_copies(kernels))
    analytic = _analytic(scale, result, shifts, decoding, len(channels(kernels)))
    core = IntCore(
        (bank_layer(bank, scale, shifts, kernels), *behind_bank, analytic, joined),
        frac_bits,
        replace(bank_host_part(scale, decoding), unit=float(np.float32(bank.unit))),
    )
    conditioned = ConditionedCore(core, biases, shifts)
    return replace(conditioned, core=conditioned.for_sensor(bank, (0.0,) * SENSOR_VALUES))


def map_steps(conditioned: ConditionedCore, weights: Weights) -> list[np.ndarray]:
    """Compute the float value that one integer step of each feature map stands for, at a gain of 1.

    Training uses the steps to round maps as INT8 does. A step of a channel is the scale of the map
    over the factor by which equalisation multiplied the channel, which is the ratio of integer
    weights to float ones.

    Args:
        conditioned: the quantised network.
        weights: the float weights that it was quantised from.

    Returns:
        Arrays (F,), one value per feature: first for the maps between head and tail, which share
        one, then for the map within each block.
    """
    core = conditioned.core
    quantized = {op.name: op.weight * 2.0**-op.weight_frac_bits for op in core.convolutions}
    floats = {op.name: op.weight for op in body_graph(weights) if isinstance(op, Conv)}

    def steps(name: str, inputs: np.ndarray | float, output: str) -> np.ndarray:
        weight = floats[name][:, : quantized[name].shape[1]] * inputs
        square = np.square(weight).sum((1, 2, 3))
        # Least squares over a channel's weights, each of which is rounded.
        products = (weight * quantized[name]).sum((1, 2, 3))
        factors = np.where(square > 0, products / np.maximum(square, 1e-30), 1.0)
        return 2.0 ** -core.frac_bits[output] / factors

    group = steps("head", 1.0, "head")
    # The weights that read the residual group hold its factors, which are taken out first.
    inputs = 2.0 ** core.frac_bits["head"] * group[:, None, None]
    inner = (
        steps(f"body.{k}.first", inputs, f"body.{k}.relu") for k in range(weights.variant.blocks)
    )
    return [group, *inner]


PATCHES = 80
SNR = (90.0, 165.0)
"""The SNR range of calibration sensors: their gain is near 1, at which
`bank_results` are computed.
"""


def bank_images(
    scenes: list[Scene], scale: int, seed: int, kernels: Kernels
) -> Sequence[np.ndarray]:
    """Return calibration inputs of the layers behind a filter bank, from patches of many sensors.

    Each patch is acquired by another sensor, and filtered by the bank of that sensor.

    Args:
        scenes: the scenes that the patches show.
        scale: the side in pixels of the square of the image that is one pixel of the network's
            maps.
        seed: the seed of all random draws.
        kernels: how the filters got 7 x 7 weights: "fitted" to that size, or "cut" in older
            networks.

    Returns:
        Arrays as `bank_results` returns them, which are computed each time they are read.
    """
    like = Sensor.load(LIKE)
    reference = Sensor.load(REFERENCE)
    patches = draw_patches(
        scenes, like, reference, PATCHES, seed, PATCH_PX, SensorFamily(like.nominal(), SNR)
    )

    def results(number: int) -> np.ndarray:
        # Each patch is of another sensor.
        sensor = patches.views[number].degraded
        bank = network_bank(sensor, kernels)
        vector = sensor_vector(sensor).values
        return bank_results(patches.degraded[number], bank, vector, scale, kernels)

    return Regenerated(results, len(patches.views))
