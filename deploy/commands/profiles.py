"""`beers-deploy profiles`: list the sensor and target profiles, or show one with the source of each constant."""

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from profiles.constant import Constant

EXAMPLE = "profiles pleiades-degraded"


def profiles(
    name: Annotated[
        str | None, typer.Argument(help="A shipped profile, or a .toml file; none lists them all.")
    ] = None,
) -> None:
    """List sensors and targets, or show one: every constant, its status and its source."""
    from rich.table import Table

    from deploy.tables import default_console
    from profiles import load_sensor, load_target, sensor_names, target_names

    table = Table("name" if name is None else "constant", title_justify="left")
    if name is None:
        table.add_column("kind")
        table.add_column("what it is")
        for sensor in sensor_names():
            table.add_row(sensor, "sensor", load_sensor(sensor).description)
        for target in target_names():
            table.add_row(target, "target", load_target(target).description)
    else:
        for column in ("value", "status", "source"):
            table.add_column(column)
        title, constants = _constants(name)
        table.title = title
        for key, constant in constants:
            table.add_row(key, str(constant), constant.status, constant.source)
    default_console().print(table)


def _constants(name: str) -> "tuple[str, list[tuple[str, Constant]]]":
    """Title and constants of a sensor, or of a target when no sensor goes by that name."""
    from profiles import load_sensor, load_target, sensor_names, target_names
    from profiles.errors import OptionError
    from profiles.sensor import TABLES
    from profiles.toml import read_toml

    if name in sensor_names() or (name.endswith(".toml") and "mtf" in read_toml("sensors", name)[1]):
        sensor = load_sensor(name)
        keys = [(table, key) for table, keys in TABLES.items() for key in keys]
        return f"{sensor.name}: {sensor.description}", [(f"{t}.{k}", getattr(sensor, k)) for t, k in keys]
    if name in target_names() or name.endswith(".toml"):
        target = load_target(name)
        groups = {**target.tables, **{f"configurations.{k}": v for k, v in target.configurations.items()}}
        return f"{target.name}: {target.description}", [
            (f"{group}.{key}", value) for group, table in groups.items() for key, value in table.items()
        ]
    known = ", ".join([*sensor_names(), *target_names()])
    raise OptionError(
        "profile", expected=f"one of {known}", got=repr(name), remedy="choose one, or give a .toml file"
    )
