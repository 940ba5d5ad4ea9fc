"""INT8 for boards that are not the DPU: what its rules cost shows against what goes without them.

As in `quant.quantise` only the correction is computed in int8, the image enters as planes, the residual stream has
one scale, equalised channels and half steps at its end, weights are fitted to what they meet, and the correction has
two gains. Gone are the DPU's rules: see `quant.free_file`. Float scales by themselves gain little: what rules in both
is a residual stream of 8 bits.
"""

from collections.abc import Callable

import onnx

from quant.calibration import Patches
from quant.float_reader import correction_graph
from quant.free_file import Scale, free_model
from quant.free_scales import tensor_scales
from quant.graph import CORRECTION, Conv, Graph, tensors
from quant.moments import Moments, input_moments
from quant.onnx_file import fixed_tile_px, metadata
from quant.passes.dual_gain import two_gains
from quant.passes.equalise import channel_ranges, equalise, search, search_steps
from quant.passes.half_steps import half_steps
from quant.passes.steady_stream import STREAM_POSITION, stream_tensors
from quant.planes import PLANES, POSITION, read_planes
from quant.positions import INT8_MAX
from quant.quantise import crop_costs, search_targets

UINT8_MAX = 255
STREAM_STEP = 2.0**-STREAM_POSITION
FINER = 2
"""The fine gain's unit is so much finer than what suits all corrections: the coarse one is there for the large."""


def quantise_free(
    model: onnx.ModelProto, patches: Patches, about: dict[str, str], tick: Callable[[], None]
) -> onnx.ModelProto:
    """Quantise a float ConvBEERS to uint8 activations and int8 weights, with float scales, of weights per channel.

    Returns:
        The host file: `image` to `restored`, every convolution an integer kernel of onnxruntime.

    Raises:
        ModelError: not a graph of convolutions, ReLUs and adds that ends with the global add.
    """
    graph = read_planes(correction_graph(model))
    scales = _scales(graph, patches, tick)
    if stream_tensors(graph):
        ranges = channel_ranges(graph, patches.degraded, tick)
        targets = search_targets(graph, patches.degraded)
        factors = search(graph, ranges, lambda tried: crop_costs(_written(tried, scales, {}), targets), tick)
        graph = equalise(graph, factors)
    about = {**metadata(model), "precision": "int8 free", "calibration_sha256": patches.digest, **about}
    moments = input_moments(_fine(graph), patches.degraded, tick)
    return _written(graph, scales, about, fixed_tile_px(model), moments)


def free_ticks(model: onnx.ModelProto, patches: int) -> int:
    """How often `quantise_free` will call `tick`."""
    graph = read_planes(correction_graph(model))
    if not stream_tensors(graph):
        return 3 * patches
    first = graph[0]
    assert isinstance(first, Conv)  # noqa: S101 - correction_graph has seen to it
    return 4 * patches + search_steps(len(first.weight))


def _scales(graph: Graph, patches: Patches, tick: Callable[[], None]) -> dict[str, Scale]:
    """Least-squares scales of what is not the stream; that has any, because `equalise` scales its channels to it."""
    convs = [op for op in graph if isinstance(op, Conv) and op.output not in stream_tensors(graph)]
    levels = {op.output: UINT8_MAX if op.relu else INT8_MAX for op in convs}
    units = tensor_scales(graph, levels, patches.degraded, tick)
    units[CORRECTION] /= FINER
    found = {op.output: Scale(units[op.output], 0) if op.relu else Scale(units[op.output]) for op in convs}
    return {PLANES: Scale(2.0**-POSITION), **found}


def _fine(graph: Graph) -> Graph:
    return two_gains(half_steps(graph, STREAM_STEP))


def _written(
    graph: Graph,
    scales: dict[str, Scale],
    about: dict[str, str],
    tile_px: int | None = None,
    moments: dict[str, Moments] | None = None,
) -> onnx.ModelProto:
    stream, fine = Scale(STREAM_STEP), _fine(graph)
    known = {name: scales.get(name, stream) for name in (PLANES, *tensors(fine))}
    return free_model(fine, known, about, tile_px, moments)
