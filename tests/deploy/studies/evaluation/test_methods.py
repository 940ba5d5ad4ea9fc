"""Tests of the methods of an evaluation by name, and of the sensor that each is given."""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest

from beers_deploy.model.shipped import SHIPPED
from beers_deploy.network_files import int8_for_sensor
from beers_deploy.profiles.errors import OptionError, ProfileError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.studies.evaluation.calibrate import network_to_calibrate
from beers_deploy.studies.evaluation.methods import (
    BLIND,
    KNOWN,
    Method,
    method_named,
    method_without_network,
)
from tests.deploy.studies.evaluation.small_pairs import (
    DEGRADED,
    OTHER,
    REFERENCE,
    SENSORS,
)


@pytest.mark.parametrize("name", ["traditional-superb", ""])
def test_an_unknown_method_is_refused(name: str) -> None:
    with pytest.raises(OptionError, match=r"`methods`|variant"):
        method_named(name, DEGRADED, REFERENCE)


def test_an_at_sign_without_a_sensor_is_refused() -> None:
    with pytest.raises(ProfileError, match="no profile ''"):
        method_named("convbeers-xs@", DEGRADED, REFERENCE)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("convbeers-xs", "known"),
        ("convbeers-xs-int8", "known"),
        ("convbeers-xs@blind", "blind"),
        ("convbeers-xs@dior-medium", "another: dior-medium"),
        ("traditional", "known"),
    ],
)
def test_a_shipped_network_is_given_the_images_sensor_unless_its_name_states_another(
    name: str, expected: str
) -> None:
    assert method_named(name, DEGRADED, REFERENCE).sensor_known == expected


@pytest.mark.parametrize("name", ["traditional-fast", "deconvolve-first-fast", "wiener"])
def test_a_chain_that_is_given_a_sensor_is_the_one_made_for_it(name: str) -> None:
    """This includes the gain: the reference that the chain aims at has the gain of that sensor."""
    dn = np.random.default_rng(0).integers(200, 1800, (40, 47)).astype(np.float32)
    method = method_without_network(name, *SENSORS)
    other = method_without_network(name, OTHER, SENSORS[1].in_units_of(OTHER))
    restored = method.with_sensor(OTHER).restore(dn)
    assert np.array_equal(restored, other.restore(dn))
    assert not np.array_equal(restored, method.restore(dn))


def test_a_method_given_a_sensor_states_so_and_one_that_accepts_none_is_unchanged() -> None:
    for fixed in (method_without_network("degraded", *SENSORS), Method("blind", np.sqrt, BLIND)):
        assert fixed.with_sensor(OTHER) is fixed
    method = Method("net", np.sqrt, BLIND, lambda _: np.abs)
    assert (method.with_sensor(OTHER).sensor_known, method.sensor_known) == (KNOWN, BLIND)


def test_a_file_for_every_sensor_is_the_method_of_its_shipped_name() -> None:
    """It is given the sensor of the images, and accepts others. A name with a sensor is fixed."""
    dn = np.random.default_rng(0).uniform(300, 900, (40, 47)).astype(np.float32)
    name = "convbeers-xs-int8"
    method = method_named(str(SHIPPED / f"{name}.onnx"), DEGRADED, REFERENCE)
    shipped = method_named(name, DEGRADED, REFERENCE)
    assert method.sensor_known == shipped.sensor_known == KNOWN
    own = method.restore(dn)
    assert np.array_equal(own, shipped.restore(dn))
    others = [each.with_sensor(OTHER).restore(dn) for each in (method, shipped)]
    assert np.array_equal(others[0], others[1])
    assert np.abs(others[0] - own).max() > 5
    np.testing.assert_allclose(method.with_sensor(SENSORS[0]).restore(dn), own, rtol=0, atol=1)
    assert method_named(f"{name}@blind", DEGRADED, REFERENCE).specialise is None


def test_the_path_of_a_network_may_have_an_at_sign_in_it(tmp_path: Path) -> None:
    path = tmp_path / "a@b" / "convbeers-xs-int8.onnx"
    path.parent.mkdir()
    shutil.copy(SHIPPED / path.name, path)
    assert method_named(str(path), DEGRADED, REFERENCE).sensor_known == KNOWN
    assert network_to_calibrate({"a": str(path)}, tmp_path / "out.onnx") == ("a", path)


def test_full_scale_is_that_of_the_images_whatever_sensor_is_supposed() -> None:
    factor = 16383 / 4095
    gain = DEGRADED.gain_dn_per_radiance.low * factor
    images = DEGRADED.replace(bits=14, gain_dn_per_radiance=gain)
    dn = np.random.default_rng(0).uniform(300, 3000, (40, 47)).astype(np.float32)
    for supposed in ("blind", "dior-medium"):
        name = f"convbeers-half-xs@{supposed}"
        of_12_bits = method_named(name, DEGRADED, REFERENCE).restore(dn)
        of_14_bits = method_named(name, images, REFERENCE).restore(dn * np.float32(factor))
        np.testing.assert_allclose(of_14_bits / factor, of_12_bits, rtol=0, atol=0.7)


def test_a_file_of_another_sensor_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stored = load_onnx(SHIPPED / "convbeers-xs-int8.onnx")
    file = tmp_path / "medium.onnx"
    save_onnx(int8_for_sensor(stored, Sensor.load("dior-medium")), file)
    with caplog.at_level(logging.WARNING):
        method_named(f"{file}@blind", DEGRADED, REFERENCE)
        assert not caplog.messages
        method_named(str(file), DEGRADED, REFERENCE)
    assert any("made for dior-medium" in message for message in caplog.messages)
