"""From an ONNX file to the DPU's short list of operations, whichever of three encodings it uses.

1. float: Conv, Relu, Add.
2. integer kernels: QLinearConv, com.microsoft QLinearAdd, Relu (or Max with the zero point), float host nodes around.
3. QDQ: QuantizeLinear and DequantizeLinear around float operators. The pairs are notation: they are dissolved, and
   only those at the border, which really convert, stay as operations.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from beers_deploy.dpu.graph import Kind, Network, Operation, Shape, Window, out_shape, padding
from beers_deploy.dpu.integers import Integers
from beers_deploy.model.bank import LARGEST
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.encodings import BORDER_PX, PLACE_PX, as_on_board
from beers_deploy.quant.graph.trials import with_shuffles
from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.quant.untrusted import contradictions

POOLS = ("AveragePool", "GlobalAveragePool")
OPERATORS: dict[Kind, tuple[str, ...]] = {
    "conv": ("Conv", "QLinearConv"),
    "transposed": ("ConvTranspose",),
    "add": ("Add", "QLinearAdd"),
    "mul": ("Mul", "QLinearMul"),
    "concat": ("Concat", "QLinearConcat"),
    "pad": ("Pad",),
    "resize": ("Resize", "Upsample"),
    "pixel shuffle": ("DepthToSpace", "SpaceToDepth"),
    "argmax": ("ArgMax",),
    "quantise": ("QuantizeLinear",),
    "dequantise": ("DequantizeLinear",),
    "activation": ("Relu", "LeakyRelu", "QLinearLeakyRelu", "PRelu", "HardSigmoid", "HardSwish"),
    "pool": ("MaxPool", *POOLS, *(f"QLinear{pool}" for pool in POOLS), "GlobalMaxPool"),
}
KINDS: dict[str, Kind] = {op_type: kind for kind, op_types in OPERATORS.items() for op_type in op_types}


BANK_ENDS = [float(np.float32(-LARGEST)), float(np.float32(LARGEST))]
"""Of the planes of a float network behind a bank."""

PLACE_MAX_PX = 64
"""Beyond what any network rearranges: a place of more pixels is a damaged file."""


def read_network(path: Path, tile_px: int | None = 640) -> Network:
    """Read an ONNX file as a network for one image with sides of `tile_px`; None is the size that it is fixed to.

    The image is the whole network's: of a core that reads places of 2 x 2 pixels, planes have half of its sides.
    """
    return network_of(load_onnx(path, to_run=False), tile_px, str(path))


def own_tile_px(model: onnx.ModelProto) -> int | None:
    """The side of the tile that a network is fixed to, in pixels of the image; None where it takes any."""
    dims = model.graph.input[0].type.tensor_type.shape.dim
    side = max((d.dim_value for d in dims[2:]), default=0)
    if not side:
        return None
    place_px, border_px = _places(model)
    return side * place_px - 2 * border_px


def _places(model: onnx.ModelProto) -> tuple[int, int]:
    """What a board's file says of its planes: a place's side in pixels, and how far they reach beyond the image."""
    found = []
    for key, least in ((PLACE_PX, 1), (BORDER_PX, 0)):
        found.append(int(metadata(model).get(key, least)))
        if not least <= found[-1] <= PLACE_MAX_PX:
            raise ValueError(f"{key} {found[-1]}")
    return found[0], found[1]


def network_of(model: onnx.ModelProto, tile_px: int | None, where: str = "ONNX model") -> Network:
    """As `read_network`, of a model in memory; a host's file is read as the board gets it."""
    model = as_on_board(model)
    if not model.graph.node:
        remedy = "give a file written by 'beers-deploy export' or 'beers-deploy quantize'"
        raise ModelError(where, expected="a network", got="an ONNX file without nodes", remedy=remedy)
    with contradictions(where):
        return _Reader(with_shuffles(model), tile_px, where).network()


def inputs_of(model: onnx.ModelProto, tile_px: int | None, where: str = "ONNX model") -> dict[str, Shape]:
    """The inputs of a file as it stands, by name: (C, H, W) in places, for a tile or as the file states them."""
    held = {t.name for t in model.graph.initializer} | {n.output[0] for n in model.graph.node if _constant(n)}
    places = _places(model)
    return {i.name: _input_shape(i, tile_px, places, where) for i in model.graph.input if i.name not in held}


