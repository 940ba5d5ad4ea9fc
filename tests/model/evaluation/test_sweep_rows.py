"""Tables of a sweep from numbers that are known: gains are paired, and the least one is named."""

import numpy as np
import pytest

from model.evaluation.sweep_rows import Found, Key
from profiles.figures import Row, by_table, unavailable

SITES = ["a", "b", "c", "d", "e", "f"]


def found() -> Found:
    """Sites differ by 20 dB, the network's lead over the chain by nothing under one condition, a little under two."""
    site = np.linspace(30, 50, len(SITES))
    lead = {"nominal": np.full(6, 0.75), "MTF 3%": np.linspace(0.1, 0.5, 6)}
    psnr: dict[Key, np.ndarray] = {}
    for truth, ahead in lead.items():
        levels = {"degraded": site - 8, "traditional": site, "net": site + ahead}
        psnr |= {(truth, truth, name): np.stack([level, level + 1]) for name, level in levels.items()}
    psnr["MTF 3%", "nominal", "traditional"] = np.stack([site - 2, site - 2])
    psnr["MTF 3%", "MTF 7%", "net"] = np.stack([site - 1, site - 1])
    return Found(psnr, dict.fromkeys(psnr, unavailable("%", "no edges here")), SITES, 0)


def tables() -> dict[str, list[Row]]:
    return by_table(found().rows)


def test_the_interval_of_a_gain_is_that_of_differences_on_the_same_images() -> None:
    nominal, blurred = (row.figures["net"] for row in tables()["sweep, gain over the chain"])
    assert nominal.value == pytest.approx(0.75)
    assert nominal.interval == pytest.approx((0.75, 0.75))
    assert blurred.interval is not None
    assert 0.1 <= blurred.interval[0] < (blurred.value or 0) < blurred.interval[1] <= 0.5


def test_over_all_conditions_mean_and_least_gain_are_named() -> None:
    (row,) = tables()["sweep, gain over the chain, all conditions"]
    assert row.name == "net"
    assert row.figures["mean of 2 conditions"].value == pytest.approx((0.75 + 0.3) / 2)
    assert row.figures["least"].value == pytest.approx(0.3)
    assert row.text == {"least at": "MTF 3%"}


def test_the_reference_without_noise_has_a_table_of_its_own() -> None:
    noisy, clean = (tables()[f"sweep, PSNR{end}"][0].figures for end in ("", ", reference without noise"))
    assert (clean["net"].value or 0) - (noisy["net"].value or 0) == pytest.approx(1)


def test_what_a_wrongly_known_sensor_costs_is_on_the_same_images() -> None:
    (row,) = tables()["sweep, lost by a sensor known wrongly"]
    assert row.name == "MTF 3%, supposed MTF 7%"
    assert row.figures["net"].value == pytest.approx(1.3)
    assert row.figures["net"].interval is not None
    assert row.figures["net"].interval[1] - row.figures["net"].interval[0] < 0.5


def test_without_networks_there_are_no_gains() -> None:
    one = found()
    chain = {key: values for key, values in one.psnr.items() if key[2] != "net"}
    assert not [row for row in Found(chain, one.mtf, SITES, 0).rows if "gain" in row.table]
