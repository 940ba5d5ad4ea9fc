"""Assign static buffers to the tensors of a core: tensors that are never needed at the same time
share one.
"""

from collections.abc import Mapping

from beers_deploy.quant.core import IntConv, IntCore
from beers_deploy.quant.graph import CORRECTION, PLANES, Add, Mul, Op, Pointwise

IN_PLACE = (Add, Mul, Pointwise)
"""Operations that read of each input of the result's size only the value at the position that they
write. A product may read a smaller one too, a factor for each channel.
"""


def share_buffers(core: IntCore, sizes: Mapping[str, int]) -> tuple[dict[str, int], list[int]]:
    """Assign a static buffer to each tensor of a core, so that the C code needs little memory.

    Tensors that are not needed at the same time share a buffer.

    Args:
        core: the integer core.
        sizes: the sizes of the tensors in bytes, by name.

    Returns:
        The number of each tensor's buffer by the tensor's name, and the size of each buffer in
        bytes.
    """
    steps = list(enumerate(core.ops))
    last_use = {PLANES: 0} | {op.output: k for k, op in steps}
    for k, op in steps:
        last_use |= dict.fromkeys(op.inputs, k)
    # The result is read after the last operation, when `run` copies it to `out`.
    last_use[CORRECTION] = len(steps)
    number = {PLANES: 0}
    buffers = [sizes[PLANES]]
    free = set[int]()
    for k, op in steps:
        ending = {number[name] for name in op.inputs if last_use[name] == k}
        size = sizes[op.output]
        over = {number[name] for name in op.inputs if last_use[name] == k and sizes[name] == size}
        chosen = _choose(op, over, free, buffers, size)
        number[op.output] = chosen
        free |= ending | {chosen}
        # A result that nothing reads leaves its buffer free at once.
        if last_use[op.output] > k:
            free.remove(chosen)
    return number, buffers


def _choose(op: IntConv | Op, over: set[int], free: set[int], buffers: list[int], size: int) -> int:
    """Return the number of the buffer for a result, and make the buffer large enough.

    1. An operation that works value by value writes over an input that nothing reads later.
    2. Others take the smallest free buffer that is large enough,
    3. or else enlarge the largest free one,
    4. or else add one.

    Args:
        op: the operation that writes the result.
        over: buffers of its inputs of that size that no later operation reads.
        free: buffers that hold no tensor which is read from here on.
        buffers: the sizes of all buffers in bytes, which are extended in place.
        size: the size of the result in bytes.
    """
    if isinstance(op, IN_PLACE) and over:
        return min(over)
    if not free:
        buffers.append(size)
        return len(buffers) - 1
    by_size = sorted(free, key=buffers.__getitem__)
    chosen = next((k for k in by_size if buffers[k] >= size), by_size[-1])
    buffers[chosen] = max(buffers[chosen], size)
    return chosen
