import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from beers_deploy.model.metrics.slanted_edge import slanted_edge
from beers_deploy.model.simulator.acquire import acquire
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.simulator.sampling import scene_spectrum
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.errors import BeersError, OptionError
from beers_deploy.profiles.sensor import Instrument, noise_from_snr
from beers_deploy.studies.characterise import characterise, cut_box, profile_toml
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid

RATIO, SIDE, GAIN, BOARD_PX = 4, 1280, 10.2375, 100
SNRS = (50.0, 110.0)
SENSOR = Instrument(0.09, *noise_from_snr(25, SNRS[0], 100, SNRS[1]), GAIN, 12, {}, 0.05)


def landscape(seed: int, board: bool) -> np.ndarray:
    """A drawn scene without its own calibration site; a leaning checkerboard of 100 x 100 pixels in it or none."""
    radiance = procedural_scene(SIDE, SIDE, np.random.default_rng(seed)).radiance.copy()
    radiance[:420] = radiance[420:840]
    if board:
        upright = slanted_edge(BOARD_PX, RATIO, 7, (-1, 1))
        start = (SIDE - upright.shape[0]) // 2
        part = slice(start, start + upright.shape[0])
        radiance[part, part] = 95 + 65 * upright * slanted_edge(BOARD_PX, RATIO, -7, (-1, 1)).T
    return radiance


def acquisition(seed: int, board: bool) -> np.ndarray:
    return to_uint16(acquire(scene_spectrum(landscape(seed, board)), SIDE, SENSOR, RATIO, Draw(seed), "degraded"))


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two raw images of one sensor, the checkerboard in the first."""
    folder = tmp_path_factory.mktemp("raw")
    paths = folder / "board.tif", folder / "plain.tif"
    for seed, path in enumerate(paths):
        tifffile.imwrite(path, acquisition(seed, board=seed == 0))
    return paths


def test_the_profile_is_that_of_the_sensor(raw: tuple[Path, Path], tmp_path: Path) -> None:
    out, figures = tmp_path / "mine.toml", tmp_path / "mine.json"
    options = "--bits", 12, "--gain", GAIN, "--gsd", 0.7
    done("characterise", *raw, *options, "--out", out, "--json", figures)
    profile = load_sensor(str(out))
    sensor = profile.nominal()
    assert sensor.mtf_axes == pytest.approx(SENSOR.mtf_axes, rel=0.1)
    for radiance, snr in zip((25, 100), SNRS, strict=True):
        assert radiance / sensor.noise_sigma(radiance) == pytest.approx(snr, rel=0.1)
    assert (sensor.bits, sensor.gain_dn_per_radiance, profile.gsd_m.low) == (12, GAIN, 0.7)
    assert {profile.mtf_nyquist.status, profile.snr_pair[0].status} == {"measured"}
    assert {profile.gain_dn_per_radiance.status, profile.bits.status, profile.gsd_m.status} == {"stated"}
    done("characterise", *raw, *options, "--out", tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_bytes() == out.read_bytes()
    shown = valid(figures)["rows"][0]["figures"]
    truths = (9.0, 5.0, *SNRS)
    assert {figure["mode"] for figure in shown.values()} == {"measured"}
    intervals = [figure["interval"] for figure in shown.values()]
    assert sum(low <= true <= high for (low, high), true in zip(intervals, truths, strict=True)) >= 3
    text = out.read_text(encoding="utf-8")
    assert text.count("95 % interval") == len(truths)
    assert f"95 % interval {intervals[2][0]:.3g} to {intervals[2][1]:.3g}" in text


def test_without_a_gain_the_noise_over_full_scale_stands(raw: tuple[Path, Path]) -> None:
    """To a network only that matters: any gain leaves it."""
    stated = characterise(raw, bits=12, gain=3.0)
    assumed = characterise(raw, bits=12)
    assert assumed.gain == pytest.approx(4095 / 400)
    for one, other in zip(stated.snrs, assumed.snrs, strict=True):
        assert one.value == pytest.approx(other.value)
        assert one.radiance * 3.0 == pytest.approx(other.radiance * assumed.gain)
    written = tomllib.loads(profile_toml(assumed))
    assert written["digitiser"]["gain_dn_per_radiance"]["status"] == "assumed"
    assert written["noise"]["radiance_1"]["value"] == pytest.approx(100)


def edge_box(raw: tuple[Path, Path]) -> str:
    """The upper half of the board's upright edge, in an image that has lost 32 pixels a side."""
    middle = SIDE // RATIO // 2 - 32
    return f"{raw[0]}:{middle - 11},{middle - 38},30,28"


def test_a_box_gives_one_axis_for_both(raw: tuple[Path, Path]) -> None:
    found = characterise(raw, (edge_box(raw),), bits=12)
    assert list(found.axes) == ["across"]
    assert found.axes["across"].edges == 1
    low, high = found.axes["across"].interval
    assert low <= 0.09 <= high < 1.5 * low
    text = profile_toml(found)
    assert "mtf_nyquist_along" not in text
    assert "across the track" in text
    assert "no edge shows the other axis" in text
    assert found.rows()[0].figures["MTF along at Nyquist"].mode == "unavailable"


