"""Tests that a gate's limits are read, and refused where no network can break them."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from beers_deploy.profiles.errors import OptionError
from beers_deploy.quant.limits import BREAKABLE, Limits, limits_of


def test_limits_come_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "gate.toml"
    path.write_text("mae = 0.0007\npsnr_drop_db = 0.25\n")
    limits = limits_of(path)
    assert (limits.mae, limits.psnr_drop_db, limits.p999) == (0.0007, 0.25, None)
    assert limits_of(path, 0.001).mae == 0.001
    assert limits_of(None) == Limits()
    assert limits_of({"mae": 0}).mae == limits_of(None, 0.0).mae == 0
    path.write_text("mae_growth = 1.2")
    # A limit that is left out has its default.
    assert limits_of(path) == Limits(mae_growth=1.2)


@pytest.mark.parametrize("name", BREAKABLE)
def test_a_limit_that_no_network_breaks_is_refused(name: str, tmp_path: Path) -> None:
    low, high = BREAKABLE[name]
    for value in (low, high):
        assert limits_of({name: value}) == replace(Limits(), **{name: value})
    for value in (high * 1.001, math.inf, *([low / 1.001] if low else [])):
        (tmp_path / "gate.toml").write_text(f"{name} = {value}")
        one = {name: value}
        for limits in (tmp_path / "gate.toml", one, replace(Limits(), **one)):
            with pytest.raises(OptionError, match="broken network"):
                limits_of(limits)
    with pytest.raises(OptionError, match="max_mae"):
        limits_of(None, math.inf)


@pytest.mark.parametrize(("name", "value"), [("mae", 0.5), ("p999", 1.1), ("saturated", 2.0)])
def test_a_limit_that_a_black_image_meets_is_refused(name: str, value: float) -> None:
    """The values are written out, because the table of the bounds may be wrong itself."""
    with pytest.raises(OptionError, match="broken network"):
        limits_of({name: value})


INVALID = [
    "mae = 'small'",
    "mae = true",
    "mea = 0.1",
    "mae = -1",
    "mae = nan",
    "= 3",
    "[mae]",
    "",
    "# none",
]


@pytest.mark.parametrize(
    "text", [*INVALID, "mae = [1]", "mae = 0x" + "f" * 400, "mae = " + "9" * 5000]
)
def test_invalid_limits_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "gate.toml").write_text(text)
    with pytest.raises(OptionError, match=r"gate\.toml(?!.*sys\.set).* mae\b"):
        limits_of(tmp_path / "gate.toml")
    with pytest.raises(OptionError, match="no such file"):
        limits_of(tmp_path / "none.toml")
