"""`beers-deploy profiles` shows sensors, scenes and boards; `characterise` makes a sensor of raw
images.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from beers_deploy.commands.shared import Json, arguments, save, say
from beers_deploy.model.shipped import SENSOR
from beers_deploy.profiles import Sensor, load_sensor, load_target, sensor_names, target_names
from beers_deploy.profiles.constant import Constant, Words
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.response import MtfTable
from beers_deploy.profiles.scene_call import load_scene_call, scene_names
from beers_deploy.profiles.sensor import MTF_NYQUIST_MAX, TABLES, constant_keys
from beers_deploy.profiles.toml import profile_path, read_toml

Row = tuple[str, ...]


def profiles(
    name: Annotated[
        str | None, typer.Argument(help="A shipped profile, or a .toml file; none lists them all.")
    ] = None,
    toml: Annotated[
        bool, typer.Option("--toml", help="Print the file itself, to start one's own from.")
    ] = False,
) -> None:
    """List sensors, scenes and targets, or show one: every constant, its status and its source.

    The keys of a sensor's file, with units and ranges: docs/reference/sensor-profile.md.
    """
    if toml:
        # `say` prints one line, whatever characters it holds.
        for line in _file_text(name).removesuffix("\n").split("\n"):
            say(line)
        return
    from rich.table import Table

    from beers_deploy.results import default_console, plain

    if name is None:
        table = Table("name", "kind", "what it is", title_justify="left")
        rows: list[Row] = [
            (sensor, "sensor", load_sensor(sensor).description) for sensor in sensor_names()
        ]
        rows += [(scene, "scene", load_scene_call(scene).description) for scene in scene_names()]
        rows += [(target, "target", load_target(target).description) for target in target_names()]
    else:
        title, rows = _shown(name)
        table = Table(
            "constant", "value", "status", "source", title=plain(title), title_justify="left"
        )
    for row in rows:
        table.add_row(*map(plain, row))
    default_console().print(table)


def _file_text(name: str | None) -> str:
    """The TOML of a profile that can be read as one."""
    if name is None:
        remedy = f"name one, such as {SENSOR}"
        raise OptionError(
            "--toml", expected="the name of a profile beside it", got="none", remedy=remedy
        )
    # A file that is no profile is refused here.
    _shown(name)
    kind = "targets"
    if name in sensor_names():
        kind = "sensors"
    elif name in scene_names():
        kind = "scenes"
    return profile_path(kind, name).read_text(encoding="utf-8")


def _shown(name: str) -> tuple[str, list[Row]]:
    """Title and rows (constant, value, status, source) of a sensor, a scene or a target, tried in
    that order.
    """
    if name in sensor_names() or (
        name.endswith(".toml") and "mtf" in read_toml("sensors", name)[1]
    ):
        sensor = load_sensor(name)
        return f"{sensor.name}: {sensor.description}", _sensor_rows(sensor)
    if name in scene_names() or (
        name.endswith(".toml") and "radiance_scale" in read_toml("scenes", name)[1]
    ):
        scene = load_scene_call(name)
        rows = [_row("radiance_scale", scene.radiance_scale), *_table_rows(scene.effects)]
        return f"{scene.name}: {scene.description}", rows
    if name in target_names() or name.endswith(".toml"):
        target = load_target(name)
        groups: dict[str, Mapping[str, Constant | Words]] = {
            **target.tables,
            **{f"configurations.{k}": v for k, v in target.configurations.items()},
        }
        groups |= {"activations": target.activations, "npu": target.npu}
        return f"{target.name}: {target.description}", _table_rows(groups)
    names = ", ".join([*sensor_names(), *scene_names(), *target_names()])
    raise OptionError(
        "profile",
        expected=f"one of {names}",
        got=repr(name),
        remedy="choose one, or give a .toml file",
    )


def _sensor_rows(sensor: Sensor) -> list[Row]:
    rows: list[Row] = []
    for table in TABLES:
        constants = [(f"{table}.{key}", getattr(sensor, key)) for key in constant_keys(table)]
        rows += [_row(key, constant) for key, constant in constants if constant is not None]
        rows += _response(sensor) if table == "mtf" else []
    return rows + _table_rows(sensor.effects)


def _response(sensor: Sensor) -> list[Row]:
    """A table's numbers, or what a point-spread function is made of."""
    response = sensor.response
    origin = (sensor.mtf_nyquist.status, sensor.mtf_nyquist.source)
    if response is None:
        return []
    if not isinstance(response, MtfTable):
        return [("mtf.psf", str(response), *origin)]
    columns = {"frequency": response.frequency, "across": response.across, "along": response.along}
    return [
        (f"mtf.{key}", ", ".join(f"{v:g}" for v in values), *origin)
        for key, values in columns.items()
    ]


