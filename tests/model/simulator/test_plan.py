"""Tests that no skipped effect would have changed a pixel by more than its bound."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.model.simulator.acquire import prepare_scene, simulate_planned, without
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.plan import (
    ORDER,
    TOLERANCE_DN,
    Plan,
    effect_bounds,
    make_plan,
    scene_stats,
)
from beers_deploy.model.simulator.sampling import crop_divisible
from beers_deploy.profiles.effects import (
    TABLES,
    AntiAlias,
    Defects,
    Dsnu,
    Effect,
    FullWell,
    Haze,
    Offset,
    Prnu,
    Smear,
    Striping,
)
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.response import MtfTable
from tests.model.simulator import stages

EXAMPLES = int(os.environ.get("BEERS_PLAN_EXAMPLES", "60"))
"""Run more by hand: BEERS_PLAN_EXAMPLES=5000 pytest tests/model/simulator/test_plan.py."""

ROUNDING_DN = 0.02
"""The rounding of float32 arithmetic at a few thousand DN."""

ALL_APPLIED = Plan((), TOLERANCE_DN)
"""A plan that skips nothing."""


def draw_scene(
    kind: str, height: int, width: int, level: float, contrast: float, seed: int
) -> np.ndarray:
    noise: np.ndarray = np.random.default_rng(seed).random((height, width), np.float32)
    if kind == "ramp":
        noise = (np.arange(height)[:, None] + np.arange(width)) / (height + width)
    if kind == "points":
        noise = noise > 0.995
    if kind == "checkers":
        noise = (np.arange(height)[:, None] // 3 + np.arange(width) // 2) % 2
    if kind == "columns":
        noise = np.tile(noise[:1], (height, 1))
    return np.asarray(level * (1 + contrast * (noise - 0.5)).clip(0), np.float32)


scenes = st.builds(
    draw_scene,
    st.sampled_from(["noise", "ramp", "points", "columns", "checkers"]),
    st.sampled_from([60, 90, 150]),
    st.sampled_from([60, 75, 105]),
    st.floats(0.1, 380),
    st.sampled_from([0.0, 1e-5, 1e-4, 1e-2, 0.5, 2.0]),
    st.integers(0, 99),
)

OPTIONAL: dict[str, st.SearchStrategy[Effect]] = {
    "antialias": st.builds(AntiAlias, st.floats(0, 0.3)),
    "smear": st.builds(Smear, st.floats(0, 3)),
    "veil": st.builds(Haze, st.floats(0.3, 1), st.sampled_from([0.0, 0.01, 5.0])),
    "full_well": st.builds(FullWell, st.floats(1, 500), st.floats(0, 0.5), st.floats(0, 8)),
    "prnu": st.builds(Prnu, st.sampled_from([0.0, 1e-5, 1e-3, 0.05])),
    "dsnu": st.builds(Dsnu, st.sampled_from([0.0, 0.01, 2.0])),
    "striping": st.builds(Striping, st.sampled_from([0.0, 0.1, 5.0])),
    "offset": st.builds(Offset, st.sampled_from([0.0, 0.05, 64.0])),
    "defects": st.builds(Defects, st.sampled_from([0.0, 1000.0]), st.sampled_from([0.0, 2000.0])),
}
effects = st.fixed_dictionaries({}, optional={name: OPTIONAL[name] for name in TABLES})
formula_sensors = st.builds(
    lambda m, a, b, e, along: Instrument(m, a, b, 10.2375, 12, e, along),
    st.floats(0.005, 0.3),
    st.sampled_from([0.0, 0.0077]),
    st.sampled_from([0.0, 1e-6, 0.058]),
    effects,
    st.one_of(st.none(), st.floats(0.005, 0.3)),
)
EDGED = (1, 0.85, 0.75, 0.01)
RESPONSES = (
    # This curve falls so steeply that an edge rings.
    MtfTable((0, 0.3, 0.4, 0.5), EDGED, EDGED),
    stages.formula_table(0.12, 0.05),
    stages.gaussian_pixel(0.3, 0.5, 4, 21),
    stages.formula_point(0.07, 2, 12, odd=True),
    stages.lopsided_point(),
)
sensors = st.one_of(
    formula_sensors,
    st.builds(
        lambda sensor, response: stages.with_response(without(sensor, ["antialias"]), response),
        formula_sensors,
        st.sampled_from(RESPONSES),
    ),
)


def change(radiance: np.ndarray, sensor: Instrument, ratio: int, name: str, seed: int) -> float:
    """Return the largest change of a pixel before digitization if one effect is left out."""
    skip = {name, "smear", "antialias"} if name == "mtf" else {name}
    radiance = crop_divisible(radiance, ratio)
    exact = stages.before_digitising(radiance, sensor, ratio, Draw(seed))
    return float(
        np.abs(exact - stages.before_digitising(radiance, sensor, ratio, Draw(seed), skip)).max()
    )


@settings(max_examples=EXAMPLES)
@given(scenes, sensors, st.sampled_from([1, 2, 3, 5]), st.integers(0, 99))
def test_no_bound_is_ever_exceeded(
    radiance: np.ndarray, sensor: Instrument, ratio: int, seed: int
) -> None:
    stats = scene_stats(crop_divisible(radiance, ratio), ratio)
    for name, bound in effect_bounds(sensor, stats).items():
        assert change(radiance, sensor, ratio, name, seed) <= bound * (1 + 1e-4) + ROUNDING_DN, name


@settings(max_examples=EXAMPLES)
@given(scenes, sensors, st.sampled_from([1, 2, 3, 5]), st.integers(0, 99))
def test_the_plan_keeps_within_its_tolerance(
    radiance: np.ndarray, sensor: Instrument, ratio: int, seed: int
) -> None:
    scene = prepare_scene(radiance, ratio)
    radiance = scene.radiance
    plan = make_plan(sensor, scene.stats)
    exact = stages.before_digitising(radiance, sensor, ratio, Draw(seed))
    planned = stages.before_digitising(radiance, sensor, ratio, Draw(seed), plan.skipped)
    assert np.abs(exact - planned).max() <= TOLERANCE_DN + ROUNDING_DN
    products = [
        simulate_planned(scene, sensor, Draw(seed), p, margin_px=2) for p in (plan, ALL_APPLIED)
    ]
    # Both are roundings of almost the same number, so they differ by at most one.
    assert np.abs(products[0] - products[1]).max() <= 1


STRONG: dict[str, Effect] = {
    "smear": Smear(2.0),
    "veil": Haze(0.5, 20.0),
    "full_well": FullWell(150.0, 0.0, 0.0),
    "prnu": Prnu(0.05),
    "dsnu": Dsnu(5.0),
    "striping": Striping(5.0),
    "offset": Offset(50.0),
    "defects": Defects(50_000, 0.0),
}


@pytest.mark.parametrize(
    "name", ["mtf", "noise", *(name for name in TABLES if name != "antialias")]
)
def test_a_quarter_of_any_bound_would_be_caught(name: str) -> None:
    """The bounds are not loose: each is less than four times the largest change."""
    radiance = np.zeros((90, 75), np.float32)
    radiance[10, :] = radiance[20:70, 10:50] = 200.0
    sensor = stages.plain_sensor(**{name: STRONG[name]} if name in TABLES else {})
    # The bound of smear ignores how much of it a blur hides. Only a sharp sensor comes near the
    # bound.
    if name == "smear":
        sensor = replace(sensor, mtf_nyquist=0.6)
    bound = effect_bounds(sensor, scene_stats(radiance, 1))[name]
    error = change(radiance, sensor, 1, name, 0)
    assert bound / 4 + ROUNDING_DN < error <= bound + ROUNDING_DN


SCENE = draw_scene("noise", 60, 80, 100, 0.5, 0)
FLAT = np.full((60, 80), 50.0, np.float32)
BLURRED = stages.plain_sensor(smear=Smear(2.0), antialias=AntiAlias(0.1))
WELL = stages.plain_sensor(full_well=FullWell(300.0, 0.3, 4.0))


@pytest.mark.parametrize(
    ("radiance", "sensor", "names", "choice"),
    [
        (FLAT, BLURRED, ("mtf", "smear", "antialias"), "cannot show"),
        (FLAT, BLURRED, ("noise", "sampling", "digitising"), "applied"),
        (SCENE, WELL, ("full_well",), "cannot show"),
        (SCENE * 3, WELL, ("full_well",), "applied"),
        (SCENE, stages.plain_sensor(striping=Striping(0.2)), ("striping",), "cannot show"),
        (SCENE, stages.plain_sensor(striping=Striping(0.0)), ("striping",), "neutral"),
        (SCENE, stages.plain_sensor(), ("striping",), "not called for"),
        (SCENE, replace(stages.plain_sensor(), alpha=0.0, beta=0.0), ("noise",), "neutral"),
    ],
)
def test_the_plan_depends_on_what_a_scene_can_show(
    radiance: np.ndarray, sensor: Instrument, names: tuple[str, ...], choice: str
) -> None:
    choices = {d.effect: d.choice for d in make_plan(sensor, scene_stats(radiance, 2)).decisions}
    assert {choices[name] for name in names} == {choice}


def test_a_plan_is_stored_as_json() -> None:
    plan = make_plan(stages.plain_sensor(**stages.TYPICAL), scene_stats(SCENE, 2))
    assert json.loads(json.dumps(plan.to_json()))["tolerance_dn"] == TOLERANCE_DN
    assert [decision.effect for decision in plan.decisions] == [*ORDER]
    assert len(plan.decisions) == 13


def test_a_flat_scene_is_simulated_without_a_transform() -> None:
    flat = np.full((200, 220), 60.0, np.float32)
    sensor = stages.plain_sensor()
    scene = prepare_scene(flat, 2)
    plan = make_plan(sensor, scene.stats)
    assert "mtf" in plan.skipped
    simulate_planned(scene, sensor, Draw(0), plan)
    assert "spectrum" not in vars(scene)
