"""Tests that docs/reference/sensor-profile.md names every key of a profile, with its range."""

import math
import re
import tomllib
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from beers_deploy.profiles.constant import Constant, Status
from beers_deploy.profiles.effects import TABLES as EFFECTS
from beers_deploy.profiles.instrument import MTF_NYQUIST_MAX
from beers_deploy.profiles.sensor import Sensor, same_instrument
from beers_deploy.profiles.sensor_file import TABLE_OF, TABLES, table_keys
from beers_deploy.profiles.shipped import sensor_names
from beers_deploy.profiles.validation import validated
from tests.deploy.command_line import done
from tests.project_files import text_of

PAGE = text_of("docs/reference/sensor-profile.md")
ROWS = dict(re.findall(r"^- `(\[\w+\] \w+)` \(.+?; (.+?)\): .+$", PAGE, re.MULTILINE))
"""The range of each key, as the page states it."""


def test_the_page_has_every_key_and_no_other() -> None:
    keys = set[str]()
    for table in TABLES:
        keys |= {f"[{table}] {key}" for key in table_keys(table)}
    for name, effect in EFFECTS.items():
        keys |= {f"[{name}] {key}" for key in effect.limits()}
    assert set(ROWS) == keys


@pytest.mark.parametrize("name", EFFECTS)
def test_the_page_gives_the_ranges_of_effects(name: str) -> None:
    for key, limits in EFFECTS[name].limits().items():
        assert ROWS[f"[{name}] {key}"].startswith(f"{limits.low:g} to {limits.high:g}")


def test_the_page_says_where_a_range_is_refused_and_what_bounds_the_mtf() -> None:
    hints = get_type_hints(Sensor, include_extras=True)
    single = {
        f"[{table}] {key}"
        for key, table in TABLE_OF.items()
        if any(limits.single for limits in getattr(hints[key], "__metadata__", ()))
    }
    assert {key for key, allowed in ROWS.items() if "no range" in allowed} == {
        *single,
        "[offset] offset_dn",
    }
    assert f"{MTF_NYQUIST_MAX:.4f}" in ROWS["[mtf] mtf_nyquist"]


@pytest.mark.parametrize("status", get_args(Status))
def test_the_page_names_every_status_and_each_is_read(status: str) -> None:
    assert f"`{status}`" in PAGE
    stated = {"value": 1, "status": status, "source": "a test"}
    assert validated(Constant, stated, "a test").status == status


WHOLE, *PARTS = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)


def test_the_example_of_the_page_is_a_profile(tmp_path: Path) -> None:
    (tmp_path / "my-sensor.toml").write_text(WHOLE, encoding="utf-8")
    assert Sensor.load(tmp_path / "my-sensor.toml").units == (10, 12, 0)


@pytest.mark.parametrize(
    ("part", "axes"), [*zip(PARTS, [(0.11, 0.08), (0.2, 0.1), (0.05, 0.05)], strict=True)]
)
def test_each_alternative_of_the_page_fits_into_the_example(
    part: str, axes: tuple[float, float], tmp_path: Path
) -> None:
    x = np.arange(-20, 21) / 8
    widths_px = (math.sqrt(-math.log(contrast) / 2) / (math.pi * 0.5) for contrast in (0.1, 0.2))
    down, right = (np.exp(-0.5 * (x / width) ** 2) for width in widths_px)
    np.save(tmp_path / "psf.npy", (down[:, None] * right).astype(np.float32))
    (name,) = tomllib.loads(part)
    text = re.sub(rf"\[{name}\].*?(?=\n\[)", lambda _: part, WHOLE, flags=re.DOTALL)
    (tmp_path / "my-sensor.toml").write_text(text, encoding="utf-8")
    assert Sensor.load(tmp_path / "my-sensor.toml").nominal().mtf_axes == pytest.approx(
        axes, abs=1e-3
    )


def test_profiles_print_the_file_to_start_from(tmp_path: Path) -> None:
    for name in (*sensor_names(), "snow", "vck190"):
        printed = done("profiles", name, "--toml")
        (tmp_path / "mine.toml").write_text(printed, encoding="utf-8")
        assert done("profiles", tmp_path / "mine.toml", "--toml") == printed
        if name in sensor_names():
            assert same_instrument(Sensor.load(tmp_path / "mine.toml"), Sensor.load(name))
