"""The two steps around a network, end to end: exact seams, the switches, and what each step
changes.
"""

import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tifffile

import beers_deploy as bd
from beers_deploy.model.consistency import REACH_PX
from beers_deploy.network import Network
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.errors import MachineError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.sensor_file import BLIND
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.restoration.options import Options
from beers_deploy.restoration.run import restore_file
from beers_deploy.restoration.tiles.rows import HeldRows, NetworkRow
from tests.deploy.command_line import done
from tests.deploy.restoration.runs import restored, stopped_after
from tests.quant.tiling.small_networks import espcn, four_bands

FLOAT = "convbeers-xs"
INT8 = "convbeers-xs-int8"
SENSOR = load_sensor("pleiades-degraded")
NOISY = load_sensor("dior-high")
"""Its noise allows no factor above 1."""
SHAPE = 129, 141
TILES_PX = (57, 100)
BRIGHT_FROM = 100
RADIUS_PX = 14
"""The first bright column, and the receptive radius of the two networks."""
NODATA = 0


@cache
def image() -> np.ndarray:
    """Dark, medium and bright ground (H, W) uint16, so that some pixels take each of the factors 1,
    4 and 8.
    """
    generator = np.random.default_rng(7)
    pixels = generator.integers(1500, 3500, SHAPE)
    pixels[:, :BRIGHT_FROM] = generator.integers(350, 600, (SHAPE[0], BRIGHT_FROM))
    pixels[20:, :60] = generator.integers(20, 200, (SHAPE[0] - 20, 60))
    return pixels.astype(np.uint16)


@cache
def lacking() -> np.ndarray:
    """The same with missing pixels, an area of them across tiles, and saturated ones."""
    pixels = image().copy()
    pixels[60:110, 40:90] = NODATA
    pixels[[3, 77, 128], [5, 120, 140]] = NODATA
    pixels[30:36, 120:130] = 4095
    return pixels


def as_floats(pixels: np.ndarray) -> np.ndarray:
    """Missing pixels are NaN."""
    return np.where(pixels == NODATA, np.float32(np.nan), pixels.astype(np.float32))


def options(
    name: str, sensors: Mapping[str, Sensor] | None = None, exposure: bool = True, **more: Any
) -> Options:
    """Build what the command makes of --network, --sensor and --no-exposure."""
    by_band = sensors or {"": SENSOR}
    with warnings.catch_warnings(action="ignore"):
        networks = {band: Network.load(name, sensor=sensor) for band, sensor in by_band.items()}
    return Options(
        next(iter(networks.values())),
        sensors=by_band,
        bands={} if "" in networks else networks,
        exposure=exposure,
        **more,
    )


def by_array(pixels: Any, name: str, **more: Any) -> Any:
    """Restore an array; that noise is no image of the sensor is told as a warning."""
    with warnings.catch_warnings(action="ignore"):
        return bd.restore(
            pixels, name, progress=None, **{"sensor": SENSOR, "full_scale": 4095, **more}
        )


def by_file(folder: Path, pixels: np.ndarray, how: Options, **tiff_options: Any) -> np.ndarray:
    tags = {"extratags": [(42113, "s", 0, f"{NODATA}", True)]} if pixels.dtype == np.uint16 else {}
    return restored(folder, pixels, replace(how, full_scale=4095), **tags, **tiff_options)[0]


@pytest.mark.parametrize(("name", "floats"), [(FLOAT, True), (INT8, False)])
def test_tiles_and_files_give_the_whole_image_s_pixels(
    name: str, floats: bool, tmp_path: Path
) -> None:
    """With both steps, missing and saturated pixels, bit for bit."""
    pixels = as_floats(lacking()) if floats else lacking()
    nodata = None if floats else NODATA
    untiled = by_array(pixels, name, nodata=nodata)
    assert (untiled != by_array(pixels, name, nodata=nodata, consistency=False)).mean() > 0.5
    for tile_px in TILES_PX:
        tiled = by_array(pixels, name, nodata=nodata, tile=tile_px)
        np.testing.assert_array_equal(tiled, untiled, err_msg=f"tiles of {tile_px}")
    np.testing.assert_array_equal(
        by_file(tmp_path, pixels, options(name, tile_px=TILES_PX[0])), untiled
    )
    missing = lacking() == NODATA
    np.testing.assert_array_equal(np.isnan(untiled) if floats else untiled == NODATA, missing)


