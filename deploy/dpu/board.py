"""One build of the DPU: a target profile and a configuration of it."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import OptionError, ProfileError, printable
from beers_deploy.profiles.shipped import MODEL_SUFFIX, board_names
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.target_limits import LIMITS

BoardLike = TargetProfile | str | os.PathLike[str]
"""A board: its profile, its name, or the path of its .toml file."""

Levels = tuple[int, ...]
"""What a run has in common with others, from the most general (`cost/kinship.py`)."""

ALL = "all"
"""Every shipped board, or every configuration."""


def boards_of(board: BoardLike | Sequence[BoardLike]) -> list[TargetProfile]:
    """Load the target profiles of one or several boards.

    Args:
        board: a board, several, or names separated by commas, each with or without the suffix
            -model. "all" stands for the shipped boards with a DPU.

    Raises:
        ProfileError: there is no such board, or its file is not valid.
    """
    sources: Sequence[BoardLike]
    if isinstance(board, os.PathLike | TargetProfile):
        sources = [board]
    elif isinstance(board, str):
        every = board.removesuffix(MODEL_SUFFIX) == ALL
        sources = board_names() if every else [name.strip() for name in board.split(",")]
    else:
        sources = board
    return list(map(TargetProfile.load, sources))


REQUIRED = ("cores", "batch_handlers", "cpb", "peak_tops")
"""Constants that every configuration must have."""
SIZED = ("array", "memory", "elementwise")
"""Tables whose constants a configuration may override by name, because a smaller array has smaller
banks."""


@dataclass(frozen=True)
class Dpu:
    """A configuration of the DPU. C32B3, for example, has 3 batch handlers, each with 32 AI engines
    and 32 output channels at a time.

    A board may have several cores, which share only its memory. The three of the ZCU102's B4096,
    each with one batch handler, run three images at once and load the weights three times.

    Attributes:
        target: the board.
        name: the name of the configuration.
        constants: the constants of the configuration.
        runs: measured on the owner's board, with ln(given / predicted); none of a shipped one.
    """

    target: TargetProfile
    name: str
    constants: dict[str, Constant]
    runs: tuple[tuple[Levels, float], ...] = ()

    @cached_property
    def tables(self) -> dict[str, dict[str, Constant]]:
        """The target's tables, with the constants that the configuration overrides."""
        sized = {
            name: {k: self.constants.get(k, v) for k, v in self.target.tables.get(name, {}).items()}
            for name in SIZED
        }
        # A table that the target lacks is left out, because rules check which constants exist.
        return {**self.target.tables, **{name: table for name, table in sized.items() if table}}

    @property
    def cores(self) -> int:
        """The number of compute units, each with its own instructions, feature maps and weights."""
        return int(self.constants["cores"].low)

    @property
    def handlers(self) -> int:
        """The number of images that a core processes at once."""
        return int(self.constants["batch_handlers"].low)

    @property
    def batch(self) -> int:
        """The number of images that are processed at once: one for each batch handler of every
        core.
        """
        return self.cores * self.handlers

    @property
    def channels_max(self) -> int:
        """The largest number of channels of an operator on the array."""
        return self.whole("array", "channel_groups") * self.input_parallel

    @property
    def input_parallel(self) -> int:
        """The number of input channels that a batch handler reads at a time."""
        return self.whole("array", "input_channel_parallel")

    @property
    def output_parallel(self) -> int:
        """The number of output channels that a batch handler computes at a time."""
        return int(self.constants["cpb"].low)

    @property
    def engine_ops_per_s(self) -> float:
        """Peak int8 operations a second of one batch handler. A multiply-accumulate counts as two.

        The peak of the configuration is that of all cores together.
        """
        return self.peak_ops_per_s / self.batch

    @property
    def peak_ops_per_s(self) -> float:
        """Peak int8 operations a second of all cores together."""
        return self.constants["peak_tops"].low * 1e12

    @property
    def lane_steps_per_s(self) -> float:
        """The number of values per second that an engine in programmable logic reads."""
        channels = self.value("elementwise", "channels_per_cycle")
        lanes = channels * self.value("elementwise", "pixels_per_cycle")
        return lanes * self.value("array", "pl_clock_hz")

    def limit(self, table: str, key: str) -> Constant:
        """Return a constant with both limits of its range. A single limit stands for both."""
        constant = self.tables.get(table, {}).get(key)
        return self.target.constant(table, key) if constant is None else constant

    def value(self, table: str, key: str) -> float:
        """Return the single value of a constant."""
        return self.limit(table, key).low

    def whole(self, table: str, key: str) -> int:
        """Return the value of a constant that is a count, as an int."""
        return int(self.value(table, key))


def load_dpu(target: str, configuration: str | None = None) -> Dpu:
    """Read a target profile and one of its configurations."""
    return dpu_of(TargetProfile.load(target), configuration)


def dpu_of(profile: TargetProfile, configuration: str | None = None) -> Dpu:
    """Return one configuration of a target profile.

    Args:
        profile: the board. A profile from a user's file could not be loaded again by its name.
        configuration: the name of the configuration; the default one if None.

    Raises:
        OptionError: the board has no DPU.
        ProfileError: there is no such configuration, or the profile lacks a constant or its
            documents.
    """
    if not profile.configurations:
        raise OptionError(
            f"The target {profile.name!r} has no DPU. Choose one of {', '.join(board_names())}."
        )
    name, constants = profile.configuration(configuration)
    for key in REQUIRED:
        if key not in constants:
            raise ProfileError(
                f"The table [configurations.{name}] of the target {profile.name} has no key "
                f"{key!r}. Add {LIMITS[key]}."
            )
    # The rules quote these documents: without them a rule's text would have no source.
    if not profile.documents:
        raise ProfileError(
            f"The target {profile.name} has no table [documents]. Add it, or start with base = the "
            "name of a board with the same DPU."
        )
    return Dpu(profile, name, constants)


def device_of(profile: TargetProfile, configuration: str | None = None) -> Dpu:
    """Return the device whose rules a network is checked against: the DPU, or the NPU of the board.

    An NPU has rules, but no constants for predictions.

    Args:
        profile: the board.
        configuration: the DPU's configuration; None for the board's default.

    Raises:
        OptionError: the board has an NPU, and a configuration is stated.
    """
    if not profile.npu:
        return dpu_of(profile, configuration)
    if configuration is not None:
        raise OptionError(
            f"`dpu` cannot be {printable(repr(configuration))} for {profile.name}, because this "
            "board has an NPU. Leave it out."
        )
    # An NPU has rules, and no configuration that a prediction could rest on.
    return Dpu(profile, "NPU", {})
