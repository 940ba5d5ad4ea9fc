"""What `check` says of a board with an NPU, of which AMD publishes a table of operators, Y or N/A, and no limits.

Where a node would run is the table's word: nothing here has seen the compiler. The rules of nodes stand with those of
the DPUs; here is what is said beside them, and what a VINT8 file must keep as a whole.
"""

from collections.abc import Callable

import numpy as np
import onnx

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.placement import PlacedNode, Placement
from beers_deploy.profiles.figures import Check
from beers_deploy.quant.encodings.description import KEY
from beers_deploy.quant.onnx_file import is_quantised, metadata


def words_of(node: PlacedNode, placement: Placement, dpu: Dpu) -> str:
    """On which device a node would be computed, as far as the table says."""
    if node.device == "host":
        return "host"
    if node.broken:
        return "refused"
    if _is_island(node, placement):
        return "float, BF16 by the compiler's default"
    return "NPU by AMD's table" if node.op.op_type in dpu.target.npu["int8"].value else "not read in AMD's table"


def unread(placement: Placement, dpu: Dpu) -> str:
    """Operators that the part of AMD's table that was read does not have."""
    core = {op.op_type for op in placement.core if op.kind not in ("quantise", "dequantise")}
    names = sorted(core - {*dpu.target.npu["int8"].value})
    return f"{', '.join(names)}: not in the part of AMD's table that was read, look there" if names else ""


def depthwise(placement: Placement, dpu: Dpu) -> str:  # noqa: ARG001 - every remark takes both
    """Depthwise convolutions are legal and slow: AMD's YOLOX-nano has them rewritten as dense ones (Vitis AI 6.3)."""
    count = sum(op.kind == "depthwise" for op in placement.core)
    return f"{count} depthwise convolutions, legal but slow: AMD's YOLOX-nano has dense ones instead" if count else ""


def float_islands(placement: Placement, dpu: Dpu) -> str:  # noqa: ARG001
    """What a quantised file leaves in float is computed in BF16 (Xilinx/ross-ai-assistant, vai-fe-args)."""
    names = [node.op.name for node in placement.nodes if _is_island(node, placement)]
    return f"{', '.join(names)}: left in float between integers; keep few such, at the ends" if names else ""


def unknown(placement: Placement, dpu: Dpu) -> str:  # noqa: ARG001
    """AMD publishes no limits of kernels, strides, channels or sizes for VINT8 (UG1787 6.2)."""
    return "no limits published: whether it compiles, fits the memory or stays in one part only AMD's compiler says"


NOTES: tuple[Callable[[Placement, Dpu], str], ...] = (unread, depthwise, float_islands, unknown)


def notes_on(placement: Placement, dpu: Dpu) -> dict[str, str]:
    """What to know besides the rules, by name."""
    found = {note.__name__: note(placement, dpu) for note in NOTES}
    return {name: text for name, text in found.items() if text}


def _is_island(node: PlacedNode, placement: Placement) -> bool:
    op, weight = node.op, node.op.constants.get("weight")
    in_float = not op.integer or (weight is not None and weight.dtype == np.float32)
    return not placement.note and node.device == "DPU" and op.kind != "dequantise" and in_float


def file_checks(model: onnx.ModelProto, dpu: Dpu) -> list[Check]:
    """What a VINT8 file must keep as a whole; none of a float file or a host's, which no compiler is given."""
    if not is_quantised(model) or KEY in metadata(model):
        return []
    opset = max(each.version for each in model.opset_import if each.domain in ("", "ai.onnx"))
    most, named = dpu.limit("file", "opset_max"), [*model.graph.input, *model.graph.output]
    sides = [f"{v.name} {d.dim_param}" for v in named for d in v.type.tensor_type.shape.dim if not d.dim_value]
    return [
        Check("opset", opset, most.low, "opset", detail=most.source),
        Check("sizes left open", len(sides), 0, "size", detail=", ".join(sides)),
    ]
