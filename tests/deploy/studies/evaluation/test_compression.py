"""Tests of restoration before and after compression: codec, noise of the profile, and tables."""

import numpy as np
import pytest
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.restoration.method import Restore
from beers_deploy.studies.evaluation.compression import (
    GAIN,
    LOSSLESS,
    SHARES,
    Trial,
    decompressed,
    run_compression,
    try_method,
)
from beers_deploy.studies.evaluation.methods import Method
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.scores import inner
from tests.deploy.studies.evaluation.small_pairs import (
    IDENTITY,
    SENSORS,
)

SENSOR = SENSORS[0]
RATE = 2.0


def scene(seed: int = 0, height: int = 128, width: int = 101, top: int = 4095) -> np.ndarray:
    """Return waves under noise, from near 0 to near `top`."""
    generator = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    waves = np.sin(rows / 5) * np.sin(columns / 7 + seed)
    noisy = waves * 0.4 + 0.5 + generator.normal(0, 0.01, waves.shape)
    return np.asarray(np.rint(top * np.clip(noisy, 0, 1)), np.float32)


def pair_of(name: str, seed: int) -> NamedPair:
    """Return a pair whose reference without noise is the degraded image less 10 DN."""
    dn = scene(seed)
    return NamedPair(name, dn, dn, noise_free=np.maximum(dn - 10, 0))


def rms_dn(image: np.ndarray, other: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image.astype(np.float64) - other) ** 2)))


def half(dn: np.ndarray) -> np.ndarray:
    return dn / 2


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_a_rate_is_kept_and_more_of_it_is_better(bits: int) -> None:
    # Clipped and fractional pixels are those that the sensor would store.
    outside = scene(top=2**bits - 1) * 1.2 - 2**bits / 10 - 0.3
    dn = np.clip(np.rint(outside), 0, 2**bits - 1)
    images = [decompressed(outside, rate, bits) for rate in (1, 2, 4)]
    assert [image.rate for image in images] == pytest.approx([1, 2, 4], rel=0.03)
    errors = [rms_dn(image.dn, dn) for image in images]
    assert errors[0] > errors[1] > errors[2]
    for image in images:
        assert np.array_equal(image.dn, np.rint(image.dn))
        assert 0 <= image.dn.min() <= image.dn.max() <= 2**bits - 1


@pytest.mark.parametrize("rate", [1, 3])
def test_the_codec_is_as_good_as_one_of_twelve_bits(rate: float) -> None:
    """GDAL writes the bits of the sensor, Pillow a container of sixteen; both are OpenJPEG."""
    dn = scene(height=256, width=256)
    options = {"NBITS": 12, "QUALITY": 100 * rate / 12, "REVERSIBLE": "NO", "RESOLUTIONS": 6}
    grid = Affine.translation(1, 1)
    shape = {"height": 256, "width": 256, "count": 1, "dtype": "uint16", "transform": grid}
    with MemoryFile(ext=".j2k") as file:
        with file.open(driver="JP2OpenJPEG", CODEC="J2K", **shape, **options) as written:
            written.write(dn.astype(np.uint16), 1)
        own_rate = 8 * len(file.getbuffer()) / dn.size
        with file.open() as read:
            other = read.read(1)
    ours = decompressed(dn, rate, 12)
    assert ours.rate == pytest.approx(own_rate, rel=0.02)
    assert rms_dn(ours.dn, dn) < 1.05 * rms_dn(other, dn)


def trial_of(method: Method, pairs: list[NamedPair]) -> Trial:
    restored = [method.restore(item.degraded) for item in pairs]
    raw = [decompressed(item.degraded, RATE, 12) for item in pairs]
    return try_method(method, pairs, restored, raw, RATE, SENSOR)


