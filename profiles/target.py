"""Define target profiles: the capabilities of a processing board, every constant with its source.

A file may begin with `base = "zcu102"`: the keys that it does not state are then those of that
shipped board. So a board with a known DPU only needs to state its cores, clock and memory.
"""

import os
from collections.abc import Mapping
from dataclasses import field
from functools import cache
from typing import Annotated, Any, Self

from pydantic import AfterValidator, model_validator
from pydantic.dataclasses import dataclass

from beers_deploy.profiles.constant import Constant, Words
from beers_deploy.profiles.errors import ProfileError, printable
from beers_deploy.profiles.shipped import MODEL_SUFFIX, board_names, target_names
from beers_deploy.profiles.target_limits import ANY_KEY, check_limits
from beers_deploy.profiles.toml import read_toml
from beers_deploy.profiles.validation import CONFIG, check_keys, validated

FUSED = ("ReLU", "ReLU6", "LeakyReLU", "PReLU", "hard-sigmoid", "hard-swish")
"""The activations that a board's file can list, by the names in its manual."""
PLACES = frozenset({"conv", "depthwise", "pool", "sum", "alone"})
"""The operations that an activation can follow; "alone" means that it may follow any operation."""
DOCUMENTS = frozenset({"operators", "numbers", "quantiser"})
"""The documents of a DPU: the list of its operators, the description of its numbers, and the
quantiser that knows the limits of its windows.
"""
NPU = frozenset({"device", "int8", "no_int8"})
"""The keys of an NPU, in place of a DPU's list: the compiler's name of the device, and the
operators that it supports or lacks in INT8.
"""

NOT_OF_DPUS = frozenset({"file", "measurement", "npu"})
"""The tables that are read of an NPU (the file for its compiler) or of a host alone."""

WATTS = "_w"
"""The suffix of measured powers, which no board inherits from another."""


def _activations(words: Words) -> Words:
    if not set(words.value) <= set(FUSED):
        raise ValueError(
            f"must be a list of names out of {', '.join(FUSED)}, got {list(words.value)}. Correct "
            "the names; an empty list stands for none."
        )
    return words


@dataclass(frozen=True, repr=False, config=CONFIG)
class TargetProfile:
    """The description of one processing board: the content of a TOML file under
    `profiles/targets/`, with the keys of its base that the file does not state itself.

    Attributes:
        name: the name of the file, without its suffix.
        description: one sentence for the user.
        tables: from a topic ("array", "memory", "conv", "power", ...) to its constants by key.
        default_configuration: the configuration that is used if none is named; None if there is
            only one build.
        configurations: from the name of a build of the accelerator to its constants; empty if there
            is only one build.
        activations: from an operation to the activation functions that the accelerator computes
            together with it; empty for a board without a DPU.
        documents: the manuals that state the rules, by their subject; empty for a board without a
            DPU.
        npu: which operators an NPU supports; empty for every other board.
    """

    name: str
    description: str
    # Dictionaries have no hash: that of a board is of its name and description.
    tables: dict[str, dict[str, Constant]] = field(hash=False)
    default_configuration: str | None = None
    configurations: dict[str, dict[str, Constant]] = field(default_factory=dict, hash=False)
    activations: dict[str, Annotated[Words, AfterValidator(_activations)]] = field(
        default_factory=dict, hash=False
    )
    documents: dict[str, str] = field(default_factory=dict, hash=False)
    npu: dict[str, Words] = field(default_factory=dict, hash=False)

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        for name, table in self.tables.items():
            check_limits(name, table)
        for name, table in self.configurations.items():
            check_limits(f"configurations.{name}", table)
        return self

    @classmethod
    def load(cls, board: "TargetProfile | str | os.PathLike[str]") -> Self:
        """Load a shipped board by its name, or a user's board by the path of its .toml file.

        A `TargetProfile` is returned as an instance of this class. The cost model of a board has
        the name of the board: `vck190-model`, as `bench` prints it, is `vck190`.

        Raises:
            ProfileError: unknown name, wrong or missing key, or a number that no board can have.
        """
        if isinstance(board, str | os.PathLike):
            board = _read(os.fspath(board).removesuffix(MODEL_SUFFIX))
        if not isinstance(board, TargetProfile):
            raise ProfileError(
                "A board must be a Board, a name or the path of a .toml file, got "
                f"{type(board).__name__}. 'beers-deploy profiles' lists the names."
            )
        return board if isinstance(board, cls) else cls(**vars(board))

    def __repr__(self) -> str:
        builds = f", {', '.join(self.configurations)}" if self.configurations else ""
        return f"{type(self).__name__}({self.name!r}{builds})"

    def value(self, table: str, key: str) -> float:
        """Return the value of a constant that is a single number.

        Args:
            table: the topic, a key of `tables`.
            key: the name of the constant.

        Raises:
            ProfileError: the profile lacks the constant.
        """
        return self.constant(table, key).low

    def constant(self, table: str, key: str) -> Constant:
        """Return a constant with its range and source.

        Args:
            table: the topic, a key of `tables`.
            key: the name of the constant.

        Raises:
            ProfileError: the profile lacks the constant.
        """
        try:
            return self.tables[table][key]
        except KeyError:
            if table == "cost" and table not in self.tables:
                raise ProfileError(
                    f"The target profile {self.name} has no [{table}] {key}, because it states no "
                    "cost constants yet. Use those of a board with the same DPU: base = its name."
                ) from None
            raise ProfileError(
                f"The target profile {self.name} has no [{table}] {key}. Add it to the file."
            ) from None

    def configuration(self, name: str | None = None) -> tuple[str, dict[str, Constant]]:
        """Return the name and the constants of one build of the accelerator.

        Args:
            name: the name of the build; None for the default one.

        Raises:
            ProfileError: the board has no such build, or no default one.
        """
        build = name or self.default_configuration
        if build is None or build not in self.configurations:
            missing = "default configuration" if build is None else f"configuration {build!r}"
            raise ProfileError(
                f"The target profile {self.name} has no {missing}. Choose one of its "
                f"configurations as `dpu`: {', '.join(self.configurations) or 'none'}."
            )
        return build, self.configurations[build]


