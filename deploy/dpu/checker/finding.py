"""What a broken rule says: the reason, in the node's own numbers, and what to change."""

from collections.abc import Callable
from dataclasses import dataclass

from beers_deploy.dpu.board import Dpu
from beers_deploy.dpu.graph import Operation
from beers_deploy.profiles.constant import Constant


@dataclass(frozen=True)
class Finding:
    """Why a node cannot run on the DPU, and what would let it."""

    reason: str
    remedy: str


Rule = Callable[[Operation, Dpu], Finding | None]
"""One rule of the DPU: None when the node keeps it.

Its docstring is the rule's text, {table[key]} its limits.
"""


def outside(values: tuple[int, ...], limit: Constant) -> bool:
    """Whether any value lies beyond the limit."""
    return any(not limit.low <= value <= limit.high for value in values)


def shown(sides: tuple[int, int]) -> str:
    """Height and width, in the order of ONNX, as sizes are shown everywhere: width x height."""
    return f"{sides[1]} x {sides[0]}"


def beyond_range(what: str, sides: tuple[int, int], limit: Constant, remedy: str) -> Finding | None:
    """What to say of a kernel or a stride of which a side lies beyond the limit."""
    if not outside(sides, limit):
        return None
    return Finding(f"{what} ({shown(sides)}) is not in the DPU's range {limit}", remedy)


def groups_of(count: int, size: int) -> int:
    """How many groups of `size` hold `count` things."""
    return -(-count // size)
