"""Tests of the sensors that a network is trained on, and of their sensor vectors."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.model.convbeers import vector_tensor
from beers_deploy.model.family import RANGES, SensorFamily, sensor_values, sensor_vector
from beers_deploy.profiles.effects import Smear
from beers_deploy.profiles.instrument import Instrument
from tests.model.simulator.stages import NOMINAL

FAMILY = SensorFamily(NOMINAL)


def draw_sensor(seed: int) -> Instrument:
    return FAMILY.draw(np.random.default_rng(seed))


def test_the_values_of_a_sensor_known_by_hand() -> None:
    # The nominal sensor has SNR 50 at 25 and SNR 110 at 100 W/m2/sr/um. Its full scale is 400.
    values = sensor_values(NOMINAL)
    assert values["mtf_across"] == values["mtf_along"] == 0.07
    assert values["sigma_dark"] == pytest.approx(25 / 50 / 400, rel=2e-3)
    assert values["sigma_bright"] == pytest.approx(100 / 110 / 400, rel=1e-3)


def test_the_ends_of_the_ranges_are_minus_one_and_one() -> None:
    ends = [vector_tensor(replace(NOMINAL, mtf_nyquist=mtf)) for mtf in RANGES["mtf_across"]]
    assert [vector[:2].tolist() for vector in ends] == [[-1.0, -1.0], [1.0, 1.0]]
    middle = (RANGES["mtf_across"][0] * RANGES["mtf_across"][1]) ** 0.5
    assert float(vector_tensor(replace(NOMINAL, mtf_nyquist=middle))[0]) == pytest.approx(
        0, abs=1e-6
    )


@pytest.mark.parametrize(
    ("sensor", "name"),
    [
        (replace(NOMINAL, mtf_nyquist=0.25), "mtf_across"),
        (replace(NOMINAL, mtf_nyquist_along=0.005), "mtf_along"),
        (replace(NOMINAL, alpha=0.0, beta=0.0), "sigma_dark"),
        (replace(NOMINAL, alpha=1.0), "sigma_bright"),
    ],
)
def test_values_outside_the_ranges_are_clamped_with_a_warning(
    sensor: Instrument, name: str
) -> None:
    vector = sensor_vector(sensor)
    assert max(map(abs, vector.values)) == 1
    sentences = [sentence for sentence in vector.outside if sentence.startswith(name)]
    assert len(sentences) == 1
    assert "outside" in sentences[0]
    assert sentences[0].endswith("may restore worse than the traditional pipeline")


@pytest.mark.parametrize(
    ("along", "warned"), [(0.027, True), (0.029, False), (0.15, False), (0.07, False)]
)
def test_axes_further_apart_than_in_training_give_a_warning(along: float, warned: bool) -> None:
    for sensor in (
        replace(NOMINAL, mtf_nyquist_along=along),
        replace(NOMINAL, mtf_nyquist=along, mtf_nyquist_along=0.07),
    ):
        vector = sensor_vector(sensor)
        assert [sentence.startswith("the lower MTF") for sentence in vector.outside] == [
            True
        ] * warned


@given(st.integers(0, 2**20))
def test_no_sensor_that_is_trained_on_is_clamped_or_impossible(seed: int) -> None:
    sensor = draw_sensor(seed)
    assert sensor_vector(sensor).outside == ()
    assert sensor.alpha >= 0
    assert sensor.beta >= 0
    across, along = sensor.mtf_axes
    assert along <= across
    assert along >= 0.399 * across


def test_no_corner_of_the_ranges_is_starved() -> None:
    """Each of the four corners of blur and noise has more than 4 % of the sensors."""
    generator = np.random.default_rng(0)
    vectors = torch.stack([vector_tensor(FAMILY.draw(generator)) for _ in range(3000)])
    low = vectors[:, [0, 1, 3]] < -1 / 3
    high = vectors[:, [0, 1, 3]] > 1 / 3
    for sharp in (False, True):
        for noisy in (False, True):
            blur = (high if sharp else low)[:, :2].all(1)
            noise = high[:, 2] if noisy else low[:, 2]
            assert float((blur & noise).float().mean()) > 0.04
    shares = [sensor_values(FAMILY.draw(generator)) for _ in range(500)]
    ratios = np.array([share["mtf_along"] / share["mtf_across"] for share in shares])
    assert np.median(ratios) > 0.75
    assert (ratios < 0.5).mean() > 0.05


@pytest.mark.parametrize("gain", [0.4, 0.7, 2.0])
def test_the_vector_refers_to_full_scale_whatever_the_gain(gain: float) -> None:
    """The digital numbers are the same, though each stands for another radiance."""
    other = replace(
        NOMINAL,
        gain_dn_per_radiance=gain * NOMINAL.gain_dn_per_radiance,
        alpha=NOMINAL.alpha / gain,
        beta=NOMINAL.beta / gain**2,
    )
    torch.testing.assert_close(vector_tensor(other), vector_tensor(NOMINAL))


def test_few_bits_are_noise() -> None:
    coarse = replace(
        NOMINAL, bits=7, gain_dn_per_radiance=NOMINAL.gain_dn_per_radiance * 127 / 4095
    )
    assert sensor_values(coarse)["sigma_dark"] > 1.5 * sensor_values(NOMINAL)["sigma_dark"]


def test_smear_counts_as_contrast_lost_along_the_track() -> None:
    smeared = replace(NOMINAL, effects={"smear": Smear(1.0)})
    across, along = (sensor_values(smeared)[name] for name in ("mtf_across", "mtf_along"))
    assert across == 0.07
    assert along == pytest.approx(0.07 * 2 / np.pi)
