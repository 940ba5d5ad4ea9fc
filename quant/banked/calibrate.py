"""A network behind a bank calibrated over the family of sensors, and put into whole numbers once
for all of them.

The body reads the bank's results of many sensors' images, rounded as the core will round them;
planes of a sensor's values stand for what its head's bias will be told.
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
from beers_deploy.quant.banked.family import BANK, Family, bank_layer
from beers_deploy.quant.banked.filters import (
    ANALYTIC_COPIES,
    BITS,
    COPIES,
    PLANES_PER_CHANNEL,
    channels,
    spread_over_a_step,
    whole_bank,
)
from beers_deploy.quant.calibration import draw_patches
from beers_deploy.quant.core import SHIFTS, IntConv, IntCore, Shifts, quantize_bias
from beers_deploy.quant.ends import Ends
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
from beers_deploy.quant.graph.network import renamed
from beers_deploy.quant.integer.arithmetic import convolve
from beers_deploy.quant.passes.level import Chain
from beers_deploy.quant.passes.selection import ALL, Passes
from beers_deploy.quant.passes.stream import lone_tensors, streams
from beers_deploy.quant.quantize import Plan, rounded
from beers_deploy.quant.samples import PATCH_PX, Remade

LIKE = "pleiades-degraded"
"""The profile that gives gain and bits; what is computed is over full scale."""

ANALYTIC = "analytic"
BODY = "body.correction"
"""The results that lie side by side: the analytic restoration, and the body's correction of it."""


def _assembled(body: IntCore, bank: Bank, scale: int, shifts: Shifts, kernels: Kernels) -> IntCore:
    """The whole core: a body that reads a bank's results as `PLANES`, behind it, beside the
    analytic restoration.
    """
    result = body.frac_bits[CORRECTION]
    behind_bank = (renamed(op, {PLANES: BANK, CORRECTION: BODY}) for op in body.ops)
    joined = Concat("joined", (BODY, ANALYTIC), CORRECTION)
    # A concat has one scale for its inputs and its output.
    frac_bits = dict(body.frac_bits) | {BANK: BITS, BODY: result, ANALYTIC: result}
    unit = float(np.float32(bank.unit))
    ends = replace(
        front_ends(scale), gains=2, outputs=scale**2, unit=unit, wide=kernels == "fitted"
    )
    analytic = _analytic(scale, result, shifts, kernels)
    ops = (bank_layer(bank, scale, shifts, kernels), *behind_bank, analytic, joined)
    return IntCore(ops, frac_bits, ends)


def _analytic(scale: int, result: int, shifts: Shifts, kernels: Kernels) -> IntConv:
    """The mean of the bank's copies of the analytic restoration, rounded at other places of a step
    each time.

    Behind fitted kernels the last result is the coarse copy alone. The results are said to have as
    many fractional bits as the correction's, `result`, beside which they lie.
    """
    coarse = int(kernels == "fitted")
    pixels = scale**2
    copies = COPIES[2] - coarse
    inputs = len(channels(kernels))
    fine = ANALYTIC_COPIES - coarse
    rows = range(pixels)
    # A single weight must hold what the weights of all fine copies add up to.
    shift = 6 if coarse else int(np.floor(np.log2(127 * copies)))
    weight = np.zeros((ANALYTIC_COPIES, pixels, inputs, pixels, 1, 1), np.int8)
    for k, share in enumerate(_spread(2**shift, copies)):
        weight[:fine, rows, inputs - COPIES[2] + k, rows] = share
    weight[fine:, rows, inputs - 1, rows] = 2**shift if coarse else 0
    # Rounded at other places of a step each time, the copies hold together what one cannot.
    offsets = np.repeat(np.array(spread_over_a_step(fine) + [0.0] * coarse), pixels)
    bias = quantize_bias(offsets * 2.0**-result, shift + result, shifts)
    flat = weight.reshape(ANALYTIC_COPIES * pixels, -1, 1, 1)
    # These bits make the shift to int8 `shift`, whatever scale the result is said to have.
    return IntConv("analytic", BANK, ANALYTIC, flat, shift + result - BITS, *bias)


