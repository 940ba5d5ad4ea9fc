"""`check`: where each node of a network goes, as rows of results and as a few lines.

Of an NPU AMD publishes a table of operators, Y or N/A, and no limits. Where its nodes would run is
the table's word: nothing here has seen the compiler.
"""

from dataclasses import dataclass

import onnx

from beers_deploy.dpu.board import BoardLike, Dpu, ruled
from beers_deploy.dpu.checker.placement import Cut, PlacedNode, Placement, place
from beers_deploy.dpu.checker.remarks import is_island, remarks_on
from beers_deploy.dpu.reading import network_of, own_tile_px
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.figures import Check, Figure, Row, predicted, unavailable
from beers_deploy.profiles.target import DEFAULT_TARGET, TILE_PX, TargetProfile, require_side
from beers_deploy.quant.encodings.description import KEY
from beers_deploy.quant.graph import refusal
from beers_deploy.quant.onnx_file import is_quantised, metadata
from beers_deploy.results import Table

SOURCE = "operator rules of the target profile"
OTHERS_NOTE = "quantised by operators that are not ONNX's: judged without their numbers"


@dataclass(frozen=True, repr=False, kw_only=True)
class Checked(Table):
    """Every node of a network on the host, the DPU or the CPU.

    It is true where the core runs whole on the DPU.

    Attributes:
        placement: the nodes, in order.
        dpu: the board's configuration that was asked.
        tile_px: side of the tile.
        network: that was looked at.
    """

    placement: Placement
    dpu: Dpu
    tile_px: int
    network: Network

    @property
    def failed(self) -> tuple[PlacedNode, ...]:
        """The nodes that should run on the DPU and cannot, with the rules that they break."""
        return self.placement.failed

    @property
    def title(self) -> str:
        """What was asked."""
        return (
            f"{self.network.input.name} on {self.dpu.target.name} {self.dpu.name}, tile "
            f"{self.tile_px}"
        )

    @property
    def lines(self) -> list[str]:
        """What a person wants to know, in a few lines."""
        placement = self.placement
        npu = self.dpu.target.npu
        lines = [] if npu else _crossings(placement)
        lines += [
            f"{name}: {text}"
            for name, text in remarks_on(placement, self.dpu, self.tile_px).items()
        ]
        if placement.note:
            refused = refusal(self.network.model)
            note = OTHERS_NOTE if is_quantised(self.network.model) else placement.note
            lines += [
                note,
                f"'quantize' does not take it: {refused}" if refused else "'quantize' takes it",
            ]
        failed = "; ".join(str(check) for check in self.checks if not check.passed)
        sound = "no rule is broken, not compiled" if npu else "the core runs whole on the DPU"
        return [*lines, f"check FAILED: {failed}" if failed else f"check passed: {sound}"]


def check(
    network: NetworkLike,
    board: BoardLike = DEFAULT_TARGET,
    *,
    dpu: str | None = None,
    tile: int | None = None,
) -> Checked:
    """Place every node of a network on the host, the DPU or the CPU, and say which rules are
    broken.

    Args:
        network: float, INT8 or a board's core, anyone's.
        board: with a DPU or an NPU.
        dpu: configuration of the DPU that the board's file lists; its own default if None.
        tile: side of a tile in pixels; the network's own where it has one, else 640.

    Raises:
        ModelError: no ONNX network of images.
        ProfileError: no such board or configuration.
        OptionError: a board without a DPU or NPU, or a tile of no pixels.

    Examples:
        >>> bool(bd.check("convbeers-xs-int8", "kv260"))
        True
    """
    source = Network.load(network, sensor=SENSOR, to_run=False)
    build = ruled(TargetProfile.load(board), dpu)
    tile_px = own_tile_px(source.model) or TILE_PX if tile is None else require_side(tile)
    placement = place(network_of(source.model, tile_px, source.label), build)
    arguments: dict[str, object] = {"target": build.target.name, "dpu": build.name, "tile": tile_px}
    rows = tuple(_rows(placement, build, tile_px))
    npu = bool(build.target.npu)
    checks = [legality(placement, npu=npu), *(_file_checks(source.model, build) if npu else [])]
    about = ("check", arguments, (source.input,), rows, tuple(checks))
    return Checked(*about, placement=placement, dpu=build, tile_px=tile_px, network=source)


