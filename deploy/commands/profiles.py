"""`beers-deploy profiles`: list the sensor, scene and target profiles, or show one with each constant's source."""

from typing import TYPE_CHECKING, Annotated

import typer

from deploy.commands.shared import say

if TYPE_CHECKING:
    from collections.abc import Mapping

    from profiles.constant import Constant
    from profiles.effects import Table

EXAMPLE = "profiles pleiades-degraded"


def profiles(
    name: Annotated[
        str | None, typer.Argument(help="A shipped profile, or a .toml file; none lists them all.")
    ] = None,
    toml: Annotated[bool, typer.Option("--toml", help="Print the file itself, to start one's own from.")] = False,
) -> None:
    """List sensors, scenes and targets, or show one: every constant, its status and its source.

    The keys of a sensor's file, with units and ranges: docs/sensor-profile.md.
    """
    if toml:
        say(_file_text(name).removesuffix("\n"))
        return
    from rich.table import Table

    from deploy.results import default_console, plain
    from profiles import load_sensor, load_target, sensor_names, target_names
    from profiles.scene_call import load_scene_call, scene_names

    table = Table("name" if name is None else "constant", title_justify="left")
    if name is None:
        table.add_column("kind")
        table.add_column("what it is")
        for sensor in sensor_names():
            table.add_row(sensor, "sensor", plain(load_sensor(sensor).description))
        for scene in scene_names():
            table.add_row(scene, "scene", plain(load_scene_call(scene).description))
        for target in target_names():
            table.add_row(target, "target", plain(load_target(target).description))
    else:
        for column in ("value", "status", "source"):
            table.add_column(column)
        title, constants = _constants(name)
        table.title = plain(title)
        for key, constant in constants:
            table.add_row(*map(plain, (key, str(constant), constant.status, constant.source)))
    default_console().print(table)


def _file_text(name: str | None) -> str:
    """The TOML of a profile that can be read as one."""
    from model.shipped import SENSOR
    from profiles import sensor_names
    from profiles.errors import OptionError
    from profiles.scene_call import scene_names
    from profiles.toml import profile_path

    if name is None:
        remedy = f"name one, such as {SENSOR}"
        raise OptionError("--toml", expected="the name of a profile beside it", got="none", remedy=remedy)
    _constants(name)
    kind = "sensors" if name in sensor_names() else "scenes" if name in scene_names() else "targets"
    return profile_path(kind, name).read_text(encoding="utf-8")


def _constants(name: str) -> "tuple[str, list[tuple[str, Constant]]]":
    """Title and constants of a sensor, a scene or a target, tried in that order."""
    from profiles import load_sensor, load_target, sensor_names, target_names
    from profiles.errors import OptionError
    from profiles.scene_call import load_scene_call, scene_names
    from profiles.sensor import OPTIONAL, TABLES
    from profiles.toml import read_toml

    if name in sensor_names() or (name.endswith(".toml") and "mtf" in read_toml("sensors", name)[1]):
        sensor = load_sensor(name)
        keys = [(table, key) for table, keys in TABLES.items() for key in (*keys, *OPTIONAL.get(table, ()))]
        given = [(f"{table}.{key}", getattr(sensor, key)) for table, key in keys]
        rows = [(key, constant) for key, constant in given if constant is not None] + _effects(sensor.effects)
        return f"{sensor.name}: {sensor.description}", rows
    if name in scene_names() or (name.endswith(".toml") and "radiance_scale" in read_toml("scenes", name)[1]):
        scene = load_scene_call(name)
        return f"{scene.name}: {scene.description}", [
            ("radiance_scale", scene.radiance_scale),
            *_effects(scene.effects),
        ]
    if name in target_names() or name.endswith(".toml"):
        target = load_target(name)
        groups = {**target.tables, **{f"configurations.{k}": v for k, v in target.configurations.items()}}
        return f"{target.name}: {target.description}", [
            (f"{group}.{key}", value) for group, table in groups.items() for key, value in table.items()
        ]
    known = ", ".join([*sensor_names(), *scene_names(), *target_names()])
    raise OptionError(
        "profile", expected=f"one of {known}", got=repr(name), remedy="choose one, or give a .toml file"
    )


def _effects(effects: "Mapping[str, Table]") -> "list[tuple[str, Constant]]":
    return [(f"{name}.{key}", constant) for name, table in effects.items() for key, constant in table.items()]
