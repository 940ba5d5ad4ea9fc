"""Test that a digital number means the same in a degraded image and in its reference."""

import logging
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.model.simulator.mtf import mtf
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.reference import reference_for
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.evaluation.methods import method_named
from beers_deploy.studies.evaluation.pairs import simulate_pairs
from beers_deploy.studies.evaluation.scores import Instruments

DEGRADED = Sensor.load("pleiades-degraded")
METHODS = ("degraded", "traditional-fast", "convbeers-xs")
SCENE = procedural_scene(330, 346, np.random.default_rng(3))


def with_units(profile: Sensor, gain: float, bits: int, offset_dn: float = 0.0) -> Sensor:
    def stated(value: float) -> Constant:
        return Constant(value, "stated", "a test")

    effects = {"offset": {"offset_dn": stated(offset_dn)}} if offset_dn else {}
    return replace(profile, gain_dn_per_radiance=stated(gain), bits=stated(bits), effects=effects)


def rescaled(profile: Sensor, bits: int, dimmer: float, offset_dn: float) -> Sensor:
    """Return a sensor of other bits, whose full scale, gain and offset grow by one factor.

    Its scenes are dimmer by a factor, and its gain is higher by the same factor.
    """
    times = (2**bits - 1) / 4095
    darker, brighter = (
        Constant(point.low / dimmer, "stated", "a test")
        for point in (profile.radiance_0, profile.radiance_1)
    )
    gain = profile.gain_dn_per_radiance.low * times * dimmer
    dimmed = replace(profile, radiance_0=darker, radiance_1=brighter)
    return with_units(dimmed, gain, bits, offset_dn * times)


@cache
def evaluated(bits: int, dimmer: float, offset_dn: float) -> tuple[np.ndarray, int]:
    """Return the PSNR in dB over full scale of each method, (3,), and the number of pixels."""
    degraded, reference = (
        rescaled(profile, bits, dimmer, offset_dn)
        for profile in (DEGRADED, Sensor.load("pleiades-reference"))
    )
    scene = replace(SCENE, radiance=SCENE.radiance / dimmer)
    (pair,), _ = simulate_pairs([scene], degraded, reference, 0, (2,))
    methods = [method_named(name, degraded, reference) for name in METHODS]
    instruments = Instruments({}, degraded.nominal().max_dn)
    scores = [instruments.score(method.restore(pair.degraded), pair) for method in methods]
    return np.array([image["PSNR"] for image in scores]), pair.degraded.size


def rounding_db(psnr_db: np.ndarray, bits: int, pixels: int) -> np.ndarray:
    """Return how far rounding to integers, of 12 bits and of `bits`, may move these PSNRs in dB."""
    # A step q leaves an error of q / sqrt(12).
    steps = np.hypot(1 / 4095, 1 / (2**bits - 1)) / np.sqrt(12)
    fx = np.fft.fftfreq(64)[None]
    fy = np.fft.fftfreq(64)[:, None]
    ratio = mtf(fx, fy, (0.25, 0.25)) / mtf(fx, fy, (0.07, 0.07))
    # The error is in the reference, in the restored image, and in the input, where the restoration
    # amplifies it as white noise by the ratio of the MTFs over all frequencies (rms).
    share = steps * np.sqrt(float(np.square(ratio).mean()) + 2) / 10 ** (-psnr_db / 20)
    # The noise dithers the input, so this error is independent of the one that a method leaves. The
    # squares add, and the mean product of the two stays within four standard deviations. Errors are
    # alike within a patch of 5 x 5 pixels.
    return np.asarray(10 * np.log10(1 + share**2 + 2 * 4 * share / np.sqrt(pixels / 25)))


@settings(max_examples=4, derandomize=True)
@given(bits=st.integers(12, 16), dimmer=st.floats(0.1, 10), offset_dn=st.sampled_from([0.0, 60.0]))
def test_radiance_gain_and_bits_scaled_together_change_nothing_but_rounding(
    bits: int, dimmer: float, offset_dn: float
) -> None:
    usual_db, pixels = evaluated(12, 1, offset_dn)
    scaled_db, _ = evaluated(bits, dimmer, offset_dn)
    allowed_db = rounding_db(usual_db, bits, pixels)
    assert np.all(np.abs(scaled_db - usual_db) <= allowed_db), (scaled_db - usual_db, allowed_db)
    # Methods differ by more than rounding may move them, so their ranking is the same.
    assert allowed_db.max() < 0.18 < np.diff(np.sort(usual_db)).min() / 2
    assert np.argsort(scaled_db).tolist() == np.argsort(usual_db).tolist()


def test_a_named_reference_of_other_units_is_converted_and_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "beers_deploy")
    degraded = with_units(DEGRADED, 40, 14, offset_dn=5)
    assert reference_for(degraded, None).units == (40, 14, 5)
    assert caplog.messages == []
    assert reference_for(degraded, "pleiades-reference").units == (40, 14, 5)
    (sentence,) = caplog.messages
    assert "pleiades-reference (10.2375 DN per W/m2/sr/um, 12 bits)" in sentence
    assert "40 DN per W/m2/sr/um, 14 bits, 5 DN of offset" in sentence
    reference_for(DEGRADED, "pleiades-reference")
    assert len(caplog.messages) == 1
