"""Change scales by one fractional bit if that reduces the error of a core in training.

Each scale was chosen by the squared error of its own tensor, before any integer was trained. A
gradient step cannot change it, because scales are powers of two: Jain et al. (2020) train the
logarithm of a threshold and round that up. Here each scale is tried one bit finer, where it clips
more, and one bit coarser, where it rounds more. The error of the result decides.

1. Tensors that must share a scale change jointly. So do those that an add of one scale connects,
   because that add is exact.
2. The planes do not change, because the host writes them. Nor does the output of a ReLU6, because
   the end of int8 may represent its six.
3. The scales of a convolution's weights and of its biases change separately. Those of copies do not
   change, because the coarse copy would have to change as well.
4. A change is skipped if the DPU's shifts do not allow it, and undone if it does not reduce the
   error.
"""

import logging
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

from beers_deploy.quant.core import IntCore, Shifts, shift_faults
from beers_deploy.quant.graph import PLANES, Activation, Add, Conv, Graph, ties_scales
from beers_deploy.quant.graph.ties import united
from beers_deploy.quant.integer.trainable import TrainableCore

logger = logging.getLogger(__name__)


def with_better_scales(
    trainable: TrainableCore, graph: Graph, shifts: Shifts, loss_of: Callable[[IntCore], float]
) -> TrainableCore:
    """Try each scale of a core one bit finer and coarser, and keep the changes that reduce its
    error.

    A change that reduces the error is kept before the next one is tried, so that changes add up.

    Args:
        trainable: the integer core in training.
        graph: the float graph of the same operations.
        shifts: the smallest and largest shifts that the target allows. A change that needs others
            is not tried.
        loss_of: returns the error of a core; smaller is better.

    Returns:
        The core with the least error found; `trainable` itself if no change reduces it.
    """
    start = trainable.core()
    least = loss_of(start)
    tried = 0
    for move in _moves(start, graph):
        for by in (1, -1):
            candidate = move(trainable, by=by)
            core = candidate.core()
            # 4.
            if shift_faults(core, shifts):
                continue
            tried += 1
            loss = loss_of(core)
            if loss < least:
                trainable = candidate
                least = loss
                # The other direction would lead back.
                break
    logger.info(
        "fine-tuning tried %d moves of scales and moved those of %d tensors",
        tried,
        moved(start, trainable.core()),
    )
    return trainable


def _moves(core: IntCore, graph: Graph) -> Iterator[Callable[..., TrainableCore]]:
    """Yield a function for each scale that may move.

    Args:
        core: the integer core whose scales are moved.
        graph: the float network of the same operations, which knows the activations.

    Yields:
        Functions of a `TrainableCore` and of `by`, the fractional bits to add. Each returns a
        changed copy.
    """
    # 1.
    links: list[tuple[str, ...]] = [(name,) for name in core.frac_bits]
    for op in core.ops:
        names = (*op.inputs, op.output)
        # An add of one scale shifts nothing, so it loses no bit. Moving one of its tensors would
        # end that.
        exact = isinstance(op, Add) and len({core.frac_bits[name] for name in names}) == 1
        if exact or ties_scales(op):
            links.append(names)
    leader = united(links)
    # 2.
    fixed = {PLANES}
    for op in graph:
        if isinstance(op, Conv) and op.activation is Activation.relu6:
            fixed.add(op.output)
    for first in dict.fromkeys(leader.values()):
        together = [name for name in leader if leader[name] == first]
        if fixed.isdisjoint(together):
            yield partial(TrainableCore.with_finer_tensors, names=together)
    # 3.
    writes_copies = core.host_part.decoding.copies > 1
    convolutions = range(len(core.convolutions) - writes_copies)
    for number, role in product(convolutions, ("weight", "bias")):
        yield partial(TrainableCore.with_finer_numbers, role=role, number=number)


def moved(core: IntCore, other: IntCore) -> int:
    """Count the scales that differ between a core before and after fine-tuning.

    Args:
        core: the one core.
        other: the other core, of the same operations.

    Returns:
        The number of tensors, weights and biases that have another number of fractional bits.
    """
    count = sum(core.frac_bits[name] != other.frac_bits[name] for name in core.frac_bits)
    for one, another in zip(core.convolutions, other.convolutions, strict=True):
        count += one.weight_frac_bits != another.weight_frac_bits
        count += one.bias_frac_bits != another.bias_frac_bits
    return count
