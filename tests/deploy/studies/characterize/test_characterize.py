import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from beers_deploy.model.metrics.slanted_edge import slanted_edge
from beers_deploy.model.simulator.acquire import acquire, prepare_scene
from beers_deploy.model.simulator.detector import Draw, to_uint16
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.profiles.errors import BeersError
from beers_deploy.profiles.instrument import Instrument, noise_from_snr
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.characterize import Stated, measure, profile_toml
from beers_deploy.verbs.characterize import characterize
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid

RATIO = 4
SIDE = 1280
GAIN = 10.2375
BOARD_PX = 100
SNRS = (50.0, 110.0)
SENSOR = Instrument(0.09, *noise_from_snr(25, SNRS[0], 100, SNRS[1]), GAIN, 12, {}, 0.05)


def landscape(seed: int, board: bool) -> np.ndarray:
    """Draw a scene without its own calibration site, and with a slanted checkerboard if `board`."""
    radiance = procedural_scene(SIDE, SIDE, np.random.default_rng(seed)).radiance.copy()
    radiance[:420] = radiance[420:840]
    if board:
        upright = slanted_edge(BOARD_PX, RATIO, 7, (-1, 1))
        start = (SIDE - upright.shape[0]) // 2
        part = slice(start, start + upright.shape[0])
        radiance[part, part] = 95 + 65 * upright * slanted_edge(BOARD_PX, RATIO, -7, (-1, 1)).T
    return radiance


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write two raw images of one sensor, the first one with the checkerboard."""
    folder = tmp_path_factory.mktemp("raw")
    paths = folder / "board.tif", folder / "plain.tif"
    for seed, path in enumerate(paths):
        scene = prepare_scene(landscape(seed, board=seed == 0), RATIO)
        signal = acquire(scene, SENSOR, Draw(seed))
        tifffile.imwrite(path, to_uint16(signal))
    return paths


FREQUENCIES = np.array([0.1, 0.25, 0.5])
KNOWN = Stated(bits=12, mtf=(0.1, 0.1))
"""With a stated MTF no edge is searched for. The search takes most of the time."""


@pytest.mark.slow
def test_the_profile_is_that_of_the_sensor(raw: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "mine.toml"
    figures = tmp_path / "mine.json"
    options = "--bits", 12, "--gain", GAIN, "--gsd", 0.7
    done("characterize", *raw, *options, "--out", out, "--json", figures)
    profile = Sensor.load(out)
    sensor = profile.nominal()
    assert sensor.response is not None
    none = np.zeros((1, 1))
    across = sensor.response.at(FREQUENCIES[None], none).ravel()
    along = sensor.response.at(none, FREQUENCIES[:, None]).ravel()
    for table, mtf in zip((across, along), SENSOR.mtf_axes, strict=True):
        assert table == pytest.approx(transfer(FREQUENCIES, mtf), rel=0.12)
    for radiance, snr in zip((25, 100), SNRS, strict=True):
        assert radiance / sensor.noise_sigma(radiance) == pytest.approx(snr, rel=0.1)
    assert (sensor.bits, sensor.gain_dn_per_radiance, profile.gsd_m.low) == (12, GAIN, 0.7)
    measured = profile.mtf_nyquist, profile.snr_pair[0]
    stated = profile.gain_dn_per_radiance, profile.bits, profile.gsd_m
    assert [c.status for c in (*measured, *stated)] == ["measured"] * 2 + ["stated"] * 3
    done("characterize", *raw, *options, "--out", tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_bytes() == out.read_bytes()
    by_name = valid(figures)["rows"][0]["figures"]
    contrasts = np.concatenate([transfer(FREQUENCIES, mtf) for mtf in SENSOR.mtf_axes])
    truths = [*(100 * contrasts), *SNRS]
    assert {figure["mode"] for figure in by_name.values()} == {"measured"}
    intervals = [figure["interval"] for figure in by_name.values()][: len(truths)]
    hits = [low <= truth <= high for (low, high), truth in zip(intervals, truths, strict=True)]
    # A 95 % interval may miss its truth, so not all eight need to contain it.
    assert sum(hits) >= 6
    assert f"95 % interval {intervals[6][0]:.3g} to {intervals[6][1]:.3g}" in out.read_text(
        encoding="utf-8"
    )


def transfer(frequencies: np.ndarray, mtf_nyquist: float) -> np.ndarray:
    """Compute the MTF by the profile's formula, exp(-gamma f) sinc(f)."""
    return np.asarray((mtf_nyquist * math.pi / 2) ** (2 * frequencies) * np.sinc(frequencies))