class _Reader:
    """Walks the nodes once, in their topological order, carrying shapes and number formats along."""

    def __init__(self, model: onnx.ModelProto, tile_px: int | None, where: str) -> None:
        graph = model.graph
        self.nodes = list(graph.node)
        self.constants: dict[str, TensorProto] = {t.name: t for t in graph.initializer}
        self.constants |= {n.output[0]: t for n in graph.node for t in _constant(n)}
        self.inputs = inputs_of(model, tile_px, where)
        self.outputs = tuple(o.name for o in graph.output)
        self.shapes: dict[str, Shape | None] = dict(self.inputs)
        self.kinds: dict[str, Kind] = {}
        self.integers = Integers(model, self.constants)

    def network(self) -> Network:
        """The operations, the notation of quantisation dissolved."""
        operations = tuple(op for node in self.nodes for op in self._read(node))
        outputs = tuple(self.integers.resolve(name) for name in self.outputs)
        return Network(operations, self.inputs, outputs, self.integers.present)

    def _read(self, node: onnx.NodeProto) -> Iterator[Operation]:
        if node.op_type == "Constant" or self.integers.is_notation(node):
            return
        weight = self._weight(node)
        kind = "activation" if self._is_activation(node) else _kind(node, weight)
        activations = self.integers.activations(node)
        shapes = tuple(self.shapes.get(name) for name in activations)
        window, channels = _window(node, weight, shapes), _channels(node, weight, shapes)
        shape = out_shape(node, kind, shapes, window, channels[1], self.constants)
        outputs = tuple(self.integers.resolve(name) for name in node.output if name)
        self.shapes |= dict.fromkeys(outputs, shape)
        self.kinds |= dict.fromkeys(outputs, kind)
        yield Operation(
            name=node.name or node.output[0],
            op_type=node.op_type,
            kind=kind,
            inputs=activations,
            outputs=outputs,
            in_shapes=shapes,
            out_shape=shape,
            window=window,
            channels=channels,
            weight_bytes=math.prod(weight.dims) if weight is not None else 0,
            constant_shape=self._constant_shape(node, kind, activations),
            attributes=_attributes(node),
            follows=self.kinds.get(activations[0]) if activations else None,
            integer=self.integers.is_integer(node),
            scales=self.integers.scales(node),
            disputed=self.integers.disputed(node),
            constants=self.integers.constants(node),
        )

    def _weight(self, node: onnx.NodeProto) -> TensorProto | None:
        place = {"Conv": 1, "ConvTranspose": 1, "QLinearConv": 3}.get(node.op_type)
        name = node.input[place] if place is not None and len(node.input) > place else ""
        return self.constants.get(self.integers.resolve(name))

    def _is_activation(self, node: onnx.NodeProto) -> bool:
        """max(q, zero point), the ReLU of integers; Clip from 0 to 6, ReLU6; and a bank's, where int8 saturates."""
        constants = [self.constants[name] for name in node.input[1:] if name in self.constants]
        if node.op_type == "Max":
            return self.integers.is_integer(node) and len(constants) == len(node.input) - 1 == 1
        limits = [float(numpy_helper.to_array(t).ravel()[0]) for t in constants if math.prod(t.dims) == 1]
        return node.op_type == "Clip" and limits in ([0.0, 6.0], BANK_ENDS)

    def _constant_shape(self, node: onnx.NodeProto, kind: Kind, inputs: Sequence[str]) -> tuple[int, ...] | None:
        """Shape of the constant operand of an element-wise operator."""
        if len(inputs) != 1 or (kind not in ("add", "mul") and node.op_type not in ("Sub", "Div")):
            return None
        behind = (self.integers.resolve(name) for name in node.input[: 2 if "QLinear" not in node.op_type else 4])
        found = [self.constants[name] for name in behind if name in self.constants]
        return tuple(found[0].dims) if found else None


def _kind(node: onnx.NodeProto, weight: TensorProto | None) -> Kind:
    kind = KINDS.get(node.op_type, "other")
    if kind != "conv":
        return kind
    groups = int(_number(_attributes(node), "group", 1))
    if groups == 1 or weight is None:
        return "conv"
    return "depthwise" if weight.dims[1] == 1 else "grouped conv"


