"""Fixtures of the tests whose results must be the same on every processor.

The whole suite runs them natively, and `.ci/emulate` on emulated processors. No test here starts
another process, which would not be emulated, or needs more than the command `gate` needs.
"""

from dataclasses import dataclass, replace

import numpy as np
import onnx
import pytest

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.encodings import board_model, read_core
from beers_deploy.quant.frac_bits import INT8_MAX, INT8_MIN
from beers_deploy.quant.onnx_file import load_onnx
from tests.shipped import shipped_pair


@dataclass(frozen=True)
class Encodings:
    """A shipped integer network: its core, the host file, and the core in the board's encoding."""

    core: IntCore
    host: onnx.ModelProto
    board: onnx.ModelProto


@pytest.fixture(scope="session", params=["convbeers-xs", "convbeers-s"])
def shipped(request: pytest.FixtureRequest) -> Encodings:
    host = load_onnx(shipped_pair(request.param)[1])
    core = with_int8_bias(read_core(host))
    return Encodings(core, host, board_model(core, {}))


def with_int8_bias(core: IntCore) -> IntCore:
    """Return the core of a host file with the board's int8 biases.

    The host's file aligns every bias to its accumulator.
    """
    return replace(
        core, ops=tuple(_unaligned(op) if isinstance(op, IntConv) else op for op in core.ops)
    )


def _unaligned(op: IntConv) -> IntConv:
    """Undo the alignment: the low bits that no bias of the layer uses are its shift."""
    used = int(np.bitwise_or.reduce(op.bias)) or 1
    shift = (used & -used).bit_length() - 1
    bias = op.bias >> shift
    assert INT8_MIN <= bias.min() <= bias.max() <= INT8_MAX
    return replace(op, bias=bias.astype(np.int8), bias_frac_bits=op.bias_frac_bits - shift)
