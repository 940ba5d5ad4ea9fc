"""Represent the reason why a measurement returns no figure, so that a table can print "unavailable:
reason".
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Refusal:
    """The result of a measurement that yields no figure. It is no error: the image lacks what the
    measurement needs.

    Attributes:
        reason: a phrase with the numbers behind it, such as "2 straight edges, 3 are needed".
    """

    reason: str
