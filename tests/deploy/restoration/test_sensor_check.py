"""Tests that a sensor that contradicts the image gives a warning, or an error with `strict`."""

import re
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile

import beers_deploy as bd
from beers_deploy.profiles.response import PointSpread, packed
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.sensor_check.check import SensorCheck, check_source
from tests.deploy.command_line import done, refused
from tests.deploy.restoration.runs import simulated, source_of
from tests.deploy.studies.evaluation.small_pairs import few_targets

NAME = "pleiades-degraded"
SENSOR = Sensor.load(NAME)


@pytest.fixture(scope="module")
def raw() -> np.ndarray:
    """Return a raw image (320, 320) of drawn fields and houses."""
    return simulated(sensor=SENSOR, size=320, seed=3).degraded


def check(
    image: np.ndarray,
    sensor: Sensor = SENSOR,
    full_scale: float = 4095,
    nodata: float | None = None,
) -> SensorCheck:
    return check_source(source_of(image, nodata), [sensor], full_scale)


def test_the_true_sensor_agrees_with_its_image(raw: np.ndarray) -> None:
    result = check(raw)
    assert result.warnings == ()
    assert result.text == {"sensor check": "agrees"}
    low, high = result.figures["measured SNR"].interval or (0, 0)
    assert 0 < high - low < 0.5 * high
    # A left-justified image, and one with missing pixels of any value, agree as well.
    assert (
        check(raw * 16, full_scale=16 * 4095).figures["measured SNR"].value
        == result.figures["measured SNR"].value
    )
    holed = raw.copy()
    holed[100:140, 30:300] = 4000
    assert check(np.where(holed == 4000, 0, raw), nodata=0).warnings == ()


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"mtf_nyquist": 0.14}, "MTF .* but the sensor profile states 14"),
        ({"snr_0": 25, "snr_1": 55}, "looks like SNR .*, but the sensor profile states"),
        ({"snr_0": 100, "snr_1": 220}, "looks like SNR .*, but the sensor profile states"),
    ],
)
def test_another_sensor_is_recognised(
    numbers: dict[str, float], words: str, raw: np.ndarray
) -> None:
    (warning, *_) = check(raw, SENSOR.replace(**numbers)).warnings
    assert re.search(words, warning)


def test_a_halo_that_the_profile_states_is_no_contradiction() -> None:
    frequency = np.fft.fftfreq(161, 1 / 4)
    down = frequency[:, None]
    distance = np.hypot(down, frequency)
    halo = np.exp(-2 * (4 * np.pi * distance) ** 2)
    transfer = (0.7 * np.exp(-4 * distance) + 0.3 * halo) * np.sinc(down) * np.sinc(frequency)
    samples = np.fft.fftshift(np.fft.ifft2(transfer).real)
    response = PointSpread(161, 161, 4.0, packed(samples))
    across, along = response.at_nyquist
    sensor = SENSOR.with_fields(response=response, mtf_nyquist=across, mtf_nyquist_along=along)
    result = check(simulated(sensor=sensor, size=320, seed=3).degraded, sensor)
    assert result.warnings == ()
    assert (result.figures["measured MTF across"].value or 0) < 3
    sharper = SENSOR.replace(mtf_nyquist=0.14)
    other = simulated(sensor=sharper, size=320, seed=3)
    assert "MTF across" in "".join(check(other.degraded, sensor).warnings)


def test_pixels_above_the_sensor_s_full_scale_contradict_it(raw: np.ndarray) -> None:
    warnings = check(raw, SENSOR.replace(bits=10), 1023).warnings
    assert "above its full scale, 1023" in "".join(warnings)


def test_each_band_is_compared_with_its_own_sensor(raw: np.ndarray) -> None:
    sensors = [SENSOR, SENSOR.replace(snr_0=25, snr_1=55)]
    two = check_source(source_of(np.stack([raw, raw])), sensors, 4095)
    assert [warning[:7] for warning in two.warnings] == ["band 2:"]
    assert two.figures["band 1: measured SNR"].value == two.figures["band 2: measured SNR"].value


def test_a_restored_image_holds_no_raw_noise(raw: np.ndarray) -> None:
    (warning, *_) = check(bd.restore(raw, network="convbeers-xs-int8", sensor=SENSOR)).warnings
    assert "restored, resampled or compressed" in warning


def test_what_cannot_be_measured_is_no_contradiction() -> None:
    generator = np.random.default_rng(0)
    for image in (
        np.full((300, 200), 900, np.uint16),
        np.zeros((64, 64), np.uint16),
        generator.random((400, 300)).astype(np.float32),
        generator.integers(400, 500, (19, 23)).astype(np.uint16),
    ):
        result = check(image)
        assert result.text["sensor check"] in ("not measurable", *result.warnings)
        assert all(
            figure.mode == "unavailable" and figure.reason for figure in result.figures.values()
        )


def test_commands_warn_and_strict_refuses(raw: np.ndarray, tmp_path: Path) -> None:
    image = tmp_path / "raw.tif"
    out = tmp_path / "out.tif"
    tifffile.imwrite(image, raw)
    profile = SENSOR.replace(snr_0=25, snr_1=55).save(tmp_path / "wrong.toml")
    network = ("--network", "convbeers-xs-int8")
    assert "look at the sensor: noise at" in done(
        "restore", image, out, *network, "--sensor", profile
    )
    preview = ("restore", image, "--dry-run", *network)
    assert "look at the sensor" not in done(*preview, "--sensor", NAME, "--strict")
    out.unlink()
    for words in (("restore", image, out, *network), preview):
        assert "contradicts the sensor wrong" in refused(*words, "--sensor", profile, "--strict")
    refused("restore", image, out, "--method", "traditional", "--sensor", profile, "--strict")
    assert not out.exists()


def test_pairs_are_compared_with_the_sensor_before_an_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few_targets(monkeypatch)
    profile = SENSOR.replace(snr_0=25, snr_1=55).save(tmp_path / "wrong.toml")
    pairs = simulated(sensor=SENSOR, size=320, seed=3).save(tmp_path / "pairs")
    (pairs / "recipe.json").unlink()
    words = ("evaluate", "--pairs", pairs, "--methods", "degraded")
    assert "contradicts the sensor wrong" in refused(*words, "--sensor", profile, "--strict")
    result = bd.evaluate(methods=["degraded"], pairs=pairs, sensor=SENSOR, strict=True)
    assert next(row for row in result.rows if "sensor" in row.table).text == {
        "sensor check": "agrees"
    }


def test_the_time_of_the_check_is_not_that_of_the_restoration(
    raw: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = tmp_path / "raw.tif"
    tifffile.imwrite(image, raw)

    def slow(*_: object) -> SensorCheck:
        time.sleep(0.2)
        return SensorCheck()

    monkeypatch.setattr("beers_deploy.restoration.prepare.checked_sensor", slow)
    start_s = time.perf_counter()
    result = bd.restore(
        image, tmp_path / "out.tif", network="convbeers-xs-int8", sensor=SENSOR, progress=False
    )
    whole_s = time.perf_counter() - start_s
    (row,) = result.rows
    (check_s, time_s) = (row.figures[name].value or 0 for name in ("sensor check", "time"))
    assert check_s >= 0.2
    assert row.figures["throughput"].value == pytest.approx(raw.size / time_s / 1e6)
    assert time_s <= whole_s - check_s