def test_on_board_is_compressed_after_and_on_the_ground_before_restoration() -> None:
    one = pair_of("a", 0)
    trial = trial_of(Method("half", half, "blind"), [one])

    def inner_db(dn: np.ndarray) -> float:
        assert one.noise_free is not None
        return psnr_db(inner(dn), inner(one.noise_free), 4095)

    raw = decompressed(one.degraded, RATE, 12)
    board = decompressed(half(one.degraded), RATE, 12)
    assert trial.board_db[0] == pytest.approx(inner_db(board.dn))
    assert trial.ground_db.tolist() == [[pytest.approx(inner_db(half(raw.dn)))]]
    assert trial.rates[:, 0].tolist() == [board.rate, raw.rate]
    assert trial.board_db[0] != trial.ground_db[0, 0]


def test_the_noise_of_the_profile_grows_by_shares_of_the_measured_error() -> None:
    sensors: list[Instrument] = []

    def specialise(sensor: Instrument) -> Restore:
        sensors.append(sensor)
        return np.asarray

    pairs = [pair_of("a", 0), pair_of("b", 1)]
    trial = trial_of(Method("telling", np.asarray, "known", specialise), pairs)
    expected = []
    for item in pairs:
        error = rms_dn(decompressed(item.degraded, RATE, 12).dn, item.degraded) ** 2
        expected += [share * error for share in SHARES[1:]]
    gain = SENSOR.gain_dn_per_radiance
    assert [gain**2 * (sensor.beta - SENSOR.beta) for sensor in sensors] == pytest.approx(expected)
    assert {(sensor.alpha, sensor.mtf_axes) for sensor in sensors} == {
        (SENSOR.alpha, SENSOR.mtf_axes)
    }
    assert trial.error_dn2 * SHARES[-1] == pytest.approx(expected[2::3])


def trial(ground: list[list[float]], sites: str, board: float = 40.0) -> Trial:
    count = len(sites)
    level = np.linspace(0, 20, count)
    ones = np.ones(count)
    rates = np.stack([np.linspace(0.98, 1, count), ones])
    return Trial(ones * board + level, np.array(ground) + level, rates, ones, list(sites))


@pytest.mark.parametrize(
    ("sites", "whole_at_a", "chosen"),
    [
        ("aabcd", 38.0, [1, 1, 1, 1, 1]),
        ("aabcd", 0.0, [1, 1, 0, 0, 0]),
        ("aaaaa", 0.0, [0, 0, 0, 0, 0]),
    ],
)
def test_other_sites_choose_the_share(sites: str, whole_at_a: float, chosen: list[int]) -> None:
    """The share of a site is the best one for the other sites. A single site decides for itself."""
    ground = [[39.0] * 2 + [30.0] * 3, [whole_at_a] * 2 + [33.0] * 3]
    assert trial(ground, sites).chosen.tolist() == chosen


def test_the_interval_of_the_gain_is_that_of_differences_on_the_same_images() -> None:
    row = trial([[39.0] * 5, [38] * 5], "abcde").row("net", 0)
    gain = row.figures["on board minus on the ground"]
    assert gain.value == pytest.approx(1)
    assert gain.interval == pytest.approx((1, 1))
    assert row.figures["restored on board"].interval is None
    whole = row.figures["on the ground, whole error as noise"]
    assert whole.value == pytest.approx(48)
    assert row.text == {"share of the error as noise": "0%"}
    assert row.figures["rates of an image differ by up to"].value == pytest.approx(2)


def test_there_is_a_row_for_each_method_and_rate_but_the_input() -> None:
    methods = [IDENTITY, Method("half", half, "blind")]
    rows = run_compression(methods, [pair_of("a", 0)], SENSOR, [1.0, 2.5], 0)
    assert [(row.table, row.name) for row in rows] == [
        (GAIN, "half, 1 bit/px"),
        (GAIN, "half, 2.5 bit/px"),
        (LOSSLESS, "half"),
    ]
    rates = [rows[2].figures[key].value or 0 for key in ("restored", "raw")]
    assert 0 < rates[0] < rates[1] < 12
    assert run_compression(methods, [pair_of("a", 0)], SENSOR, [], 0) == []