def test_without_a_gain_the_noise_over_full_scale_is_unchanged(raw: tuple[Path, Path]) -> None:
    """Only the noise over full scale matters to a network, and no gain changes it."""
    with_gain = measure(raw, stated=replace(KNOWN, gain=3.0))
    without_gain = measure(raw, stated=KNOWN)
    assert without_gain.gain == pytest.approx(4095 / 400)
    for one, other in zip(with_gain.snrs, without_gain.snrs, strict=True):
        assert one.value == pytest.approx(other.value)
        assert one.radiance * 3.0 == pytest.approx(other.radiance * without_gain.gain)
    profile = tomllib.loads(profile_toml(without_gain))
    assert profile["digitiser"]["gain_dn_per_radiance"]["status"] == "assumed"
    assert profile["noise"]["radiance_1"]["value"] == pytest.approx(100)


def test_a_box_gives_one_axis_for_both(raw: tuple[Path, Path], tmp_path: Path) -> None:
    # The box contains the upper half of the board's upright edge. The simulator cuts 32 pixels off
    # each side of an image.
    middle = SIDE // RATIO // 2 - 32
    box = f"{raw[0]}:{middle - 11},{middle - 38},30,28"
    result = measure(raw, (box,), Stated(bits=12))
    assert list(result.curves) == ["across"]
    _, (low, high) = result.curves["across"].at(0.5)
    assert low <= 0.09 <= high < 2 * low
    table = tomllib.loads(profile_toml(result))["mtf"]
    assert table["across"]["value"] == table["along"]["value"]
    assert "no curve along the track" in table["along"]["source"]
    assert (table["across"]["status"], table["along"]["status"]) == ("measured", "assumed")
    (tmp_path / "mine.toml").write_text(profile_toml(result), encoding="utf-8")
    axes = Sensor.load(tmp_path / "mine.toml").contrasts
    assert [axis.status for axis in axes] == ["measured", "assumed"]
    assert result.rows()[0].figures["MTF along at Nyquist"].mode == "unavailable"


def test_without_an_edge_the_mtf_is_assumed_and_marked_so(tmp_path: Path) -> None:
    out = tmp_path / "mine.toml"
    ramp = np.linspace(200, 3000, 320)[:, None] + np.random.default_rng(1).normal(0, 20, (320, 320))
    command = "characterize", tiff(tmp_path, ramp.astype(np.uint16)), "--bits", 12, "--out", out
    assert "the profile's MTF is an assumption" in done(*command)
    profile = Sensor.load(out)
    assert profile.mtf_nyquist.status == "assumed"
    assert profile.snr_pair[1].status == "measured"
    assert "assumption" not in done(*command, "--mtf", "0.08,0.04", "--overwrite")
    profile = Sensor.load(out)
    assert profile.nominal().mtf_axes == (0.08, 0.04)
    assert profile.mtf_nyquist.status == "stated"


def test_steps_and_a_black_level_change_nothing_but_the_units(
    raw: tuple[Path, Path], tmp_path: Path
) -> None:
    """Values stored eight times as large, above a pedestal, have the same noise above the dark."""
    plain = measure(raw, stated=KNOWN)
    folder = tmp_path / "frames"
    folder.mkdir()
    for path in raw:
        tifffile.imwrite(folder / path.name, ((tifffile.imread(path) + 200) * 8).astype(np.uint16))
    stored = replace(KNOWN, bits=15)
    result = measure([folder], stated=replace(stored, black_level=1600))
    frames = result.frames
    assert (frames.step, frames.bits, frames.stored_full_scale) == (8, 12, 32760)
    for one, other in zip(result.snrs, plain.snrs, strict=True):
        assert one.value == pytest.approx(other.value, rel=0.02)
    assert tomllib.loads(profile_toml(result))["offset"]["offset_dn"]["value"] == 200
    assert any("full scale 32760" in note for note in result.notes())
    assert not any("black level" in note for note in result.notes())
    hidden = measure([folder], stated=stored)
    assert any("black level" in note for note in hidden.notes())
    none = measure([folder], stated=replace(stored, black_level=0))
    assert not any("black level" in note for note in none.notes())


