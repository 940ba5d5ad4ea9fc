"""Tests of the two steps around a network: exact seams, switches, and the change by each step."""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tifffile
from numpy.testing import assert_array_equal
from scipy.ndimage import gaussian_filter

from beers_deploy.model.consistency.step import REACH_PX
from beers_deploy.model.exposure import EDGE_RADIUS_PX
from beers_deploy.profiles.errors import MachineError, OptionError
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.restoration.tiles.rows import HeldRows
from beers_deploy.verbs.restore import restore
from tests.deploy.command_line import done
from tests.deploy.documents import valid
from tests.deploy.restoration.runs import PLANES, marked, restored, stopped_after
from tests.quant.tiling.small_networks import espcn, four_bands

pytestmark = pytest.mark.usefixtures("unchecked")

FLOAT = "convbeers-xs"
INT8 = "convbeers-xs-int8"
SENSOR = Sensor.load("pleiades-degraded")
NOISY = Sensor.load("dior-high")
"""Its noise allows no factor above 2."""
SHAPE = 129, 141
TILES_PX = (57, 100)
BRIGHT_FROM = 100
RADIUS_PX = 14
"""The first bright column, and the receptive radius of the two networks."""
NODATA = 0


@cache
def image() -> np.ndarray:
    """Return dark, medium and bright ground (H, W) uint16, so that some pixels need each of the
    factors 16, 4 and 1, and those near the edge of bright ground 0.5.
    """
    generator = np.random.default_rng(7)
    pixels = generator.integers(2400, 2800, SHAPE)
    pixels[:, :BRIGHT_FROM] = generator.integers(190, 250, (SHAPE[0], BRIGHT_FROM))
    pixels[20:, :60] = generator.integers(55, 85, (SHAPE[0] - 20, 60))
    return pixels.astype(np.uint16)


@cache
def lacking() -> np.ndarray:
    """Return `image` with saturated pixels and with missing ones, which extend across tiles."""
    pixels = image().copy()
    pixels[60:110, 40:90] = NODATA
    pixels[[3, 77, 128], [5, 120, 140]] = NODATA
    pixels[30:36, 120:130] = 4095
    return pixels


def as_floats(pixels: np.ndarray) -> np.ndarray:
    """Return pixels as float32, with NaN for missing ones."""
    return np.where(pixels == NODATA, np.float32(np.nan), pixels.astype(np.float32))


DEFAULTS: dict[str, Any] = {"sensor": SENSOR, "full_scale": 4095}
"""Options of a restoration, unless it names others."""


def by_array(pixels: Any, network: str | Path, **options: Any) -> Any:
    """Restore an array."""
    return restore(pixels, network=network, **{**DEFAULTS, **options})


def by_file(
    folder: Path, pixels: np.ndarray, layout: dict[str, Any] | None = None, **options: Any
) -> np.ndarray:
    """Restore a file. `layout` contains options of tifffile."""
    tags = (layout or {}) | (marked(NODATA) if pixels.dtype == np.uint16 else {})
    return restored(folder, pixels, tags, **{**DEFAULTS, **options})[0]


@pytest.mark.parametrize(("name", "floats"), [(FLOAT, True), (INT8, False), ("", True)])
def test_tiles_and_files_give_the_whole_image_s_pixels(
    name: str, floats: bool, model: Path, tmp_path: Path
) -> None:
    """The pixels are the same bit for bit, with both steps and with missing and saturated pixels.

    The network of a user has no exposures.
    """
    name = name or str(model)
    pixels = as_floats(lacking()) if floats else lacking()
    nodata = None if floats else NODATA
    untiled = by_array(pixels, name, nodata=nodata)
    assert (untiled != by_array(pixels, name, nodata=nodata, consistency=False)).mean() > 0.5
    for tile_px in TILES_PX:
        tiled = by_array(pixels, name, nodata=nodata, tile=tile_px)
        assert_array_equal(tiled, untiled, err_msg=f"tiles of {tile_px}")
    written = by_file(tmp_path, pixels, network=name, tile=TILES_PX[0])
    assert_array_equal(written, untiled)
    missing = lacking() == NODATA
    assert_array_equal(np.isnan(untiled) if floats else untiled == NODATA, missing)


