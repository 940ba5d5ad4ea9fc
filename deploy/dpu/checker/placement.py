"""Where each node goes: to the host by design, to the DPU, or to the CPU for want of a rule kept.

A network on this board has three parts:

1. host-front: scaling and splitting the image, before the first convolution.
2. dpu-core: everything from the first convolution to the last, and int8 nodes right behind it.
3. host-back: making numbers of integers, adding the correction to the 12-bit image, clipping.

What of the core the DPU cannot take goes to the CPU, as the vendor's compiler places it. At the
ends of a float file that costs time and no more; between two parts of the DPU it would cut the
core.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Literal

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.operators import Broken, judge, require_known
from beers_deploy.dpu.graph import CONVOLUTIONS, Operation, SizedGraph
from beers_deploy.quant.domains import is_foreign

Part = Literal["host-front", "dpu-core", "host-back"]
Device = Literal["host", "DPU", "CPU"]

SCALING = {"Mul", "Div", "Add", "Sub", "Clip", "Cast", "Round", "Floor", "Identity", "Min", "Max"}
"""What a float file may do to the image before the network and to the result behind it."""

SHAPING = {
    "ArgMax",
    "DepthToSpace",
    "Flatten",
    "Gather",
    "NonMaxSuppression",
    "Reshape",
    "Sigmoid",
    "Slice",
    "Softmax",
    "Split",
    "Squeeze",
    "TopK",
    "Transpose",
    "Unsqueeze",
}
"""What a float file may do to the result behind the network: it moves numbers, compares them or
makes scores of them.
"""

DECODING = {"Exp", "Pow", "Sigmoid", "Slice", "Softplus", "Split", "Sqrt", "Tanh", "Transpose"}
"""What it may do to make boxes of the result, which `quantize` leaves to the host too."""

FLOAT_NOTE = "a float file: judged as if its tensors had 8 bits, its final add left to the host"


@dataclass(frozen=True)
class PlacedNode:
    """A node with its part, its device and, where it should run on the DPU and cannot, the rules it
    breaks.
    """

    op: Operation
    part: Part
    device: Device
    broken: tuple[Broken, ...]
    subgraph: int


@dataclass(frozen=True)
class Cut:
    """A tensor that crosses between the DPU and a processor, as int8; its size None where its shape
    is unknown.
    """

    tensor: str
    size_bytes: int | None
    onto_dpu: bool


@dataclass(frozen=True)
class Placement:
    """The nodes in order; note says what was assumed."""

    nodes: tuple[PlacedNode, ...]
    cuts: tuple[Cut, ...]
    note: str

    @property
    def dpu_subgraphs(self) -> int:
        """How many subgraphs the DPU runs, each with its own transfers."""
        return len({node.subgraph for node in self.nodes if node.device == "DPU"})

    @property
    def failed(self) -> tuple[PlacedNode, ...]:
        """The nodes that should run on the DPU and cannot."""
        return tuple(node for node in self.nodes if node.broken)

    @property
    def cutting(self) -> tuple[PlacedNode, ...]:
        """Those of them that part the core in two; of a quantised file all, whose numbers can be
        made again.
        """
        if not self.note:
            return self.failed
        operations = tuple(node.op for node in self.nodes)
        starts = {node.op.output for node in self.nodes if node.device == "DPU"}
        behind, before = (
            _reached(operations, starts, forwards=forwards) for forwards in (True, False)
        )
        return tuple(node for node in self.failed if node.op.output in behind & before)

    @property
    def core(self) -> tuple[Operation, ...]:
        """The operations that the DPU runs."""
        return tuple(node.op for node in self.nodes if node.device == "DPU")


def place(network: SizedGraph, dpu: Dpu) -> Placement:
    """Judge every node of a network against the rules of a DPU."""
    # A misspelt constant would silence the rule that it is for.
    require_known(dpu)
    parts = _parts(network)
    pairs = zip(network.operations, parts, strict=True)
    broken = [judge(op, dpu, network.quantized) if part == "dpu-core" else () for op, part in pairs]
    # In a float file a cut at an end costs time and no more.
    if not network.quantized:
        parts = _left_to_the_host(network, parts, broken)
    devices: list[Device] = []
    for part, rules in zip(parts, broken, strict=True):
        on_core: Device = "CPU" if rules else "DPU"
        devices.append(on_core if part == "dpu-core" else "host")
    subgraphs = _subgraphs(network.operations, devices)
    nodes = tuple(map(PlacedNode, network.operations, parts, devices, broken, subgraphs))
    return Placement(nodes, tuple(_cuts(network, nodes)), "" if network.quantized else FLOAT_NOTE)


def _parts(network: SizedGraph) -> list[Part]:
    """A node before the first or behind the last convolution is the host's if it is one of the
    host's kinds.
    """
    operations = network.operations
    behind, before = (
        _reached(operations, _convolved(network), forwards=forwards) for forwards in (True, False)
    )
    parts: list[Part] = []
    finished: set[str] = set()
    for op in operations:
        leads = op.output not in behind
        trails = op.output not in before
        # What no processor here computes is not the host's either.
        if is_foreign(op.op_type):
            parts.append("dpu-core")
        elif leads and _is_host_front(op, network, trails=trails):
            parts.append("host-front")
        elif trails and (_is_host_back(op, network, leads=leads) or finished & set(op.inputs)):
            parts.append("host-back")
            finished |= set(op.outputs)
        else:
            parts.append("dpu-core")
    return parts


def _left_to_the_host(
    network: SizedGraph, parts: list[Part], broken: list[tuple[Broken, ...]]
) -> list[Part]:
    """Behind the last convolution, what reads a result of the CPU stays with it: it is not handed
    over again.
    """
    before = _reached(network.operations, _convolved(network), forwards=False)
    cpu_results: set[str] = set()
    moved: list[Part] = []
    for op, part, rules in zip(network.operations, parts, broken, strict=True):
        trails = op.output not in before
        follows = trails and not rules and part == "dpu-core" and bool(cpu_results & set(op.inputs))
        moved.append("host-back" if follows else part)
        if trails and (rules or follows):
            cpu_results |= set(op.outputs)
    return moved


def _convolved(network: SizedGraph) -> set[str]:
    convolutions = (op for op in network.operations if op.kind in CONVOLUTIONS)
    return set(chain.from_iterable(op.outputs for op in convolutions))


def _reached(operations: Sequence[Operation], starts: set[str], *, forwards: bool) -> set[str]:
    """The results computed from one of `starts`, these included (forwards), or that one is computed
    from.
    """
    results: set[str] = set()
    for op in operations if forwards else reversed(operations):
        reads = op.inputs if forwards else op.outputs
        if not results.isdisjoint(reads) or not starts.isdisjoint(op.outputs):
            results |= set(op.outputs)
            if not forwards:
                results |= set(op.inputs)
    return results


def _is_host_front(op: Operation, network: SizedGraph, *, trails: bool) -> bool:
    """In a quantised file whatever leads to the core; in a float file scaling, mirroring, and
    pixels to channels.
    """
    # The DPU does not pad by reflection: the host mirrors the image.
    mirrors = (
        op.op_type == "Pad"
        and op.inputs[0] in network.inputs
        and op.attributes.get("mode") == "reflect"
    )
    moves = (op.op_type == "SpaceToDepth" or mirrors) and not trails
    return network.quantized or op.op_type in SCALING or moves


def _is_host_back(op: Operation, network: SizedGraph, *, leads: bool) -> bool:
    """In a quantised file what is float again; in a float file the add of the image, scaling,
    shaping.
    """
    if op.kind in CONVOLUTIONS:
        return False
    if network.quantized:
        return not op.integer and (op.kind == "dequantize" or op.op_type in SCALING)
    if op.op_type in SHAPING | DECODING:
        return not leads
    return op.op_type in SCALING and (
        bool(set(op.inputs) & set(network.inputs)) or len(op.inputs) == 1
    )


def _subgraphs(operations: tuple[Operation, ...], devices: list[Device]) -> list[int]:
    """Pieces that run in one go: neighbours on one device that no other device's node stands
    between.
    """
    depth: dict[str, tuple[bool, int]] = {}
    parents: dict[str, str] = {}
    for op, device in zip(operations, devices, strict=True):
        on_dpu = device == "DPU"
        # A level counts the changes of device on the way here: what comes back to the DPU has
        # another level than what left it, so that the two are never one piece.
        levels = (depth[name] for name in op.inputs if name in depth)
        steps = [changes + (was_on_dpu != on_dpu) for was_on_dpu, changes in levels]
        level = (on_dpu, max(steps, default=0))
        depth |= dict.fromkeys(op.outputs, level)
        for name in (*(name for name in op.inputs if depth.get(name) == level), *op.outputs):
            parents[_root(parents, name)] = _root(parents, op.output)
    numbers: dict[str, int] = {}
    return [numbers.setdefault(_root(parents, op.output), len(numbers)) for op in operations]


def _root(parents: dict[str, str], name: str) -> str:
    """The tensor that stands for all of a piece."""
    root = name
    while parents.get(root, root) != root:
        root = parents[root]
    # The way is walked once: in a long chain each node would walk all of it again.
    while name != root:
        parent = parents[name]
        parents[name] = root
        name = parent
    return root


def _cuts(network: SizedGraph, nodes: Iterable[PlacedNode]) -> Iterable[Cut]:
    """Tensors written on one side and read on the other, the network's own ends included."""
    on_dpu: dict[str, bool] = {}
    for node in nodes:
        on_dpu |= dict.fromkeys(node.op.outputs, node.device == "DPU")
    readers: dict[str, set[bool]] = {}
    sizes = {name: shape[0] * shape[1] * shape[2] for name, shape in network.inputs.items()}
    for node in nodes:
        for name in node.op.inputs:
            readers.setdefault(name, set()).add(node.device == "DPU")
        if node.op.out_shape is not None:
            sizes |= dict.fromkeys(node.op.outputs, node.op.out_bytes)
    # The host reads the network's results.
    for name in network.outputs:
        readers.setdefault(name, set()).add(False)
    for name, sides in readers.items():
        written_on_dpu = on_dpu.get(name, False)
        if (not written_on_dpu) in sides:
            yield Cut(name, sizes.get(name), onto_dpu=not written_on_dpu)
