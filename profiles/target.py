"""Target profiles: what a processing board can do, every constant with its source."""

from collections.abc import Mapping
from dataclasses import dataclass

from profiles.constant import Constant, check_keys, read_constant
from profiles.errors import ProfileError
from profiles.toml import read_toml, shipped_names

MODEL_SUFFIX = "-model"
"""What `bench` adds to a board's name: its figures are of a model of the board."""


@dataclass(frozen=True)
class TargetProfile:
    """What one TOML file under `profiles/targets/` states.

    `tables` maps a topic ("array", "memory", "conv", "power", ...) to its constants; `configurations` maps the name
    of a build of the accelerator to its constants, and is empty where there is but one.
    """

    name: str
    description: str
    default_configuration: str | None
    configurations: dict[str, dict[str, Constant]]
    tables: dict[str, dict[str, Constant]]

    def value(self, table: str, key: str) -> float:
        """The single value of a constant that states no range.

        Raises:
            ProfileError: the profile lacks it.
        """
        return self.constant(table, key).low

    def constant(self, table: str, key: str) -> Constant:
        """A constant with its range and source.

        Raises:
            ProfileError: the profile lacks it.
        """
        try:
            return self.tables[table][key]
        except KeyError:
            raise ProfileError(
                f"target profile {self.name}",
                expected=f"[{table}] {key}",
                got="none",
                remedy="add it to the file",
            ) from None

    def configuration(self, name: str | None = None) -> tuple[str, dict[str, Constant]]:
        """Name and constants of configuration `name`, or of the default one.

        Raises:
            ProfileError: no such configuration.
        """
        chosen = name or self.default_configuration
        if chosen is None or chosen not in self.configurations:
            raise ProfileError(
                f"target profile {self.name}",
                expected=f"a configuration out of {', '.join(self.configurations) or 'none'}",
                got=repr(name),
                remedy="choose one of them with --config",
            )
        return chosen, self.configurations[chosen]


def target_names() -> list[str]:
    """The names of the shipped target profiles."""
    return shipped_names("targets")


def load_target(name: str) -> TargetProfile:
    """Read a shipped target profile by name, or the user's own by the path of its .toml file.

    A board's cost model has the name of the board: `vck190-model`, as `bench` calls it, is `vck190`.

    Raises:
        ProfileError: unknown name, or a table that is not made of constants.
    """
    label, raw = read_toml("targets", name.removesuffix(MODEL_SUFFIX))
    special = {"description", "default_configuration", "configurations"}
    check_keys(label, {k: v for k, v in raw.items() if k in special}, {"description"}, special)
    tables = {k: _table(f"{label} [{k}]", v) for k, v in raw.items() if k not in special}
    configurations = {
        k: _table(f"{label} [configurations.{k}]", v)
        for k, v in _mapping(label, raw.get("configurations", {})).items()
    }
    default = raw.get("default_configuration")
    profile = TargetProfile(
        label.removesuffix(".toml"),
        str(raw["description"]),
        str(default) if default else None,
        configurations,
        tables,
    )
    if configurations:
        profile.configuration()
    return profile


def _table(where: str, raw: object) -> dict[str, Constant]:
    return {key: read_constant(f"{where} {key}", value) for key, value in _mapping(where, raw).items()}


def _mapping(where: str, raw: object) -> Mapping[str, object]:
    if not isinstance(raw, Mapping):
        raise ProfileError(where, expected="a table of constants", got=repr(raw), remedy="write it as [table]")
    return raw
