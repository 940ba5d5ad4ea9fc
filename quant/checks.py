"""One thing that a gate looks at, as a number beside its limit.

The number decides: a check cannot say that it passed and hold a value beyond its limit, and NaN keeps no limit.
"""

import math
from dataclasses import dataclass
from typing import Literal

from beers_deploy.profiles.errors import printable

Bound = Literal["at most", "at least"]

IN_THE_NAME = {"ratio", "node", "ReLU", "fault", "step"}
"""Units that a check's name tells a reader already."""


@dataclass(frozen=True)
class Check:
    """A value and its limit.

    Attributes:
        name: what is measured, for example "MAE".
        value: what was found, in `unit`; infinite or NaN where a network gave that.
        limit: the largest value that passes, or the smallest where `bound` says "at least"; infinity for none.
        unit: of both; a count has the name of what is counted, for example "node".
        bound: the side of the limit that passes.
        detail: where the value was found, or where the limit comes from; empty where there is nothing to add.
    """

    name: str
    value: float
    limit: float
    unit: str
    bound: Bound = "at most"
    detail: str = ""

    @property
    def passed(self) -> bool:
        """Whether the value keeps its limit."""
        return self.value >= self.limit if self.bound == "at least" else self.value <= self.limit

    @property
    def found(self) -> str:
        """The value with its unit and its detail, for a person."""
        unit = "" if self.unit in IN_THE_NAME else f" {self.unit}"
        # A detail may hold the name of a node of another's file: it must stay on its line of a log.
        return f"{self.value:.4g}{unit}" + (f" ({printable(self.detail)})" if self.detail else "")

    @property
    def allowed(self) -> str:
        """The limit, for a person."""
        return f"{self.bound} {self.limit:.4g}"

    def __str__(self) -> str:
        return f"{self.name} {self.found}, allowed {self.allowed}"

    def to_json(self) -> dict[str, object]:
        """The check as the results schema wants it; None for what JSON has no number for."""
        return {
            "name": self.name,
            "value": _finite(self.value),
            "limit": _finite(self.limit),
            "unit": self.unit,
            "bound": self.bound,
            "passed": self.passed,
            "detail": self.detail if math.isfinite(self.value) else self.found,
        }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
