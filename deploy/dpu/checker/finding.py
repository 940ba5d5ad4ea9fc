"""The result of a broken rule: the reason, with the node's own values, and what to change."""

from collections.abc import Callable
from dataclasses import dataclass

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.graph import Operation
from beers_deploy.profiles.constant import Constant


@dataclass(frozen=True)
class Finding:
    """The result of a rule that a node breaks.

    Attributes:
        reason: why the node cannot run on the DPU, with the node's own values.
        remedy: what to change in the network.
    """

    reason: str
    remedy: str


Rule = Callable[[Operation, Dpu], Finding | None]
"""One rule of the DPU. It returns None if the node complies with it.

Its docstring is the rule's text, in which {table[key]} stands for a limit.
"""


def outside(values: tuple[int, ...], limit: Constant) -> bool:
    """Return True if any of the values is below `limit.low` or above `limit.high`."""
    return any(not limit.low <= value <= limit.high for value in values)


def shown(sides: tuple[int, int]) -> str:
    """Format (height, width), the order of ONNX, as text "WIDTH x HEIGHT"."""
    return f"{sides[1]} x {sides[0]}"


def beyond_range(what: str, sides: tuple[int, int], limit: Constant, remedy: str) -> Finding | None:
    """Check a kernel or a stride against the range that the DPU supports.

    Args:
        what: the name of the checked value in messages, such as "kernel".
        sides: height and width.
        limit: the range for either side.
        remedy: what to change in the network, in which {most} stands for the largest side.

    Returns:
        The finding if a side lies outside the range, else None.
    """
    if not outside(sides, limit):
        return None
    reason = f"{what} ({shown(sides)}) is not in the DPU's range {limit}"
    return Finding(reason, remedy.format(most=f"{limit.high:g}"))


def groups_of(count: int, size: int) -> int:
    """Return `count` / `size`, rounded up: the number of groups of `size` that hold all items."""
    return -(-count // size)
