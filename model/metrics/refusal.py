"""Represent the reason why a measurement returns no figure, so that a table can print "unavailable:
reason".
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Refusal:
    """The result of a measurement without a figure. It is no error: the image lacks what the
    measurement needs.

    `reason` is one sentence with the numbers behind it.
    """

    reason: str
