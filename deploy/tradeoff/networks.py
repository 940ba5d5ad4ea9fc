"""The networks of a study: shipped ones by name, the user's by file."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import onnx

from deploy.counterpart import is_quantised
from deploy.defaults import float_model
from model.convbeers import VARIANTS
from model.shipped import SHIPPED, shipped_names, shipped_weights
from profiles.errors import OptionError
from quant.onnx_file import fixed_tile_px, load_onnx, metadata

PAPER = VARIANTS["convbeers"]
"""The paper's network: 16 blocks of 64 features."""


@dataclass(frozen=True)
class Network:
    """A network in the precisions in which it is at hand.

    Attributes:
        name: what it is listed under.
        float_file: weights or ONNX in float32; None where only INT8 is given.
        int8_file: INT8 ONNX; None where it is yet to be made.
        given: precision of the INT8 file, "INT8 legal" unless the file says otherwise.
    """

    name: str
    float_file: Path | None
    int8_file: Path | None
    given: str = "INT8 legal"

    def model(self) -> onnx.ModelProto:
        """The float network as ONNX, or the INT8 one where that is all there is."""
        return float_model(self.float_file) if self.float_file else load_onnx(self.int8_file or Path())


def find_networks(names: Iterable[str]) -> list[Network]:
    """Networks by shipped name or file, each once.

    Raises:
        OptionError: neither a shipped name nor a file of weights, two files of one name, or a model of one tile size.
        ModelError: a file that is no network.
    """
    found: dict[str, Network] = {}
    for name in dict.fromkeys(each.strip() for each in names):
        network = _network(name)
        if network.name in found:
            raise OptionError("--networks", expected="names that differ", got=repr(name), remedy="rename one file")
        found[network.name] = network
    return list(found.values())


def _network(name: str) -> Network:
    path = Path(name)
    if name in shipped_names():
        int8 = SHIPPED / f"{name}-int8.onnx"
        return Network(name, shipped_weights(name), int8 if int8.is_file() else None)
    if path.suffix not in (".onnx", ".safetensors"):
        expected = f"a shipped network ({', '.join(shipped_names())}) or an ONNX or safetensors file"
        raise OptionError("--networks", expected=expected, got=repr(name), remedy="correct that name")
    model = float_model(path)
    if fixed_tile_px(model):
        got, remedy = f"{name} for one tile size", "export it without --tile"
        raise OptionError("--networks", expected="networks for images of any size", got=got, remedy=remedy)
    if is_quantised(model):
        precision = metadata(model).get("precision", "int8 legal").replace("int8", "INT8")
        return Network(path.stem, None, path, precision)
    return Network(path.stem, path, None)


def shape_of(model: onnx.ModelProto) -> tuple[int, int]:
    """Residual blocks and features of a ConvBEERS, from its convolutions: head, two a block, body's end, tail."""
    weights = conv_weights(model)
    return (len(weights) - 3) // 2, weights[0][0] if weights else 0


def is_papers(model: onnx.ModelProto) -> bool:
    """Whether a network has the paper's shape."""
    return shape_of(model) == (PAPER.blocks, PAPER.features)


def operations_per_px(model: onnx.ModelProto) -> int:
    """Operations of the convolutions for each pixel, a product and its sum counting as two."""
    return 2 * sum(math.prod(shape) for shape in conv_weights(model))


def conv_weights(model: onnx.ModelProto) -> list[tuple[int, ...]]:
    """Shapes of the convolutions' weights, in order."""
    sizes = {tensor.name: tuple(tensor.dims) for tensor in model.graph.initializer}
    place = {"Conv": 1, "QLinearConv": 3}
    named = [node.input[place[node.op_type]] for node in model.graph.node if node.op_type in place]
    return [sizes[name] for name in named if name in sizes]