def test_images_without_an_edge_are_refused(raw: tuple[Path, Path], tmp_path: Path) -> None:
    said = refused("characterise", raw[1], "--bits", 12, "--out", tmp_path / "mine.toml")
    assert list(tmp_path.iterdir()) == []
    assert "expected 3 straight edges" in said
    assert "--edge FILE:X,Y,WIDTH,HEIGHT" in said


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ("board.tif", "FILE:X,Y,WIDTH,HEIGHT"),
        ("board.tif:1,2,3", "FILE:X,Y,WIDTH,HEIGHT"),
        ("board.tif:1,2,-3,4", "FILE:X,Y,WIDTH,HEIGHT"),
        ("other.tif:1,2,30,40", "one of the images"),
    ],
)
def test_a_box_written_wrongly_is_refused(box: str, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        cut_box(box, [Path("board.tif")])


@pytest.mark.parametrize(
    ("box", "words"),
    [("0,0,9999,20", "or more inside"), ("9,9,0,0", "or more inside"), ("2,2,30,40", "one straight edge")],
)
def test_a_box_that_holds_no_edge_is_refused(raw: tuple[Path, Path], tmp_path: Path, box: str, words: str) -> None:
    edge = "--edge", f"{raw[0]}:{box}"
    assert words in refused("characterise", *raw, "--bits", 12, *edge, "--out", tmp_path / "mine.toml")
    assert list(tmp_path.iterdir()) == []


def tiff(folder: Path, pixels: np.ndarray) -> Path:
    tifffile.imwrite(folder / "raw.tif", pixels, photometric="rgb" if pixels.ndim == 3 else "minisblack")
    return folder / "raw.tif"


FLAT = np.random.default_rng(0).normal(1000, 20, (200, 200))
WRONG: dict[str, tuple[np.ndarray, tuple[str, ...], str]] = {
    "8-bit": (np.clip(FLAT / 8, 0, 255).astype(np.uint8), (), "or are stored in 8 bits"),
    "bands": (np.full((64, 64, 3), 7, np.uint16), ("--bits", "12"), "one band"),
    "fractions": (FLAT.astype(np.float32), ("--bits", "12"), "whole digital numbers"),
    "negative": (FLAT.astype(np.int16) - 2000, ("--bits", "12"), "from 0 to 65535"),
    "wide": (FLAT.astype(np.uint32) * 70, ("--bits", "16"), "from 0 to 65535"),
    "all missing": (np.full((200, 200), np.nan, np.float32), ("--bits", "12"), "unclipped"),
    "steps": (FLAT.astype(np.uint16) * 16, ("--bits", "16"), "divide it by 16"),
    "open bits": (FLAT.astype(np.uint16), (), "--bits: expected --bits beside images"),
    "wrong bits": (FLAT.astype(np.uint16), ("--bits", "8"), "up to 255"),
    "gain": (FLAT.astype(np.uint16), ("--bits", "12", "--gain", "0"), "above 0"),
    "no noise": (np.full((200, 200), 1000, np.uint16), ("--bits", "12"), "noise"),
    "nodata": (np.zeros((200, 200), np.uint16), ("--bits", "12"), "unclipped"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence(case: str, tmp_path: Path) -> None:
    pixels, options, words = WRONG[case]
    image = tiff(tmp_path, pixels)
    written = "--out", tmp_path / "mine.toml", "--json", tmp_path / "mine.json"
    said = refused("characterise", image, *options, *written)
    assert [p.name for p in tmp_path.iterdir()] == ["raw.tif"]
    assert words in said
    assert said.startswith("beers-deploy: ")


def test_one_image_twice_is_refused(raw: tuple[Path, Path], tmp_path: Path) -> None:
    """Its blocks would count twice, and the intervals would shrink for nothing."""
    assert "twice" in refused("characterise", raw[0], raw[0], "--bits", 12, "--out", tmp_path / "mine.toml")


def test_images_of_two_gains_are_refused(raw: tuple[Path, Path], tmp_path: Path) -> None:
    half = tmp_path / "half.tif"
    tifffile.imwrite(half, tifffile.imread(raw[0]) // 2)
    said = refused("characterise", raw[0], half, "--bits", 12, "--out", tmp_path / "mine.toml")
    assert "differ in gain" in said
    assert f"DN^2 in {half.name}" in said


def test_pixels_clipped_at_full_scale_tell_the_bits(raw: tuple[Path, Path], tmp_path: Path) -> None:
    pixels = tifffile.imread(raw[0]).copy()
    pixels[:4, :4] = 4095
    image = tiff(tmp_path, pixels)
    found = characterise((image, raw[1]))
    assert found.bits == 12
    assert tomllib.loads(profile_toml(found))["digitiser"]["bits"]["status"] == "measured"
    with pytest.raises(BeersError, match="clipped pixels"):
        characterise((image, raw[1]), (f"{image}:0,0,30,30",))
    pixels[:4, :4] = 4000
    with pytest.raises(BeersError, match="bits"):
        characterise((tiff(tmp_path, pixels), raw[1]))


def test_names_cannot_break_the_profile(raw: tuple[Path, Path], tmp_path: Path) -> None:
    odd = tmp_path / 'a "quoted" \x7f\u202e name.tif'
    odd.write_bytes(raw[0].read_bytes())
    text = profile_toml(characterise((odd, raw[1]), bits=12))
    assert "\x7f" not in text
    assert "quoted" in tomllib.loads(text)["description"]


def test_the_noise_of_a_bound_is_a_profile_that_loads(raw: tuple[Path, Path], tmp_path: Path) -> None:
    """All noise in beta, or in alpha: decimals must not put the SNR beyond what physics allows."""
    found = characterise(raw, bits=12)
    full_scale = 4095 / found.gain
    for dark in (math.sqrt(1 / 4), 1 / 4):
        bright = replace(found.snrs[1], radiance=full_scale / 4, value=100 / 3)
        low = replace(found.snrs[0], radiance=full_scale / 16, value=dark * 100 / 3)
        (tmp_path / "mine.toml").write_text(profile_toml(replace(found, snrs=(low, bright))), encoding="utf-8")
        sensor = load_sensor(str(tmp_path / "mine.toml")).nominal()
        assert min(sensor.alpha, sensor.beta) >= 0
