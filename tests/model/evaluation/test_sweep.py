"""Conditions of a sweep, and what a chain loses when it is told the wrong sensor."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from model.evaluation import run as module
from model.evaluation import targets as targets_module
from model.evaluation.methods import Method
from model.evaluation.run import NOMINAL_KNOWN, TRUTH_KNOWN, Condition, Fixed, conditions, sweep_rows
from model.simulator.procedural import procedural_scene
from profiles import SensorProfile, load_sensor
from profiles.figures import Row
from profiles.sensor import Sensor

PROFILE, REFERENCE = load_sensor("pleiades-degraded"), load_sensor("pleiades-reference")
NOMINAL = PROFILE.nominal()


def test_every_condition_is_a_sensor_that_can_be() -> None:
    found = conditions(NOMINAL, PROFILE)
    assert found[0].sensor == NOMINAL
    assert len({each.name for each in found}) == len(found)
    for each in found:
        assert 0 < each.sensor.mtf_nyquist < 0.6
        assert each.sensor.alpha >= 0
        assert each.sensor.beta >= 0


def test_a_fixed_sensor_is_what_every_draw_gives() -> None:
    assert Fixed(NOMINAL).draw(np.random.default_rng(0)) is NOMINAL


def rows(monkeypatch: pytest.MonkeyPatch, chosen: Sequence[Condition]) -> dict[str, Row]:
    monkeypatch.setattr(targets_module, "REPEATS", 1)

    def few(_nominal: Sensor, _profile: SensorProfile) -> list[Condition]:
        return list(chosen)

    monkeypatch.setattr(module, "conditions", few)
    scene = procedural_scene(700, 760, np.random.default_rng(5))
    half = Method("half", lambda dn: dn / 2, "nothing")
    ticks: list[int] = []
    found = sweep_rows([half], [scene], PROFILE, REFERENCE, 0, lambda: ticks.append(1))
    assert len(ticks) == len(chosen)
    assert [row.table for row in found] == sorted(row.table for row in found)
    return {row.name: row for row in found if row.table == "sweep, PSNR"}


def level(row: Row, method: str) -> float:
    return row.figures[method].value or 0.0


def test_the_truth_pays_where_the_sensor_has_drifted(monkeypatch: pytest.MonkeyPatch) -> None:
    drifted = Condition("MTF 3%", replace(NOMINAL, mtf_nyquist=0.03))
    found = rows(monkeypatch, [Condition("nominal", NOMINAL), drifted])
    assert level(found["nominal"], TRUTH_KNOWN) == level(found["nominal"], NOMINAL_KNOWN)
    assert level(found["MTF 3%"], TRUTH_KNOWN) > level(found["MTF 3%"], NOMINAL_KNOWN) + 1
    assert level(found["nominal"], "half") < level(found["nominal"], "degraded") - 5


def test_another_gain_is_told_to_the_chains_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference has the gain of the input, so brightness is no error of a method that knows no gains."""
    dimmer = replace(NOMINAL, gain_dn_per_radiance=0.7 * NOMINAL.gain_dn_per_radiance)
    found = rows(monkeypatch, [Condition("nominal", NOMINAL), Condition("dim", dimmer)])
    assert level(found["dim"], NOMINAL_KNOWN) == level(found["dim"], TRUTH_KNOWN)
    assert level(found["dim"], "degraded") == pytest.approx(level(found["nominal"], "degraded") + 3.1, abs=0.5)