def _rows(placement: Placement, dpu: Dpu, tile_px: int) -> list[Row]:
    """Every node, then the subgraphs, the tensors that cross, what else to know, and the counts."""
    npu = dpu.target.npu
    nodes: list[Row] = []
    for node in placement.nodes:
        nodes += _node_rows(node, placement, dpu)
    texts = remarks_on(placement, dpu, tile_px)
    remarks = [Row("remarks", name, {}, {"remark": text}) for name, text in texts.items()]
    refusals = {"nodes refused": _count(len(placement.failed), "node")}
    # Into which parts an NPU's compiler cuts a network is not known.
    if npu:
        return [*nodes, *remarks, Row("summary", "placement", refusals)]
    parts = {"DPU subgraphs": _count(placement.dpu_subgraphs, "subgraph")}
    summary = Row("summary", "placement", parts | refusals)
    return [*nodes, *_subgraph_rows(placement), *map(_cut_row, placement.cuts), *remarks, summary]


def legality(placement: Placement, *, npu: bool = False) -> Check:
    """The verdict on a network: no node of its core may break a rule.

    What an NPU refuses is not known.
    """
    name = "nodes that break a rule" if npu else "nodes the DPU refuses"
    failed = placement.failed
    first = f"{failed[0].op.name}: {failed[0].broken[0].finding.reason}" if failed else ""
    return Check(name, len(failed), 0, "node", detail=first)


def _file_checks(model: onnx.ModelProto, dpu: Dpu) -> list[Check]:
    """What a VINT8 file must keep as a whole; none of a float file or a host's, which no compiler
    is given.
    """
    if not is_quantised(model) or KEY in metadata(model):
        return []
    # ONNX allows both names for its own domain.
    opset = max(entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx"))
    most = dpu.limit("file", "opset_max")
    tensors = [*model.graph.input, *model.graph.output]
    sides = []
    for tensor in tensors:
        dims = tensor.type.tensor_type.shape.dim
        sides += [f"{tensor.name} {dim.dim_param}" for dim in dims if not dim.dim_value]
    return [
        Check("opset", opset, most.low, "opset", detail=most.source),
        Check("sizes left open", len(sides), 0, "size", detail=", ".join(sides)),
    ]


def _crossings(placement: Placement) -> list[str]:
    pieces = len({node.subgraph for node in placement.nodes})
    lines = [f"device subgraphs: {pieces}, DPU subgraphs: {placement.dpu_subgraphs}"]
    for cut in placement.cuts:
        size = "a size unknown" if cut.size_bytes is None else f"{cut.size_bytes / 1e6:.2f} MB"
        direction = "to" if cut.onto_dpu else "from"
        lines.append(f"{direction} the DPU: {cut.tensor}, {size} an image as int8")
    return lines


def _node_rows(node: PlacedNode, placement: Placement, dpu: Dpu) -> list[Row]:
    words = {"operator": node.op.op_type, "part": node.part, "device": node.device}
    if dpu.target.npu:
        words |= {
            "part": node.part.removeprefix("dpu-"),
            "device": _npu_words(node, placement, dpu),
        }
    if not node.broken:
        return [Row("nodes", node.op.name, {}, words)]
    breaches = [
        {"rule": b.text, "reason": b.finding.reason, "remedy": b.finding.remedy}
        for b in node.broken
    ]
    return [Row("nodes", node.op.name, {}, {**words, **why}) for why in breaches]


def _npu_words(node: PlacedNode, placement: Placement, dpu: Dpu) -> str:
    """On which device of an NPU's board a node would be computed, as far as AMD's table says."""
    if node.device == "host":
        return "host"
    if node.broken:
        return "refused"
    if is_island(node, placement):
        return "float, BF16 by the compiler's default"
    return (
        "NPU by AMD's table"
        if node.op.op_type in dpu.target.npu["int8"].value
        else "not read in AMD's table"
    )


def _subgraph_rows(placement: Placement) -> list[Row]:
    members_of: dict[int, list[PlacedNode]] = {}
    for node in placement.nodes:
        members_of.setdefault(node.subgraph, []).append(node)
    rows = []
    for number, members in members_of.items():
        words = {
            "device": members[0].device,
            "first": members[0].op.name,
            "last": members[-1].op.name,
        }
        figures = {"nodes": _count(len(members), "node")}
        rows.append(Row("subgraphs", f"subgraph {number}", figures, words))
    return rows


def _cut_row(cut: Cut) -> Row:
    unit = "byte/image"
    size = (
        unavailable(unit, "its shape is unknown")
        if cut.size_bytes is None
        else _count(cut.size_bytes, unit)
    )
    return Row(
        "cuts",
        cut.tensor,
        {"size": size},
        {"direction": "onto the DPU" if cut.onto_dpu else "off the DPU"},
    )


def _count(value: int, unit: str) -> Figure:
    return predicted(value, unit, (value, value), SOURCE)
