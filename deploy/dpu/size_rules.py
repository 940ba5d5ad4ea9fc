"""What a tile's size has to keep, whatever the operator: one rule, one function.

No document states a largest height or width of the DPU's maps; they stream through its banks (see `remarks`).
"""

import math

from deploy.dpu.board import Dpu
from deploy.dpu.finding import Finding, shown
from deploy.dpu.graph import Operation
from profiles.errors import sizes

WINDOWED = {"conv", "grouped conv", "depthwise", "transposed", "pool"}


def map_exists(op: Operation, dpu: Dpu) -> Finding | None:  # noqa: ARG001 - every rule takes the operation and the DPU
    """The tile is large enough for every window: each map keeps at least one pixel (ONNX 1.17, Conv and MaxPool)."""
    before = op.in_shapes[0] if op.in_shapes else None
    if op.kind not in WINDOWED or before is None or op.out_shape is not None:
        return None
    window = f"a kernel of {shown(op.window.kernel)}, stride {shown(op.window.stride)}"
    reason = f"nothing is left of a map of {shown(before[1:])} under {window}"
    return Finding(reason, "use a larger tile, or fewer strides before it")


def maps_aligned(op: Operation, dpu: Dpu) -> Finding | None:  # noqa: ARG001
    """Maps that meet in an add, mul or concat have one height and width, or 1 x 1 (ONNX 1.17, Add and Concat)."""
    sizes = {(shape[1], shape[2]) for shape in op.in_shapes if shape is not None}
    if op.kind not in ("add", "mul", "concat") or len(sizes - {(1, 1)}) < 2:
        return None
    reason = " and ".join(shown(size) for size in sorted(sizes)) + " meet"
    return Finding(
        reason, "use a tile whose side is a multiple of the network's total stride, or pad the smaller map"
    )


def map_in_memory(op: Operation, dpu: Dpu) -> Finding | None:
    """A map, for all images of a batch, fits {tile[memory_bytes].low:.0f} bytes (assumed: the board's LPDDR4)."""
    most = dpu.value("tile", "memory_bytes")
    size = math.prod(op.out_shape) * dpu.batch if op.out_shape else 0
    if size <= most:
        return None
    taken, room = sizes(size, most)
    reason = f"{taken} for {dpu.batch} images, of {room}"
    return Finding(reason, f"use a tile of at most {math.sqrt(most / size):.2f} times this side")
