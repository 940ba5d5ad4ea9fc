"""Define what a scene requires: its light, and the effects that it adds to a sensor or forbids
(night port, haze over sea, ...).
"""

from collections.abc import Collection
from typing import Annotated, Self

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from beers_deploy.profiles.constant import Constant, Limits
from beers_deploy.profiles.effects import TABLES, AnyEffects, Effects, Table, effect_tables
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import HERE
from beers_deploy.profiles.toml import read_toml
from beers_deploy.profiles.validation import CONFIG, check_keys, validated


@dataclass(frozen=True, config=CONFIG)
class SceneCall:
    """The content of one TOML file under `profiles/scenes/`.

    `radiance_scale` multiplies the radiance of the scene, because photographs show a clear day.
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
        """Read a shipped scene by name, or the user's own by the path of its .toml file."""
        label, raw = read_toml("scenes", name)
        check_keys(label, raw, ("description", "radiance_scale"), ("without", *TABLES))
        fields = {key: value for key, value in raw.items() if key not in TABLES}
        fields["name"] = label.removesuffix(".toml")
        fields["effects"] = effect_tables(label, raw)
        return validated(SceneCall, fields, label, {"effects": ""})


def typical_effects() -> dict[str, Table]:
    """Return typical values of every optional effect (`profiles/effects.toml`), which `--with NAME`
    adds.
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
    `forbid`.

    Values that the profile or the scene states take precedence over typical ones.

    Args:
        profile: the sensor.
        scene: the scene, if any; it may add effects and forbid others.
        add: names of effects to add with typical values.
        forbid: names of effects to remove.

    Raises:
        OptionError: if a name is not that of an effect.
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
    return profile.with_fields(
        effects={name: effects[name] for name in effects if name not in forbidden}
    )


def origins(
    profile: Sensor,
    scene: SceneCall | None,
    add: Collection[str] = (),
    forbid: Collection[str] = (),
) -> dict[str, str]:
    """Return, by name of the effect, where each effect of `calling_for`'s profile comes from.

    An effect that was removed is listed with the sensor, scene or option that removed it.
    """
    # Stated effects take precedence over added ones.
    sources = dict.fromkeys(add, "`with_`")
    sources |= dict.fromkeys(("mtf", "noise", *profile.effects), f"sensor {profile.name}")
    if scene:
        sources |= dict.fromkeys(scene.effects, f"scene {scene.name}")
        sources |= dict.fromkeys(scene.without, f"left out by scene {scene.name}")
    return sources | dict.fromkeys(forbid, "left out by `without`")
