"""What a scene calls for: light, and effects that it adds to a sensor or forbids (night port, haze
over sea, ...).
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

from beers_deploy.profiles.constant import Constant, check_keys, read_constant
from beers_deploy.profiles.effects import TABLES, Table, read_effect
from beers_deploy.profiles.errors import OptionError, ProfileError, printable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.toml import HERE, read_toml, shipped_names


@dataclass(frozen=True)
class SceneCall:
    """One TOML file under `profiles/scenes/`.

    `radiance_scale` multiplies the scene's radiance: photographs are of a clear day.
    """

    name: str
    description: str
    radiance_scale: Constant
    effects: dict[str, Table]
    without: tuple[str, ...]


def scene_names() -> list[str]:
    """The names of the shipped scenes."""
    return shipped_names("scenes")


def load_scene_call(name: str) -> SceneCall:
    """Read a shipped scene by name, or the user's own by the path of its .toml file."""
    label, raw = read_toml("scenes", name)
    check_keys(
        label, raw, required={"description", "radiance_scale"}, optional={"without", *TABLES}
    )
    scale = read_constant(f"{label} radiance_scale", raw["radiance_scale"])
    if scale.low <= 0:
        raise ProfileError(
            f"{label} radiance_scale must be above 0, but it is {scale}. Give 1 for a clear day."
        )
    effects = {key: read_effect(f"{label} [{key}]", key, raw[key]) for key in TABLES if key in raw}
    without = raw.get("without", [])
    if not isinstance(without, list) or not all(
        isinstance(w, str) and w in TABLES for w in without
    ):
        raise ProfileError(
            f"{label} without must be a list of names out of {', '.join(TABLES)}, got "
            f"{printable(repr(without))}. Correct the names."
        )
    if set(without) & set(effects):
        both = ", ".join(sorted(set(without) & set(effects)))
        raise ProfileError(f"{label} both adds and forbids {both}. Remove one of the two.")
    return SceneCall(
        label.removesuffix(".toml"), str(raw["description"]), scale, effects, tuple(without)
    )


def typical_effects() -> dict[str, Table]:
    """Typical values of every optional effect (`profiles/effects.toml`): what
    `--with NAME` adds.
    """
    label, raw = read_toml("", str(HERE / "effects.toml"))
    return {name: read_effect(f"{label} [{name}]", name, raw[name]) for name in TABLES}


def calling_for(
    profile: Sensor,
    scene: SceneCall | None,
    add: Collection[str] = (),
    forbid: Collection[str] = (),
) -> Sensor:
    """The profile with a scene's effects and `add`, without `forbid`; stated values win over
    typical ones.
    """
    for name in (*add, *forbid):
        if name not in TABLES:
            raise OptionError(
                f"There is no effect {name!r}. Correct the name, which must be one of "
                f"{', '.join(TABLES)}."
            )
    typical = typical_effects()
    effects = {**profile.effects, **(scene.effects if scene else {})}
    effects |= {name: typical[name] for name in add if name not in effects}
    forbidden = {*forbid, *(scene.without if scene else ())}
    return replace(
        profile,
        effects={
            name: effects[name] for name in TABLES if name in effects and name not in forbidden
        },
    )


def origins(
    profile: Sensor,
    scene: SceneCall | None,
    add: Collection[str] = (),
    forbid: Collection[str] = (),
) -> dict[str, str]:
    """Of each effect of `calling_for`'s profile where it comes from; of one that it lost, who
    leaves it out.
    """
    # What is stated wins over what is added.
    sources = dict.fromkeys(add, "`with_`")
    sources |= dict.fromkeys(("mtf", "noise", *profile.effects), f"sensor {profile.name}")
    if scene:
        sources |= dict.fromkeys(scene.effects, f"scene {scene.name}")
        sources |= dict.fromkeys(scene.without, f"left out by scene {scene.name}")
    return sources | dict.fromkeys(forbid, "left out by `without`")
