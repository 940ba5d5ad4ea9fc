"""Remarks on a placed network in addition to the rules. Each remark is one function whose docstring
is its text.
"""

import math
from collections.abc import Callable

import numpy as np

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.placement import PlacedNode, Placement

# ruff: noqa: ARG001 - every remark takes the placement, the DPU and the tile's side

Remark = Callable[[Placement, Dpu, int], str]
"""Checks a placed network, given the DPU and the tile's side, and returns its remark, or "" if
there is none.
"""


def fix2float(placement: Placement, dpu: Dpu, tile_px: int) -> str:
    """The DPU's results are int8: the last conversion, fix2float, runs on the CPU (Vitis-AI 3.0,
    xcompiler).
    """
    leaving = ", ".join(cut.tensor for cut in placement.cuts if not cut.onto_dpu)
    return (
        leaving
        and f"what leaves the DPU is int8 ({leaving}); making it float runs on the CPU, for "
        "every tile"
    )


def subgraphs(placement: Placement, dpu: Dpu, tile_px: int) -> str:
    """Every DPU subgraph is started by the CPU, and its maps cross memory both ways (Vitis-AI 3.0,
    xcompiler).
    """
    count = placement.dpu_subgraphs
    if count < 2:
        return ""
    return f"{count} DPU subgraphs: the CPU starts each, and carries maps between them"


def streaming(placement: Placement, dpu: Dpu, tile_px: int) -> str:
    """A map above {memory[feature_map_bytes].low:.0f} bytes streams through memory, at every layer.

    That is the room of one image on chip ({memory[feature_map_bytes].source}).
    """
    room = dpu.whole("memory", "feature_map_bytes")
    sizes = [op.out_bytes for op in placement.core if op.out_shape is not None]
    large = [size for size in sizes if size > room]
    if not large:
        return ""
    # The size of a map grows with the square of the tile's side.
    side_px = math.isqrt(room * tile_px * tile_px // max(large))
    return (
        f"{len(large)} of {len(sizes)} maps above {room / 2**20:g} MiB, the largest has "
        f"{max(large) / 1e6:.1f} MB: "
        f"they stream through memory; tiles of {side_px} px and less would keep every map on chip"
    )


def shuffles(placement: Placement, dpu: Dpu, tile_px: int) -> str:
    """A pixel shuffle inside compiles, but has given wrong numbers on a board (Vitis-AI issues
    1486, 1199).

    Its inverse as torch writes it, PixelUnshuffle, has run on the CPU.
    """
    names = ", ".join(op.name for op in placement.core if op.kind == "pixel shuffle")
    return (
        names
        and f"{names}: has given wrong numbers on a board; compare the board's results with "
        "this file's"
    )


def unread(placement: Placement, dpu: Dpu, tile_px: int) -> str:
    """Operators that the part of AMD's table that was read does not have."""
    core = {op.op_type for op in placement.core if op.kind not in ("quantize", "dequantize")}
    names = ", ".join(sorted(core - {*dpu.target.npu["int8"].value}))
    return names and f"{names}: not in the part of AMD's table that was read, look there"


def depthwise(placement: Placement, dpu: Dpu, tile_px: int) -> str:
    """Depthwise convolutions are legal and slow: AMD's YOLOX-nano has them rewritten as dense ones
    (Vitis AI 6.3).
    """
    count = sum(op.kind == "depthwise" for op in placement.core)
    if not count:
        return ""
    return (
        f"{count} depthwise convolutions, legal but slow: AMD's YOLOX-nano has dense ones instead"
    )


def float_islands(placement: Placement, dpu: Dpu, tile_px: int) -> str:
    """Float nodes of a quantised file are computed in BF16 (Xilinx/ross-ai-assistant,
    vai-fe-args).
    """
    names = ", ".join(node.op.name for node in placement.nodes if is_island(node, placement))
    return names and f"{names}: left in float between integers; keep few such, at the ends"


def is_island(node: PlacedNode, placement: Placement) -> bool:
    """Return True if a quantised file leaves a node in float between its integer nodes."""
    op = node.op
    weight = op.constants.get("weight")
    in_float = not op.integer or (weight is not None and weight.dtype == np.float32)
    return not placement.note and node.device == "DPU" and op.kind != "dequantize" and in_float


def unknown(placement: Placement, dpu: Dpu, tile_px: int) -> str:
    """AMD publishes no limits of kernels, strides, channels or sizes for VINT8 (UG1787 6.2)."""
    return (
        "no limits published: whether it compiles, fits the memory or stays in one part only "
        "AMD's compiler says"
    )


REMARKS: tuple[Remark, ...] = (fix2float, subgraphs, streaming, shuffles)
"""The remarks for a DPU."""
NPU_REMARKS: tuple[Remark, ...] = (unread, depthwise, float_islands, unknown)


def remarks_on(placement: Placement, dpu: Dpu, tile_px: int) -> dict[str, str]:
    """Return remarks on a network for a reader of `check`, in addition to broken rules.

    Args:
        placement: where each node of the network runs.
        dpu: the DPU configuration or NPU.
        tile_px: side of the square image in pixels.

    Returns:
        The text of each remark that applies, by the name of its function.
    """
    remarks = NPU_REMARKS if dpu.target.npu else REMARKS
    texts = {remark.__name__: remark(placement, dpu, tile_px) for remark in remarks}
    return {name: text for name, text in texts.items() if text}
