"""Tests that MTF tables and point-spread functions are read, compared, saved and refused."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from beers_deploy.cli.commands import app
from beers_deploy.profiles.response import MtfTable, PointSpread, centroid, packed, unpacked
from beers_deploy.profiles.sensor import Sensor, same_instrument
from beers_deploy.profiles.validation import validated
from beers_deploy.shipped_tables import kind_and_table
from tests.profiles.own_sensor import SHIPPED, own_sensor
from tests.profiles.test_profile_files import refusal

TABLE = "frequency = [0, 0.25, 0.5]\nacross = [1, 0.5, 0.12]\nalong = [1, 0.4, 0.05]"
PSF = 'psf = "psf.npy"\npsf_samples_per_px = 4'


def lopsided(rows: int = 33, columns: int = 44) -> np.ndarray:
    """Return a sheared point spread (rows, columns) with two widths and a one-sided tail."""
    y, x = np.mgrid[:rows, :columns] - np.array([rows - 1, columns - 1])[:, None, None] / 2
    samples: np.ndarray = np.exp(-(y**2) / 18 - (x + 0.4 * y) ** 2 / 10)
    samples += 0.1 * np.exp(-(y**2) / 30 - (x - 3) ** 2 / 30)
    return samples


def sensor_file(folder: Path, mtf: str, noise: str | None = None) -> Path:
    """Write the shipped sensor with another [mtf], and another [noise] if given."""
    text = re.sub(r"\[mtf\].*?(?=\n\[)", lambda _: f"[mtf]\n{mtf}\n", SHIPPED, flags=re.DOTALL)
    if noise is not None:
        text = re.sub(
            r"\[noise\].*?(?=\n\[)", lambda _: f"[noise]\n{noise}\n", text, flags=re.DOTALL
        )
    return own_sensor(folder, text=text)


def with_psf(folder: Path, samples: np.ndarray, mtf: str = PSF) -> Sensor:
    np.save(folder / "psf.npy", samples)
    return Sensor.load(sensor_file(folder, mtf))


def formula(frequency: np.ndarray, contrast: float) -> np.ndarray:
    return np.asarray(np.exp(2 * np.log(contrast * np.pi / 2) * frequency) * np.sinc(frequency))


def test_a_table_returns_its_own_values(tmp_path: Path) -> None:
    profile = Sensor.load(sensor_file(tmp_path, TABLE))
    sensor = profile.nominal()
    f = np.array([[0.0, 0.25, 0.5]])
    assert isinstance(sensor.response, MtfTable)
    assert sensor.response.at(f, np.zeros((1, 1)))[0] == pytest.approx([1, 0.5, 0.12])
    assert sensor.response.at(np.zeros((1, 1)), f.T)[:, 0] == pytest.approx([1, 0.4, 0.05])
    assert sensor.mtf_axes == pytest.approx((0.12, 0.05))
    assert sensor == profile.draw(np.random.default_rng(3))
    one_axis = Sensor.load(sensor_file(tmp_path, TABLE.rsplit("\n", 1)[0]))
    assert one_axis.mtf_nyquist_along is None
    assert one_axis.nominal().mtf_axes == pytest.approx((0.12, 0.12))


@pytest.mark.parametrize("along", [[1, 0.5, 0.12], [1, 0.4, 0.05]])
def test_each_axis_of_a_table_keeps_its_own_source(along: list[float], tmp_path: Path) -> None:
    mtf = f"""frequency = [0, 0.25, 0.5]
