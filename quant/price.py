"""What each restriction of a DPU costs: the float network with one more of them a step.

Each step rounds weights and tensors as such hardware would, and computes in float between:

1. 8 bits: a scale for the weights of each output channel, and 256 steps from the smallest to the
   largest value of each tensor.
2. No zero point: the steps lie around 0, so what is never negative has 128 of them.
3. One scale for all weights of a convolution.
4. Powers of two as scales, the finest that clip nothing.
5. The INT8 network: also shifts, scales that tensors share and biases of 8 bits, against what the
   passes and fine-tuning win back.

Ranges are those of the samples that are measured, so that steps 1 to 4 clip nothing. The image
enters, and is added at the end, as the host of the INT8 network does it. What clipping costs in
step 5 is the difference to the same integers in tensors whose values have no end.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import onnx
from onnx import helper, numpy_helper

from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.profiles.figures import Figure, Row, measured
from beers_deploy.quant.core import INT8_MAX, INT8_MIN, IntConv, dequantized
from beers_deploy.quant.gate import SCALE
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Conv,
    Graph,
    graph_to_onnx,
    read_planes,
    tensors,
)
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_any_size, open_session, planes_of, result_of

BITS = 8
SAMPLES = 16
"""That are measured, of those that calibration did not see."""
PER_CHANNEL = (1, 2, 3)
"""Axes of weights (O, I, kh, kw) over which a scale for each output channel is shared."""


@dataclass(frozen=True)
class Grid:
    """The multiples of a scale from `low` to `high` times it, to which a tensor is rounded."""

    scale: float
    low: float = INT8_MIN
    high: float = INT8_MAX


@dataclass(frozen=True)
class Cost:
    """What a step has lost: mean absolute difference from float, and PSNR to references in dB, NaN
    without them.
    """

    mae: float
    drop_db: float

    def beyond(self, before: "Cost", source: str) -> Figure:
        """Return what was added, in dB if there are references."""
        if math.isfinite(self.drop_db) and math.isfinite(before.drop_db):
            return measured(self.drop_db - before.drop_db, "dB", source)
        return measured(self.mae - before.mae, SCALE, source)


def price_rows(result: Quantized, held_out: Patches) -> list[Row]:
    """Return a row for each step, and one for what clipping costs in the last.

    Args:
        result: the INT8 network, which knows the float one.
        held_out: samples that calibration did not see.
    """
    pairs = list(islice(held_out.pairs, SAMPLES))
    images = [image for image, _ in pairs]
    core = result.core
    float_graph = read_planes(result.network.graph)
    names = tensors(float_graph)
    session = open_session(graph_to_onnx(float_graph, names, core.host_part.planes))
    floats = []
    lows, highs = np.zeros((2, len(names)))
    for image in images:
        values = session.run(names, {PLANES: planes_of(image, core.host_part)})
        floats.append(core.host_part.finish(image, values[names.index(CORRECTION)]))
        # Steps start at 0 at the latest, because padding has to be exact.
        lows = np.minimum(lows, [value.min() for value in values])
        highs = np.maximum(highs, [value.max() for value in values])

    def cost(results: Sequence[np.ndarray]) -> Cost:
        return _cost(results, floats, [reference for _, reference in pairs])

    def simulated(graph: Graph, grids: Mapping[str, Grid]) -> list[np.ndarray]:
        model = rounded_model(graph_to_onnx(graph, [CORRECTION], core.host_part.planes), grids)
        session = open_session(model)
        feeds = [{PLANES: planes_of(image, core.host_part)} for image in images]
        return [session.run(None, feed)[0] for feed in feeds]

    def of_step(axes: tuple[int, ...] | None, zero_point: bool, powers: bool) -> Cost:
        graph = tuple(
            replace(op, weight=rounded_weight(op.weight, axes, powers))
            if isinstance(op, Conv)
            else op
            for op in result.network.graph
        )
        grids = {
            name: grid_of(low, high, zero_point, powers)
            for name, low, high in zip(names, lows, highs, strict=True)
        }
        corrections = simulated(read_planes(graph), grids)
        return cost(
            [core.host_part.finish(*each) for each in zip(images, corrections, strict=True)]
        )

    def of_core(grids: Mapping[str, Grid]) -> Cost:
        corrections = simulated(_in_integers(result), grids)
        scale = core.scale(CORRECTION)
        return cost(
            [core.host_part.restore(*each, scale) for each in zip(images, corrections, strict=True)]
        )

    int8 = open_any_size(result.host)
    costs = {
        "8 bits": of_step(PER_CHANNEL, zero_point=True, powers=False),
        "no zero point": of_step(PER_CHANNEL, zero_point=False, powers=False),
        "one scale for the weights of a layer": of_step(None, zero_point=False, powers=False),
        "powers of two as scales": of_step(None, zero_point=False, powers=True),
        "INT8 as written": cost([result_of(int8, image) for image in images]),
    }
    source = f"{len(images)} samples that calibration did not see"
    rows = []
    before = Cost(0.0, 0.0 if math.isfinite(costs["8 bits"].drop_db) else math.nan)
    for name, step_cost in costs.items():
        figures = {"price": step_cost.beyond(before, source)}
        if math.isfinite(step_cost.drop_db):
            figures["PSNR drop"] = measured(step_cost.drop_db, "dB", source)
        figures["MAE"] = measured(step_cost.mae, SCALE, source)
        rows.append(Row("price", name, figures))
        before = step_cost
    scales = {name: core.scale(name) for name in names}
    clipped = of_core({name: Grid(scale) for name, scale in scales.items()})
    endless = of_core({name: Grid(scale, -np.inf, np.inf) for name, scale in scales.items()})
    rows.append(
        Row("price", "clipping, of INT8 as written", {"price": clipped.beyond(endless, source)})
    )
    return rows


def rounded_weight(weight: np.ndarray, axes: tuple[int, ...] | None, powers: bool) -> np.ndarray:
    """Round weights (O, I, kh, kw), with one scale over these axes, or None over all."""
    largest = np.abs(weight).max(axes, keepdims=True)
    scale = np.where(largest > 0, largest, 1) / (2 ** (BITS - 1) - 1)
    if powers:
        scale = 2.0 ** np.ceil(np.log2(scale))
    return np.asarray(np.rint(weight / scale) * scale, np.float32)


def grid_of(low: float, high: float, zero_point: bool, powers: bool) -> Grid:
    """Return the grid of a tensor with values from `low` to `high`, which does not clip them."""
    steps = 2**BITS - 1
    if zero_point:
        scale = (high - low) / steps or 1.0
        first = round(low / scale)
        return Grid(scale, first, first + steps)
    end = steps // 2
    scale = max(-low, high) / end or 1.0
    if powers:
        scale = 2.0 ** math.ceil(math.log2(scale))
    return Grid(scale, -end - 1, end)


def rounded_model(model: onnx.ModelProto, grids: Mapping[str, Grid]) -> onnx.ModelProto:
    """Return a float model that rounds these tensors to their grids, half up as a DPU does."""
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
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return model


def _in_integers(result: Quantized) -> Graph:
    """Return the rounded graph with the values that its int8 weights and biases stand for."""
    pairs = zip(result.graph, result.core.ops, strict=True)
    return tuple(
        dequantized(op, whole) if isinstance(op, Conv) and isinstance(whole, IntConv) else op
        for op, whole in pairs
    )


def _cost(
    results: Sequence[np.ndarray], floats: Sequence[np.ndarray], references: Sequence[np.ndarray]
) -> Cost:
    """Return what results lose, in the mean over the samples."""
    triples = list(zip(results, floats, references, strict=True))
    mae = float(np.mean([np.abs(result - in_float).mean() for result, in_float, _ in triples]))
    if any(result.shape != reference.shape for result, _, reference in triples):
        return Cost(mae, math.nan)
    drops = [
        psnr_db(np.clip(in_float, 0, 1), reference, 1.0)
        - psnr_db(np.clip(result, 0, 1), reference, 1.0)
        for result, in_float, reference in triples
    ]
    return Cost(mae, float(np.mean(drops)))
