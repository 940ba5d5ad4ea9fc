"""Target profiles: what a processing board can do, every constant with its source.

A file may begin with `base = "zcu102"`: what it does not state is then that shipped board's. So a
board with a DPU of a known kind states its cores, clock and memory, and nothing else.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

from beers_deploy.profiles.constant import Constant, Words, check_keys, read_constant, read_words
from beers_deploy.profiles.errors import OptionError, ProfileError, printable
from beers_deploy.profiles.target_limits import CONFIGURATIONS, check_limits
from beers_deploy.profiles.toml import profile_path, read_toml, shipped_names

TILE_PX = 640
"""Side of a tile unless somebody asks for another: what the paper's network was
given on the board.
"""
DEFAULT_TARGET = "vck190"
"""The board of the paper: what a command takes where no board is named."""

MODEL_SUFFIX = "-model"
"""What `bench` adds to a board's name: its figures are of a model of the board."""

FUSED = ("ReLU", "ReLU6", "LeakyReLU", "PReLU", "hard-sigmoid", "hard-swish")
"""The activations that a board's file can list, as its manual names them."""
PLACES = frozenset({"conv", "depthwise", "pool", "sum", "alone"})
"""Where: behind a convolution, a depthwise one, a pool, an add or a mul; or by themselves, behind
anything.
"""
DOCUMENTS = frozenset({"operators", "numbers", "quantiser"})
"""Where a DPU's operators are listed, where its numbers are described, and the quantiser that knows
their windows.
"""
NPU = frozenset({"device", "int8", "no_int8"})
"""Of an NPU in place of a DPU's list: the compiler's name of it, and the operators that it has or
lacks in INT8.
"""

WATTS = "_w"
"""How the names of measured powers end, which no board takes from another."""


@dataclass(frozen=True, repr=False)
class TargetProfile:
    """What one TOML file under `profiles/targets/` states, its base included.

    `tables` maps a topic ("array", "memory", "conv", "power", ...) to its constants;
    `configurations` maps the name of a build of the accelerator to its constants, and is empty
    where there is but one. `activations` says what is fused with which operation, `documents` names
    the manuals; both are empty of a board without a DPU. `npu` says which operators an NPU
    computes, and is empty of every other board.
    """

    name: str
    description: str
    default_configuration: str | None
    configurations: dict[str, dict[str, Constant]]
    tables: dict[str, dict[str, Constant]]
    activations: dict[str, Words] = field(default_factory=dict)
    documents: dict[str, str] = field(default_factory=dict)
    npu: dict[str, Words] = field(default_factory=dict)

    @classmethod
    def load(cls, board: "TargetProfile | str | os.PathLike[str]") -> Self:
        """A shipped board by its name, the user's own by the path of its .toml file, or the board
        given.
        """
        if isinstance(board, cls):
            return board
        return cls(
            **vars(board if isinstance(board, TargetProfile) else load_target(os.fspath(board)))
        )

    def __repr__(self) -> str:
        builds = f", {', '.join(self.configurations)}" if self.configurations else ""
        return f"{type(self).__name__}({self.name!r}{builds})"

    def value(self, table: str, key: str) -> float:
        """The single value of a constant that states no range."""
        return self.constant(table, key).low

    def constant(self, table: str, key: str) -> Constant:
        """A constant with its range and source."""
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
        """Name and constants of configuration `name`, or of the default one."""
        build = name or self.default_configuration
        if build is None or build not in self.configurations:
            missing = "default configuration" if build is None else f"configuration {build!r}"
            raise ProfileError(
                f"The target profile {self.name} has no {missing}. Choose one of its "
                f"configurations as `dpu`: {', '.join(self.configurations) or 'none'}."
            )
        return build, self.configurations[build]


def target_names() -> list[str]:
    """The names of the shipped target profiles."""
    return shipped_names("targets")


def board_names() -> list[str]:
    """The names of the shipped targets with a DPU: their files name its manual."""
    return _names_with(r"^(base =|operators =)")


