"""Decide where each node goes: to the host by design, to the DPU, or to the CPU because it breaks a
rule.

A network on this board has three parts:

1. host-front: scaling and splitting the image, before the first convolution.
2. dpu-core: everything from the first convolution to the last, and the int8 nodes that directly
   follow it.
3. host-back: converting integers to numbers, adding the correction to the 12-bit image, clipping.

Nodes of the core that the DPU cannot run go to the CPU, as the vendor's compiler places them. At
the beginning or end of a float file this only costs time. Between two parts of the DPU it would cut
the core.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Literal

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.checker.operators import Broken, broken_rules, require_known_constants
from beers_deploy.dpu.graph import CONVOLUTIONS, Operation, SizedGraph
from beers_deploy.quant.domains import is_foreign
from beers_deploy.quant.graph.ties import united

Part = Literal["host-front", "dpu-core", "host-back"]
Device = Literal["host", "DPU", "CPU"]

SCALING = {"Mul", "Div", "Add", "Sub", "Clip", "Cast", "Round", "Floor", "Identity", "Min", "Max"}
"""Operators that a float file may apply to the image before the network and to the result after
it.
"""

RESULTS = {
    "ArgMax",
    "DepthToSpace",
    "Exp",
    "Flatten",
    "Gather",
    "NonMaxSuppression",
    "Pow",
    "Reshape",
    "Sigmoid",
    "Slice",
    "Softmax",
    "Softplus",
    "Split",
    "Sqrt",
    "Squeeze",
    "Tanh",
    "TopK",
    "Transpose",
    "Unsqueeze",
}
"""Operators that a float file may apply to the result after the network. They move values, compare
them, convert them to scores, or decode boxes. `quantize` leaves them to the host too.
"""

FLOAT_NOTE = "a float file: judged as if its tensors had 8 bits, its final add left to the host"


@dataclass(frozen=True)
class PlacedNode:
    """One operation of a network, and the device that runs it.

    Attributes:
        op: the operation.
        part: the part of the network: the host's before the core, the core, or the host's after it.
        device: "DPU"; "host" if it belongs to the host by design; "CPU" if it belongs to the core,
            but breaks a rule of the DPU.
        broken: the rules that an operation of the core breaks; empty if none.
        subgraph: the number of the subgraph: connected operations that run on one device without a
            transfer in between.
    """

    op: Operation
    part: Part
    device: Device
    broken: tuple[Broken, ...]
    subgraph: int


@dataclass(frozen=True)
class Cut:
    """A tensor that is transferred between the DPU and a processor.

    Attributes:
        tensor: the name of the tensor.
        size_bytes: its size as int8 for one image; None if its shape is unknown.
        onto_dpu: True if the DPU reads it, False if the DPU writes it.
    """

    tensor: str
    size_bytes: int | None
    onto_dpu: bool


@dataclass(frozen=True)
class Placement:
    """The device of each operation of a network.

    Attributes:
        nodes: the operations in the order of the file, each with its device.
        cuts: the tensors that are transferred between the DPU and a processor.
        note: the assumption about a float file; empty for a quantised one.
    """

    nodes: tuple[PlacedNode, ...]
    cuts: tuple[Cut, ...]
    note: str

    @property
    def dpu_subgraphs(self) -> int:
        """The number of parts of the network that the DPU runs without a transfer in between."""
        return len({node.subgraph for node in self.nodes if node.device == "DPU"})

    @property
    def failed(self) -> tuple[PlacedNode, ...]:
        """The nodes that should run on the DPU and cannot."""
        return tuple(node for node in self.nodes if node.broken)

    @property
    def cutting(self) -> tuple[PlacedNode, ...]:
        """The nodes that the DPU cannot run although it must run nodes both before and after them.

        For a quantised file they are all failed nodes, because its integers can be regenerated.
        """
        if not self.note:
            return self.failed
        operations = tuple(node.op for node in self.nodes)
        between = _computed_from(operations, self.core) & _leading_to(operations, self.core)
        return tuple(node for node in self.failed if node.op.output in between)

    @property
    def core(self) -> tuple[Operation, ...]:
        """The operations that the DPU runs."""
        return tuple(node.op for node in self.nodes if node.device == "DPU")


def place(network: SizedGraph, dpu: Dpu) -> Placement:
    """Check every operation of a network against the rules of a DPU, and decide where it runs.

    Args:
        network: the network, for one image size.
        dpu: the device, with the limits of its rules.

    Raises:
        ProfileError: the board's file has a constant that no rule reads, probably misspelt.
    """
    # A misspelt constant would silence the rule that it is for.
    require_known_constants(dpu)
    convolutions = [op for op in network.operations if op.kind in CONVOLUTIONS]
    behind = _computed_from(network.operations, convolutions)
    before = _leading_to(network.operations, convolutions)
    parts = _parts(network, behind, before)
    broken: list[tuple[Broken, ...]] = []
    devices: list[Device] = []
    on_cpu: set[str] = set()
    for number, op in enumerate(network.operations):
        rules = broken_rules(op, dpu, network.quantized) if parts[number] == "dpu-core" else ()
        broken.append(rules)
        if parts[number] != "dpu-core":
            devices.append("host")
            continue
        # After the last convolution of a float file a cut only costs time. A node there that reads
        # a result of the CPU stays on the CPU, so that the tensor is not transferred again.
        trails = not network.quantized and op.output not in before
        follows = trails and not rules and not on_cpu.isdisjoint(op.inputs)
        if follows:
            parts[number] = "host-back"
            devices.append("host")
        else:
            devices.append("CPU" if rules else "DPU")
        if trails and devices[-1] != "DPU":
            on_cpu |= set(op.outputs)
    subgraphs = _subgraphs(network.operations, devices)
    nodes = tuple(map(PlacedNode, network.operations, parts, devices, broken, subgraphs))
    return Placement(nodes, tuple(_cuts(network, nodes)), "" if network.quantized else FLOAT_NOTE)


def _parts(network: SizedGraph, behind: set[str], before: set[str]) -> list[Part]:
    """Return the part of each node. A node before the first or after the last convolution belongs
    to the host if it is of a kind that the host computes.

    Args:
        network: the network.
        behind: the results that are computed from one of a convolution.
        before: the results from which one of a convolution is computed.
    """
    parts: list[Part] = []
    finished: set[str] = set()
    for op in network.operations:
        leads = op.output not in behind
        trails = op.output not in before
        # The host cannot run an operator that no processor here computes.
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


def _computed_from(operations: Sequence[Operation], starts: Iterable[Operation]) -> set[str]:
    """Return the results of some operations, and all results that are computed from these."""
    results = set(chain.from_iterable(op.outputs for op in starts))
    for op in operations:
        if not results.isdisjoint(op.inputs):
            results |= set(op.outputs)
    return results


def _leading_to(operations: Sequence[Operation], ends: Iterable[Operation]) -> set[str]:
    """Return the results of some operations, and all results that these are computed from."""
    results = set(chain.from_iterable(op.outputs for op in ends))
    for op in reversed(operations):
        if not results.isdisjoint(op.outputs):
            results |= {*op.inputs, *op.outputs}
    return results


def _is_host_front(op: Operation, network: SizedGraph, *, trails: bool) -> bool:
    """Return True if a node before the core belongs to the host.

    In a quantised file that is every such node; in a float file scaling, mirroring, pixels to
    channels, and an enlargement of the image that no convolution reads.
    """
    of_image = op.op_type == "Resize" and op.inputs[0] in network.inputs
    enlarges = of_image and trails and op.output not in network.outputs
    # The DPU does not pad by reflection: the host mirrors the image.
    mirrors = (
        op.op_type == "Pad"
        and op.inputs[0] in network.inputs
        and op.attributes.get("mode") == "reflect"
    )
    moves = (op.op_type == "SpaceToDepth" or mirrors) and not trails
    return network.quantized or op.op_type in SCALING or moves or enlarges


def _is_host_back(op: Operation, network: SizedGraph, *, leads: bool) -> bool:
    """Return True if a node after the core belongs to the host.

    In a quantised file that is a node in float; in a float file adding the image, scaling and
    shaping.
    """
    if op.kind in CONVOLUTIONS:
        return False
    if network.quantized:
        return not op.integer and (op.kind == "dequantize" or op.op_type in SCALING)
    if op.op_type in RESULTS:
        return not leads
    return op.op_type in SCALING and (
        bool(set(op.inputs) & set(network.inputs)) or len(op.inputs) == 1
    )


def _subgraphs(operations: Sequence[Operation], devices: Sequence[Device]) -> list[int]:
    """Return the number of the subgraph of each operation: connected operations on one device with
    none of another device between them.
    """
    depth: dict[str, tuple[bool, int]] = {}
    links: list[list[str]] = []
    for op, device in zip(operations, devices, strict=True):
        on_dpu = device == "DPU"
        # A level counts the changes of device up to this node. Nodes after a return to the DPU
        # have another level than those before it, so the two are never one subgraph.
        levels = (depth[name] for name in op.inputs if name in depth)
        steps = [changes + (was_on_dpu != on_dpu) for was_on_dpu, changes in levels]
        level = (on_dpu, max(steps, default=0))
        depth |= dict.fromkeys(op.outputs, level)
        links.append([*op.outputs, *(name for name in op.inputs if depth.get(name) == level)])
    first = united(links)
    numbers: dict[str, int] = {}
    return [numbers.setdefault(first[op.output], len(numbers)) for op in operations]


def _cuts(network: SizedGraph, nodes: Iterable[PlacedNode]) -> Iterable[Cut]:
    """Yield the tensors that are written on one side and read on the other, including the network's
    inputs and outputs.
    """
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