def _window(node: onnx.NodeProto, weight: TensorProto | None, shapes: tuple[Shape | None, ...]) -> Window:
    given = _attributes(node)
    whole = shapes[0][1:] if "Global" in node.op_type and shapes and shapes[0] else (1, 1)
    kernel = _pair(given, "kernel_shape", weight.dims[2:4] if weight is not None else whole)
    pads = given.get("pads", (0, 0, 0, 0)) if node.op_type != "Pad" else (0, 0, 0, 0)
    top, left, bottom, right = map(int, pads) if isinstance(pads, list | tuple) and len(pads) == 4 else (0, 0, 0, 0)
    stride, dilation = _pair(given, "strides", (1, 1)), _pair(given, "dilations", (1, 1))
    beyond = _pair(given, "output_padding", (0, 0))
    window = Window(kernel, stride, (top, left, bottom, right), dilation, beyond)
    return padding(given, shapes[0] if shapes else None, window)


def _channels(node: onnx.NodeProto, weight: TensorProto | None, shapes: tuple[Shape | None, ...]) -> tuple[int, int]:
    groups = int(_number(_attributes(node), "group", 1))
    if weight is None:
        channels = shapes[0][0] if shapes and shapes[0] else 0
        return channels, channels
    if node.op_type == "ConvTranspose":
        return weight.dims[0], weight.dims[1] * groups
    return weight.dims[1] * groups, weight.dims[0]


def _constant(node: onnx.NodeProto) -> list[TensorProto]:
    return [a.t for a in node.attribute if a.name == "value"] if node.op_type == "Constant" else []


def _attributes(node: onnx.NodeProto) -> dict[str, object]:
    return {a.name: helper.get_attribute_value(a) for a in node.attribute}


def _number(attributes: dict[str, object], key: str, default: int) -> float:
    value = attributes.get(key, default)
    return float(value) if isinstance(value, int | float) else default


def _pair(attributes: dict[str, object], key: str, default: object) -> tuple[int, int]:
    given = attributes.get(key, default)
    values = [int(v) for v in given] if hasattr(given, "__iter__") else []
    return (values[0], values[1]) if len(values) == 2 else (1, 1)


def _input_shape(info: onnx.ValueInfoProto, tile_px: int | None, places: tuple[int, int], where: str) -> Shape:
    """(C, tile, tile) of an input (N, C, H, W), in places; without a tile (C, H, W) as the file states them."""
    sizes = [d.dim_value for d in info.type.tensor_type.shape.dim]
    if len(sizes) != 4 or sizes[1] < 1:
        got, remedy = f"{info.name} {sizes}", "export the network as such"
        raise ModelError(where, expected="inputs (N, C, H, W)", got=got, remedy=remedy)
    if sizes[0] > 1:
        remedy = "export it for any number of images, or for one"
        raise ModelError(where, expected="an input of one image", got=f"{info.name} of {sizes[0]}", remedy=remedy)
    if tile_px is None:
        if not all(sizes[2:]):
            raise ModelError(where, expected="an input of a stated size", got="any size", remedy="give `tile`")
        return sizes[1], sizes[2], sizes[3]
    place_px, border_px = places
    side, beyond = divmod(tile_px + 2 * border_px, place_px)
    if beyond:
        expected, remedy = f"a tile of a multiple of {place_px} px", "choose another `tile`"
        raise ModelError(where, expected=expected, got=f"{tile_px} px", remedy=remedy)
    fixed = {size for size in sizes[2:] if size} - {side}
    if fixed:
        expected = f"an input that takes {tile_px} x {tile_px} pixels"
        got = f"one fixed to {_side_px(sizes[3], places)} x {_side_px(sizes[2], places)}"
        remedy = f"give `tile` {_side_px(min(fixed), places)}, or export it with free sizes"
        raise ModelError(where, expected=expected, got=got, remedy=remedy)
    return (sizes[1], side, side)


def _side_px(size: int, places: tuple[int, int]) -> int | str:
    """A side of the image, from that of an input of such places; any where the file states none."""
    return size * places[0] - 2 * places[1] if size else "any"
