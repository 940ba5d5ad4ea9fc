"""Measure the error of each layer: one in int8 while all others remain in float.

The error of a convolution comes from its int8 weights and bias, and from rounding and clipping its
result. The error of an add comes from integer sums: in a group of one scale it is zero unless the
sum saturates. Errors of a layer's inputs do not count.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from onnx import TensorProto, helper
from onnxruntime import InferenceSession

from beers_deploy.profiles.figures import Figure, Row, measured, unavailable
from beers_deploy.quant.core import IntConv, IntCore, dequantized, rounded_to
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.gate import GateResult, Spread
from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    Add,
    AveragePool,
    Conv,
    Graph,
    Op,
    Resize,
    graph_to_onnx,
    tensors,
    ties_scales,
)
from beers_deploy.quant.input_range import to_shares
from beers_deploy.quant.integer.agreement import few_crops
from beers_deploy.quant.onnx_file import metadata
from beers_deploy.quant.quantize import FINETUNE, Quantized
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session, planes_of, result_of, tensor_values

IN_INT8 = ".in_int8"
"""Suffix of the name of a tensor: its value computed by int8 weights and bias from float inputs,
not yet rounded.
"""

WORST = 4
BEYOND_DN = (1, 2, 4, 8, 16, 32, 64)


class Loss:
    """Sums over the differences between results and targets, from which errors are computed at the
    end.

    `mae` and `squared` are in the unit of the results that were added.
    """

    def __init__(self) -> None:
        self._signal = 0.0
        self._noise = 0.0
        self._size = 0.0
        self._count = 0

    def add(self, result: np.ndarray, target: np.ndarray, offset: np.ndarray | float = 0.0) -> None:
        """Count the values of one more array.

        Args:
            result: the computed values.
            target: the values that they should be, of the same shape.
            offset: subtracted from the target to get the signal of `sqnr_db`, such as the image to
                which a correction was added.
        """
        difference = np.subtract(result, target, dtype=np.float64)
        self._noise += float(np.square(difference).sum())
        self._signal += float(np.square(np.subtract(target, offset, dtype=np.float64)).sum())
        self._size += float(np.abs(difference).sum())
        self._count += difference.size

    @property
    def sqnr_db(self) -> float:
        """Signal-to-quantization-noise ratio in dB: 10 log10 of the signal's energy over the
        difference's.

        It is infinite if there is no difference or no signal.
        """
        return (
            10 * math.log10(self._signal / self._noise)
            if self._noise and self._signal
            else math.inf
        )

    @property
    def mae(self) -> float:
        """The mean absolute difference."""
        return self._size / self._count

    @property
    def squared(self) -> float:
        """The mean squared difference."""
        return self._noise / self._count


@dataclass(frozen=True)
class LayerError:
    """The error that one layer causes if it alone is computed in int8 and all others in float.

    Attributes:
        name: the name of the layer.
        alone: the error of the layer's own result. Its SQNR is relative to the float result.
        network: the error of the restored image, as a share of full scale. The layer's mean error
            is left out, because the bias of the next layer can make up for it. The SQNR is relative
            to the float result, less the input image if the network adds that.
    """

    name: str
    alone: Loss
    network: Loss


def layer_errors(
    graph: Graph, core: IntCore, crops: Iterable[np.ndarray]
) -> tuple[list[LayerError], Loss]:
    """Measure the error that each layer of a network causes in int8, and that of all layers
    jointly.

    Args:
        graph: the float graph that was rounded to `core`. It reads the int8 planes that an image is
            split into.
        core: the same operations in integers.
        crops: images (1, C, h, w) as the network reads them. Each is run once for every layer.

    Returns:
        The error of each layer in order, and the loss of the restored image with all layers in
        int8.
    """
    # The same convolutions, by their side, with the values that their int8 weights and biases stand
    # for.
    twins = tuple(
        replace(dequantized(op, int_op), name=op.name + IN_INT8, output=op.output + IN_INT8)
        for op, int_op in zip(graph, core.ops, strict=True)
        if isinstance(op, Conv) and isinstance(int_op, IntConv)
    )
    names = tensors((*graph, *twins))
    width = core.host_part.planes

    float_session = open_session(graph_to_onnx((*graph, *twins), names, width))
    int8_session = open_session(host_model(core, {}))
    rests = {name: _rest_after(name, graph, width) for name in set(tensors(graph)) - {CORRECTION}}
    layers = [LayerError(op.name, Loss(), Loss()) for op in graph]
    together = Loss()
    scale = core.scale(CORRECTION)
    ranges = core.host_part.input_ranges
    for crop in crops:
        # A crop is one tile, also that of a network which is fixed to a larger size.
        (values,) = tensor_values(float_session, names, crop, None, core.host_part)
        float_values = dict(zip(names, values, strict=True))
        restored = core.host_part.restore(crop, float_values[CORRECTION], scale)
        restored = to_shares(restored, ranges)
        # Without a correction the result is the image, which may be added before a pixel shuffle.
        nothing = 0 * core.host_part.unrounded(float_values[CORRECTION])
        image = core.host_part.finish(crop, nothing)
        offset = to_shares(image, ranges) if core.host_part.adds_image else 0.0
        for op, layer in zip(graph, layers, strict=True):
            result = _in_int8(core, op, float_values)
            expected = float_values[op.output]
            # Of two gains one is coarse and the other clipped, so they count together.
            if op.output == CORRECTION:
                result = core.host_part.decode(result, scale)
                expected = core.host_part.unrounded(expected)
            layer.alone.add(result, expected)
            # The next layer's bias makes up for a mean error.
            result = result - (result - expected).mean((2, 3), keepdims=True)
            if op.output == CORRECTION:
                image = core.host_part.finish(crop, result)
            else:
                feed = {PLANES: planes_of(crop, core.host_part), op.output: result}
                image = core.host_part.restore(crop, rests[op.output].run(None, feed)[0], scale)
            layer.network.add(to_shares(image, ranges), restored, offset)
        together.add(to_shares(result_of(int8_session, crop), ranges), restored, offset)
    return layers, together


def _rest_after(name: str, graph: Graph, planes: int) -> InferenceSession:
    """Open the part of a float network behind a tensor, which is an input next to the planes."""
    behind = tuple(op for op in graph if op.output != name)
    model = graph_to_onnx(behind, [CORRECTION], planes)
    model.graph.input.append(
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", "C", None, None])
    )
    return open_session(model)


def _in_int8(core: IntCore, op: Op, exact: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return a layer's result when it alone is in int8."""
    if isinstance(op, Conv):
        return rounded_to(exact[op.output + IN_INT8], core.frac_bits[op.output])
    # Operations that only pass values on round nothing, because their inputs and result have one
    # scale.
    if ties_scales(op) and not isinstance(op, AveragePool | Resize):
        return exact[op.output]
    if not isinstance(op, Add):
        return rounded_to(exact[op.output], core.frac_bits[op.output])
    left, right = (rounded_to(exact[name], core.frac_bits[name]) for name in op.inputs)
    # Only the error of the sum itself: that of its inputs belongs to the layers that wrote them.
    error = rounded_to(left + right, core.frac_bits[op.output]) - (left + right)
    return np.asarray(exact[op.output] + error)