across = {{value = [1, 0.5, 0.12], status = "measured", source = "a lab"}}
along = {{value = {along}, status = "assumed", source = "no edge"}}"""
    profile = Sensor.load(sensor_file(tmp_path, mtf))
    for sensor in (profile, Sensor.load(profile.save(tmp_path / "saved.toml"))):
        assert [axis.source for axis in sensor.contrasts] == ["a lab", "no edge"]
        assert [axis.status for axis in sensor.contrasts] == ["measured", "assumed"]
    _, table = kind_and_table(str(tmp_path / "saved.toml"))
    texts = {row.name: row.text for row in table}
    assert [texts[f"mtf.{axis}"]["source"] for axis in ("across", "along")] == ["a lab", "no edge"]


@settings(max_examples=30)
@given(st.floats(0.005, 0.6), st.floats(0.005, 0.6), st.lists(st.floats(0.01, 0.99), max_size=6))
def test_a_table_never_rises_beyond_its_end(
    across: float, along: float, inner: list[float]
) -> None:
    frequency = (0.0, *sorted({f / 2 for f in inner}), 0.5)
    contrast = [tuple(formula(np.array(frequency), c)) for c in (across, along)]
    table = MtfTable(frequency, *contrast)
    beyond = np.linspace(0.5, 4, 50)[None]
    for response in (
        table.at(beyond, np.zeros((1, 1)))[0],
        table.at(np.zeros((1, 1)), beyond.T)[:, 0],
    ):
        optics = response / np.where(np.abs(np.sinc(beyond[0])) < 1e-9, np.nan, np.sinc(beyond[0]))
        assert (np.diff(optics[np.isfinite(optics)]) <= 0).all()


def test_a_point_spread_is_its_transform_about_its_centroid(tmp_path: Path) -> None:
    """The reference is a padded FFT at multiples of 4 / 96 cycles per pixel, shifted by hand."""
    samples = lopsided(24, 32)
    sensor = with_psf(tmp_path, samples).nominal()
    row, column = centroid(samples)
    f = np.fft.fftfreq(96, 1 / 4)
    shift = np.exp(2j * np.pi * f[:, None] * (row + 11.5) / 4) * np.exp(
        2j * np.pi * f * (column + 15.5) / 4
    )
    expected = np.fft.fft2(samples, (96, 96)) * shift / samples.sum()
    assert sensor.response is not None
    assert np.abs(sensor.response.at(f[None], f[:, None]) - expected).max() < 3e-6
    across = abs(expected[0, 12])
    along = abs(expected[12, 0])
    assert sensor.mtf_axes == pytest.approx((across, along), abs=3e-6)


def test_beyond_its_own_nyquist_frequency_a_point_spread_is_0(tmp_path: Path) -> None:
    response = with_psf(tmp_path, lopsided()).response
    assert response is not None
    contrasts = response.at(np.array([[1.9, 2.1, 4.0]]), np.zeros((1, 1)))[0]
    assert abs(contrasts[0]) > 0
    assert (contrasts[1:] == 0).all()


@settings(max_examples=25)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 99))
def test_packed_samples_are_unpacked_unchanged(height: int, width: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    assert (unpacked(PointSpread(height, width, 8.0, packed(values))) == values).all()


@pytest.mark.parametrize("scale", [1e-300, 1e308])
def test_the_unit_of_the_samples_does_not_matter(scale: float, tmp_path: Path) -> None:
    one, other = (
        with_psf(tmp_path, samples).nominal().mtf_axes
        for samples in (lopsided(), lopsided() * scale)
    )
    assert one == pytest.approx(other, rel=1e-6)


def test_the_empty_rim_of_a_point_spread_is_cut_and_changes_nothing(tmp_path: Path) -> None:
    samples = lopsided()
    (tmp_path / "wide").mkdir()
    tight = with_psf(tmp_path, samples).response
    wide = with_psf(tmp_path / "wide", np.pad(samples, 400)).response
    assert isinstance(wide, PointSpread)
    assert wide.height <= samples.shape[0]
    assert wide.width <= samples.shape[1]
    f = np.linspace(-2, 2, 41)
    assert tight is not None
    assert np.abs(tight.at(f[None], f[:, None]) - wide.at(f[None], f[:, None])).max() < 3e-6


@pytest.mark.parametrize("dtype", [">f8", "<u2"])
def test_any_type_of_number_is_the_same_instrument(dtype: str, tmp_path: Path) -> None:
    samples = np.rint(lopsided() * 4000)
    assert same_instrument(
        with_psf(tmp_path, samples.astype("<f4")), with_psf(tmp_path, samples.astype(dtype))
    )


@pytest.mark.parametrize("mtf", [TABLE, PSF])
@pytest.mark.parametrize("noise", [None, "alpha = 0.0077\nbeta = [0.05, 0.07]"])
def test_a_profile_is_read_back_from_json_without_its_file(
    mtf: str, noise: str | None, tmp_path: Path
) -> None:
    np.save(tmp_path / "psf.npy", lopsided())
    profile = Sensor.load(sensor_file(tmp_path, mtf, noise))
    (tmp_path / "psf.npy").unlink()
    saved = Sensor.load(profile.save(tmp_path / "saved.toml"))
    assert saved.nominal().mtf_axes == pytest.approx(profile.nominal().mtf_axes, rel=1e-4)
    back = validated(Sensor, json.loads(json.dumps(asdict(profile))), "a test")
    assert back == profile
    assert same_instrument(back, profile)
    assert hash(back.response) == hash(profile.response)
    other = replace(profile, response=None)
    assert not same_instrument(other, profile)


@pytest.mark.parametrize(
    ("mtf", "words"),
    [
        (
            TABLE + "\nmtf_nyquist = 0.07",
            ("one of mtf_nyquist, or frequency and across, or psf", "Keep one"),
        ),
        (PSF + "\nmtf_nyquist_along = 0.07", ("Keep one",)),
        ("across = [1, 0.1]", ("'frequency'",)),
        (TABLE.replace("0.25", "0.6"), ("ascending from 0", "got (0.0, 0.6, 0.5)")),
        (TABLE.replace("0.25, 0.5]", "0.25, 0.4]"), ("to at least 0.5", "0.4)")),
        (TABLE.replace("0.25, 0.5]", "0.25, 1.0]"), ("below 1",)),
        (TABLE.replace("0.5]", "nan]"), ("mtf.frequency.2 must be a finite number",)),
        (TABLE.replace("0.25", "1e-310"), ("0.0001 apart",)),
        (
            TABLE.replace("[1, 0.4", "[0.9, 0.4"),
            ("first of them 1,", "got (0.9, 0.4", "along"),
        ),
        (TABLE.replace("[1, 0.4, 0.05]", "[1, 0.4]"), ("3 contrasts", "along")),
        (TABLE.replace("0.12", "0"), ("above 0", "across", "psf")),
        (TABLE.replace("1, 0.5, 0.12", "1, 0.95, 0.12"), ("0.9003", "sinc")),
        (TABLE + "\n[antialias]\nsigma_px = 0.1", ("no table antialias", "MTF table", "Remove")),
        (PSF.replace("4", "1"), ("mtf.psf_samples_per_px", "from 2 to 64, but it is 1.")),
        (PSF.replace("4", "true"), ("valid number", "True")),
        (PSF.replace("psf.npy", "none.npy"), ("no such file", "none.npy")),
        (PSF.replace("psf.npy", "psf.png"), (".npy", "no such file")),
        (PSF.replace("psf.npy", "../psf.npy"), ("or below it", "'../psf.npy'")),
        (PSF.replace('"psf.npy"', "3"), ("mtf.psf", "a text, got 3")),
    ],
)
def test_a_wrong_blur_gets_one_sentence(mtf: str, words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for folder in (tmp_path, tmp_path / "in"):
        np.save(folder / "psf.npy", lopsided())
    refusal(sensor_file(tmp_path / "in", mtf), *words)


def corrupted(change: Callable[[np.ndarray], object]) -> np.ndarray:
    samples = lopsided()
    change(samples)
    return samples


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        (corrupted(lambda s: s.__setitem__((3, 4), np.nan)), ("finite", "NaN")),
        (-lopsided(), ("sum is above 0",)),
        (np.zeros((5, 5)), ("their sum is 0.",)),
        (np.stack([lopsided()] * 3), ("(rows, columns)", "(3, 33, 44)")),
        (np.ones((0, 7)), ("(rows, columns)",)),
        (lopsided().astype(complex), ("real numbers",)),
        (np.zeros((4097, 2), np.uint8), ("4096 a side",)),
        (np.ones((1100, 2), np.uint8), ("1024 x 1024",)),
        (np.roll(np.pad(lopsided(), 40), 17, 1), ("centroid", "pixels off")),
        (np.ones((1, 1)), ("0.6366", "detector included")),
    ],
)
def test_samples_that_are_no_point_spread_get_one_sentence(
    samples: np.ndarray, words: tuple[str, ...], tmp_path: Path
) -> None:
    np.save(tmp_path / "psf.npy", samples)
    refusal(sensor_file(tmp_path, PSF), *words)


@pytest.mark.parametrize(
    "content", [b"", b"\x93NUMPY", b"version https://git-lfs.github.com", b"x" * 999]
)
def test_a_damaged_file_gets_one_sentence(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "psf.npy").write_bytes(content)
    refusal(sensor_file(tmp_path, PSF))


def test_alpha_and_beta_are_the_noise_itself(tmp_path: Path) -> None:
    plain = Sensor.load("pleiades-degraded")
    alpha = plain.nominal().alpha
    beta = plain.nominal().beta
    profile = Sensor.load(
        sensor_file(tmp_path, "mtf_nyquist = 0.07", f"alpha = {alpha}\nbeta = {beta}")
    )
    assert profile.nominal() == plain.nominal()
    # The default radiances are 1/16 and 1/4 of full scale, which is 400 for the shipped sensor.
    assert (profile.radiance_0.low, profile.radiance_1.low) == (25, 100)
    ranged = Sensor.load(
        sensor_file(tmp_path, "mtf_nyquist = 0.07", "alpha = [0.1, 0.2]\nbeta = 0\nradiance_1 = 60")
    )
    sensors = [ranged.draw_counted(np.random.default_rng(seed)) for seed in range(20)]
    assert all(
        0.1 <= sensor.alpha <= 0.2 and sensor.beta == rejected == 0 for sensor, rejected in sensors
    )
    assert len({sensor.alpha for sensor, _ in sensors}) == 20
    assert ranged.nominal().noise_sigma(60) == pytest.approx(math.sqrt(0.15 * 60))
    assert (ranged.radiance_0.low, ranged.nominal().radiance_1) == (15, 60)


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        ("alpha = -1\nbeta = 1", ("alpha", "of at least 0")),
        ("alpha = 0\nbeta = 0", ("not both be 0",)),
        ("alpha = 1", ("'beta'",)),
        ("alpha = 1\nbeta = 1\nsnr_0 = 50", ("alpha and beta", "Keep one")),
        ("alpha = 1\nbeta = 1\nradiance_0 = 300", ("below radiance_1, 100",)),
        ("radiance_0 = 25\nradiance_1 = 100", ("'snr_0'",)),
    ],
)
def test_a_wrong_noise_gets_one_sentence(
    noise: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    refusal(sensor_file(tmp_path, "mtf_nyquist = 0.07", noise), *words)


def test_profiles_print_the_response_and_its_source(tmp_path: Path) -> None:
    def shown(mtf: str, *more: str) -> str:
        run = CliRunner(env={"COLUMNS": "400"}).invoke(
            app, ["profiles", str(sensor_file(tmp_path, mtf)), *more]
        )
        assert run.exit_code == 0
        return run.output

    np.save(tmp_path / "psf.npy", lopsided())
    table = shown(
        TABLE.replace(
            "across = [1, 0.5, 0.12]",
            'across = {value = [1, 0.5, 0.12], status = "measured", source = "a lab"}',
        )
    )
    assert re.search(r"mtf\.across .*1, 0\.5, 0\.12 .*measured .*a lab", table)
    assert re.search(r"mtf\.mtf_nyquist_along .*0\.05", table)
    assert re.search(r"mtf\.psf .*37 x 33 samples, 4 to a pixel", shown(PSF))
    assert PSF in shown(PSF, "--toml")