def _read(name: str) -> TargetProfile:
    label, raw = _with_base(*read_toml("targets", name))
    own = TargetProfile.__dataclass_fields__.keys() - {"name", "tables"}
    stated: dict[str, Any] = {key: raw[key] for key in own if key in raw}
    # The rules of an NPU stand in [npu], in place of a DPU's manuals.
    documents = ("quantiser",) if "npu" in raw else DOCUMENTS
    for key, names in (("activations", PLACES), ("npu", NPU), ("documents", documents)):
        if isinstance(table := raw.get(key), Mapping):
            check_keys(f"{label} {key}", table, names)
    stated["tables"] = {key: table for key, table in raw.items() if key not in own}
    stated["name"] = label.removesuffix(".toml")
    profile = validated(TargetProfile, stated, label, {"tables": ""})
    if profile.configurations:
        # This raises if the default is none of them.
        profile.configuration()
    # Nothing reads a table or a key that is in no shipped target. That is checked last, because a
    # wrong type or number is the more precise message.
    keys = _shipped_keys()
    # Any rule applies if a board states its constants. Keys that only an NPU or a host reads would
    # have no effect on a DPU.
    tables = keys.keys() - NOT_OF_DPUS if profile.configurations else keys
    check_keys(label, profile.tables, (), tables)
    for name, table in profile.tables.items():
        if name not in ANY_KEY:
            check_keys(f"{label} [{name}]", table, (), keys[name])
    for name, table in profile.configurations.items():
        check_keys(f"{label} [configurations.{name}]", table, (), keys["configurations"])
    return profile


@cache
def _shipped_keys() -> Mapping[str, set[str]]:
    """Return the top-level keys of all shipped targets, each with the keys of its table; those of
    "configurations" are the keys of its builds.
    """
    keys: dict[str, set[str]] = {}
    for name in target_names():
        for key, content in read_toml("targets", name)[1].items():
            tables = [content] if isinstance(content, dict) else []
            if key == "configurations":
                tables = [*tables[0].values()]
            keys.setdefault(key, set()).update(*tables)
    return keys


def _with_base(label: str, raw: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Merge the file's own tables over those of its base, key by key, configurations included."""
    base = raw.pop("base", None)
    if base is None:
        return label, raw
    if base not in target_names():
        raise ProfileError(
            f"{label} base must be a shipped board, one of {', '.join(board_names())}, got "
            f"{printable(repr(base))}."
        )
    inherited = _with_base(*read_toml("targets", str(base)))[1]
    # Measured powers belong to one board, and no other board inherits them.
    power = {
        key: value for key, value in inherited.get("power", {}).items() if not key.endswith(WATTS)
    }
    below = {**inherited, "power": power}
    table = _joined(raw, below)
    # Under "configurations" each table holds the tables of the builds: one level more to join.
    if isinstance(builds := raw.get("configurations", {}), Mapping):
        table["configurations"] = _joined(builds, below.get("configurations", {}))
    return label, table


def _joined(above: Mapping[str, Any], below: Mapping[str, Any]) -> dict[str, Any]:
    """Return one set of tables over another, key by key; anything but a table replaces."""
    tables = {**below, **above}
    for key in above.keys() & below.keys():
        if isinstance(above[key], Mapping) and isinstance(below[key], Mapping):
            tables[key] = {**below[key], **above[key]}
    return tables
