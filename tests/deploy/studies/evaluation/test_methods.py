"""Methods that need no network, and what they do when another sensor is known."""

from dataclasses import replace

import numpy as np
import pytest

from beers_deploy.profiles import load_sensor
from beers_deploy.studies.evaluation.methods import BLIND, KNOWN, Method, method_without_network

DEGRADED, REFERENCE = load_sensor("pleiades-degraded").nominal(), load_sensor("pleiades-reference").nominal()
OTHER = replace(DEGRADED, mtf_nyquist=0.03, gain_dn_per_radiance=0.7 * DEGRADED.gain_dn_per_radiance)


@pytest.mark.parametrize("name", ["traditional-fast", "deconvolve-first-fast", "wiener"])
def test_a_chain_that_gets_to_know_a_sensor_is_the_one_made_for_it(name: str) -> None:
    """Its gain included: the reference that is aimed at then has it too."""
    dn = np.random.default_rng(0).integers(200, 1800, (40, 47)).astype(np.float32)
    method = method_without_network(name, DEGRADED, REFERENCE)
    made = method_without_network(name, OTHER, REFERENCE.in_units_of(OTHER))
    found = method.knowing(OTHER).restore(dn)
    assert np.array_equal(found, made.restore(dn))
    assert not np.array_equal(found, method.restore(dn))


def test_what_depends_on_no_sensor_stays_as_it_is() -> None:
    degraded = method_without_network("degraded", DEGRADED, REFERENCE)
    for method in (degraded, Method("blind", np.sqrt, BLIND)):
        assert method.knowing(OTHER) is method


def test_who_knows_a_sensor_says_so() -> None:
    method = Method("net", np.sqrt, BLIND, lambda _: np.abs)
    assert (method.knowing(OTHER).sensor_known, method.sensor_known) == (KNOWN, BLIND)