def test_a_dask_array_gives_the_same_and_its_workers_read_no_files(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A worker on another machine has no file of a network, at any exposure."""
    da = pytest.importorskip("dask.array", reason="the extra 'dask' is not installed")
    untiled = by_array(lacking(), INT8, nodata=NODATA)
    lazy = by_array(da.from_array(lacking(), chunks=50), INT8, nodata=NODATA, tile=TILES_PX[0])
    for module in ("network", "network_files"):
        monkeypatch.setattr(
            f"beers_deploy.{module}.load_onnx", lambda path: pytest.fail(f"reads {path}")
        )
    assert_array_equal(lazy.compute(scheduler="synchronous"), untiled)


def test_each_band_is_restored_with_the_steps_of_its_own_sensor(tmp_path: Path) -> None:
    """The sensor of one band has other factors, and that of another is not known."""
    bands = np.stack([image(), image()[::-1], image()])
    by_name = {"B0": SENSOR, "B1": NOISY, "B2": Sensor.load(BLIND)}
    results = by_file(tmp_path, bands, PLANES, network=INT8, sensor=by_name, tile=64)
    for band, sensor, result in zip(bands, by_name.values(), results, strict=True):
        assert_array_equal(result, by_array(band, INT8, sensor=sensor, nodata=NODATA))
    da = pytest.importorskip("dask.array", reason="the extra 'dask' is not installed")
    chunks = da.from_array(bands, chunks=(1, 50, 50))
    lazy = by_array(chunks, INT8, sensor=by_name, nodata=NODATA, tile=64)
    assert_array_equal(lazy.compute(scheduler="synchronous"), results)


HOW: dict[str, Any] = {**DEFAULTS, "network": INT8, "tile": 57, "threads": 1}
"""Options of the runs that are stopped."""


def stop(folder: Path, tiles: int) -> None:
    """Stop a run after a number of tiles, when its first rows are finished."""
    error = MachineError("The machine has no power. Wait.")
    with stopped_after(tiles, error):
        restore(folder / "in.tif", folder / "out.tif", **HOW)


def test_a_run_that_was_stopped_twice_is_resumed_to_the_same_bytes(tmp_path: Path) -> None:
    out = tmp_path / "out.tif"
    tall = np.concatenate([lacking(), image()])
    by_file(tmp_path, tall, **HOW)
    expected = out.read_bytes()
    out.unlink()
    stop(tmp_path, tiles=25)
    with stopped_after(24):
        restore(tmp_path / "in.tif", out, **HOW, resume=True)
    restore(tmp_path / "in.tif", out, **HOW, resume=True)
    assert out.read_bytes() == expected


OTHER: list[dict[str, Any]] = [
    {"consistency": False},
    {"exposure": False},
    {"halo": 20},
    {"tile": 64},
    {"full_scale": 4000},
    {"sensor": NOISY},
    {"network": FLOAT},
    {"fix_detectors": "found"},
]
"""Options, each of which changes the pixels."""


def test_a_run_is_not_resumed_with_other_options(tmp_path: Path) -> None:
    pixels = np.concatenate([image(), image()])
    pixels[9, 9] = 4095
    tifffile.imwrite(tmp_path / "in.tif", pixels)
    stop(tmp_path, tiles=25)
    for other in OTHER:
        with pytest.raises(OptionError, match=r"`resume` needs .* the options"):
            restore(tmp_path / "in.tif", tmp_path / "out.tif", **HOW | other, resume=True)


CONSISTENCY = "consistency step"
BRIGHTENED = "brightened pixels"


@pytest.mark.parametrize(("consistency", "exposure"), [(True, False), (False, True)])
def test_the_command_reports_the_steps(consistency: bool, exposure: bool, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "in.tif", image())
    switches = {"consistency": consistency, "exposure": exposure}
    words = [f"--no-{name}" for name, is_on in switches.items() if not is_on]
    out = tmp_path / "out.tif"
    results = tmp_path / "results.json"
    files = f"restore {tmp_path}/in.tif {out} --json {results}"
    done(f"{files} --network {INT8} --sensor {SENSOR.name}", *words)
    assert_array_equal(tifffile.imread(out), by_array(image(), INT8, **switches))
    (row,) = valid(results)["rows"]
    figures = row["figures"]
    assert (CONSISTENCY in figures, BRIGHTENED in figures) == (consistency, exposure)
    assert row["text"]["consistency"] == ("on" if consistency else "off")
    assert row["text"].get("exposures") == ("x0.5, x1, x4, x16" if exposure else None)
    if exposure:
        # These pixels have no bright ground within the receptive radius.
        share = 100 * (BRIGHT_FROM - RADIUS_PX) / SHAPE[1]
        assert figures[BRIGHTENED]["value"] == pytest.approx(share, abs=0.01)
        assert figures["network runs"]["value"] == 4


def test_each_step_changes_what_it_is_for() -> None:
    """Exposure changes dark pixels and the edge of bright ground alone; the consistency step
    changes all of them a little.
    """
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
    assert changed[:, end : BRIGHT_FROM + EDGE_RADIUS_PX].mean() > 0.3
    assert not changed[:, BRIGHT_FROM + EDGE_RADIUS_PX + 1 :].any()
    assert (results["consistency"] != results["none"]).mean() > 0.8
    assert (results["both"] != results["exposure"]).mean() > 0.8


def test_points_of_light_are_corrected_in_int8_as_far_as_in_float() -> None:
    """Without other exposures INT8 cannot represent their corrections."""
    light = np.full(SHAPE, 300.0)
    light[60, 70] = 8000
    light[90:92, 50:52] = 2700
    pixels = gaussian_filter(light, 0.8).clip(0, 4095).astype(np.float32)
    in_float = by_array(pixels, FLOAT)
    inner = (slice(20, -20), slice(20, -20))
    with_exposure, without = (
        np.abs(by_array(pixels, INT8, exposure=exposure) - in_float)[inner].max()
        for exposure in (True, False)
    )
    assert with_exposure < 0.3 * without


@pytest.mark.parametrize(
    ("make", "options", "reason"),
    [
        (None, {"sensor": BLIND}, "no sensor is named"),
        (espcn, {"force": True}, "the network makes other pixels or bands"),
        (partial(four_bands, 2), {"force": True}, "the network makes other pixels or bands"),
    ],
)
def test_the_consistency_step_is_off_if_it_is_not_possible(
    make: Callable[[], onnx.ModelProto] | None, options: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    pixels = image()
    layout = None
    how: dict[str, Any] = {**DEFAULTS, "network": INT8, **options}
    if make:
        how["network"] = tmp_path / "network.onnx"
        save_onnx(make(), how["network"])
    if isinstance(make, partial):
        pixels = np.stack([pixels] * 4)
        layout = PLANES
    result, row = restored(tmp_path, pixels, layout, **how)
    assert row.text["consistency"] == f"off: {reason}"
    assert CONSISTENCY not in row.figures
    without, _ = restored(tmp_path, pixels, layout, **how, consistency=False)
    assert_array_equal(result, without)


def test_the_mean_of_a_dark_image_is_kept() -> None:
    """At 30 DN the result was 3.8 % darker without the steps (measured), and differed by less than
    0.001 % with both.
    """
    nominal = SENSOR.nominal()
    level_dn = 30
    sigma = (
        nominal.noise_sigma(level_dn / nominal.gain_dn_per_radiance) * nominal.gain_dn_per_radiance
    )
    noise = np.random.default_rng(0).normal(0, sigma, (97, 110))
    dark = np.rint(level_dn + noise).astype(np.float32)
    with_steps = by_array(dark, INT8).mean() / dark.mean()
    without_steps = by_array(dark, INT8, consistency=False, exposure=False).mean() / dark.mean()
    assert abs(with_steps - 1) < 0.003 < 0.02 < abs(without_steps - 1)


def test_few_rows_of_a_tall_image_are_held(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The consistency step needs its reach above and below a row of tiles.

    That reach ends within two other rows of tiles.
    """
    most = [0]
    forget_above = HeldRows.forget_above

    def counting(self: HeldRows, row: int) -> None:
        most[0] = max(most[0], sum(part.shape[1] for part in self.parts))
        forget_above(self, row)

    monkeypatch.setattr(HeldRows, "forget_above", counting)
    by_array(np.full((800, 9), 900, np.uint16), model, tile=40)
    assert 2 * REACH_PX < most[0] <= 2 * REACH_PX + 3 * 40
