"""Define the constants that a profile stores: a number or a list of names, with its provenance."""

import math
from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from numbers import Real
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, GetCoreSchemaHandler, PlainValidator, model_validator
from pydantic.dataclasses import dataclass
from pydantic_core import ArgsKwargs, CoreSchema, core_schema

from beers_deploy.profiles.errors import printable
from beers_deploy.profiles.validation import CONFIG

Status = Literal["published", "inferred", "measured", "assumed", "stated"]
"""The origin of a value.

"published": in a document. "measured": on the instrument. "inferred": computed from published or
measured values. "assumed": chosen by this project. "stated": given by the user.
"""


def is_number(raw: object) -> bool:
    """Return True if a value of a user is a finite number that float64 can hold."""
    # Python counts True as an int.
    if isinstance(raw, bool) or not isinstance(raw, Real):
        return False
    try:
        return math.isfinite(float(raw))
    # TOML allows integers of any size.
    except OverflowError:
        return False


def _number(raw: Any) -> float | tuple[float, float]:
    if is_number(raw):
        return float(raw)
    ends = raw if isinstance(raw, list | tuple) else ()
    if len(ends) == 2 and all(map(is_number, ends)) and ends[0] <= ends[1]:
        return (float(ends[0]), float(ends[1]))
    value = printable(repr(raw))
    raise ValueError(f"must be a finite number or a range [low, high], got {value}. Correct it.")


Number = Annotated[float | tuple[float, float], PlainValidator(_number)]


def _source(text: str) -> str:
    if not text.strip():
        raise ValueError("must name a document, but it is empty. State where the value comes from.")
    return text


@dataclass(frozen=True, config=CONFIG)
class Stated:
    """A value of any kind with its provenance.

    A file states it as `{ value = ..., status = ..., source = ... }`. A bare value is the user's
    own statement: status "stated".

    Attributes:
        value: the value.
        status: how the value was obtained, one of `Status`.
        source: the document, measurement or reasoning that the value comes from; not empty.
    """

    value: Any
    status: Status
    source: Annotated[str, AfterValidator(_source)]

    @model_validator(mode="before")
    @classmethod
    def _bare(cls, raw: object) -> object:
        if isinstance(raw, Mapping | Stated | ArgsKwargs):
            return raw
        source = "stated by the profile without a source"
        return {"value": raw, "status": "stated", "source": source}


@dataclass(frozen=True, config=CONFIG)
class Constant(Stated):
    """A number, or a range (low, high) of numbers, with its provenance.

    A range in a sensor's file describes a family of sensors, from which single numbers are drawn.
    """

    value: Number

    @property
    def low(self) -> float:
        """The smallest value of the range; the number itself if there is no range."""
        return self.value[0] if isinstance(self.value, tuple) else self.value

    @property
    def high(self) -> float:
        """The largest value of the range; the number itself if there is no range."""
        return self.value[1] if isinstance(self.value, tuple) else self.value

    @property
    def middle(self) -> float:
        """The mean of the two ends of the range; the number itself if there is no range."""
        return (self.low + self.high) / 2

    def __str__(self) -> str:
        return f"{self.low:g}" if self.low == self.high else f"{self.low:g} to {self.high:g}"


@dataclass(frozen=True, config=CONFIG)
class Words(Stated):
    """A list of names with its provenance, for example the activations that an operation can be
    fused with. It may be empty.
    """

    value: tuple[str, ...]

    def __str__(self) -> str:
        return ", ".join(self.value) or "none"


NEARLY_0 = 1e-12
"""A lower limit that stands for "above 0", for numbers that are used as divisors."""


@plain_dataclass(frozen=True)
class Limits:
    """The valid values of a constant, both ends included: `Annotated[Constant, Limits(0, 5)]` is a
    type that pydantic checks.

    Attributes:
        low: the smallest valid value.
        high: the largest valid value.
        whole: True if the constant must be an integer, because it counts something.
        single: True if the constant must be one number and no range, because other numbers depend
            on it.
        hint: a sentence that ends the error message about an invalid number and says what to do.
    """

    low: float
    high: float
    whole: bool = False
    single: bool = False
    hint: str = "Correct it; the unit is in the name."

    def holds(self, value: float) -> bool:
        """Return True if one number is a valid value of the constant."""
        return self.low <= value <= self.high and not (self.whole and value % 1)

    def check(self, constant: Constant) -> Constant:
        """Return the constant unchanged if all its values are valid.

        Raises:
            ValueError: an end of the range is outside the limits or no integer, or the constant is
                a range where one number is required.
        """
        ends = dict.fromkeys((constant.low, constant.high))
        stated = " to ".join(f"{value:.12g}" for value in ends)
        if not all(map(self.holds, ends)):
            raise ValueError(f"must be {self}, but it is {stated}. {self.hint}")
        if self.single and len(ends) > 1:
            raise ValueError(
                f"must be one number, but it is the range {stated}. Write a profile for each "
                "number."
            )
        return constant

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def __str__(self) -> str:
        kind = "an integer" if self.whole else "a number"
        least = f"of at least {self.low:g}"
        if 0 < self.low <= NEARLY_0:
            least = f"above 0 (at least {self.low:g})"
        return f"{kind} {least} and at most {self.high:g}"