def layer_error_rows(result: Quantized, patches: Patches) -> list[Row]:
    """Measure the error that each layer causes if it alone is in int8, as table rows.

    Args:
        result: the quantised network.
        patches: the calibration patches. A crop of each of the first few is run.

    Returns:
        A row for each layer: the SQNR (signal-to-quantization-noise ratio) of its result in dB, the
        error of the network's result, and the layer's share of the squared errors of all layers.
        The last row has the whole network in int8.
    """
    crops = few_crops(patches.degraded, result.host)
    layers, together = layer_errors(result.graph, result.core, crops)
    source = f"{len(crops)} patches, all other layers in float"
    total = sum(layer.network.squared for layer in layers)
    rows = []
    for layer in layers:
        figures = {"SQNR alone": _sqnr(layer.alone, source), **_network(layer.network, source)}
        figures["share of squared error"] = measured(
            100 * layer.network.squared / total if total else 0, "%", source
        )
        rows.append(Row("layers", layer.name, figures))
    return [*rows, Row("layers", "all layers", _network(together, f"{len(crops)} patches"))]


def _network(loss: Loss, source: str) -> dict[str, Figure]:
    return {
        "SQNR of the network": _sqnr(loss, source),
        "MAE": measured(loss.mae, "of full scale", source),
    }


def _sqnr(loss: Loss, source: str) -> Figure:
    if math.isinf(loss.sqnr_db):
        return unavailable("dB", "infinite: nothing is lost")
    return measured(loss.sqnr_db, "dB", source)