def _spread(total: int, parts: int) -> list[int]:
    """So many whole numbers, as alike as can be, of that sum."""
    # Differences of rounded-down multiples telescope to `total`.
    return [total * (k + 1) // parts - total * k // parts for k in range(parts)]


def body_graph(weights: Weights) -> Graph:
    """The float body, from a bank's results and four planes of a sensor's values to the correction
    in units.
    """
    variant = weights.variant
    tensors = weights.tensors
    graph: list[Op] = [_head(weights)]

    def conv(name: str, source: str, output: str, activation: Activation = Activation.none) -> None:
        weight = tensors[f"{name}.weight"]
        bias = tensors[f"{name}.bias"]
        graph.append(Conv(name, source, output, weight, bias, activation, window=same(weight)))

    stream = "head"
    for k in range(variant.blocks):
        conv(f"body.{k}.first", stream, f"body.{k}.relu", Activation.relu)
        conv(f"body.{k}.second", f"body.{k}.relu", f"body.{k}.second")
        graph.append(Add(f"body.{k}.add", (stream, f"body.{k}.second"), f"body.{k}.add"))
        stream = f"body.{k}.add"
    conv("body_end", stream, "body_end")
    graph.append(Add("deep", ("head", "body_end"), "deep"))
    conv("tail", "deep", CORRECTION)
    return tuple(graph)


def _head(weights: Weights) -> Conv:
    """The head on a bank's results, all copies of each, and on the planes of a sensor's values at
    its middle tap.
    """
    variant = weights.variant
    trained = weights.tensors["head.weight"].reshape(
        variant.features, 1 + FILTERS, variant.pixels, 3, 3
    )
    counts = COPIES
    # A filter's result of 1 is 128 steps here, where the trained weights count `UNIT_STEPS` as 1.
    units = 2.0**BITS / UNIT_STEPS
    copies = [(0, counts[0], 1.0), *((1 + k, counts[1], units) for k in range(FILTERS))]
    # Copies are averaged, so each gets an equal share of the weights of what it stands for.
    of_copies = chain.from_iterable(
        repeat(trained[:, kernel] * (unit / count), count) for kernel, count, unit in copies
    )
    # The body does not read the analytic restoration, the coarse copy among it.
    of_analytic = np.zeros((variant.features, counts[2] * variant.pixels, 3, 3))
    of_values = np.zeros((variant.features, SENSOR_VALUES, 3, 3))
    # The planes of a sensor's values hold half of each.
    of_values[:, :, 1, 1] = 2 * weights.tensors["bias.weight"]
    weight = np.concatenate([*of_copies, of_analytic, of_values], 1).astype(np.float32)
    return Conv("head", PLANES, "head", weight, weights.tensors["head.bias"], window=same(weight))


def front_ends(scale: int) -> Ends:
    """What the host does around a network of that scale behind a bank."""
    if scale == 1:
        return Ends(1, PLANES_PER_CHANNEL, banked=True)
    front, back = (
        Shuffle(name, "", "", scale, up, False)
        for name, up in (("unshuffle", False), ("shuffle", True))
    )
    return Ends(scale**2, PLANES_PER_CHANNEL, front=(front,), back=(back,), banked=True)


def bank_results(
    image: np.ndarray, bank: Bank, vector: Sequence[float], scale: int, kernels: Kernels = "fitted"
) -> np.ndarray:
    """What the body of a family is calibrated on, of an image (1, 1, H, W) in [0, 1]: (1, C, H / S,
    W / S) float32.

    The bank's results over 128 at a gain of 1, and planes of the halves of a sensor's values.
    """
    integers = whole_bank(bank, scale, 1, kernels)
    sums = convolve(front_ends(scale).split(image), integers.weight, Window())
    # Rounded half up and saturated as in the core, so that calibration meets these errors.
    raw = sums / 2.0**integers.frac_bits + integers.offsets[:, None, None]
    results = np.floor(raw + 0.5).clip(-128, 127)
    # Half of a value in [-1, 1] fits int8 at the bank's scale, which ends just below 1.
    vector_planes = np.ones((1, SENSOR_VALUES, *results.shape[2:]))
    vector_planes = vector_planes * np.asarray(vector)[:, None, None] / 2
    return np.concatenate([results / 2.0**BITS, vector_planes], 1).astype(np.float32)


def quantize_family(
    weights: Weights,
    bank: Bank,
    images: Remade[np.ndarray],
    shifts: Shifts = SHIFTS,
    passes: Passes = ALL,
) -> Family:
    """A network behind a bank in whole numbers, for the middle of the family.

    Args:
        weights: of a `BankedConvBEERS`.
        bank: of the middle of the family.
        images: of `bank_results`, of sensors from all over the family.
        shifts: the windows of the target.
        passes: that reduce the error.
    """
    body, _ = rounded(_plan(weights, shifts, passes), images)
    biases = {op.name: _biases(op) for op in body.convolutions}
    # A sensor's values are constant, so their planes become part of the biases.
    ops = tuple(
        replace(op, weight=op.weight[:, :-SENSOR_VALUES])
        if isinstance(op, IntConv) and op.input == PLANES
        else op
        for op in body.ops
    )
    core = _assembled(replace(body, ops=ops), bank, weights.variant.scale, shifts, weights.kernels)
    family = Family(core, biases, shifts, weights.kernels)
    return replace(family, core=family.for_sensor(bank, (0.0,) * SENSOR_VALUES))


def map_steps(family: Family, weights: Weights) -> list[np.ndarray]:
    """What a 1 of a family's maps is in those of its float network, at a gain of 1.

    Levelling multiplied each channel by a factor: the one that whole weights have to the float
    ones.

    Returns:
        (F,) of the maps between head and tail, then of the one within each block.
    """
    quantized = {op.name: op.weight * 2.0**-op.weight_frac_bits for op in family.core.convolutions}
    floats = {op.name: op.weight for op in body_graph(weights) if isinstance(op, Conv)}

    def steps(name: str, inputs: np.ndarray | float, output: str) -> np.ndarray:
        weight = floats[name][:, : quantized[name].shape[1]] * inputs
        square = np.square(weight).sum((1, 2, 3))
        # Least squares over a channel's weights, each of which is rounded.
        products = (weight * quantized[name]).sum((1, 2, 3))
        factors = np.where(square > 0, products / np.maximum(square, 1e-30), 1.0)
        return np.asarray(2.0 ** -family.core.frac_bits[output] / factors)

    stream = steps("head", 1.0, "head")
    # The factors of the stream are in the weights that read it, so they are taken out first.
    inputs = 2.0 ** family.core.frac_bits["head"] * stream[:, None, None]
    inner = (
        steps(f"body.{k}.first", inputs, f"body.{k}.relu") for k in range(weights.variant.blocks)
    )
    return [stream, *inner]


def _biases(op: IntConv) -> np.ndarray:
    """What a convolution adds, (O, 1); where it reads the planes of a sensor's values, which hold
    half, (O, 5).
    """
    if op.input != PLANES:
        return op.float_bias[:, None]
    values = op.weight[:, -SENSOR_VALUES:, 1, 1] * 2.0 ** -(op.weight_frac_bits + 1)
    return np.concatenate([op.float_bias[:, None], values], 1)


def _plan(weights: Weights, shifts: Shifts, passes: Passes) -> Plan:
    """What is to be quantised: the body, from a bank's results."""
    graph = body_graph(weights)
    scale = weights.variant.scale
    width = len(channels()) * scale**2 + SENSOR_VALUES
    ends = Ends(width, 1, adds_image=False, gains=2, outputs=scale**2, direct=True)
    inner = tuple(lone_tensors(graph))
    chain = Chain(inner, (weights.variant.features,) * len(inner), by_channel=False)
    return Plan(graph, ends, streams(graph), chain, shifts, passes)


PATCHES = 80
SNR = (90.0, 165.0)
"""Of calibration: sensors whose gain lies near 1, so that the body sees what all others will show
it at theirs.
"""


def family_images(
    scenes: list[Scene], scale: int, seed: int, kernels: Kernels, patch_px: int = PATCH_PX
) -> Remade[np.ndarray]:
    """What a family is calibrated on: scenes as many sensors of it see them, behind the bank of
    each.

    Args:
        scenes: that are seen.
        scale: of the network.
        seed: of everything that is drawn.
        kernels: of the banks.
        patch_px: side of a patch.
    """
    like = Sensor.load(LIKE)
    reference = Sensor.load(REFERENCE)
    patches = draw_patches(
        scenes, like, reference, PATCHES, seed, patch_px, SensorFamily(like.nominal(), SNR)
    )

    def results(number: int) -> np.ndarray:
        # Every patch is seen by another sensor of the family, through the bank of that one.
        sensor = patches.views[number].degraded
        bank = network_bank(sensor, kernels)
        vector = sensor_vector(sensor).values
        return bank_results(patches.degraded[number], bank, vector, scale, kernels)

    return Remade(results, len(patches.views))
