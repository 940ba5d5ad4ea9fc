"""Take the image out of a long skip connection, so that int8 has to represent only the differences
from it.

A first convolution (head) whose features are added to those of the last block carries the whole
image: its range is wide and its steps are coarse, although the result hardly depends on its level.

1. Find a sum of the head's features and others that the last convolution (tail) alone reads.
2. Divide each feature of the head into its detail and the pixel itself times a gain, the sum of the
   feature's weights.
3. Add only the detail. Put the pixel's coarse part and remainder next to the sum, as channels of
   their own.
4. Let the tail read these channels too, with its weights times the gains of the features.

The float network remains the same, also where the tail reads zeros beyond the border. The DPU
computes a second small head and a tail with two more channels for each channel of the image.
"""

from dataclasses import replace

import numpy as np

from beers_deploy.quant.graph import (
    CORRECTION,
    PLANES,
    PLANES_FRAC_BITS,
    Activation,
    Add,
    Concat,
    Conv,
    Graph,
    Op,
    Pointwise,
    same,
)
from beers_deploy.quant.passes.residual_groups import GROUP_FRAC_BITS

COARSE = 2.0 ** (PLANES_FRAC_BITS - GROUP_FRAC_BITS)
REMAINDER = 4 * COARSE
"""The weights with which the pixel's planes become channels. At the scale of a group their integers
are those of the coarse plane, up to 127, and four times those of the remainder, up to 4 x 31. Both
are exact: no value is clipped, and none is a tie that boards and processors round differently.
"""


def split_long_skip(graph: Graph) -> Graph:
    """Return the graph whose last convolution reads the image next to a sum of details.

    Args:
        graph: a float graph that reads the int8 planes that an image is split into.

    Returns:
        The graph; `graph` itself if no sum that the last convolution alone reads contains the head.
    """
    for add in graph:
        if isinstance(add, Add) and add.activation is Activation.none:
            head = _head(graph, add)
            readers = [op for op in graph if add.output in op.inputs]
            tail = readers[0] if len(readers) == 1 else None
            ends_graph = isinstance(tail, Conv) and tail.output == CORRECTION and tail.groups == 1
            if head is not None and isinstance(tail, Conv) and ends_graph:
                # Weights that overflow are rejected where the float network is run.
                with np.errstate(over="ignore", invalid="ignore"):
                    return _split(graph, head, add, tail)
    return graph


def activates_sums(graph: Graph) -> bool:
    """Return True if an activation of its own stands behind a sum, as in distillation networks."""
    sums = {op.output for op in graph if isinstance(op, Add)}
    return any(isinstance(op, Pointwise) and op.input in sums for op in graph)


def _head(graph: Graph, add: Add) -> Conv | None:
    """Return the convolution of the planes that writes one term of a sum, in the size of the image;
    None if there is none.
    """
    for op in graph:
        if (
            isinstance(op, Conv)
            and op.input == PLANES
            and add.inputs.count(op.output) == 1
            and op.activation is Activation.none
            and op.window == same(op.weight)
            # An even kernel has no middle, and its result another size than the image.
            and all(side % 2 for side in op.weight.shape[2:])
        ):
            return op
    return None


def _split(graph: Graph, head: Conv, add: Add, tail: Conv) -> Graph:
    planes = head.weight.shape[1]
    # The third plane of each channel adds nothing in float: it makes the head's weights finer.
    pixel_planes = 2 * planes // 3
    # 2. In float64, because a gain and what it is taken from must cancel.
    gains = head.weight.astype(np.float64).sum((2, 3))
    detail_weight = head.weight.astype(np.float64)
    middle = (head.weight.shape[2] // 2, head.weight.shape[3] // 2)
    detail_weight[:, :, *middle] -= gains
    detail = replace(
        head,
        name=f"{add.name}.head",
        output=f"{add.output}.head",
        weight=detail_weight.astype(np.float32),
    )
    # 3.
    shares = np.repeat([COARSE, REMAINDER], pixel_planes // 2)
    pixel = Conv(
        f"{add.name}.pixel",
        PLANES,
        f"{add.output}.pixel",
        (np.eye(pixel_planes, planes) * shares[:, None]).astype(np.float32)[..., None, None],
        np.zeros(pixel_planes, np.float32),
        scalable=False,
    )
    others = tuple(name for name in add.inputs if name != head.output)
    # Under a name of its own, because its values are no longer those of the float network.
    summed = replace(add, inputs=(*others, detail.output), output=f"{add.output}.detail")
    joined = Concat(f"{add.name}.join", (summed.output, pixel.output), f"{add.output}.join")
    # 4.
    direct = np.einsum(
        "ofyx,fp->opyx", tail.weight.astype(np.float64), gains[:, :pixel_planes] / shares
    ).astype(np.float32)
    wider = replace(tail, input=joined.output, weight=np.concatenate([tail.weight, direct], axis=1))
    read_elsewhere = any(head.output in op.inputs for op in graph if op is not add)
    result = list[Op]()
    for op in graph:
        if op is head:
            result += [head, detail, pixel] if read_elsewhere else [detail, pixel]
        elif op is add:
            result += [summed, joined]
        else:
            result.append(wider if op is tail else op)
    return tuple(result)