def test_a_dask_array_gives_the_same_and_its_workers_read_no_files(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A worker on another machine has none of the networks' files, of any exposure."""
    da = pytest.importorskip("dask.array", reason="the extra 'dask' is not installed")
    untiled = by_array(lacking(), INT8, nodata=NODATA)
    lazy = by_array(da.from_array(lacking(), chunks=50), INT8, nodata=NODATA, tile=TILES_PX[0])
    for module in ("network", "network_files"):
        monkeypatch.setattr(
            f"beers_deploy.{module}.load_onnx",
            lambda path: pytest.fail(f"reads {path}"),
        )
    np.testing.assert_array_equal(lazy.compute(scheduler="synchronous"), untiled)


@pytest.mark.parametrize("floats", [False, True])
def test_a_dask_array_has_the_full_scale_of_its_sensor(floats: bool) -> None:
    da = pytest.importorskip("dask.array", reason="the extra 'dask' is not installed")
    sensor = SENSOR.replace(bits=14)
    pixels = image()[:60, 70:] * 4
    pixels = pixels.astype(np.float32) if floats else pixels
    expected = by_array(pixels, INT8, sensor=sensor, full_scale=None)
    lazy = by_array(da.from_array(pixels, chunks=50), INT8, sensor=sensor, full_scale=None, tile=57)
    np.testing.assert_array_equal(lazy.compute(scheduler="synchronous"), expected)


@pytest.mark.parametrize("sensors", [(SENSOR, NOISY), (load_sensor(BLIND), SENSOR)])
def test_each_band_takes_the_steps_of_its_own_sensor(
    sensors: tuple[Sensor, Sensor], tmp_path: Path
) -> None:
    """Also where one band's sensor allows no factor above 1, or is not known."""
    bands = np.stack([image(), image()[::-1]])
    separate: dict[str, Any] = {"planarconfig": "separate", "photometric": "minisblack"}
    by_name = {f"B{number}": sensor for number, sensor in enumerate(sensors)}
    results = by_file(tmp_path, bands, options(INT8, by_name, tile_px=64), **separate)
    for band, sensor, result in zip(bands, sensors, results, strict=True):
        np.testing.assert_array_equal(result, by_array(band, INT8, sensor=sensor, nodata=NODATA))


def stopped(folder: Path, how: Options, tiles: int) -> Options:
    """Stop a run after so many tiles, the first rows of them finished; return the options to resume
    it.
    """
    error = MachineError("machine", expected="power", got="none", remedy="wait")
    with stopped_after(tiles, error):
        restore_file(folder / "in.tif", folder / "out.tif", how)
    return replace(how, resume=True)


def test_a_run_that_was_stopped_twice_is_resumed_to_the_same_bytes(tmp_path: Path) -> None:
    how = options(INT8, tile_px=57, threads=1, full_scale=4095)
    tall = np.concatenate([lacking(), image()])
    by_file(tmp_path, tall, how)
    expected = (tmp_path / "out.tif").read_bytes()
    resumed = stopped(tmp_path, how, tiles=25)
    with stopped_after(24):
        restore_file(tmp_path / "in.tif", tmp_path / "out.tif", resumed)
    restore_file(tmp_path / "in.tif", tmp_path / "out.tif", resumed)
    assert (tmp_path / "out.tif").read_bytes() == expected


@pytest.mark.parametrize("switch", [{"consistency": False}, {"exposure": False}])
def test_a_run_is_not_resumed_with_other_steps(switch: dict[str, Any], tmp_path: Path) -> None:
    how = options(INT8, tile_px=57, threads=1, full_scale=4095)
    tifffile.imwrite(tmp_path / "in.tif", np.concatenate([image(), image()]))
    resumed = stopped(tmp_path, how, tiles=25)
    with pytest.raises(OptionError, match="resume"):
        restore_file(tmp_path / "in.tif", tmp_path / "out.tif", replace(resumed, **switch))


CONSISTENCY = "consistency step"
RUNS = "network runs"
BRIGHTENED = "brightened pixels"


@cache
def share_of_dark() -> float:
    """The share of pixels in percent that have no pixel above 614 DN within the receptive radius of
    14 px.
    """
    return 100 * (BRIGHT_FROM - RADIUS_PX) / SHAPE[1]


@pytest.mark.parametrize(
    ("words", "figures", "text"),
    [
        ((), {CONSISTENCY, RUNS, BRIGHTENED}, {"consistency": "on", "exposures": "x1, x4, x8"}),
        (
            ("--no-consistency",),
            {RUNS, BRIGHTENED},
            {"consistency": "off", "exposures": "x1, x4, x8"},
        ),
        (("--no-exposure",), {CONSISTENCY}, {"consistency": "on", "exposures": None}),
        (("--no-consistency", "--no-exposure"), set(), {"consistency": "off", "exposures": None}),
    ],
)
def test_the_command_says_which_steps_were_taken(
    words: tuple[str, ...], figures: set[str], text: dict[str, str | None], tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "in.tif", image())
    out = tmp_path / "out.tif"
    results = tmp_path / "results.json"
    files = ("restore", tmp_path / "in.tif", out, "--json", results)
    done(*files, "--network", INT8, "--sensor", SENSOR.name, *words)
    switches = {
        "consistency": "--no-consistency" not in words,
        "exposure": "--no-exposure" not in words,
    }
    np.testing.assert_array_equal(tifffile.imread(out), by_array(image(), INT8, **switches))
    (row,) = json.loads(results.read_text(encoding="utf-8"))["rows"]
    assert {CONSISTENCY, RUNS, BRIGHTENED} & set(row["figures"]) == figures
    assert {key: row["text"].get(key) for key in text} == text
    if BRIGHTENED in figures:
        assert row["figures"][BRIGHTENED]["value"] == pytest.approx(share_of_dark(), abs=0.01)
        assert row["figures"][RUNS]["value"] == 3


def test_each_step_changes_what_it_is_for() -> None:
    """Exposure changes dark pixels alone, the consistency step all of them, by little."""
    pixels = as_floats(image())
    switches = {
        "none": (False, False),
        "exposure": (False, True),
        "consistency": (True, False),
        "both": (True, True),
    }
    results = {
        name: by_array(pixels, INT8, consistency=consistency, exposure=exposure)
        for name, (consistency, exposure) in switches.items()
    }
    end = BRIGHT_FROM - RADIUS_PX
    changed = results["exposure"] != results["none"]
    assert changed[:, :end].mean() > 0.9
    assert not changed[:, end:].any()
    assert (results["consistency"] != results["none"]).mean() > 0.8
    assert (results["both"] != results["exposure"]).mean() > 0.8


@pytest.mark.parametrize("sensor", [(), ("--sensor", BLIND)])
def test_without_a_sensor_the_consistency_step_is_off(
    sensor: tuple[str, ...], tmp_path: Path
) -> None:
    """The two mean the same."""
    tifffile.imwrite(tmp_path / "in.tif", image())
    results = tmp_path / "results.json"
    files = (tmp_path / "in.tif", tmp_path / "out.tif", "--json", results)
    done("restore", *files, "--network", INT8, *sensor)
    (row,) = json.loads(results.read_text(encoding="utf-8"))["rows"]
    assert row["text"]["consistency"] == "off: no sensor is named"
    assert CONSISTENCY not in row["figures"]
    expected = by_array(image(), INT8, sensor=BLIND)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "out.tif"), expected)
    np.testing.assert_array_equal(
        expected, by_array(image(), INT8, sensor=BLIND, consistency=False)
    )


