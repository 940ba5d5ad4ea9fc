"""One build of the DPU: a target profile and a configuration of it."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import OptionError, ProfileError, listed, printable
from beers_deploy.profiles.shipped import MODEL_SUFFIX, board_names
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.target_limits import LIMITS

BoardLike = TargetProfile | str | os.PathLike[str]
"""A board: its profile, its name, or the path of its .toml file."""

Levels = tuple[int, ...]
"""Keys that two measured runs share if they have a property in common (`cost/kinship.py`)."""

ALL = "all"
"""Every shipped board, or every configuration."""


def boards_of(board: BoardLike | Sequence[BoardLike]) -> list[TargetProfile]:
    """Load the target profiles of one or several boards, as `bench` accepts them.

    Args:
        board: a board, a sequence of boards, or their names separated by commas. A name may have
            the suffix -model, which tables add to the figures of the cost model. "all" stands for
            the shipped boards with a DPU.

    Raises:
        ProfileError: there is no such board, or its file is not valid.
    """
    every = isinstance(board, str) and board.removesuffix(MODEL_SUFFIX) == ALL
    sources = board_names() if every else listed(board)
    if not sources:
        raise OptionError("`target` names no board. Give a name, a .toml file, or all.")
    return list(map(TargetProfile.load, sources))


REQUIRED = ("cores", "batch_handlers", "cpb", "peak_tops")
"""Constants that every configuration must have."""
SIZED = ("array", "memory", "elementwise")
"""Tables whose constants a configuration may override by name, because a smaller array has smaller
banks."""


@dataclass(frozen=True)
class Dpu:
    """One configuration of the DPU on a board, with the constants of the board.

    A batch handler is the part of a core that computes one image. C32B3, for example, has 3 batch
    handlers, each with 32 AI engines and 32 output channels at a time. A board may have several
    cores, which share only its memory. The three of the ZCU102's B4096, each with one batch
    handler, run three images at once and load the weights three times.

    Attributes:
        target: the profile of the board.
        name: the name of the configuration, such as C32B3; "NPU" for a board with an NPU.
        constants: the constants of the configuration, by key; empty for an NPU.
        runs: frame rates measured on the user's own board, by which predictions are corrected. Each
            has keys that say what the run has in common with others (`cost/kinship.py`), and
            ln(measured / predicted). Empty without such measurements.
    """

    target: TargetProfile
    name: str
    constants: dict[str, Constant]
    runs: tuple[tuple[Levels, float], ...] = ()

    @cached_property
    def tables(self) -> dict[str, dict[str, Constant]]:
        """The board's constants by table and key, replaced where the configuration has its own."""
        sized = {
            name: {k: self.constants.get(k, v) for k, v in self.target.tables.get(name, {}).items()}
            for name in SIZED
        }
        # A table that the target lacks is left out, because rules check which constants exist.
        return {**self.target.tables, **{name: table for name, table in sized.items() if table}}

    @cached_property
    def facts(self) -> dict[str, Mapping[str, object]]:
        """The values that the texts of rules refer to: constants, fused activations, documents, and
        limits derived from constants.
        """
        facts: dict[str, Mapping[str, object]] = {**self.tables}
        if "channel_groups" in facts.get("array", {}):
            facts["limits"] = {"channels": self.channels_max}
        return facts | {
            key: getattr(self.target, key) for key in ("activations", "documents", "npu")
        }

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
        """The largest number of input or output channels of an operator on the DPU's array."""
        return self.whole("array", "channel_groups") * self.input_parallel

    @property
    def input_parallel(self) -> int:
        """The number of input channels that a batch handler reads in parallel."""
        return self.whole("array", "input_channel_parallel")

    @property
    def output_parallel(self) -> int:
        """The number of output channels that a batch handler computes in parallel."""
        return int(self.constants["cpb"].low)

    @property
    def engine_ops_per_s(self) -> float:
        """Peak int8 operations a second of one batch handler. A multiply-accumulate counts as two
        operations.
        """
        return self.peak_ops_per_s / self.batch

    @property
    def peak_ops_per_s(self) -> float:
        """Peak int8 operations a second of all cores together. A multiply-accumulate counts as two
        operations.
        """
        return self.constants["peak_tops"].low * 1e12

    def limit(self, table: str, key: str) -> Constant:
        """Return a constant of the board or the configuration, with its source.

        Args:
            table: the table in the board's file, such as "conv".
            key: the key in that table, such as "kernel".

        Returns:
            The constant, whose `low` and `high` are equal if it has one value.

        Raises:
            ProfileError: the board has no such constant.
        """
        constant = self.tables.get(table, {}).get(key)
        return self.target.constant(table, key) if constant is None else constant

    def value(self, table: str, key: str) -> float:
        """Return a constant that has a single value; the arguments are those of `limit`."""
        return self.limit(table, key).low

    def whole(self, table: str, key: str) -> int:
        """Return a constant that is a count, as an int; the arguments are those of `limit`."""
        return int(self.value(table, key))


def load_dpu(target: str, configuration: str | None = None) -> Dpu:
    """Load a board by its name or .toml file, and select one configuration of its DPU.

    Args:
        target: the name of the board, or the path of its .toml file.
        configuration: the name of the configuration; the board's default if None.

    Raises:
        OptionError: the board has no DPU.
        ProfileError: there is no such board or configuration, or the file is not valid.
    """
    return dpu_of(TargetProfile.load(target), configuration)


def dpu_of(profile: TargetProfile, configuration: str | None = None) -> Dpu:
    """Select one configuration of the DPU of a board that is loaded already.

    Args:
        profile: the board.
        configuration: the name of the configuration; the board's default if None.

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
    """Select the device whose rules a network is checked against: the DPU or NPU of a board.

    Args:
        profile: the board.
        configuration: the name of the DPU's configuration; the board's default if None. It must be
            None for an NPU.

    Returns:
        The device. That of an NPU is named "NPU" and has rules, but no constants for predictions.

    Raises:
        OptionError: the board has an NPU and a configuration is given, or has neither a DPU nor an
            NPU.
        ProfileError: there is no such configuration, or the profile lacks a constant of the device.
    """
    if not profile.npu:
        return dpu_of(profile, configuration)
    if configuration is not None:
        raise OptionError(
            f"`dpu` cannot be {printable(repr(configuration))} for {profile.name}, because this "
            "board has an NPU. Leave it out."
        )
    # An NPU has rules, but no configuration to predict with.
    return Dpu(profile, "NPU", {})
