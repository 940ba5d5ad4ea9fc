"""Tests of targets with a known truth, on methods that do nothing, scale, blur or sharpen."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from beers_deploy.model.metrics.refusal import Refusal
from beers_deploy.profiles.figures import Row
from beers_deploy.studies.evaluation import target_scenes
from beers_deploy.studies.evaluation.methods import BLIND, Method, method_named
from beers_deploy.studies.evaluation.target_scenes import Targets, acquire_targets
from beers_deploy.studies.evaluation.targets import (
    OF_REFERENCE,
    flat_figure,
    flux_name,
    mean_figures,
    mtf_figure,
    target_row,
)
from tests.deploy.studies.evaluation.small_pairs import DEGRADED, IDENTITY, REFERENCE, SENSORS


@pytest.fixture(scope="module")
def raw_targets() -> Iterator[Targets]:
    """Acquire the targets with the degraded sensor, with fewer edges, points and patterns."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(target_scenes, "REPEATS", 1)
        patch.setattr(target_scenes, "POINTS_A_SIDE", 3)
        patch.setattr(target_scenes, "BAR_CONTRASTS", (0.1,))
        yield acquire_targets(*SENSORS, 0)


@pytest.fixture(scope="module")
def perfect(raw_targets: Targets) -> Targets:
    """Return the targets as the reference sensor acquires them without noise.

    Only the background of the points has its noise.
    """
    points = [
        replace(target, acquired=target.flat + target.expected) for target in raw_targets.points
    ]
    return replace(
        raw_targets,
        points=points,
        patterns=[replace(target, acquired=target.expected) for target in raw_targets.patterns],
    )


def values(row: Row, unit: str) -> list[float]:
    """Return the values of the figures that have a unit."""
    return [figure.value or 0.0 for figure in row.figures.values() if figure.unit == unit]


@pytest.mark.parametrize("factor", [1.0, 0.5, 0.0, -1.0])
def test_flux_and_contrast_are_the_factor_of_a_linear_method_at_any_level(
    factor: float, perfect: Targets
) -> None:
    """The method leaves the reference unchanged, halves it, erases it or inverts it."""
    row = target_row(Method("linear", lambda dn: np.float32(factor) * dn + 37, BLIND), perfect)
    assert (row.table, row.name, row.text["sensor"]) == ("targets", "linear", BLIND)
    assert len(row.figures) == 6 + 3 + 2
    assert values(row, "%") == pytest.approx([100 * factor] * 6, abs=0.01)
    assert values(row, OF_REFERENCE) == pytest.approx([factor] * 5, abs=1e-4)


def test_a_blur_lowers_the_contrast_but_not_the_flux(perfect: Targets) -> None:
    blurred = target_row(Method("blur", lambda dn: gaussian_filter(dn, 1.0), BLIND), perfect)
    assert values(blurred, "%") == pytest.approx([100] * 6, abs=3)
    period_2, period_267, period_3, *plates = values(blurred, OF_REFERENCE)
    assert period_2 < period_267 < period_3 < 0.15
    # A Gaussian of sigma 1 px leaves exp(-2 (pi f)^2) of the contrast at a frequency f, here 1/3.
    assert period_3 == pytest.approx(np.exp(-2 * (np.pi / 3) ** 2), rel=0.05)
    assert max(plates) < 0.1


def test_flux_and_contrast_of_the_raw_image_are_those_of_its_blur(raw_targets: Targets) -> None:
    row = target_row(IDENTITY, raw_targets)
    bright = row.figures[flux_name(120, 100)]
    assert bright.value == pytest.approx(98, abs=2)
    assert bright.interval is not None
    low, high = bright.interval
    assert low < (bright.value or 0) < high
    assert row.figures["bars of 10%, period 2 px"].value == pytest.approx(7 / 25, abs=0.03)
    assert all(0.2 < value < 0.5 for value in values(row, OF_REFERENCE))


def test_targets_measure_the_sensor_and_the_result_of_a_chain(raw_targets: Targets) -> None:
    assert len(raw_targets.edges) == 4
    before = mean_figures(IDENTITY, raw_targets)
    assert before["MTF at Nyquist"].value == pytest.approx(7, abs=0.7)
    for radiance in (10, 25, 100):
        true_snr = radiance / SENSORS[0].noise_sigma(radiance)
        figure = before[f"SNR at {radiance} W/m2/sr/um"]
        assert figure.value == pytest.approx(true_snr, rel=0.06)
    after = mean_figures(method_named("traditional-fast", DEGRADED, REFERENCE), raw_targets)
    assert (after["MTF at Nyquist"].value or 0) > 12
    assert (after["SNR at 25 W/m2/sr/um"].value or 0) > 200


def test_refused_edges_and_silent_fields_are_unavailable() -> None:
    figure = mtf_figure([Refusal("a step of 3 in noise of 2")] * 3)
    assert figure.value is None
    assert "3 of 3 edges refused" in figure.reason
    assert flat_figure(np.full((9, 9), 100.0)).value is None
