"""Why an instrument gives no figure: a named status and a sentence, so that a table can say "unavailable: reason"."""

from dataclasses import dataclass
from typing import Literal

Status = Literal[
    "contrast", "clipped", "few-rows", "no-convergence", "not-finite", "few-windows", "range", "no-noise"
]


@dataclass(frozen=True)
class Refusal:
    """No figure, and that is no error: the image does not hold what the instrument needs.

    Attributes:
        status: the short name of the reason, for counting.
        reason: one sentence with the numbers behind it.
    """

    status: Status
    reason: str
