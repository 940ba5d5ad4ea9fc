"""Define what a scene requires: its light, and the effects that it adds to a sensor or forbids
(night port, haze over sea, ...).
"""

from collections.abc import Collection
from typing import Annotated, Self

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from beers_deploy.profiles.constant import Constant, Limits
from beers_deploy.profiles.effects import TABLES, AnyEffects, Effects, EffectTable, effect_tables
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import HERE
from beers_deploy.profiles.toml import read_toml
from beers_deploy.profiles.validation import CONFIG, check_keys, validated


@dataclass(frozen=True, config=CONFIG)
class SceneCall:
    """A kind of scene, such as a port at night: what it demands of the simulation of a sensor.

    It is the content of one TOML file under `profiles/scenes/`.

    Attributes:
        name: the name of the file, without its suffix.
        description: one sentence for the user.
        radiance_scale: the factor on the radiance of the scene; 1 is the clear day that photographs
            show.
        effects: the effects that the scene adds to a sensor, by name.
        without: the names of effects that the scene removes from a sensor.
    """

    name: str
    description: str
    radiance_scale: Annotated[Constant, Limits(1e-12, 1e12, hint="Give 1 for a clear day.")]
    effects: Effects = Field(default_factory=dict)
    without: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _agrees(self) -> Self:
        if not set(self.without) <= set(TABLES):
            raise ValueError(
                f"without must be a list of names out of {', '.join(TABLES)}, got "
                f"{list(self.without)}. Correct the names."
            )
        if both := set(self.without) & set(self.effects):
            raise ValueError(
                f"both adds and forbids {', '.join(sorted(both))}. Remove one of the two."
            )
        return self

    @classmethod
    def load(cls, name: str) -> "SceneCall":
        """Read a shipped scene by its name, or a user's scene by the path of its .toml file.

        Raises:
            ProfileError: unknown name, or a file with wrong, missing or contradictory keys.
        """
        label, raw = read_toml("scenes", name)
        check_keys(label, raw, ("description", "radiance_scale"), ("without", *TABLES))
        fields = {key: value for key, value in raw.items() if key not in TABLES}
        fields["name"] = label.removesuffix(".toml")
        fields["effects"] = effect_tables(label, raw)
        return validated(SceneCall, fields, label, {"effects": ""})


def typical_effects() -> dict[str, EffectTable]:
    """Read the typical values of every optional effect from `profiles/effects.toml`.

    `simulate --with NAME` adds an effect with these values.

    Returns:
        The parameters of each effect, by the name of the effect.
    """
    label, raw = read_toml("", str(HERE / "effects.toml"))
    return dict(validated(AnyEffects, raw, label))


def calling_for(
    profile: Sensor,
    scene: SceneCall | None,
    add: Collection[str] = (),
    forbid: Collection[str] = (),
) -> Sensor:
    """Return the profile with the effects of a scene and those in `add`, and without those in
    `forbid` and those that the scene removes.

    Values that the profile or the scene states take precedence over typical ones.

    Args:
        profile: the sensor.
        scene: the scene, if any; it may add effects and remove others.
        add: names of effects to add with typical values.
        forbid: names of effects to remove.

    Raises:
        OptionError: if a name is not that of an effect, or is in `add` and in `forbid`.
        ProfileError: if the resulting profile is contradictory.
    """
    for name in (*add, *forbid):
        if name not in TABLES:
            raise OptionError(
                f"There is no effect {name!r}. Correct the name, which must be one of "
                f"{', '.join(TABLES)}."
            )
    if both := {*add} & {*forbid}:
        raise OptionError(
            f"The simulation both adds and forbids {', '.join(sorted(both))} (`with_`, `without`). "
            "Remove one of the two."
        )
    typical = typical_effects()
    effects = {**profile.effects, **(scene.effects if scene else {})}
    effects |= {name: typical[name] for name in add if name not in effects}
    forbidden = {*forbid, *(scene.without if scene else ())}
    return profile.with_fields(
        effects={name: effects[name] for name in effects if name not in forbidden}
    )


def origins(
    profile: Sensor,
    scene: SceneCall | None,
    add: Collection[str] = (),
    forbid: Collection[str] = (),
) -> dict[str, str]:
    """State where each effect of a simulation comes from, for its printed plan.

    Args:
        profile: the sensor before `calling_for` was applied to it.
        scene: the scene, if any.
        add: names of effects that the user adds.
        forbid: names of effects that the user removes.

    Returns:
        From the name of an effect to the sensor, scene or option that added it, or that removed it.
    """
    # Stated effects take precedence over added ones.
    sources = dict.fromkeys(add, "`with_`")
    sources |= dict.fromkeys(("mtf", "noise", *profile.effects), f"sensor {profile.name}")
    if scene:
        sources |= dict.fromkeys(scene.effects, f"scene {scene.name}")
        sources |= dict.fromkeys(scene.without, f"left out by scene {scene.name}")
    return sources | dict.fromkeys(forbid, "left out by `without`")
