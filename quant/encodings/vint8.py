"""VINT8, the file that AMD's current NPU flow compiles: the numbers of the board's file in another layout.

One image of one tile, every size stated; a pair of Q and DQ for each reader of a tensor; a scale and a zero point of
its own for each tensor; and a pair between an operation and a clamp behind it, which AMD's quantiser writes there
too. On the result's own grid it does not matter whether a value is clamped before it is rounded or after, so no bit
changes. LeakyReLU is no clamp: it stays behind the sums, as the core computes it.

As in the board's file, HardSigmoid, HardSwish and the mean of a window that is no power of two are ONNX's own, and
the host's file has the DPU's approximations of them: there results may differ by a few steps.
"""

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
from onnx import shape_inference

from beers_deploy.model.io.files import write_text
from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings.board import BoardWriter, core_file
from beers_deploy.quant.graph import CORRECTION, PLANES, Activation, Add, Op, Pointwise

CONFIG = "vitisai_config.json"
"""What AMD's compiler reads beside the network."""
CLAMPS = (Activation.relu, Activation.relu6)


def vint8_model(core: IntCore, about: dict[str, str], tile_px: int | None) -> onnx.ModelProto:
    """As `board_model`, of one image with sides of `tile_px`.

    Raises:
        OptionError: no tile.
    """
    side_px = required_tile(tile_px)
    parts = [(part, core.frac_bits[op.output]) for op in core.ops for part in _apart(op)]
    writer = _Writer({PLANES: core.frac_bits[PLANES], **{op.output: bits for op, bits in parts}})
    for op, _ in parts:
        writer.operation(op, [writer.read(name) for name in op.inputs], writer.source(op.output))
    writer.read(CORRECTION, CORRECTION)
    model = core_file(writer, core.ends, about, side_px)
    return shape_inference.infer_shapes(model, strict_mode=True)


def required_tile(tile_px: int | None) -> int:
    """The tile's side, which an NPU's file must be fixed to."""
    if tile_px is None:
        expected, remedy = "a side in pixels: the compiler of an NPU takes stated sizes alone", "give it, such as 640"
        raise OptionError("tile", expected=expected, got="none", remedy=remedy)
    return tile_px


def _apart(op: IntConv | Op) -> Iterator[IntConv | Op]:
    """An operation, and by itself the clamp behind it."""
    if not isinstance(op, IntConv | Add) or op.activation not in CLAMPS:
        yield op
        return
    inner, kind = f"{op.output}.linear", op.activation
    yield replace(op, output=inner, activation=Activation.none)
    yield Pointwise(f"{op.name}.{kind.name}", inner, op.output, kind)


class _Writer(BoardWriter):
    """Writes each tensor once in float, and once more as int8 for each of its readers."""

    def __init__(self, frac_bits: dict[str, int]) -> None:
        super().__init__()
        self._frac_bits = frac_bits
        self._readers = Counter[str]()

    def scale(self, tensor: str, frac_bits: int) -> list[str]:
        """Scale and zero point of a tensor, which no other shares."""
        scale = self.constant(f"{tensor}.scale", np.array(2.0**-frac_bits, np.float32))
        return [scale, self.constant(f"{tensor}.zero_point", np.array(0, np.int8))]

    def source(self, tensor: str) -> str:
        """The name of a tensor in float, before it is rounded."""
        return tensor if tensor == PLANES else f"{tensor}.float"

    def read(self, tensor: str, name: str = "") -> str:
        """One more reader of a tensor: a pair for it alone. Returns the name of what it reads."""
        self._readers[tensor] += 1
        reader, numbers = f"{tensor}.{self._readers[tensor]}", self.scale(tensor, self._frac_bits[tensor])
        middle = self.node("QuantizeLinear", f"{reader}.int8", [self.source(tensor), *numbers])
        return self.node("DequantizeLinear", name or reader, [middle, *numbers])


def save_config(core: Path, device: str) -> Path:
    """Write what AMD's compiler reads beside the file of a core: the device, and for the rest its own defaults."""
    names, vaiml = ("init", "vaiml_partition"), {"device": device, "optimize_level": 2}
    first, second = ({"name": name, "plugin": f"vaip-pass_{name}"} for name in names)
    passes = [first, {**second, "vaiml_config": vaiml}]
    said = {"passes": passes, "target": "VAIML", "targets": [{"name": "VAIML", "pass": [*names]}]}
    write_text(core.with_name(CONFIG), json.dumps(said, indent=1) + "\n")
    return core.with_name(CONFIG)