def npu_names() -> list[str]:
    """The names of the shipped targets with an NPU: it has rules and no cost model."""
    return _names_with(r"^\[npu]")


def _names_with(line: str) -> list[str]:
    texts = {
        name: profile_path("targets", name).read_text(encoding="utf-8") for name in target_names()
    }
    return [name for name, text in texts.items() if re.search(line, text, re.MULTILINE)]


def load_target(name: str) -> TargetProfile:
    """Read a shipped target profile by name, or the user's own by the path of its .toml file.

    A board's cost model has the name of the board: `vck190-model`, as `bench` calls it, is
    `vck190`.
    """
    label, raw = _with_base(*read_toml("targets", name.removesuffix(MODEL_SUFFIX)))
    special = {
        "description",
        "default_configuration",
        "configurations",
        "activations",
        "documents",
        "npu",
    }
    check_keys(label, {k: v for k, v in raw.items() if k in special}, {"description"}, special)
    tables = {k: _table(f"{label} [{k}]", k, v) for k, v in raw.items() if k not in special}
    configurations = {
        k: _table(f"{label} [configurations.{k}]", CONFIGURATIONS, v)
        for k, v in _mapping(f"{label} configurations", raw.get("configurations", {})).items()
    }
    default = raw.get("default_configuration")
    activations = _whole_table(label, raw, "activations", PLACES)
    npu = _whole_table(label, raw, "npu", NPU)
    # The rules of an NPU stand in [npu], in place of a DPU's manuals.
    documents = _whole_table(
        label, raw, "documents", frozenset({"quantiser"}) if npu else DOCUMENTS
    )
    profile = TargetProfile(
        label.removesuffix(".toml"),
        str(raw["description"]),
        str(default) if default else None,
        configurations,
        tables,
        {
            key: read_words(f"{label} [activations] {key}", value, FUSED)
            for key, value in activations.items()
        },
        {key: str(value) for key, value in documents.items()},
        {key: read_words(f"{label} [npu] {key}", value) for key, value in npu.items()},
    )
    if configurations:
        # This raises if the default is none of them.
        profile.configuration()
    return profile


def _with_base(label: str, raw: dict[str, object]) -> tuple[str, dict[str, object]]:
    """The file's own tables over those of its base, key by key; a configuration's too."""
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
        key: value
        for key, value in _mapping(label, inherited.get("power", {})).items()
        if not key.endswith(WATTS)
    }
    return label, _over(raw, {**inherited, "power": power}, depth=1)


def _over(
    above: Mapping[str, object], below: Mapping[str, object], depth: int
) -> dict[str, object]:
    """One table over another: `depth` levels of tables are joined, below them what stands above
    replaces.
    """
    table = dict(below)
    for key, value in above.items():
        under = below.get(key)
        if depth and isinstance(value, Mapping) and isinstance(under, Mapping):
            # Under "configurations" each table holds the tables of the builds: one level more to
            # join.
            table[key] = _over(value, under, depth if key == "configurations" else depth - 1)
        else:
            table[key] = value
    return table


def _whole_table(
    label: str, raw: Mapping[str, object], name: str, keys: frozenset[str]
) -> Mapping[str, object]:
    """A table that has all of its keys, or is not there at all."""
    if name not in raw:
        return {}
    table = _mapping(f"{label} [{name}]", raw[name])
    check_keys(f"{label} [{name}]", table, set(keys))
    return table


def _table(where: str, name: str, raw: object) -> dict[str, Constant]:
    constants = {
        key: read_constant(f"{where} {key}", value) for key, value in _mapping(where, raw).items()
    }
    check_limits(where, name, constants)
    return constants


def _mapping(where: str, raw: object) -> Mapping[str, object]:
    if not isinstance(raw, Mapping):
        raise ProfileError(
            f"{where} must be a table of constants, got {printable(repr(raw))}. Write it as "
            "[table]."
        )
    return raw


def require_side(tile_px: int) -> int:
    """The side of a tile, refused where it is none."""
    if tile_px < 1:
        raise OptionError(f"`tile` must be at least 1 px, got {tile_px} px. Choose another.")
    return tile_px