def test_pairs_of_one_scene_give_the_noise_alone(tmp_path: Path) -> None:
    """In a pair, texture as fine as the noise cancels. In one image it counts as noise."""
    generator = np.random.default_rng(4)
    scene = np.linspace(300, 3000, 320)[:, None] + generator.normal(0, 40, (320, 320))
    for number in range(2):
        noisy = scene + generator.normal(size=scene.shape) * np.sqrt(0.5 * scene)
        tifffile.imwrite(
            tmp_path / f"{number}.tif", np.clip(noisy.round(), 1, 4094).astype(np.uint16)
        )
    result = measure([tmp_path], stated=KNOWN)
    assert result.noise.pairs == 1
    assert result.noise.model.at(1000).value == pytest.approx(500, rel=0.05)
    alone = measure([tmp_path / "0.tif"], stated=KNOWN)
    assert alone.noise.model.at(1000).value > 1500


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ("board.tif", "FILE:X,Y,WIDTH,HEIGHT"),
        ("board.tif:1,2,-3,4", "FILE:X,Y,WIDTH,HEIGHT"),
        ("other.tif:1,2,30,40", "'other.tif', which is not one of the IMAGES"),
        ("{}:0,0,9999,20", "or more inside"),
        ("{}:9,9,0,0", "or more inside"),
        ("{}:2,2,30,40", "one straight edge"),
    ],
)
def test_a_box_without_an_edge_is_refused(
    raw: tuple[Path, Path], tmp_path: Path, box: str, words: str
) -> None:
    options = "--bits", 12, "--edge", box.format(raw[0]), "--out", tmp_path / "mine.toml"
    assert words in refused("characterize", *raw, *options)
    assert list(tmp_path.iterdir()) == []


def tiff(folder: Path, pixels: np.ndarray) -> Path:
    tifffile.imwrite(
        folder / "raw.tif", pixels, photometric="rgb" if pixels.ndim == 3 else "minisblack"
    )
    return folder / "raw.tif"