def _table_rows(tables: Mapping[str, Mapping[str, Constant | Words]]) -> list[Row]:
    rows = list[Row]()
    for name, table in tables.items():
        rows += [_row(f"{name}.{key}", value) for key, value in table.items()]
    return rows


def _row(key: str, constant: Constant | Words) -> Row:
    return key, str(constant), constant.status, constant.source


def characterise(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="Raw images of one sensor, or folders of them: whole numbers, one band."
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The sensor profile, a TOML file.")],
    edge: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE:X,Y,WIDTH,HEIGHT",
            help="A box with one straight edge; searched for if none.",
        ),
    ] = None,
    mtf: Annotated[
        str | None,
        typer.Option(
            metavar="ACROSS[,ALONG]",
            help="MTF at Nyquist if you know it, 0.07 is 7 %; measured if none.",
        ),
    ] = None,
    black_level: Annotated[
        float | None,
        typer.Option(help="Value of the dark in the images; 0 counts as dark if none."),
    ] = None,
    bits: Annotated[
        int | None,
        typer.Option(min=1, max=16, help="Bits of a pixel; found from clipped pixels if none."),
    ] = None,
    gain: Annotated[
        float | None,
        typer.Option(help="DN per W/m2/sr/um; full scale is taken for 400 W/m2/sr/um if none."),
    ] = None,
    gsd: Annotated[
        float | None, typer.Option(help="Ground sampling distance in m; no pixel depends on it.")
    ] = None,
    json: Json = None,
) -> None:
    """Measure MTF and noise on raw images and write them as a sensor profile, for every --sensor.

    The MTF needs straight edges: a target, roofs, kerbs, shadows. Where they give none, --mtf or an
    assumption takes its place. The noise needs raw pixels: what was denoised, sharpened or
    resampled is refused.
    """
    from beers_deploy.model.io.files import require_writable, write_text
    from beers_deploy.results import Table as Results
    from beers_deploy.results import print_rows
    from beers_deploy.studies.characterise import Stated, profile_toml
    from beers_deploy.studies.characterise import characterise as measure

    require_writable(out, json, inputs=images)
    measurement = measure(images, edge or (), Stated(bits, gain, gsd, black_level, _contrasts(mtf)))
    rows = measurement.rows()
    count = len(measurement.frames.paths)
    print_rows(f"sensor of {count} image{'' if count == 1 else 's'}", rows)
    for note in measurement.notes():
        say(f"note: {note}")
    write_text(out, profile_toml(measurement))
    save(Results("characterise", arguments(), measurement.frames.paths, tuple(rows)), json)
    say(f"wrote {out}: beers-deploy profiles {out}")


def _contrasts(words: str | None) -> tuple[float, float] | None:
    """The contrast at Nyquist across and along the track that --mtf states, one number for both or
    two.
    """
    if words is None:
        return None
    try:
        # One number stands for both axes.
        across, along = (float(part) for part in (words.split(",") * 2)[:2])
    except ValueError:
        # NaN lies within no limits, so the message below covers words as well.
        across = along = math.nan
    if words.count(",") > 1 or not (0 < across <= MTF_NYQUIST_MAX and 0 < along <= MTF_NYQUIST_MAX):
        expected = f"one or two ratios above 0 and up to {MTF_NYQUIST_MAX:.4f}"
        raise OptionError(
            "mtf", expected=expected, got=repr(words), remedy="write 0.07 for 7 %, or 0.09,0.05"
        )
    return across, along
