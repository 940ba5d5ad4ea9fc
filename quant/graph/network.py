"""A network cut where the DPU's part begins and ends, and whether its operations fit together."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from profiles.errors import ModelError
from quant.graph.operations import CORRECTION, IMAGE, Activation, Add, Concat, Conv, Graph, Mul, Op, Shuffle


@dataclass(frozen=True)
class Network:
    """A float network, cut where the DPU's part begins and ends.

    Attributes:
        graph: from `IMAGE` to `CORRECTION`, what is computed in INT8.
        channels: of the image, before `front`.
        front: what the host does to the image first: pixel unshuffle.
        back: what it does to the correction: pixel shuffle.
        adds_image: whether the image is added to the result (the global add), in the host's float numbers.
        flat: whether the result is (N, K) rather than an image.
    """

    graph: Graph
    channels: int = 1
    front: tuple[Shuffle, ...] = ()
    back: tuple[Shuffle, ...] = ()
    adds_image: bool = True
    flat: bool = False

    @property
    def core_channels(self) -> int:
        """Of what the DPU's part reads."""
        return self.channels * int(np.prod([shuffle.block**2 for shuffle in self.front], initial=1))


def refused_graph(expected: str, got: str, remedy: str = "") -> ModelError:
    """The sentence for a network that cannot be quantised."""
    remedy = remedy or "see docs/commands.md for what 'quantize' takes; 'check' names what a DPU does not run"
    return ModelError("float model", expected=expected, got=got, remedy=remedy)


def cut(graph: Graph, channels: int, flat: bool) -> Network:
    """The network of operations from `IMAGE` to `CORRECTION`: what the host does at both ends is taken off.

    Pixel shuffles there move values and cost the host next to nothing; DPUs have been seen to compute them wrongly.
    """
    last = graph[-1]
    adds_image = isinstance(last, Add) and IMAGE in last.inputs and last.activation is Activation.none
    back: list[Shuffle] = []
    if adds_image:
        graph = _ended(graph[:-1], last.inputs[1 - last.inputs.index(IMAGE)])
    while graph and isinstance(shuffle := graph[-1], Shuffle) and shuffle.up and not _read(graph, CORRECTION):
        back.insert(0, shuffle)
        graph = _ended(graph[:-1], shuffle.input)
    front: list[Shuffle] = []
    while isinstance(first := _only_reader(graph), Shuffle) and not first.up:
        front.append(first)
        graph = tuple(renamed(op, {first.output: IMAGE}) for op in graph if op is not first)
    return Network(graph, channels, tuple(front), tuple(back), adds_image, flat)


def _ended(graph: Graph, name: str) -> Graph:
    """The graph that ends with the tensor of that name."""
    if name == IMAGE or not any(op.output == name for op in graph):
        raise refused_graph("a correction that the network computes", f"{name} of nobody")
    return tuple(renamed(op, {name: CORRECTION}) for op in graph)


def _read(graph: Graph, name: str) -> bool:
    return any(name in op.inputs for op in graph)


def _only_reader(graph: Graph) -> Op | None:
    readers = [op for op in graph if IMAGE in op.inputs]
    return readers[0] if len(readers) == 1 else None


def renamed(op: Op, names: Mapping[str, str]) -> Op:
    """An operation whose tensors have other names."""
    changed: dict[str, Any] = {"output": names.get(op.output, op.output)}
    if hasattr(op, "input"):
        changed["input"] = names.get(op.inputs[0], op.inputs[0])
    else:
        changed["inputs"] = tuple(names.get(name, name) for name in op.inputs)
    return replace(op, **changed)  # type: ignore[type-var]


def check_network(network: Network) -> None:
    """Refuse what cannot be quantised, before anything is computed.

    Raises:
        ModelError: a tensor read that nobody wrote, widths that do not fit, or weights that are no numbers.
    """
    graph = network.graph
    if not graph or graph[-1].output != CORRECTION:
        raise refused_graph("a last operation that writes the result", graph[-1].name if graph else "no operation")
    channels_of(graph, {IMAGE: network.core_channels})
    for op in graph:
        if isinstance(op, Conv) and not (np.isfinite(op.weight).all() and np.isfinite(op.bias).all()):
            raise refused_graph("finite weights", f"NaN or infinity in {op.name}")


def channels_of(graph: Graph, given: Mapping[str, int]) -> dict[str, int]:
    """Channels of every tensor, from those of the given ones.

    Raises:
        ModelError: an operation that reads what nobody wrote, or channels that do not fit.
    """
    widths = dict(given)
    for op in graph:
        missing = [name for name in op.inputs if name not in widths]
        if missing:
            raise refused_graph(f"{op.name} behind what it reads", missing[0])
        widths[op.output] = _width(op, [widths[name] for name in op.inputs])
    return widths


def _width(op: Op, read: list[int]) -> int:
    if isinstance(op, Conv):
        if read[0] != op.weight.shape[1] * op.groups:
            raise refused_graph(f"{op.weight.shape[1] * op.groups} channels for {op.name}", f"{read[0]}")
        return len(op.weight)
    if isinstance(op, Concat):
        return sum(read)
    if isinstance(op, Add | Mul) and len(set(read)) > 1:
        raise refused_graph(f"two tensors of one width for {op.name}", f"{read[0]} and {read[1]} channels")
    if isinstance(op, Shuffle):
        if op.up and read[0] % op.block**2:
            raise refused_graph(f"a multiple of {op.block**2} channels for {op.name}", f"{read[0]}")
        return read[0] // op.block**2 if op.up else read[0] * op.block**2
    return read[0]
