"""One engine: one image is restored to the same pixels, whichever command or
function restores it.
"""

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import beers_deploy as bd
from beers_deploy import library
from beers_deploy.library import restore
from beers_deploy.profiles import load_sensor
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.restoration import method
from beers_deploy.restoration.method import Around, network_method
from beers_deploy.restoration.options import Options, Runtime
from beers_deploy.restoration.plan import plan_for
from beers_deploy.restoration.runtime import open_runtime
from beers_deploy.restoration.steps import step_for
from beers_deploy.restoration.tiles.rows import restore_dn, restore_floats
from beers_deploy.studies.evaluation.methods import method_named
from beers_deploy.studies.stress.networks import Network
from beers_deploy.studies.tradeoff.measure import restore_in_tiles
from beers_deploy.studies.tradeoff.points import FLOAT, INT8, Point, Variant
from tests.deploy.restoration.runs import restored
from tests.shipped import shipped_pair

Restored = Callable[[np.ndarray], np.ndarray]

SENSOR = load_sensor("pleiades-degraded")
REFERENCE = load_sensor("pleiades-reference")
ODD = 131, 97
TILES_PX = {"float": 23, "int8": 64}
SMALL_HALOS_PX = {"float": 2, "int8": 8}


@pytest.fixture(params=TILES_PX)
def precision(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Of the network; evaluate and the trade-off's scores take tiles so small that the image has
    many.
    """
    monkeypatch.setattr(method, "TILE_PX", TILES_PX[request.param])
    return str(request.param)


@pytest.fixture
def path(precision: str, model: Path) -> Path:
    return model if precision == "float" else shipped_pair()[1]


def image() -> np.ndarray:
    """Noise (H, W) uint16, black and full scale among it."""
    return np.random.default_rng(2).integers(0, 4096, ODD).astype(np.uint16)


def by_engine(dn: np.ndarray, options: Options) -> np.ndarray:
    """As an array in memory."""
    network = bd.Network.load(options.network)
    infer, _ = open_runtime(Runtime.onnxruntime, network.model, threads=0)
    steps = tuple(step_for(sensor, 4095) for sensor in options.sensors.values())
    return restore_dn(dn, infer, plan_for(network, (1, *ODD), options), consistency=steps)


def exact_ways(path: Path, tile_px: int) -> dict[str, Restored]:
    """Every way from digital numbers (H, W) float32 to whole restored ones
    whose seams are exact.
    """
    network = load_onnx(path)
    return {
        "evaluate and tradeoff": method_named(
            str(path), SENSOR, REFERENCE, around=Around(consistency=False)
        ).restore,
        "the library and the demo": lambda dn: np.rint(
            library.restore(dn, path, tile=tile_px, full_scale=4095)
        ),
        "stress": lambda dn: np.rint(Network(network).restore(dn, tile_px=tile_px)),
        "the array": partial(by_engine, options=Options(path, tile_px)),
    }


def test_with_exact_seams_every_command_gives_the_pixels_of_restore(
    precision: str, path: Path, tmp_path: Path
) -> None:
    pixels = image()
    tile_px = TILES_PX[precision]
    expected = restored(tmp_path, pixels, Options(path, tile_px))[0]
    assert (expected != pixels).mean() > 0.5
    np.testing.assert_array_equal(restore(pixels, path, tile=tile_px), expected)
    for name, way in exact_ways(path, tile_px).items():
        np.testing.assert_array_equal(way(pixels.astype(np.float32)), expected, err_msg=name)


def test_with_a_halo_below_the_radius_they_have_the_same_seams(
    precision: str, path: Path, tmp_path: Path
) -> None:
    pixels = image()
    tile_px = TILES_PX[precision]
    halo_px = SMALL_HALOS_PX[precision]
    options = Options(path, tile_px, str(halo_px), sensors={"": SENSOR})
    expected = restored(tmp_path, pixels, options)[0]
    exact = restored(tmp_path, pixels, Options(path, tile_px, sensors={"": SENSOR}))[0]
    assert (expected != exact).any()
    dn = pixels.astype(np.float32)
    # The image is noise, which contradicts the sensor and gives a warning.
    with warnings.catch_warnings(action="ignore"):
        result = restore(pixels, path, tile=tile_px, halo=halo_px, sensor=SENSOR)
    np.testing.assert_array_equal(result, expected)
    # A trade-off study scores an operating point whose halo is below the network's radius this way.
    variant = Variant(path.stem, FLOAT if precision == "float" else INT8, bd.Network.load(path))
    point = Point(variant, tile_px=tile_px, halo_px=halo_px)
    by_tradeoff = restore_in_tiles(point, SENSOR, REFERENCE)
    np.testing.assert_array_equal(by_tradeoff(dn), expected)
    np.testing.assert_array_equal(by_engine(dn, options), expected)


def test_floats_are_those_of_restore_unrounded(precision: str, path: Path, tmp_path: Path) -> None:
    dn = np.minimum(image() + np.float32(0.37), np.float32(4095))
    tile_px = TILES_PX[precision]
    expected = restored(tmp_path, dn, Options(path, tile_px))[0]
    assert (expected % 1 > 0).mean() > 0.5
    np.testing.assert_array_equal(restore(dn, path, tile=tile_px), expected)
    np.testing.assert_array_equal(Network(load_onnx(path)).restore(dn, tile_px=tile_px), expected)


@pytest.mark.parametrize("bits", [8, 14])
def test_a_sensor_of_other_bits_has_its_own_full_scale(
    bits: int, model: Path, tmp_path: Path
) -> None:
    max_dn = (1 << bits) - 1
    dn = np.random.default_rng(3).integers(0, max_dn + 1, ODD).astype(np.uint16)
    network = bd.Network.load(model)
    expected = restored(tmp_path, dn, Options(model, 23, full_scale=max_dn))[0]
    evaluated = network_method(network.model, max_dn)(dn.astype(np.float32))
    np.testing.assert_array_equal(evaluated, expected)
    infer, _ = open_runtime(Runtime.onnxruntime, network.model, threads=0)
    plan = plan_for(network, (1, *ODD), Options(model, 23))
    # `evaluate` rounds to integers as `restore` does, restore_floats does not.
    assert np.abs(restore_floats(dn, infer, plan, max_dn) - evaluated).max() <= 0.5
