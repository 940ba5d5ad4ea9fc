"""Why an instrument gives no figure, so that a table can say "unavailable: reason"."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Refusal:
    """No figure, and that is no error: the image does not hold what the instrument needs.

    `reason` is one sentence with the numbers behind it.
    """

    reason: str
