"""A user's own sensor file: a shipped file with some of its text replaced."""

from pathlib import Path

from beers_deploy.profiles.constant import Stated
from beers_deploy.profiles.response import MtfTable
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import axes_of
from tests.project_files import text_of

SHIPPED = text_of("profiles/sensors/pleiades-degraded.toml")


def edited(*changes: tuple[str, str]) -> str:
    """Return the shipped file's text with every `old` replaced by its `new`."""
    text = SHIPPED
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def own_sensor(folder: Path, *changes: tuple[str, str], text: str | None = None) -> Path:
    """Write the edited text, or `text` if given, to mine.toml in `folder` and return its path."""
    path = folder / "mine.toml"
    path.write_text(edited(*changes) if text is None else text, encoding="utf-8")
    return path


def departing(sensor: Sensor) -> Sensor:
    """Return a sensor with a table whose MTF departs from the formula's curve."""
    table = MtfTable((0.0, 0.25, 0.5), (1.0, 0.6, 0.1), (1.0, 0.6, 0.1))
    about = Stated(table, "stated", "for a test")
    return sensor.with_fields(response=table, **axes_of(table, about, about))
