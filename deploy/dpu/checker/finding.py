"""The result of a broken rule: the reason, with the node's own values, and what to change."""

from collections.abc import Callable
from dataclasses import dataclass

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.graph import Operation
from beers_deploy.profiles.constant import Constant


@dataclass(frozen=True)
class Finding:
    """The reason why a node cannot run on the DPU, and a remedy."""

    reason: str
    remedy: str


Rule = Callable[[Operation, Dpu], Finding | None]
"""One rule of the DPU. It returns None if the node complies with it.

Its docstring is the rule's text, in which {table[key]} stands for a limit.
"""


def outside(values: tuple[int, ...], limit: Constant) -> bool:
    """Return True if any value lies outside the limit."""
    return any(not limit.low <= value <= limit.high for value in values)


def shown(sides: tuple[int, int]) -> str:
    """Format height and width (the order of ONNX) as sizes are shown everywhere: width x height."""
    return f"{sides[1]} x {sides[0]}"


def beyond_range(what: str, sides: tuple[int, int], limit: Constant, remedy: str) -> Finding | None:
    """Return a finding if one side of a kernel or a stride lies outside the limit, else None.

    In the remedy, {most} stands for the largest side.
    """
    if not outside(sides, limit):
        return None
    reason = f"{what} ({shown(sides)}) is not in the DPU's range {limit}"
    return Finding(reason, remedy.format(most=f"{limit.high:g}"))


def groups_of(count: int, size: int) -> int:
    """Return the number of groups of `size` that are needed for `count` items."""
    return -(-count // size)