def test_a_network_of_the_user_s_gets_the_consistency_step_and_no_exposure(
    model: Path, tmp_path: Path
) -> None:
    own = Options(model, 23, sensors={"": SENSOR}, full_scale=4095)
    tiled, row = restored(tmp_path, lacking().astype(np.float32), own)
    assert row.text["consistency"] == "on"
    assert "exposures" not in row.text
    untiled, _ = restored(tmp_path, lacking().astype(np.float32), replace(own, tile_px=512))
    np.testing.assert_array_equal(tiled, untiled)
    without, row = restored(tmp_path, lacking().astype(np.float32), replace(own, consistency=False))
    assert row.text["consistency"] == "off"
    assert (tiled != without).mean() > 0.8


@pytest.mark.parametrize(("make", "bands"), [(espcn, 1), (lambda: four_bands(2), 4)])
def test_a_network_of_other_pixels_or_bands_gets_none(
    make: Callable[[], onnx.ModelProto], bands: int, tmp_path: Path
) -> None:
    save_onnx(make(), tmp_path / "network.onnx")
    pixels = np.stack([image()] * bands) if bands > 1 else image()
    layout: dict[str, Any] = {"planarconfig": "separate"} if bands > 1 else {}
    how = Options(tmp_path / "network.onnx", 56, sensors={"": SENSOR}, full_scale=4095, force=True)
    result, row = restored(tmp_path, pixels, how, photometric="minisblack", **layout)
    assert row.text["consistency"] == "off: the network makes other pixels or bands"
    without, _ = restored(
        tmp_path, pixels, replace(how, consistency=False), photometric="minisblack", **layout
    )
    np.testing.assert_array_equal(result, without)


@pytest.mark.parametrize("name", [FLOAT, INT8])
def test_the_mean_of_a_dark_image_is_kept(name: str) -> None:
    """Measured at 30 DN: 3.3 and 3.8 % darker without the steps, less than
    0.001 % off with both.
    """
    nominal = SENSOR.nominal()
    level_dn = 30
    sigma = (
        nominal.noise_sigma(level_dn / nominal.gain_dn_per_radiance) * nominal.gain_dn_per_radiance
    )
    noise = np.random.default_rng(0).normal(0, sigma, (97, 110))
    dark = np.rint(level_dn + noise).astype(np.float32)
    with_steps = by_array(dark, name).mean() / dark.mean()
    without_steps = by_array(dark, name, consistency=False, exposure=False).mean() / dark.mean()
    assert abs(with_steps - 1) < 0.003 < 0.02 < abs(without_steps - 1)


def test_few_rows_are_held_of_a_tall_image(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The consistency step needs its reach above and below a row of tiles, which ends within two
    others.
    """
    most = [0]
    add = HeldRows.add

    def counting(self: HeldRows, row: NetworkRow) -> None:
        add(self, row)
        most[0] = max(most[0], sum(part.shape[1] for part in self.parts))

    monkeypatch.setattr(HeldRows, "add", counting)
    by_array(np.full((800, 9), 900, np.uint16), str(model), tile=40)
    assert 2 * REACH_PX < most[0] <= 2 * REACH_PX + 3 * 40