FLAT = np.random.default_rng(0).normal(1000, 20, (200, 200))
RAW = FLAT.astype(np.uint16)
WRONG: dict[str, tuple[np.ndarray, str, str]] = {
    "8-bit": ((FLAT / 8).astype(np.uint8), "", "or are stored in 8 bits"),
    "bands": (np.full((64, 64, 3), 7, np.uint16), "--bits 12", "one band"),
    "fractions": (FLAT.astype(np.float32), "--bits 12", "whole digital numbers"),
    "negative": (FLAT.astype(np.int16) - 2000, "--bits 12", "from 0 to 65535"),
    "wide": (FLAT.astype(np.uint32) * 70, "--bits 16", "from 0 to 65535"),
    "all missing": (np.full((200, 200), np.nan, np.float32), "--bits 12", "no pixels with values"),
    "steps": (RAW * 16 + 3, "--bits 16", "Divide them by 16"),
    "black": (RAW, "--bits 12 --black-level 1500", "--black-level must be at least 0"),
    "mtf": (RAW, "--bits 12 --mtf 7", "Write 0.07 for 7 %"),
    "mtf and edge": (
        RAW,
        "--bits 12 --mtf 0.07 --edge a.tif:1,1,30,30",
        "--edge has no effect with",
    ),
    "three contrasts": (RAW, "--bits 12 --mtf 0.1,0.1,0.1", "one or two ratios"),
    "open bits": (RAW, "", "--bits is missing"),
    "wrong bits": (RAW, "--bits 8", "up to 255"),
    "bits and steps": (RAW // 4 * 64, "--bits 12", "a full scale of 262080, but 16 bits"),
    "gain": (RAW, "--bits 12 --gain 0", "above 0"),
    "no noise": (np.full_like(RAW, 1000), "--bits 12", "noise"),
    "nodata": (np.zeros_like(RAW), "--bits 12", "unclipped"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence(case: str, tmp_path: Path) -> None:
    pixels, options, words = WRONG[case]
    outputs = "--out", tmp_path / "mine.toml", "--json", tmp_path / "mine.json"
    message = refused("characterize", tiff(tmp_path, pixels), *options.split(), *outputs)
    assert [p.name for p in tmp_path.iterdir()] == ["raw.tif"]
    assert words in message
    assert message.startswith("beers-deploy: ")


def test_a_profile_that_no_command_reads_is_not_written(tmp_path: Path) -> None:
    image = tiff(tmp_path, RAW)
    message = refused("characterize", image, "--bits", 12, "--out", tmp_path / "mine.txt")
    assert "must end in .toml" in message
    assert [*tmp_path.iterdir()] == [image]


def test_a_profile_that_exists_is_replaced_only_if_asked(tmp_path: Path) -> None:
    edited = tmp_path / "mine.toml"
    edited.write_text("edited by hand")
    image = tiff(tmp_path, RAW)
    message = refused("characterize", image, "--bits", 12, "--mtf", 0.1, "--out", edited)
    assert "mine.toml exists already. Add --overwrite" in message
    assert edited.read_text() == "edited by hand"


def test_arrays_are_read_like_files(tmp_path: Path) -> None:
    """One number is an MTF, masked pixels are missing, and numbers below 0 do not wrap around. The
    sensor restores in memory as its file does.
    """
    noisy = np.random.default_rng(0).normal(np.linspace(200, 3000, 320)[:, None], 20, (320, 320))
    pixels = noisy.astype(np.int32)
    corrupted = pixels.copy()
    corrupted[:20] = 4095
    masked = np.ma.masked_equal(corrupted, 4095)
    sensor = characterize(masked, bits=12, mtf=0.08)
    assert sensor.snr_pair == characterize(masked.filled(0), bits=12, mtf="0.08").snr_pair
    assert sensor.mtf_nyquist.low == 0.08
    assert repr(sensor).startswith("Sensor('measured': 12 bits, MTF 0.08")
    restored = restore(pixels, network="convbeers-half-xs", sensor=sensor)
    sensor.save(tmp_path / "my.toml")
    as_file = restore(pixels, network="convbeers-half-xs", sensor=tmp_path / "my.toml")
    assert np.array_equal(restored, as_file)
    with pytest.raises(BeersError, match="from 0 to 65535, but one has -"):
        characterize(pixels - 3000, bits=12, mtf=0.08)


def test_one_image_twice_or_images_of_two_gains_are_refused(
    raw: tuple[Path, Path], tmp_path: Path
) -> None:
    half = tmp_path / "half.tif"
    tifffile.imwrite(half, tifffile.imread(raw[0]) // 2)
    with pytest.raises(BeersError, match=r"in half\.tif and .* differ in gain"):
        measure([raw[0], half], stated=KNOWN)
    # Its blocks would count twice, and the intervals would shrink for nothing.
    with pytest.raises(BeersError, match="given twice"):
        measure([raw[0], raw[0]], stated=KNOWN)


def test_pixels_clipped_at_full_scale_determine_the_bits(
    raw: tuple[Path, Path], tmp_path: Path
) -> None:
    pixels = tifffile.imread(raw[0]).copy()
    pixels[:4, :4] = 4095
    image = tiff(tmp_path, pixels)
    result = measure((image, raw[1]), stated=replace(KNOWN, bits=None))
    assert result.frames.bits == 12
    assert tomllib.loads(profile_toml(result))["digitiser"]["bits"]["status"] == "measured"
    with pytest.raises(BeersError, match="clipped pixels"):
        measure((image, raw[1]), (f"{image}:0,0,30,30",))
    pixels[:4, :4] = 4000
    with pytest.raises(BeersError, match="bits"):
        measure((tiff(tmp_path, pixels), raw[1]))


def test_names_cannot_break_the_profile(raw: tuple[Path, Path], tmp_path: Path) -> None:
    odd = tmp_path / 'a "quoted" \x7f\u202e name.tif'
    odd.write_bytes(raw[0].read_bytes())
    text = profile_toml(measure((odd, raw[1]), stated=KNOWN))
    assert "\x7f" not in text
    assert "quoted" in tomllib.loads(text)["description"]


def test_the_noise_of_a_bound_is_a_profile_that_loads(
    raw: tuple[Path, Path], tmp_path: Path
) -> None:
    """With all noise in beta, or in alpha, rounding must not make alpha or beta negative."""
    result = measure(raw, stated=KNOWN)
    low, high = result.snrs
    for dark in (math.sqrt(1 / 4), 1 / 4):
        snrs = replace(low, value=dark * 100 / 3), replace(high, value=100 / 3)
        (tmp_path / "mine.toml").write_text(
            profile_toml(replace(result, snrs=snrs)), encoding="utf-8"
        )
        sensor = Sensor.load(tmp_path / "mine.toml").nominal()
        assert min(sensor.alpha, sensor.beta) >= 0
