"""What a host's file says of its core in its metadata: the operations and scales, without weights
and biases.

An operation such as a transposed convolution is several nodes there. Written again from the
description and the file's own weights, all nodes must come out the same
(`quant.encodings.encoding_faults`).
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.ends import Ends
from beers_deploy.quant.graph import (
    Activation,
    Add,
    AveragePool,
    Concat,
    MaxPool,
    Mul,
    Op,
    Pointwise,
    Resize,
    Shuffle,
    Window,
)
from beers_deploy.quant.graph.tail import Tail

KEY = "core"
PLACE_PX = "place_px"
"""In the metadata of a board's file: the side in pixels of the square of the image that is one
place of its planes; 1 where nothing is said.
"""
BORDER_PX = "border_px"
"""Likewise: by how many pixels the planes reach beyond the image on each side; 0 where nothing is
said.
"""
LARGEST = 1 << 16
"""Channels, windows, strides and factors of whatever a DPU runs are smaller still."""
KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (IntConv, Add, Mul, Concat, MaxPool, AveragePool, Resize, Shuffle, Pointwise)
}


def describe(core: IntCore) -> str:
    """The core as JSON, without its arrays."""
    ops = [{"kind": type(op).__name__, **_plain(op)} for op in core.ops]
    return json.dumps(
        {"ops": ops, "frac_bits": dict(core.frac_bits), "ends": asdict(core.ends)}, sort_keys=True
    )


def _plain(op: IntConv | Op) -> dict[str, Any]:
    found = asdict(op)  # type: ignore[arg-type]
    if isinstance(op, IntConv):
        found |= {"weight": list(op.weight.shape), "bias": len(op.bias)}
    return found


def described_core(text: str, constants: Mapping[str, np.ndarray]) -> IntCore:
    """Return the core that a description and the constants of its file make.

    Raises:
        ModelError: metadata that are damaged, or that do not fit the constants.
    """
    try:
        return _described(text, constants)
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        got = f"damaged ones ({type(error).__name__}: {' '.join(str(error).split())[:80]})"
        expected = f"metadata {KEY!r} that describe its integers"
        raise ModelError(
            "INT8 core", expected=expected, got=got, remedy="quantise the network again"
        ) from error


def _described(text: str, constants: Mapping[str, np.ndarray]) -> IntCore:
    said = json.loads(text)
    _require_small({**said, "ends": {**said["ends"], "offsets": []}})  # values, of any size
    frac_bits = {str(name): int(bits) for name, bits in said["frac_bits"].items()}
    ops = tuple(_op(dict(op), frac_bits, constants) for op in said["ops"])
    ends = said["ends"]
    shuffles = {
        key: tuple(Shuffle(**each) for each in ends[key]) for key in ("front", "back", "last")
    }
    offsets = tuple(tuple(float(each) for each in window) for window in ends["offsets"])
    counts = {key: int(ends[key]) for key in ("channels", "planes", "gains", "outputs")}
    tail = Tail(**ends["tail"]) if ends["tail"] else None
    return IntCore(
        ops, frac_bits, Ends(**{**ends, **counts, **shuffles, "offsets": offsets, "tail": tail})
    )


def _require_small(said: object) -> None:
    """Numbers that size something are looked at before anything is made of them."""
    parts: Iterable[object] = ()
    if isinstance(said, dict):
        parts = said.values()
    elif isinstance(said, list):
        parts = said
    for part in parts:
        _require_small(part)
    if isinstance(said, int | float) and not abs(said) <= LARGEST:
        raise ValueError(f"a size of {said}")


def _op(
    said: dict[str, Any], frac_bits: Mapping[str, int], constants: Mapping[str, np.ndarray]
) -> IntConv | Op:
    kind = KINDS[said.pop("kind")]
    if "window" in said:
        said["window"] = Window(**{key: tuple(value) for key, value in said["window"].items()})
    if "activation" in said:
        said["activation"] = Activation(said["activation"])
    for key in ("inputs", "kernel"):
        if key in said:
            said[key] = tuple(said[key])
    if kind is IntConv:
        shift = said["weight_frac_bits"] + frac_bits[said["input"]] - said["bias_frac_bits"]
        whole = constants[f"{said['name']}.bias"].ravel()[: said["bias"]].astype(np.int64)
        weight = constants[f"{said['name']}.weight"]
        if said["transposed"]:
            weight = of_phases(weight, tuple(said["weight"]), said["window"].strides[0])
        said |= {"weight": weight.reshape(said["weight"]), "bias": (whole >> shift).astype(np.int8)}
    op: IntConv | Op = kind(**said)
    return op


def phases(weight: np.ndarray, stride: int) -> tuple[np.ndarray, int]:
    """The weights (stride^2 O, I, J, J) of a transposed convolution's phases, and their padding, J
    - 1.

    Output row q stride + f takes x[q - j] w[f + stride j]: a convolution over rows q - J + 1 .. q
    for each f. The phases come first in the channels, as ONNX's own DepthToSpace wants them.
    """
    outputs, inputs, *kernel = weight.shape
    reach = max(-(-k // stride) for k in kernel)
    padded = np.zeros((outputs, inputs, reach * stride, reach * stride), weight.dtype)
    padded[:, :, : kernel[0], : kernel[1]] = weight
    taps = padded.reshape(outputs, inputs, reach, stride, reach, stride)[:, :, ::-1, :, ::-1]
    return np.ascontiguousarray(taps.transpose(3, 5, 0, 1, 2, 4)).reshape(
        -1, inputs, reach, reach
    ), reach - 1


def of_phases(weight: np.ndarray, shape: tuple[int, ...], stride: int) -> np.ndarray:
    """The weights (O, I, kh, kw) that `phases` made (stride^2 O, I, J, J) of."""
    outputs, inputs, rows, columns = shape
    reach = weight.shape[2]
    taps = weight.reshape(stride, stride, outputs, inputs, reach, reach).transpose(2, 3, 4, 0, 5, 1)
    padded = taps[:, :, ::-1, :, ::-1].reshape(outputs, inputs, reach * stride, reach * stride)
    return np.ascontiguousarray(padded[:, :, :rows, :columns])
