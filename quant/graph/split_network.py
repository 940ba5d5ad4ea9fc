"""Split a network where the DPU's part begins and ends, and check that its
operations fit together.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from beers_deploy.profiles.errors import LONGEST, ModelError, counted, printable
from beers_deploy.quant.graph.host_steps import HostSteps
from beers_deploy.quant.graph.operations import (
    CORRECTION,
    IMAGE,
    PLANES,
    Activation,
    Add,
    AveragePool,
    Concat,
    Conv,
    Graph,
    HasWeight,
    MaxPool,
    Mul,
    Op,
    Resize,
    Shuffle,
)
from beers_deploy.quant.onnx.image_input import require_one_input
from beers_deploy.quant.onnx.window import Sides
from beers_deploy.quant.untrusted import times

REMEDY = (
    "See docs/reference/any-network.md for the operators that 'quantize' accepts; 'check' names "
    "what a DPU does not run."
)
ADAPT = "'quantize --adapt' (adapt=True) replaces it by what a DPU computes, and measures the cost."
ADAPT_EXACTLY = "'quantize --adapt' (adapt=True) rewrites it exactly."


@dataclass(frozen=True)
class SplitNetwork(HostSteps):
    """A float network, split where the DPU's part begins and ends.

    The host shuffles pixels and adds the image. The DPU computes everything else.

    Attributes:
        graph: the operations that the DPU computes in INT8, from the tensor `IMAGE` to
            `CORRECTION`.
        channels: the number of channels of the image, before `front`.
        border_px: the number of pixels by which the network mirrors the image beyond its borders.
    """

    graph: Graph = field(compare=False)
    channels: int = 1
    border_px: int = 0

    @property
    def core_channels(self) -> int:
        """The number of channels that the DPU's part reads: those of the image after the unshuffles
        of `front`.
        """
        return self.channels * int(np.prod([shuffle.block**2 for shuffle in self.front], initial=1))


class AdaptableError(ModelError):
    """A float network has an operator that the DPU lacks, but that `quant.adapt` can replace."""


def unsupported(fault: str, remedy: str = REMEDY) -> ModelError:
    """Build the error for a float network that cannot be quantised.

    Args:
        fault: a sentence on what is wrong. Names in it may come from a file, and a long one is cut.
        remedy: a sentence on what to do. If it says that operators can be replaced, the error is an
            `AdaptableError`.
    """
    kind = AdaptableError if remedy in (ADAPT, ADAPT_EXACTLY) else ModelError
    return kind(f"{printable(fault, 4 * LONGEST)} {remedy}")


def require_one_image(inputs: Collection[str], outputs: Collection[str]) -> None:
    """Raise ModelError unless a network has exactly one input and one output.

    Args:
        inputs: the names of the network's inputs.
        outputs: the names of the network's outputs.
    """
    require_one_input(inputs)
    if len(outputs) != 1:
        raise unsupported(
            f"The network must have one output, but it has {len(outputs)}: {', '.join(outputs)}.",
            "Name the one to keep as `output`.",
        )


def cut(graph: Graph, channels: int, with_sum: bool = True) -> SplitNetwork:
    """Split a network into the host's part at both ends, and the DPU's part between.

    The host gets pixel shuffles at the ends and the add of the image. Shuffles only move values,
    which costs the host almost nothing, and DPUs have been seen to compute them wrongly.

    Args:
        graph: all operations of the network, from the tensor `IMAGE` to `CORRECTION`.
        channels: the number of channels of the image.
        with_sum: True if the host also gets an add of the image that ends the network.

    Raises:
        ModelError: nothing is left for the DPU.
    """
    graph, last = _without_shuffles(graph)
    end = graph[-1] if graph else None
    adds_image = False
    if (
        with_sum
        and isinstance(end, Add)
        and IMAGE in end.inputs
        and end.activation is Activation.none
    ):
        adds_image = True
        correction = end.inputs[1 - end.inputs.index(IMAGE)]
        graph, back = _without_shuffles(_ended(graph[:-1], correction))
    else:
        back = last
        last = ()
    front = []
    while len(readers := [op for op in graph if IMAGE in op.inputs]) == 1:
        (first,) = readers
        if not isinstance(first, Shuffle) or first.up:
            break
        front.append(first)
        graph = tuple(renamed(op, {first.output: IMAGE}) for op in graph if op is not first)
    network = SplitNetwork(
        graph, channels, front=tuple(front), back=back, adds_image=adds_image, last=last
    )
    return replace(network, graph=_image_for_convolutions(graph, network.core_channels))


def _image_for_convolutions(graph: Graph, channels: int) -> Graph:
    """Return a graph in which only convolutions read the image.

    Other operations read it from a convolution that copies it. The image therefore enters in all
    its planes, and its copy among the features has a scale of its own.
    """
    copied = f"{IMAGE}.copied"
    others = tuple(
        op if isinstance(op, Conv) and not op.transposed else renamed(op, {IMAGE: copied})
        for op in graph
    )
    if not any(copied in op.inputs for op in others):
        return graph
    weight = np.eye(channels, dtype=np.float32)[:, :, None, None]
    bias = np.zeros(channels, np.float32)
    return (Conv(f"{IMAGE}.copy", IMAGE, copied, weight, bias), *others)


def _without_shuffles(graph: Graph) -> tuple[Graph, tuple[Shuffle, ...]]:
    """Return the graph up to the pixel shuffles at its end, and these in order."""
    shuffles: list[Shuffle] = []
    while graph and isinstance(end := graph[-1], Shuffle) and end.up:
        shuffles.insert(0, end)
        graph = _ended(graph[:-1], end.input)
    return graph, tuple(shuffles)


def _ended(graph: Graph, name: str) -> Graph:
    if name == IMAGE or not any(op.output == name for op in graph):
        raise unsupported(
            "The network must compute its result by at least one operation other than pixel "
            f"shuffles, but none writes {name!r}."
        )
    return tuple(renamed(op, {name: CORRECTION}) for op in graph)


def renamed(op: Op, names: Mapping[str, str]) -> Op:
    """Return a copy of an operation that reads and writes tensors of other names.

    Args:
        op: the operation.
        names: the new name of each tensor, by the old one. Other tensors keep their names.
    """
    changed: dict[str, Any] = {"output": names.get(op.output, op.output)}
    if hasattr(op, "input"):
        changed["input"] = names.get(op.inputs[0], op.inputs[0])
    else:
        changed["inputs"] = tuple(names.get(name, name) for name in op.inputs)
    return replace(op, **changed)  # type: ignore[type-var]


def named_apart(ops: Sequence[Op], ends: Mapping[str, str]) -> Graph:
    """Rename tensors and operations so that none has a name that this project's own files use.

    Such names, like "planes" or "restored", get "net." in front.

    Args:
        ops: the operations of a network.
        ends: the new name of some tensors, by the old one: those at the ends of the network.
    """
    # A network may call its own tensors "planes" or "restored", which our files use for others.
    names = {op.output: f"net.{op.output}" for op in ops if _is_ours(op.output)} | dict(ends)
    renamed_ops = (renamed(op, names) for op in ops)
    return tuple(
        replace(op, name=f"net.{op.name}") if _is_ours(op.name) else op  # type: ignore[type-var]
        for op in renamed_ops
    )


def _is_ours(name: str) -> bool:
    """Return True if the files that this project writes have a tensor of that name."""
    ours = IMAGE, CORRECTION, PLANES, "restored"
    return name in ours or name.startswith(("host_front.", "host_back.", f"{IMAGE}."))


def check_split(network: SplitNetwork) -> None:
    """Raise ModelError if a network cannot be quantised, before any work is done.

    Its last operation must write the result, its weights must be finite, and no pixel unshuffle of
    several channels may be within it.

    Args:
        network: the network, split into host and DPU part.
    """
    graph = network.graph
    if not graph or graph[-1].output != CORRECTION:
        last = f"is {graph[-1].name}" if graph else "does not exist"
        raise unsupported(f"The last operation must write the network's result, but it {last}.")
    widths = channels_of(graph, {IMAGE: network.core_channels})
    for op in graph:
        # ONNX's SpaceToDepth has the other order of channels, so several need a Gather, which the
        # DPU does not compute.
        if isinstance(op, Shuffle) and not op.up and op.columns_first and widths[op.input] > 1:
            raise unsupported(
                f"{op.name} is a pixel unshuffle of several channels within the network, which is "
                "supported on the image only.",
                "Put it at the network's start, where the host does it, or use a strided "
                "convolution.",
            )
        if isinstance(op, Conv) and not (
            np.isfinite(op.weight).all() and np.isfinite(op.bias).all()
        ):
            raise unsupported(f"The weights of {op.name} contain NaN or infinity.")


def sized(graph: Graph, size: Sides) -> Graph:
    """Return the graph for images of one size, in which global pooling has its whole map as its
    window.

    Args:
        graph: the operations from the tensor `IMAGE` to `CORRECTION`.
        size: rows and columns of the image.

    Raises:
        ModelError: an operation reads tensors of sizes that do not fit together.
    """
    sizes = _sizes(graph, size)
    return tuple(
        replace(op, kernel=sizes[op.input])
        if isinstance(op, AveragePool) and op.kernel is None
        else op
        for op in graph
    )


def _sizes(graph: Graph, size: Sides) -> dict[str, Sides]:
    """Return the size of every tensor for images of one size."""
    sizes = {IMAGE: size}
    for op in graph:
        input_sizes = [sizes[name] for name in op.inputs]
        # Squeeze and excite: a factor for each channel, of one pixel, times a map.
        is_gate = isinstance(op, Mul) and (1, 1) in input_sizes
        if not is_gate and len(set(input_sizes)) > 1:
            unequal = " and ".join(map(times, input_sizes))
            raise unsupported(
                f"{op.name} needs tensors of one size, but for an image of {times(size)} they have "
                f"{unequal} pixels."
            )
        sizes[op.output] = _size(op, max(input_sizes))
    return sizes


WHOLE_PX = 1024 * 3 * 5 * 7
"""A side that the factors of all practical networks divide without a remainder."""


def check_result_size(graph: Graph, border_px: int, crop_px: int) -> None:
    """Raise ModelError unless the result's size is a fixed multiple or fraction of the image's
    size.

    Layers without padding would take some rows and columns away, whatever the size of the image.

    Args:
        graph: the operations from `IMAGE` to `CORRECTION`, for any size of image.
        border_px: the number of pixels by which the network mirrors the image beyond its borders.
        crop_px: the number of pixels of the result that it cuts off at each side.
    """
    once, twice = (
        _sizes(graph, (side_px + 2 * border_px,) * 2)[CORRECTION]
        for side_px in (WHOLE_PX, 2 * WHOLE_PX)
    )
    extra = [2 * one - two - 2 * crop_px for one, two in zip(once, twice, strict=True)]
    if any(extra):
        raise unsupported(
            f"The network's result is not its image's size or a multiple of it: "
            f"rows {extra[0]:+d}, columns {extra[1]:+d}, because some layers lack padding.",
            "Pad every convolution, or none: then the image is mirrored beyond its borders.",
        )


def _size(op: Op, size: Sides) -> Sides:
    if isinstance(op, Conv | MaxPool | AveragePool):
        rows, columns = op.weight.shape[2:] if isinstance(op, Conv) else op.kernel or size
        is_transposed = isinstance(op, Conv) and op.transposed
        side = op.window.transposed_size if is_transposed else op.window.output_size
        return side(0, rows, size[0]), side(1, columns, size[1])
    if isinstance(op, Resize):
        return size[0] * op.factor, size[1] * op.factor
    if isinstance(op, Shuffle):
        if op.up:
            return size[0] * op.block, size[1] * op.block
        return size[0] // op.block, size[1] // op.block
    return size


def channels_of(graph: Iterable[Op], sources: Mapping[str, int]) -> dict[str, int]:
    """Return the number of channels of every tensor of a graph, by its name.

    Args:
        graph: the operations in order.
        sources: the number of channels, by name, of the tensors that the operations read but none
            writes.
    """
    widths = dict(sources)
    for op in graph:
        unwritten = [name for name in op.inputs if name not in widths]
        if unwritten:
            raise unsupported(f"{op.name} reads {unwritten[0]!r} before it is computed.")
        widths[op.output] = _width(op, [widths[name] for name in op.inputs])
    return widths


def _width(op: Op, widths: list[int]) -> int:
    if isinstance(op, HasWeight):  # in float or in integers
        if widths[0] != op.weight.shape[1] * op.groups:
            raise unsupported(
                f"{op.name} needs {counted(op.weight.shape[1] * op.groups, 'channel')}, got "
                f"{widths[0]}."
            )
        return len(op.weight)
    if isinstance(op, Concat):
        return sum(widths)
    if isinstance(op, Add | Mul) and len(set(widths)) > 1:
        raise unsupported(
            f"{op.name} needs tensors of one number of channels, got {widths[0]} and {widths[1]}."
        )
    if isinstance(op, Shuffle):
        if op.up and widths[0] % op.block**2:
            raise unsupported(
                f"{op.name} needs a multiple of {op.block**2} channels, got {widths[0]}."
            )
        return widths[0] // op.block**2 if op.up else widths[0] * op.block**2
    return widths[0]
