"""Describe a core in the metadata of a host's file: the operations and scales, without weights and
biases.

An operation such as a transposed convolution is several nodes there. When the file is written again
from the description and its own weights, all nodes must be the same
(`quant.encodings.encoding_faults`).
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from beers_deploy.profiles.errors import ModelError, reason_of
from beers_deploy.quant.core import IntConv, IntCore
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
from beers_deploy.quant.host_part import host_part_from_json, host_part_to_json
from beers_deploy.quant.untrusted import DAMAGE

KEY = "core"
SENSOR_BIASES = "family"
"""The metadata key of the biases by which a file is conditioned on a sensor."""
PLACE_PX = "place_px"
"""The metadata key in a board's file of the side in pixels of the square of the image that is one
place of its planes; 1 if it is missing.
"""
BORDER_PX = "border_px"
"""The metadata key of the number of pixels by which the planes extend beyond the image on each
side; 0 if it is missing.
"""
LARGEST = 1 << 16
"""The limit of channels, windows, strides and factors; those of every DPU network are smaller."""
HOST_PART = "ends"
"""The key of the host's part in the description."""
KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (IntConv, Add, Mul, Concat, MaxPool, AveragePool, Resize, Shuffle, Pointwise)
}


def describe(core: IntCore) -> str:
    """Describe a core as JSON for the metadata of its file, without weights and biases."""
    ops = []
    for op in core.ops:
        fields = {"kind": type(op).__name__, **asdict(op)}  # type: ignore[arg-type]
        if isinstance(op, IntConv):
            fields |= {"weight": list(op.weight.shape), "bias": len(op.bias)}
        ops.append(fields)
    return json.dumps(
        {
            "ops": ops,
            "frac_bits": dict(core.frac_bits),
            HOST_PART: host_part_to_json(core.host_part),
        },
        sort_keys=True,
    )


def described_core(text: str, constants: Mapping[str, np.ndarray]) -> IntCore:
    """Build the core that a file describes, with weights and biases from the file's constants.

    Args:
        text: the JSON that `describe` returned.
        constants: the constants of the file, by name.

    Raises:
        ModelError: the description is damaged, or does not fit the constants.
    """
    try:
        description = json.loads(text)
        # Offsets are values, which may be of any size; every other number is bounded.
        _require_small({**description, HOST_PART: {**description[HOST_PART], "offsets": []}})
        frac_bits = {str(name): int(bits) for name, bits in description["frac_bits"].items()}
        ops = tuple(_op(dict(op), frac_bits, constants) for op in description["ops"])
        return IntCore(ops, frac_bits, host_part_from_json(description[HOST_PART]))
    except DAMAGE as error:
        raise ModelError(
            f"The metadata {KEY!r} of the INT8 network, which describe its integers, are damaged "
            f"({type(error).__name__}: {reason_of(error)}). Quantise the network again."
        ) from error


def _require_small(value: object) -> None:
    """Raise ValueError if a number is large enough to make an object of absurd size."""
    parts: Iterable[object] = ()
    if isinstance(value, dict):
        parts = value.values()
    elif isinstance(value, list):
        parts = value
    for part in parts:
        _require_small(part)
    if isinstance(value, int | float) and not abs(value) <= LARGEST:
        raise ValueError(f"a size of {value}")


def _op(
    fields: dict[str, Any], frac_bits: Mapping[str, int], constants: Mapping[str, np.ndarray]
) -> IntConv | Op:
    kind = KINDS[fields.pop("kind")]
    if "window" in fields:
        fields["window"] = Window(**{key: tuple(value) for key, value in fields["window"].items()})
    if "activation" in fields:
        fields["activation"] = Activation(fields["activation"])
    for key in ("inputs", "kernel"):
        if key in fields:
            fields[key] = tuple(fields[key])
    if kind is IntConv:
        shift = fields["weight_frac_bits"] + frac_bits[fields["input"]] - fields["bias_frac_bits"]
        bias = constants[f"{fields['name']}.bias"].ravel()[: fields["bias"]].astype(np.int64)
        weight = constants[f"{fields['name']}.weight"]
        if fields["transposed"]:
            weight = of_phases(weight, tuple(fields["weight"]), fields["window"].strides[0])
        # The file holds the bias at the accumulator's scale, the core at its own, in int8.
        fields["weight"] = weight.reshape(fields["weight"])
        fields["bias"] = (bias >> shift).astype(np.int8)
    op: IntConv | Op = kind(**fields)
    return op


def phases(weight: np.ndarray, stride: int) -> tuple[np.ndarray, int]:
    """Rearrange the weights of a transposed convolution into those of a convolution with stride^2
    times as many channels.

    Output row q stride + f reads x[q - j] w[f + stride j]: a convolution over rows q - J + 1 .. q
    for each phase f, 0 <= f < stride. The phases come first in the channels, as ONNX's DepthToSpace
    requires, which then puts them side by side.

    Args:
        weight: (O, I, kh, kw) of the transposed convolution.
        stride: its stride in rows and columns.

    Returns:
        The weights (stride^2 O, I, J, J), and their padding, J - 1.
    """
    outputs, inputs, *kernel = weight.shape
    reach = max(-(-k // stride) for k in kernel)
    padded = np.zeros((outputs, inputs, reach * stride, reach * stride), weight.dtype)
    padded[:, :, : kernel[0], : kernel[1]] = weight
    # Reversed, because w[f + stride j] meets x[q - j], and a convolution's taps go the other way.
    taps = padded.reshape(outputs, inputs, reach, stride, reach, stride)[:, :, ::-1, :, ::-1]
    by_phase = np.ascontiguousarray(taps.transpose(3, 5, 0, 1, 2, 4))
    return by_phase.reshape(-1, inputs, reach, reach), reach - 1


def of_phases(weight: np.ndarray, shape: tuple[int, ...], stride: int) -> np.ndarray:
    """Return the weights of a transposed convolution from those that `phases` returned: the inverse
    of it.

    Args:
        weight: (stride^2 O, I, J, J).
        shape: (O, I, kh, kw) of the result.
        stride: the stride in rows and columns.
    """
    outputs, inputs, rows, columns = shape
    reach = weight.shape[2]
    taps = weight.reshape(stride, stride, outputs, inputs, reach, reach).transpose(2, 3, 4, 0, 5, 1)
    padded = taps[:, :, ::-1, :, ::-1].reshape(outputs, inputs, reach * stride, reach * stride)
    return np.ascontiguousarray(padded[:, :, :rows, :columns])
