"""`check`: a table of where each node of a network runs.

For an NPU, AMD publishes a table of operators, Y or N/A, and no limits. The device of each node
then follows from that table: it was not verified with the compiler.
"""

from collections import Counter, defaultdict
from dataclasses import asdict, dataclass

import onnx

from beers_deploy.dpu.board import Dpu, device_of
from beers_deploy.dpu.checker.placement import PlacedNode, Placement, place
from beers_deploy.dpu.checker.remarks import is_island, remarks_on
from beers_deploy.dpu.reading import sized_graph, usual_tile_px
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.figures import Check, Figure, Row, predicted, unavailable
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.encodings import as_on_board, implicit_parts
from beers_deploy.quant.encodings.description import KEY
from beers_deploy.quant.graph import refusal
from beers_deploy.quant.onnx.image_input import fixed_tile_px
from beers_deploy.quant.onnx_file import is_quantized, metadata
from beers_deploy.results import Table

SOURCE = "operator rules of the target profile"
OTHERS_NOTE = "quantised by operators that are not ONNX's: judged without their numbers"


@dataclass(frozen=True, repr=False, kw_only=True)
class Checked(Table):
    """The result of `check`: the device of every node of a network, and the rules that it breaks.

    The table is true if the DPU (or NPU) can run the whole core, the part of the network that is
    not left to the host by design, and if `quantize` would accept a float network.

    Attributes:
        placement: the nodes in order, each with its device.
        dpu: the DPU configuration or NPU whose rules were checked.
        tile_px: side of the square image in pixels that shapes were computed for.
        network: the network that was checked.
    """

    placement: Placement
    dpu: Dpu
    tile_px: int
    network: Network

    @property
    def refused(self) -> tuple[PlacedNode, ...]:
        """The nodes that should run on the DPU and cannot, with the rules that they break."""
        return self.placement.failed

    @property
    def verdict(self) -> str:
        """A sentence that states whether the device can run the network, and what that rests on."""
        if self.failed:
            return f"check FAILED: {'; '.join(map(str, self.failed))}"
        if self.dpu.target.npu:
            return "check passed: no rule is broken; nothing was compiled"
        if not self.placement.note:
            return "check passed: it fits as it is, the core runs whole on the DPU"
        if any(check.name == ACCEPTED for check in self.checks):
            return "check passed: it fits once 'quantize' has rewritten it to INT8"
        return (
            "check passed: its nodes run on the DPU, but 'quantize' accepts only networks that map "
            "one image to one image"
        )


def check_network(
    network: NetworkLike | None,
    target: TargetProfile,
    dpu: str | None,
    tile: int | None,
    output: str | None = None,
) -> Checked:
    """Check which nodes of a network a board's DPU or NPU can run; the work of `check`.

    Args:
        network: a network in float or INT8, or the integer core of one for a board; the shipped
            convbeers-s-int8 if None.
        target: a board with a DPU or an NPU.
        dpu: the name of the DPU's configuration; the board's default if None.
        tile: side of the square image in pixels; if None, the size that the network is fixed to,
            or 640 or a little more.
        output: the name of the only output to check; all outputs if None.

    Returns:
        The table of `check`.

    Raises:
        ModelError: the file is not an ONNX network of images.
        ProfileError: there is no such configuration.
        OptionError: the target has neither a DPU nor an NPU.
    """
    source = Network.load(network, sensor=SENSOR, int8=True, to_run=False)
    if output is not None:
        source = source.with_output(output)
    build = device_of(target, dpu)
    core = as_on_board(source.model)
    tile_px = usual_tile_px(core) if tile is None else tile
    sized = sized_graph(core, tile_px, source.label)
    placement = place(sized, build)
    quantized = is_quantized(source.model)
    # A float file or a host's file is not for a compiler.
    for_compiler = quantized and KEY not in metadata(source.model)
    rows = _rows(placement, build, tile_px)
    checks = [legality(placement, build)]
    if for_compiler:
        for rule, names in implicit_parts(source.model).items():
            figures = {"count": _count(len(names), "place")}
            rows.append(Row("profile", rule, figures, {"first": "".join(names[:1])}))
        checks += _file_checks(source.model, build) if target.npu else []
    results = [op.out_shape for op in sized.operations if op.output in sized.outputs]
    # A result of unknown shape may be an image.
    makes_image = bool(results) and all(shape is None or min(shape[1:]) > 1 for shape in results)
    if makes_image and not quantized:
        # First, because the inputs of a file that is refused may include weights.
        reason = refusal(source.model)
        try:
            if not reason:
                fixed_tile_px(source.model)
        except ModelError as error:
            reason = str(error)
        checks.append(Check(ACCEPTED, int(bool(reason)), 0, "network", detail=reason))
    # A quantised file whose numbers nobody reads here is placed as if it were in float.
    note = OTHERS_NOTE if placement.note and quantized else placement.note
    return Checked(
        title=f"{source.input.name} on {target.name} {build.name}, tile {tile_px}",
        command="check",
        arguments={"target": target.name, "dpu": build.name, "tile": tile_px},
        inputs=(source.input,),
        rows=tuple(rows),
        checks=tuple(checks),
        notes=tuple(filter(None, [note])),
        headings=HEADINGS,
        details=DETAILS,
        placement=placement,
        dpu=build,
        tile_px=tile_px,
        network=source,
    )


