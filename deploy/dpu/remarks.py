"""What breaks no rule and yet surprises on the board: one remark, one small function, its docstring the text."""

import math
from collections.abc import Callable

from deploy.dpu.board import Dpu
from deploy.dpu.placement import Placement

Remark = Callable[[Placement, Dpu, int], str | None]
"""Looks at a placed network, the DPU and the tile's side; None where there is nothing to say."""


def fix2float(placement: Placement, dpu: Dpu, tile_px: int) -> str | None:  # noqa: ARG001 - every remark takes all three
    """The DPU's results are int8: the last conversion, fix2float, runs on the CPU (Vitis-AI 3.0, xcompiler)."""
    leaving = [cut.tensor for cut in placement.cuts if not cut.onto_dpu]
    if not leaving:
        return None
    return f"what leaves the DPU is int8 ({', '.join(leaving)}); making it float runs on the CPU, for every tile"


def pieces(placement: Placement, dpu: Dpu, tile_px: int) -> str | None:  # noqa: ARG001
    """Every DPU subgraph is started by the CPU, and its maps cross memory both ways (Vitis-AI 3.0, xcompiler)."""
    count = placement.dpu_subgraphs
    return None if count < 2 else f"{count} DPU subgraphs: the CPU starts each, and carries maps between them"


def streaming(placement: Placement, dpu: Dpu, tile_px: int) -> str | None:
    """A map above {memory[feature_map_bytes].low:.0f} bytes streams through memory, at every layer (PG389 1.3)."""
    room = dpu.whole("memory", "feature_map_bytes")
    sizes = [op.out_bytes for op in placement.core if op.out_shape is not None]
    large = [size for size in sizes if size > room]
    if not large:
        return None
    kept_px = math.isqrt(room * tile_px * tile_px // max(large))
    return (
        f"{len(large)} of {len(sizes)} maps exceed {room / 2**20:g} MiB, the largest has {max(large) / 1e6:.1f} MB: "
        f"they stream through memory; tiles of {kept_px} px and less would keep every map on chip"
    )


REMARKS: tuple[Remark, ...] = (fix2float, pieces, streaming)


def remarks_on(placement: Placement, dpu: Dpu, tile_px: int) -> dict[str, str]:
    """Every remark that a placed network calls for, by name."""
    found = {remark.__name__: remark(placement, dpu, tile_px) for remark in REMARKS}
    return {name: text for name, text in found.items() if text is not None}
