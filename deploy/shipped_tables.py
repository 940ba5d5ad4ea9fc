"""The shipped data as tables: sensors, scenes, boards, networks, and the constants of a profile."""

from collections.abc import Mapping
from itertools import product

from beers_deploy.model.shipped import INT8, shipped_names
from beers_deploy.profiles.constant import Constant, Words
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Figure, Mode, Row
from beers_deploy.profiles.response import MtfTable
from beers_deploy.profiles.scene_call import SceneCall
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import TABLES, constant_keys
from beers_deploy.profiles.shipped import (
    board_names,
    scene_names,
    sensor_names,
    target_names,
)
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.toml import read_toml
from beers_deploy.results import Table


def boards() -> Table:
    """List the boards with a DPU that this package has profiles of, one row for each.

    The texts of a row are the names of the DPU's configurations, and a description.

    Examples:
        >>> bd.boards().to_pandas().index.to_list()
        ['kv260', 'vck190', 'vek280', 'zcu102', 'zcu104']
    """
    rows = []
    for board in map(TargetProfile.load, board_names()):
        words = {
            "configurations": ", ".join(board.configurations),
            "description": board.description,
        }
        rows.append(Row("boards", board.name, {}, words))
    return Table("boards", rows=tuple(rows))


def sensors() -> Table:
    """List the sensor profiles of this package, one row for each.

    The figures of a row are the contrast (MTF) at the Nyquist frequency, the SNR at the second
    radiance of the profile, and the number of bits of a pixel. If a profile states a range, the
    figure is its middle, and the interval is the range.

    Examples:
        >>> bd.sensors().to_pandas().index.to_list()[2:]
        ['pleiades-degraded', 'pleiades-reference', 'pleiades-variable']
    """
    rows = []
    for sensor in map(Sensor.load, sensor_names()):
        figures = {"MTF at Nyquist": _figure(sensor.mtf_nyquist, "ratio")}
        if sensor.snr_1 is not None:
            figures["SNR"] = _figure(sensor.snr_1, "ratio")
        figures["bits"] = _figure(sensor.bits, "bit")
        rows.append(Row("sensors", sensor.name, figures, {"description": sensor.description}))
    return Table("sensors", rows=tuple(rows))


def _figure(constant: Constant, unit: str) -> Figure:
    """Return a constant as a figure, in which a range is the interval around its middle."""
    interval = None if constant.low == constant.high else (constant.low, constant.high)
    mode: Mode = "measured" if constant.status == "measured" else "published"
    source = f"{constant.status}: {constant.source}"
    return Figure(constant.middle, unit, mode, source, interval)


def networks() -> Table:
    """List the networks that are installed with this package, by the name that commands accept.

    Each has a row for float32 and one for INT8, whose name ends in -int8.

    Examples:
        >>> "convbeers-s-int8" in bd.networks().to_pandas().index
        True
    """
    pairs = product(shipped_names(), (("", "float32"), (INT8, "int8")))
    rows = [
        Row("networks", f"{name}{suffix}", {}, {"precision": precision})
        for name, (suffix, precision) in pairs
    ]
    return Table("networks", rows=tuple(rows))


def list_of_profiles() -> Table:
    """List the shipped sensors, scenes and boards: a table of each kind, with a description."""
    kinds = {
        "sensors": {name: Sensor.load(name).description for name in sensor_names()},
        "scenes": {name: SceneCall.load(name).description for name in scene_names()},
        "boards": {name: TargetProfile.load(name).description for name in target_names()},
    }
    rows = []
    for kind, descriptions in kinds.items():
        rows += [Row(kind, name, {}, {"what it is": text}) for name, text in descriptions.items()]
    return Table(rows=tuple(rows))


def kind_and_table(name: str) -> tuple[str, Table]:
    """Return the kind of a profile, and a table of its constants. The file is tried as a sensor, a
    scene and a target in turn.

    Args:
        name: the name of a shipped profile, or a .toml file.

    Returns:
        The name of the folder of such profiles, and a table with a row for each key of the file,
        whose texts are value, status and source.

    Raises:
        OptionError: there is no profile of this name.
    """
    if _is(name, "sensors", sensor_names(), "mtf"):
        sensor = Sensor.load(name)
        return "sensors", _table(sensor.name, sensor.description, _sensor_rows(sensor))
    if _is(name, "scenes", scene_names(), "radiance_scale"):
        scene = SceneCall.load(name)
        rows = [_row("radiance_scale", scene.radiance_scale), *_table_rows(scene.effects)]
        return "scenes", _table(scene.name, scene.description, rows)
    if name in target_names() or name.endswith(".toml"):
        target = TargetProfile.load(name)
        groups: dict[str, Mapping[str, Constant | Words]] = {
            **target.tables,
            **{f"configurations.{k}": v for k, v in target.configurations.items()},
        }
        groups |= {"activations": target.activations, "npu": target.npu}
        return "targets", _table(target.name, target.description, _table_rows(groups))
    names = ", ".join([*sensor_names(), *scene_names(), *target_names()])
    raise OptionError(
        f"`name` must be one of {names}, or a .toml file, but it is {name!r}. Choose one."
    )


def _is(name: str, kind: str, shipped: list[str], key: str) -> bool:
    """Return True if a profile is of a kind, by its name or by a key in its file."""
    return name in shipped or (name.endswith(".toml") and key in read_toml(kind, name)[1])


def _table(name: str, description: str, rows: list[Row]) -> Table:
    return Table(title=f"{name}: {description}", rows=tuple(rows), headings={"constants": ""})


def _sensor_rows(sensor: Sensor) -> list[Row]:
    rows: list[Row] = []
    for table in TABLES:
        constants = [(f"{table}.{key}", getattr(sensor, key)) for key in constant_keys(table)]
        rows += [_row(key, constant) for key, constant in constants if constant is not None]
        response = sensor.response
        if table != "mtf" or response is None:
            continue
        # The MTF is a measured table, or follows from parts of a point-spread function.
        across, along = sensor.contrasts
        texts = {"psf": str(response)}
        if isinstance(response, MtfTable):
            columns = ("frequency", "across", "along")
            texts = {key: ", ".join(f"{v:g}" for v in getattr(response, key)) for key in columns}
        for key, text in texts.items():
            about = along if key == "along" else across
            words = {"value": text, "status": about.status, "source": about.source}
            rows.append(Row("constants", f"mtf.{key}", {}, words))
    return rows + _table_rows(sensor.effects)


def _table_rows(tables: Mapping[str, Mapping[str, Constant | Words]]) -> list[Row]:
    rows = list[Row]()
    for name, table in tables.items():
        rows += [_row(f"{name}.{key}", value) for key, value in table.items()]
    return rows


def _row(key: str, constant: Constant | Words) -> Row:
    words = {"value": str(constant), "status": constant.status, "source": constant.source}
    return Row("constants", key, {}, words)