HEADINGS = {
    "devices": "where the nodes run",
    "refusals": "what is refused, by rule",
    "cuts": "tensors that cross between host and DPU",
    "remarks": "also to know",
    "profile": "what the file leaves open by the draft of ONNX's safety-related profile",
}
DETAILS = frozenset({"nodes", "subgraphs", "summary"})
"""Tables with one line for each node, for detailed inspection."""


ACCEPTED = "networks that 'quantize' refuses"


def _rows(placement: Placement, dpu: Dpu, tile_px: int) -> list[Row]:
    """Return all rows: devices, refusals, nodes, subgraphs, crossing tensors, remarks, counts."""
    rows = [*_device_rows(placement, dpu), *_refusal_rows(placement)]
    for node in placement.nodes:
        words = {
            "operator": node.op.op_type,
            "part": node.part.removeprefix("dpu-") if dpu.target.npu else node.part,
            "device": _device(node, placement, dpu),
        }
        whys = [{"rule": breach.text, **asdict(breach.finding)} for breach in node.broken]
        rows += [Row("nodes", node.op.name, {}, words | why) for why in whys or [{}]]
    counts = {"nodes refused": _count(len(placement.failed), "node")}
    # It is not known into which parts an NPU's compiler cuts a network.
    if not dpu.target.npu:
        rows += _part_rows(placement)
        counts = {"DPU subgraphs": _count(placement.dpu_subgraphs, "subgraph")} | counts
    texts = remarks_on(placement, dpu, tile_px)
    rows += [Row("remarks", name, {}, {"remark": text}) for name, text in texts.items()]
    return [*rows, Row("summary", "placement", counts)]


def _part_rows(placement: Placement) -> list[Row]:
    """Return a row for each subgraph, then for each tensor that crosses between two devices."""
    members_of = defaultdict[int, list[PlacedNode]](list)
    for node in placement.nodes:
        members_of[node.subgraph].append(node)
    rows = []
    for number, members in members_of.items():
        first, *_ = members
        words = {"device": first.device, "first": first.op.name, "last": members[-1].op.name}
        figures = {"nodes": _count(len(members), "node")}
        rows.append(Row("subgraphs", f"subgraph {number}", figures, words))
    for cut in placement.cuts:
        size = unavailable("byte/image", "its shape is unknown")
        if cut.size_bytes is not None:
            size = _count(cut.size_bytes, "byte/image")
        words = {"direction": "onto the DPU" if cut.onto_dpu else "off the DPU"}
        rows.append(Row("cuts", cut.tensor, {"size": size}, words))
    return rows


def legality(placement: Placement, dpu: Dpu) -> Check:
    """Summarise a placement as one check, which fails if a node of the core breaks a rule.

    Args:
        placement: where each node runs.
        dpu: the device. AMD publishes no limits of an NPU's compiler, so the name of the check does
            not say that nodes are refused.
    """
    name = "nodes that break a rule" if dpu.target.npu else "nodes the DPU refuses"
    failed = placement.failed
    first = f"{failed[0].op.name}: {failed[0].broken[0].finding.reason}" if failed else ""
    return Check(name, len(failed), 0, "node", detail=first)


def _file_checks(model: onnx.ModelProto, dpu: Dpu) -> list[Check]:
    """Return the checks of a VINT8 file as a whole."""
    # ONNX allows both names for its own domain.
    opset = max(entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx"))
    most = dpu.limit("file", "opset_max")
    sides = []
    for tensor in (*model.graph.input, *model.graph.output):
        dims = tensor.type.tensor_type.shape.dim
        sides += [f"{tensor.name} {dim.dim_param}" for dim in dims if not dim.dim_value]
    return [
        Check("opset", opset, most.low, "opset", detail=most.source),
        Check("sizes left open", len(sides), 0, "size", detail=", ".join(sides)),
    ]


def _device_rows(placement: Placement, dpu: Dpu) -> list[Row]:
    """Return a row for each device: the number of nodes that it runs, and their operators."""
    operators = defaultdict[str, Counter[str]](Counter)
    for node in placement.nodes:
        operators[_device(node, placement, dpu)][node.op.op_type] += 1
    rows = []
    for device, counts in operators.items():
        words = ", ".join(f"{name} {count}" for name, count in counts.most_common())
        figures = {"count": _count(counts.total(), "node")}
        rows.append(Row("devices", device, figures, {"operators": words}))
    return rows


def _refusal_rows(placement: Placement) -> list[Row]:
    """Return a row for each broken rule: the number of nodes, the first one, and a remedy."""
    counts = Counter[str]()
    words: dict[str, dict[str, str]] = {}
    for node in placement.failed:
        for breach in node.broken:
            counts[breach.text] += 1
            first = f"{node.op.name}: {breach.finding.reason}"
            words.setdefault(breach.text, {"first": first, "remedy": breach.finding.remedy})
    return [
        Row("refusals", rule, {"count": _count(count, "node")}, words[rule])
        for rule, count in counts.items()
    ]


def _device(node: PlacedNode, placement: Placement, dpu: Dpu) -> str:
    """Return the device of a node: for an NPU, the one that AMD's table states."""
    if node.device == "host" or not dpu.target.npu:
        return node.device
    if node.broken:
        return "refused"
    if is_island(node, placement):
        return "float, BF16 by the compiler's default"
    if node.op.op_type in dpu.target.npu["int8"].value:
        return "NPU by AMD's table"
    return "not read in AMD's table"


def _count(value: int, unit: str) -> Figure:
    return predicted(value, unit, (value, value), SOURCE)
