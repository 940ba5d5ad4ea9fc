"""Measure the cost of each restriction of a DPU: each step adds one restriction to the float
network.

Each step rounds weights and tensors as such hardware would, and computes in float between:

1. 8 bits: a scale for the weights of each output channel, and 256 steps from the smallest to the
   largest value of each tensor.
2. No zero point: the steps lie around 0, so a tensor that is never negative has 128 of them.
3. One scale for all weights of a convolution.
4. Powers of two as scales, the finest that clip nothing.
5. The INT8 network: also shifts, shared scales and 8-bit biases, minus the gain of the passes and
   of fine-tuning.

Ranges are those of the measured samples, so that steps 1 to 4 clip nothing. The image enters, and
is added at the end, as in the host's part of the INT8 network. The cost of clipping in step 5 is
the difference to the same integers in tensors without limits.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from onnx import ModelProto, helper, numpy_helper

from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.profiles.errors import counted
from beers_deploy.profiles.figures import Figure, Row, measured
from beers_deploy.quant.core import IntConv, dequantized
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Conv,
    Graph,
    fold_full_scale,
    graph_to_onnx,
    read_planes,
    tensors,
)
from beers_deploy.quant.host_part import HostPart
from beers_deploy.quant.input_range import ranges_of_result, to_shares
from beers_deploy.quant.metrics import SCALE
from beers_deploy.quant.onnx.messages import replace_all
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.samples.patches import Pair, Patches
from beers_deploy.quant.session import open_any_size, open_session, planes_of, result_of

BITS = 8
SAMPLES = 16
"""The maximum number of measured samples that were held out from calibration."""
PER_CHANNEL = (1, 2, 3)
"""Axes of weights (O, I, kh, kw) over which a scale for each output channel is shared."""
STEPS: Mapping[str, tuple[tuple[int, ...] | None, bool, bool]] = {
    "8 bits": (PER_CHANNEL, True, False),
    "no zero point": (PER_CHANNEL, False, False),
    "one scale for the weights of a layer": (None, False, False),
    "powers of two as scales": (None, False, True),
}
"""The axes, the zero point and the powers of two of `Measured.cost_of_step`, in steps 1 to 4."""


@dataclass(frozen=True)
class Grid:
    """The values that a rounded tensor may have: scale times each integer from `low` to `high`.

    Attributes:
        scale: distance between neighbouring values, in the tensor's unit.
        low: the smallest integer, or minus infinity if the grid has no lower end.
        high: the largest integer, or infinity if the grid has no upper end.
    """

    scale: float
    low: float
    high: float


@dataclass(frozen=True)
class Cost:
    """The loss of a network with some restrictions of a DPU against the float network, as mean over
    samples.

    Attributes:
        mae: mean absolute difference from the float network's result, in shares of the input's
            range.
        drop_db: PSNR of the float network less that of the restricted one, in dB against the
            references; NaN without references.
    """

    mae: float
    drop_db: float

    def beyond(self, before: "Cost", source: str) -> Figure:
        """Return the loss that one more restriction adds to the loss before it, as a figure.

        Args:
            before: the loss with the restrictions before this one.
            source: how both were measured, for the figure.

        Returns:
            The added loss in dB if both have references, else the added mean absolute difference as
            a share of full scale.
        """
        if math.isfinite(self.drop_db) and math.isfinite(before.drop_db):
            return measured(self.drop_db - before.drop_db, "dB", source)
        return measured(self.mae - before.mae, SCALE, source)


@dataclass(frozen=True)
class Measured:
    """Samples on which restrictions of a DPU are measured, with the float network's results for
    them.

    Attributes:
        pairs: the pairs of an image and its reference. A reference may be an empty array.
        floats: the float network's result for each image.
        ranges: the smallest and the largest value of each tensor of the float network by name, over
            all samples and 0.
        host_part: the host's pre- and post-processing, which all steps share.
    """

    pairs: Sequence[Pair]
    floats: Sequence[np.ndarray]
    ranges: Mapping[str, tuple[float, float]]
    host_part: HostPart

    @classmethod
    def of(cls, result: Quantized, pairs: Sequence[Pair]) -> "Measured":
        """Run the float network on samples, and record its results and the ranges of its tensors.

        Args:
            result: the quantised network, which also holds the float one.
            pairs: images (1, C, H, W) in the network's units, each with its reference or an empty
                array.
        """
        host_part = result.core.host_part
        graph = read_planes(result.network.graph, host_part.full_scale)
        names = tensors(graph)
        session = open_session(graph_to_onnx(graph, names, host_part.planes))
        floats = []
        # Steps include 0, because padding has to be exact.
        lows, highs = np.zeros((2, len(names)))
        for image, _ in pairs:
            values = session.run(names, {PLANES: planes_of(image, host_part)})
            floats.append(host_part.finish(image, values[names.index(CORRECTION)]))
            lows = np.minimum(lows, [value.min() for value in values])
            highs = np.maximum(highs, [value.max() for value in values])
        limits = zip(lows.tolist(), highs.tolist(), strict=True)
        return cls(pairs, floats, dict(zip(names, limits, strict=True)), host_part)

    def corrections(self, graph: Graph, grids: Mapping[str, Grid]) -> Iterator[np.ndarray]:
        """Run a float graph with some tensors rounded to grids, on all samples.

        Args:
            graph: a float graph that reads the int8 planes that an image is split into.
            grids: the grid of each rounded tensor by name. Other tensors stay in float.

        Yields:
            The result for each image, (1, C, H', W') float32, before the host adds the image.
        """
        model = rounded_model(graph_to_onnx(graph, [CORRECTION], self.host_part.planes), grids)
        session = open_session(model)
        for image, _ in self.pairs:
            yield session.run(None, {PLANES: planes_of(image, self.host_part)})[0]

    def cost(self, results: Iterable[np.ndarray]) -> Cost:
        """Return the mean absolute error and the PSNR drop of restored images over the samples.

        Args:
            results: restored images (1, C, H', W') in the network's units, in the order of the
                samples.

        Returns:
            The loss against the float network's results. The PSNR drop is NaN if a sample has no
            reference of the result's shape.
        """
        maes = []
        drops_db = []
        for image, in_float, (degraded, reference) in zip(
            results, self.floats, self.pairs, strict=True
        ):
            ranges = ranges_of_result(in_float, degraded, self.host_part.input_ranges)
            float_shares, shares = (to_shares(each, ranges) for each in (in_float, image))
            maes.append(float(np.abs(shares - float_shares).mean()))
            drop_db = math.nan
            if reference.shape == image.shape:
                float_db, step_db = (
                    psnr_db(np.clip(each, 0, 1), to_shares(reference, ranges), 1.0)
                    for each in (float_shares, shares)
                )
                drop_db = float_db - step_db
            drops_db.append(drop_db)
        return Cost(float(np.mean(maes)), float(np.mean(drops_db)))

    def cost_of_step(
        self, graph: Graph, axes: tuple[int, ...] | None, zero_point: bool, powers: bool
    ) -> Cost:
        """Return the loss of the float network with weights and tensors rounded as one step of the
        module says.

        Args:
            graph: the float network, which reads the image.
            axes: the axes of weights (O, I, kh, kw) over which a scale is shared; None shares one
                scale over all of them.
            zero_point: if True, the grid of a tensor reaches from its smallest to its largest
                value. Otherwise it lies around 0.
            powers: if True, scales are rounded up to powers of two.
        """
        rounded = tuple(
            replace(op, weight=rounded_weight(op.weight, axes, powers))
            if isinstance(op, Conv)
            else op
            for op in fold_full_scale(graph, self.host_part.full_scale)
        )
        grids = {
            name: grid_of(low, high, zero_point, powers)
            for name, (low, high) in self.ranges.items()
        }
        corrections = self.corrections(read_planes(rounded), grids)
        pairs = zip(self.pairs, corrections, strict=True)
        return self.cost(self.host_part.finish(image, each) for (image, _), each in pairs)

    def cost_of_integers(self, result: Quantized, clips: bool) -> Cost:
        """Return the loss of the integers and scales of an INT8 network, with or without clipping.

        Args:
            result: the quantised network.
            clips: if True, tensors are clipped to int8. Otherwise their integers have no limits, so
                that the difference of both losses is the loss by clipping.
        """
        graph = tuple(
            dequantized(op, int_op) if isinstance(op, Conv) and isinstance(int_op, IntConv) else op
            for op, int_op in zip(result.graph, result.core.ops, strict=True)
        )
        ends = (INT8_MIN, INT8_MAX) if clips else (-math.inf, math.inf)
        grids = {name: Grid(result.core.scale(name), *ends) for name in tensors(graph)}
        scale = result.core.scale(CORRECTION)
        pairs = zip(self.pairs, self.corrections(graph, grids), strict=True)
        return self.cost(self.host_part.restore(image, each, scale) for (image, _), each in pairs)


def price_rows(result: Quantized, held_out: Patches) -> list[Row]:
    """Measure the loss that each restriction of a DPU adds, from the float network to INT8, as
    table rows.

    Args:
        result: the quantised network, which also holds the float one.
        held_out: samples that are held out from calibration. At most SAMPLES of them are measured.

    Returns:
        Rows of the table "price": one for each step of the module in order, and one for clipping in
        the last step. Their figure "price" is the loss that a step adds to the step before it.
    """
    samples = Measured.of(result, list(islice(held_out.pairs, SAMPLES)))
    graph = result.network.graph
    int8 = open_any_size(result.host)
    costs = {
        name: samples.cost_of_step(graph, *restrictions) for name, restrictions in STEPS.items()
    }
    costs["INT8 as written"] = samples.cost(result_of(int8, image) for image, _ in samples.pairs)
    source = f"{counted(len(samples.pairs), 'sample')} that calibration did not see"
    rows = []
    before = Cost(0.0, 0.0)
    for name, cost in costs.items():
        figures = {"price": cost.beyond(before, source)}
        if math.isfinite(cost.drop_db):
            figures["PSNR drop"] = measured(cost.drop_db, "dB", source)
        figures["MAE"] = measured(cost.mae, SCALE, source)
        rows.append(Row("price", name, figures))
        before = cost
    clipped = samples.cost_of_integers(result, clips=True)
    price = clipped.beyond(samples.cost_of_integers(result, clips=False), source)
    return [*rows, Row("price", "clipping, of INT8 as written", {"price": price})]


def rounded_weight(weight: np.ndarray, axes: tuple[int, ...] | None, powers: bool) -> np.ndarray:
    """Round weights to a symmetric grid of 8 bits that clips none of them.

    Args:
        weight: weights (O, I, kh, kw).
        axes: axes over which a scale is shared; None shares one scale over all of them.
        powers: if True, scales are rounded up to powers of two.

    Returns:
        The rounded weights in their own unit, (O, I, kh, kw) float32.
    """
    largest = np.abs(weight).max(axes, keepdims=True)
    # Weights that are all zero have no range, so any scale represents them exactly.
    scale = np.where(largest > 0, largest, 1) / (2 ** (BITS - 1) - 1)
    if powers:
        # Rounding the exponent up keeps the largest weight within 127 steps, so that nothing clips.
        scale = 2.0 ** np.ceil(np.log2(scale))
    return np.asarray(np.rint(weight / scale) * scale, np.float32)


def grid_of(low: float, high: float, zero_point: bool, powers: bool) -> Grid:
    """Return the grid of a tensor with values from `low` to `high`, which does not clip them.

    Args:
        low: the smallest value of the tensor, at most 0.
        high: the largest value of the tensor, at least 0.
        zero_point: if True, the 256 values span `low` to `high`. Otherwise they lie around 0.
        powers: if True, the scale of a grid around 0 is rounded up to a power of two.
    """
    steps = 2**BITS - 1
    if zero_point:
        scale = (high - low) / steps or 1.0
        # The end is rounded to a multiple of the scale, so that 0 is on the grid and padding is
        # exact.
        first = round(low / scale)
        return Grid(scale, first, first + steps)
    # Only 127 steps lie above 0, so the larger side must fit these. -128 is the one step more
    # below.
    end = steps // 2
    scale = max(-low, high) / end or 1.0
    if powers:
        scale = 2.0 ** math.ceil(math.log2(scale))
    return Grid(scale, -end - 1, end)


def rounded_model(model: ModelProto, grids: Mapping[str, Grid]) -> ModelProto:
    """Round tensors of a float model to their grids, half up as a DPU does.

    Args:
        model: a float model, which is changed in place.
        grids: the grid of each tensor that is rounded, by the tensor's name.

    Returns:
        The same model, in which the rounded tensors have the original names.
    """
    nodes = []
    for node in model.graph.node:
        nodes.append(node)
        name = node.output[0]
        if name not in grids:
            continue
        grid = grids[name]
        node.output[0] = f"{name}.exact"
        constants = {"scale": grid.scale, "half": 0.5, "low": grid.low, "high": grid.high}
        for key, value in constants.items():
            array = np.array(value, np.float32)
            model.graph.initializer.append(numpy_helper.from_array(array, f"{name}.{key}"))
        # floor(x / scale + 0.5) rounds ties up. Round of ONNX would round them to the even
        # neighbour.
        feeds = {
            "Div": ["exact", "scale"],
            "Add": ["Div", "half"],
            "Floor": ["Add"],
            "Clip": ["Floor", "low", "high"],
        }
        for kind, suffixes in feeds.items():
            inputs = [f"{name}.{suffix}" for suffix in suffixes]
            nodes.append(helper.make_node(kind, inputs, [f"{name}.{kind}"]))
        nodes.append(helper.make_node("Mul", [f"{name}.Clip", f"{name}.scale"], [name]))
    replace_all(model.graph.node, nodes)
    return model
