"""How many threads and processes a machine is asked for: more than it has cores only wait, some for minutes."""

import os

from profiles.errors import OptionError

SEEDS = 2**62
"""The largest seed: torch takes one of 64 bits, and other draws of a run add to it."""


def require_cores(option: str, asked: int) -> None:
    """Refuse more threads or processes than this machine has logical cores; 0 is the option's own default.

    Raises:
        OptionError: more, or a number below 0.
    """
    cores = os.cpu_count() or 1
    if not 0 <= asked <= cores:
        expected = f"0 to {cores}, the cores of this machine"
        raise OptionError(option, expected=expected, got=str(asked), remedy="leave it out for the default")