def worst_row(number: int, patches: Patches, spread: Spread) -> Row:
    """Return the errors of one patch as a table row; for a simulated one also its content and its
    sensor.

    Args:
        number: the place of the patch in `patches`, such as one of `Spread.worst`.
        patches: the patches that the gate measured on.
        spread: the differences of INT8 from float on these patches.
    """
    errors = {"MAE": spread.mae[number], "max": spread.largest[number]}
    kind = "simulated patch" if patches.views else "sample"
    figures = {
        key: measured(float(value), "of full scale", f"one {kind}") for key, value in errors.items()
    }
    if not patches.views:
        return Row("worst samples", f"sample {number}", figures)
    view = patches.views[number]
    figures["mean radiance"] = measured(
        view.ground.brightness, "W/m2/sr/um", "of the simulated ground"
    )
    # One value, or two if the axes of the sensor differ.
    across, along = (f"{100 * value:.3g} %" for value in view.degraded.mtf_axes)
    mtf = across if across == along else f"{across} across the track, {along} along it"
    words = {
        "scene": view.ground.scene.name,
        "MTF at Nyquist, drawn from the profile": mtf,
        "scene pixels a pixel, drawn": str(view.ground.oversampling),
    }
    return Row("worst patches", f"patch {number}", figures, words)


def sizes_row(spread: Spread) -> Row:
    """Return a table row with the shares of pixels, in %, whose INT8 value is off by more than some
    numbers of DN.

    BEYOND_DN lists these numbers of digital numbers (DN).

    Args:
        spread: the differences of INT8 from float.
    """
    source = f"{len(spread.mae)} patches"
    figures = {
        f"beyond {dn} DN": measured(100 * spread.share_beyond(dn), "%", source) for dn in BEYOND_DN
    }
    return Row("error sizes", "INT8 against float", figures)


MUCH_DB = 0.2
"""The PSNR drop above which the costliest layers are listed."""


def losses(
    result: Quantized, gate: GateResult, patches: Patches, layers: Sequence[Row] = ()
) -> str:
    """Describe the PSNR that INT8 loses in a sentence, on average and on the worst patch.

    If the loss exceeds MUCH_DB, the costliest layers and advice are added. Without references the
    mean difference from float is stated instead.

    Args:
        result: the quantised network.
        gate: the differences of INT8 from float on `patches`.
        patches: samples that were held out from calibration.
        layers: the rows of `layer_error_rows`, if they were computed before; otherwise they are
            computed if the sentence needs them.
    """
    if math.isnan(gate.drop_db):
        mae = f"{gate.mae:.2g} of full scale on average"
        unfit = any(reference.size for _, reference in patches.pairs)
        advice = "; no loss of PSNR, because references are not of the result's size"
        return f"INT8 differs from float by {mae} ({gate.source}){advice if unfit else ''}"
    message = (
        f"INT8 {_change(gate.drop_db)} against {gate.psnr_float_db:.2f} dB in float, and "
        f"{_change(gate.worst_drop_db)} at worst ({gate.source})"
    )
    if gate.drop_db <= MUCH_DB:
        return message
    costliest = _costliest(layers or layer_error_rows(result, patches))
    names = ", ".join(f"{name} ({share:.0f} %)" for name, share in costliest)
    # A network that is fine-tuned already gains nothing more by it.
    advice = "" if FINETUNE in metadata(result.host) else "; try `finetune` auto"
    return f"{message}: most of it in {names}{advice}"


def _change(drop_db: float) -> str:
    """Return a drop of PSNR in words, such as "loses 0.10 dB"."""
    return f"gains {-drop_db:.2f} dB" if drop_db < 0 else f"loses {drop_db:.2f} dB"


MOST = 3
"""The maximum number of layers that are named."""


def _costliest(layers: Sequence[Row]) -> list[tuple[str, float]]:
    """Return the layers that make most of the squared error, with their shares in per cent."""
    # The last row is of all layers.
    shares = {row.name: row.figures["share of squared error"].value or 0 for row in layers[:-1]}
    return sorted(shares.items(), key=lambda share: share[1], reverse=True)[:MOST]


def headline(gate: GateResult, layers: Sequence[Row]) -> str:
    """Describe the mean error of INT8, its kind (rounding or clipping), and the layers that cause
    most of it.

    Args:
        gate: the differences of INT8 from float.
        layers: the rows of `layer_error_rows`.

    Returns:
        Sentences for a report.
    """
    names = ", ".join(f"{name} {share:.0f} %" for name, share in _costliest(layers))
    drop = "" if math.isnan(gate.drop_db) else f" and costs {gate.drop_db:.2f} dB"
    return (
        f"INT8 differs from float by {gate.mae:.2g} of full scale on average{drop} "
        f"(measured). std / MAE is {gate.std_over_mae:.2f}: rounding alone makes it 1.25, and "
        f"clipping makes it larger. Most of the squared error comes from: {names}."
    )
