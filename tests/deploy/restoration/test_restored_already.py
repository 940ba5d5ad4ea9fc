"""Tests that an image without raw noise is reported if no sensor is given, and a raw one is not."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

import beers_deploy as bd
from beers_deploy.model.family import SNR_BRIGHT, SensorFamily
from beers_deploy.model.shipped import INT8
from beers_deploy.model.simulator.acquire import acquire_three, prepare_scene
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.network import Network
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.restoration.sensor_check.check import restored_already
from tests.deploy.command_line import done
from tests.deploy.restoration.runs import simulated, source_of

NETWORK = f"convbeers-xs{INT8}"
SENSOR = Sensor.load("pleiades-degraded")
SIDE_PX = 256


@cache
def scene() -> np.ndarray:
    side = SIDE_PX + 64
    return procedural_scene(side, side, np.random.default_rng(3)).radiance


@cache
def raw(seed: int = 0, light: float = 1.0, snr: tuple[float, float] = SNR_BRIGHT) -> np.ndarray:
    """Return a raw image (256, 256) of a sensor in the range, at a share of the light."""
    sensor = SensorFamily(SENSOR.nominal(), snr).draw(np.random.default_rng(seed))
    return to_uint16(
        acquire_three(prepare_scene(light * scene(), 1), sensor, sensor, Draw(seed))[0]
    )


def check(
    image: np.ndarray, full_scale: float = 4095, network: str = NETWORK, nodata: float | None = None
) -> str:
    return restored_already(source_of(image, nodata), [Network.load(network).model], full_scale)


@settings(max_examples=10)
@given(
    st.integers(0, 2**20),
    st.sampled_from([1.0, 0.25, 0.05]),
    st.sampled_from([SNR_BRIGHT, (SNR_BRIGHT[1],) * 2]),
)
def test_a_raw_image_of_any_sensor_in_range_is_not_reported(
    seed: int, light: float, snr: tuple[float, float]
) -> None:
    assert check(raw(seed, light, snr)) == ""


def restored() -> np.ndarray:
    return np.asarray(bd.restore(simulated(sensor=SENSOR, size=320).degraded, network=NETWORK))


def smoothed(image: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(gaussian_filter(image.astype(np.float64), 1.0)), np.uint16)


PROCESSED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "restored": lambda _: restored(),
    "smoothed": smoothed,
    "left-justified": lambda image: 16 * smoothed(image),
}


@pytest.mark.parametrize("kind", PROCESSED)
def test_a_processed_image_is_reported(kind: str) -> None:
    image = PROCESSED[kind](raw(1))
    sentence = check(image, 16 * 4095 if kind == "left-justified" else 4095)
    assert "it looks restored already, with" in sentence
    assert "give the raw image, or its own sensor or full scale" in sentence
    assert sentence.isprintable()


def test_bands_are_named_if_not_all_are_reported() -> None:
    image = raw(1)
    assert "already in band 2, with" in check(np.stack([image, smoothed(image)]))


def test_an_image_that_cannot_be_judged_is_not_reported(model: Path) -> None:
    smooth = smoothed(raw(1))
    # There are too few blocks to judge.
    assert check(smooth[:100, :100]) == ""
    # These are no integers.
    assert check(smooth.astype(np.float32) * np.float32(0.7)) == ""
    # The image is filled with one value.
    assert check(np.full((300, 300), 900, np.uint16)) == ""
    assert check(np.zeros((300, 300), np.uint16)) == ""
    # This network is for another kind of image.
    assert check(smooth, network=str(model)) == ""
    assert check(raw(1) // 2, full_scale=2047) == ""


@pytest.mark.parametrize("nodata", [None, 0])
def test_filled_parts_of_a_raw_image_do_not_count(nodata: int | None) -> None:
    image = raw(2).copy()
    image[:, :150] = 0 if nodata is not None else 1
    assert check(image, nodata=nodata) == ""


def test_the_command_warns_and_goes_on(tmp_path: Path) -> None:
    image = tmp_path / "in.tif"
    out = tmp_path / "out.tif"
    tifffile.imwrite(image, PROCESSED["smoothed"](raw(1)))
    output = done(f"restore {image} {out} --network {NETWORK}")
    assert f"network: {NETWORK}, for an unknown sensor" in output
    assert "if your sensor is sharper or noisier than assumed" in " ".join(output.split())
    assert "look at the image: it looks restored already" in output
    assert out.exists()
    again = f"restore {image} {out} --overwrite --network {NETWORK}"
    output = done(f"{again} --sensor {SENSOR.name}")
    assert "look at the image" not in output
    assert "look at the sensor" in output
    tifffile.imwrite(image, raw(1))
    assert "look at the image" not in done(again)
