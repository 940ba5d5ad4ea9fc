"""What a compiler makes of an operation where the operation as written breaks a rule.

A fully connected layer is a convolution as large as its map, and just as well one of 1 x 1 over the map laid flat: a
matrix product becomes a convolution once that fits the hardware (UG1414 1.4.1, Operators Supported by TensorFlow).
Its outputs do not meet, so they may be computed in parts. That they are is inferred from a rate: Ultrafast lanes'
last layer has 14472 outputs, and at 392 images a second with one thread (Vitis-AI 2.5, model_zoo/README.md, VCK190)
the DPU's batch of six leaves the processor 15 ms for 356 MFLOP, more than its two cores can do.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.graph import Operation, Window


def forms(op: Operation, dpu: Dpu) -> Iterator[Operation]:
    """The operation as it is written, then what else it may be taken as, each to be held against the rules."""
    yield op
    if "array" in dpu.tables and fully_connected(op):  # an NPU's file does not state the array that it would fit
        yield _in_parts(op, dpu)
        yield _in_parts(_flat(op), dpu)


def fully_connected(op: Operation) -> bool:
    """Whether a convolution is as large as its map, and so has a result of one pixel."""
    shape, window = op.in_shapes[0] if op.in_shapes else None, op.window
    return (
        op.kind == "conv"
        and shape is not None
        and window.kernel == shape[1:]
        and window.dilation == (1, 1)
        and not any(window.pads)
    )


def _flat(op: Operation) -> Operation:
    """Over the map laid flat: as many channels as it has values."""
    values = math.prod(op.in_shapes[0] or ())
    return replace(op, in_shapes=((values, 1, 1),), window=Window(), channels=(values, op.channels[1]))


def _in_parts(op: Operation, dpu: Dpu) -> Operation:
    """The largest part, of as many outputs as the DPU takes."""
    outputs = min(op.channels[1], dpu.channels_max)
    return replace(op, channels=(op.channels[0], outputs), out_shape=(outputs, 1, 1))
