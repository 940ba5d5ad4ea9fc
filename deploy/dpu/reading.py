"""Convert an ONNX file to the DPU's short list of operations. Three encodings are supported.

1. float: Conv, Relu, Add.
2. integer kernels: QLinearConv, com.microsoft QLinearAdd, Relu (or Max with the zero point), float
   host nodes around.
3. QDQ: QuantizeLinear and DequantizeLinear around float operators. These pairs are notation and are
   removed. Only those at the border, which really convert, remain as operations.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx

from beers_deploy.dpu.graph import Kind, Operation, Shape, SizedGraph, kind_of, out_shape
from beers_deploy.model.bank import GAINS, LARGEST, WIDE
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.quant.encodings import BORDER_PX, PLACE_PX, as_on_board
from beers_deploy.quant.graph.pixel_shuffle import with_shuffles
from beers_deploy.quant.graph.quantized import Integers
from beers_deploy.quant.onnx.graph import Node, OnnxGraph
from beers_deploy.quant.onnx.image_input import require_image, require_one_input
from beers_deploy.quant.onnx.window import Sides, Window
from beers_deploy.quant.onnx_file import faults_named, load_onnx, metadata
from beers_deploy.quant.tiling.receptive_field import tiling_of
from beers_deploy.quant.untrusted import contradictions

BANK_GAINS = np.arange(8 * GAINS[0], 8 * GAINS[1] + 1) / 8
BANK_REACHES = (
    np.outer([LARGEST, WIDE * LARGEST], 1 / BANK_GAINS).astype(np.float32).ravel().tolist()
)
BANK_ENDS = [[-reach, reach] for reach in BANK_REACHES]
"""The clipping limits of the planes and of the analytic restoration in a float network behind a
bank, for each gain of a sensor.
"""

PLACE_MAX_PX = 64
"""The largest side of a place that is accepted. No network rearranges more pixels, so the file is
damaged.
"""


def read_sized_graph(path: Path, tile_px: int | None = 640) -> SizedGraph:
    """Read an ONNX file as the list of operations that a DPU would compute.

    Args:
        path: the ONNX file, in float or INT8, whole or only the integer core for a board.
        tile_px: side of the square image in pixels; None for the size that the file is fixed to.
            For a core whose host moves squares of 2 x 2 pixels into channels, it is the side of the
            image, not of the core's input.

    Raises:
        ModelError: the file is not a valid ONNX network of images of this size.
    """
    return sized_graph(load_onnx(path, to_run=False), tile_px, str(path))


def own_tile_px(model: onnx.ModelProto) -> int | None:
    """Return the side in pixels of the image that a network is fixed to; None if it accepts any
    size.

    For the integer core of a network, which reads int8 planes prepared by the host, it is the side
    of the image that the planes are made from.
    """
    dims = model.graph.input[0].type.tensor_type.shape.dim
    side = max((d.dim_value for d in dims[2:]), default=0)
    if not side:
        return None
    place_px, border_px = _places(model)
    return side * place_px - 2 * border_px


def usual_tile_px(model: onnx.ModelProto) -> int:
    """Return the side in pixels of the image that a network is fixed to; else the smallest side of
    at least TILE_PX that it accepts, and whose pixels the host can move into channels.

    Args:
        model: a float network, or an INT8 one as `as_on_board` returns it.
    """
    place_px, border_px = _places(model)
    # A network that cannot be tiled may accept any size.
    with suppress(ModelError):
        place_px *= tiling_of(model).alignment_px
    whole_px = up_to_multiple(TILE_PX + 2 * border_px, place_px)
    return own_tile_px(model) or whole_px - 2 * border_px


def _places(model: onnx.ModelProto) -> tuple[int, int]:
    """Read the geometry of the planes from the metadata of a board's file.

    Returns:
        The side in pixels of a place, a square of pixels that the host moves into channels; and the
        number of pixels by which the planes extend beyond the image on every side.
    """
    about = metadata(model)
    place_px = int(about.get(PLACE_PX, 1))
    border_px = int(about.get(BORDER_PX, 0))
    if not (1 <= place_px <= PLACE_MAX_PX and 0 <= border_px <= PLACE_MAX_PX):
        raise ValueError(f"places of {place_px} px, {border_px} px around")
    return place_px, border_px


def sized_graph(
    model: onnx.ModelProto, tile_px: int | None, where: str = "ONNX model"
) -> SizedGraph:
    """Convert an ONNX model in memory to the list of operations that a DPU would compute.

    An INT8 file for onnxruntime, which contains the steps of the host too, is first converted to
    the file for the board.

    Args:
        model: the ONNX model.
        tile_px: side of the square image in pixels; None for the size that the file is fixed to.
        where: name of the file, for messages.

    Raises:
        ModelError: the model has no nodes, or is not valid.
    """
    model = as_on_board(model)
    if not model.graph.node:
        raise ModelError(
            f"{where} has no nodes, so it is not a network. Give a file written by 'beers-deploy "
            "export' or 'beers-deploy quantize'."
        )
    with contradictions(where):
        return _sized(with_shuffles(model), inputs_of(model, tile_px, where))


def inputs_of(model: onnx.ModelProto, tile_px: int | None, where: str) -> dict[str, Shape]:
    """Return the shape (C, H, W) of each input of a network for one image size, by name.

    Args:
        model: the ONNX model. If its metadata state that the host moves squares of pixels into
            channels, H and W count these squares.
        tile_px: side of the square image in pixels; None for the sizes that the file states.
        where: name of the file, for messages.

    Raises:
        ModelError: an input is no image, has another fixed size, or cannot consist of whole
            squares; or `tile_px` is None and the file states no size.
    """
    place_px, border_px = _places(model)
    shapes: dict[str, Shape] = {}
    inputs = OnnxGraph(model).inputs
    for name, sizes in inputs.items():
        with faults_named(where):
            # `check` and `bench` read networks of several images, but a parameter is none.
            if len(sizes) < 4 or (sizes[2:] == [1, 1] and tile_px not in (None, 1)):
                require_one_input(inputs)
            # Without a tile a network is predicted at the sizes that its file states, if it does.
            require_image(name, sizes, square=tile_px is not None or not all(sizes[2:]))
        if tile_px is None:
            if not all(sizes[2:]):
                raise ModelError(f"{where} states no size of its input. Give `tile`.")
            shapes[name] = sizes[1], sizes[2], sizes[3]
            continue
        # The tile is stated in pixels of the image, and the input counts places of several pixels.
        side, beyond = divmod(tile_px + 2 * border_px, place_px)
        if beyond:
            raise ModelError(
                f"`tile` must be a multiple of {place_px} px for {where}, got {tile_px} px. Choose "
                "another `tile`."
            )
        if sizes[2] not in (0, side):
            fixed_px = sizes[2] * place_px - 2 * border_px
            raise ModelError(
                f"The input of {where} is fixed to {fixed_px} x {fixed_px} pixels, but `tile` is "
                f"{tile_px} px. Give `tile` {fixed_px}, or export the network with free sizes."
            )
        shapes[name] = sizes[1], side, side
    return shapes


def _sized(graph: OnnxGraph, inputs: dict[str, Shape]) -> SizedGraph:
    """Return the operations of a graph, without the notation of quantisation.

    The nodes are visited once in topological order, and shapes and number formats are propagated.
    """
    integers = Integers(graph)
    shape_of: dict[str, Shape | None] = dict(inputs)
    kind_by_name: dict[str, Kind] = {}
    operations = []
    for node in graph.nodes:
        if integers.is_notation(node):
            continue
        weight = integers.weight(node)
        kind = "activation" if _is_activation(graph, node, integers) else kind_of(node, weight)
        sources = integers.activations(node)
        formats = integers.formats(node)
        shapes = tuple(map(shape_of.get, sources))
        kernel, window = _window(node, weight, shapes)
        channels = _channels(node, weight, shapes)
        outputs = tuple(integers.resolve(name) for name in node.outputs if name)
        operand = None
        # An element-wise operator with one activation has a constant operand.
        if len(sources) == 1 and (kind in ("add", "mul") or node.op_type in ("Sub", "Div")):
            operand = integers.operand(node)
        operation = Operation(
            name=node.name,
            op_type=node.op_type,
            kind=kind,
            inputs=sources,
            outputs=outputs,
            in_shapes=shapes,
            kernel=kernel,
            window=window,
            channels=channels,
            weight_bytes=weight.size if weight is not None else 0,
            constant_shape=None if operand is None else operand.shape,
            attributes=node.attributes,
            follows=kind_by_name.get(sources[0]) if sources else None,
            integer=integers.is_integer(node),
            scales={role: scales[0] for role, scales in formats.items() if scales},
            disputed={role: scales for role, scales in formats.items() if len(scales) > 1},
            constants=integers.numbers(node),
        )
        operation = replace(operation, out_shape=out_shape(operation, node, graph.constants))
        shape_of |= dict.fromkeys(outputs, operation.out_shape)
        kind_by_name |= dict.fromkeys(outputs, kind)
        operations.append(operation)
    network_outputs = tuple(map(integers.resolve, graph.outputs))
    return SizedGraph(tuple(operations), inputs, network_outputs, integers.present)


def _is_activation(graph: OnnxGraph, node: Node, integers: Integers) -> bool:
    """Return True for the activations of integer files and banks.

    These are max(q, zero point), which is the ReLU of integers, Clip from 0 to 6, which is ReLU6,
    and the Clip of a bank at the limits where int8 saturates.
    """
    values = [graph.value(node, k) for k in range(1, len(node.inputs))]
    constants = [value for value in values if value is not None]
    if node.op_type == "Max":
        return integers.is_integer(node) and len(constants) == len(values) == 1
    # A limit that is no single constant cannot be ReLU6, and is left out: the lists then differ.
    limits = [float(value.ravel()[0]) for value in constants if value.size == 1]
    return node.op_type == "Clip" and limits in ([0.0, 6.0], *BANK_ENDS)


def _window(
    node: Node, weight: np.ndarray | None, shapes: Sequence[Shape | None]
) -> tuple[Sides, Window]:
    # The window of a global pool is its whole map.
    size = shapes[0][1:] if shapes and shapes[0] else (0, 0)
    if "Global" in node.op_type:
        return size if any(size) else (1, 1), Window()
    return node.window(() if weight is None else weight.shape[2:], size) or ((1, 1), Window())


def _channels(
    node: Node, weight: np.ndarray | None, shapes: Sequence[Shape | None]
) -> tuple[int, int]:
    if weight is None:
        channels = shapes[0][0] if shapes and shapes[0] else 0
        return channels, channels
    first = weight.shape[0]
    second = weight.shape[1] * int(node.attributes.get("group", 1))
    # ONNX stores the input channels first for ConvTranspose, and the output channels for Conv.
    return (first, second) if node.op_type == "ConvTranspose" else (second, first)
