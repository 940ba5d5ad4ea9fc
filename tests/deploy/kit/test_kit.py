"""Tests of the kit for a board's engineer: its host part computes the host file's bytes."""

import json
import logging
import re
import runpy
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import beers_deploy as bd
from beers_deploy.kit import RECORD
from beers_deploy.kit.golden import read_golden
from beers_deploy.kit.host_facts import consistency_facts, host_facts
from beers_deploy.model.bank import bank_of_vector
from beers_deploy.model.consistency.blocks import Placed
from beers_deploy.model.consistency.step import Consistency
from beers_deploy.model.convbeers import arrays
from beers_deploy.model.exposure import choose_factors, exposures_for
from beers_deploy.model.io.tensors import Weights
from beers_deploy.model.self_check import SelfCheck
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.errors import MachineError, OptionError, ProfileError
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.sensor_bank.calibrate import bank_results, quantize_behind_bank
from beers_deploy.quant.session import open_session, tensors_of
from tests.deploy.kit.test_golden import NORMALISED, network
from tests.model.networks import behind_a_bank
from tests.profiles.own_sensor import departing, edited, own_sensor
from tests.quant.quick import patches_of, quickly, uniform
from tests.quant.sensor_bank.test_filters import textured
from tests.quant.simplify.networks import parsed
from tests.quant.test_host_end import float_network

BOARD = bd.Board.load("vck190")
BARE = """
import sys
class Bare:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("beers_deploy", "torch", "scipy", "onnx", "PIL"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Bare())
sys.argv = ["host.py", *sys.argv[2:]]
import runpy
runpy.run_path("host.py", run_name="__main__")
"""


def behind_fitted_kernels() -> bd.Network:
    """Return a small network whose analytic restoration has a coarse copy."""
    net = behind_a_bank(Variant(1, 8, 2), 0.1)
    weights = Weights(arrays(net.state_dict()), net.variant, {}, conditioned=True)
    middle = bank_of_vector((0.0,) * 4)
    results = [bank_results(textured(48, 48, k), middle, (0.0,) * 4, 2) for k in range(2)]
    family = quantize_behind_bank(weights, middle, results)
    return bd.Network.load(host_model(family.core, {}))


def with_host_end() -> bd.Network:
    """Return a network whose result the host crops and adds to the enlarged image."""
    network = float_network("Tanh, enlarged image, and a crop of the mirrored border")
    raw = uniform(1, 2, 40, 40)
    return bd.Network.load(quickly(network, patches_of([raw])).host)


@pytest.mark.parametrize(
    "name",
    [
        "convbeers-xs-int8",
        "convbeers-half-xs-int8",
        "unet",
        "espcn",
        "fitted kernels",
        "host end",
        NORMALISED,
    ],
)
def test_the_host_part_gives_the_host_files_bytes(name: str, tmp_path: Path) -> None:
    """The host part restores an image of odd sides."""
    own = {"fitted kernels": behind_fitted_kernels, "host end": with_host_end}
    int8 = own[name]() if name in own else network(name)
    folder = BOARD.kit(int8, tmp_path / "kit", tile=96)
    shape = int8.tiling.channels_in, 131, 203
    image = uniform(*shape, seed=1)
    image = 2 * image - 1 if name == NORMALISED else image
    np.save(tmp_path / "image.npy", image)
    host = runpy.run_path(str(folder / "host.py"))
    host["main"](tmp_path / "image.npy", tmp_path / "out.npy", host["cores"](), learn=False)
    alignment_px = int8.tiling.alignment_px
    scale = int(int8.tiling.scale)
    wide = np.pad(image, [(0, 0), *((0, -side % alignment_px) for side in image.shape[1:])], "edge")
    expected = int8(wide[None])[0][:, : 131 * scale, : 203 * scale]
    assert np.array_equal(np.load(tmp_path / "out.npy"), expected)
    assert {"core.onnx", "measure.py", "README.md", "golden"} < {
        path.name for path in folder.iterdir()
    }
    # Without it measure.py would not know which DPU it measures.
    command = "measure.py core.onnx --provider PROVIDER --configuration C32B3"
    assert command in (folder / "README.md").read_text(encoding="utf-8")
    golden = folder / "golden"
    dims = onnx.load(golden / "core.onnx").graph.input[0].type.tensor_type.shape.dim
    planes = np.load(golden / "noise" / "00-planes.npy")
    assert tuple(side.dim_value for side in dims[1:]) == planes.shape[1:]


def test_a_network_that_reads_its_whole_tile_has_a_kit_of_its_size(tmp_path: Path) -> None:
    """`host.py` could not cut images for it, so that the kit has none."""
    model = parsed(
        "p = GlobalAveragePool(x) h = HardSigmoid<alpha=0.16666667, beta=0.5>(p) y = Mul(x, h)",
        "float[1,1,32,32] x => float[1,1,32,32] y",
    )
    samples = uniform(4, 1, 32, 32)
    int8 = bd.quantize(model, samples=samples, effort="fast", progress=False)
    folder = BOARD.kit(int8, tmp_path / "kit")
    assert np.load(folder / "input.npy").shape[2:] == (32, 32)
    assert not list(folder.glob("host.*"))


OFFSET_DN = 60
NAME = "convbeers-xs-int8"
TILE_PX = 96
FACTORS = {0.5, 1, 4, 16}


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    """Draw an image (131, 203) of odd sides: dark ground, bright ground, an edge between them, and
    some saturated pixels.
    """
    light = np.random.default_rng(1).uniform(0.9, 1, (131, 203)).astype(np.float32)
    light *= np.linspace(0.02, 0.9, 203, dtype=np.float32)
    light[:60] *= np.float32(0.05)
    light[100:103, 150:153] = 1
    return light


@pytest.fixture(scope="module")
def sensor(tmp_path_factory: pytest.TempPathFactory) -> bd.Sensor:
    """Return a sensor whose dark offset is not 0."""
    offset = (
        f'[offset]\noffset_dn = {{ value = {OFFSET_DN}, status = "assumed", source = "a test" }}\n'
    )
    return bd.Sensor.load(
        own_sensor(tmp_path_factory.mktemp("sensor"), text=f"{edited()}\n{offset}")
    )


@pytest.fixture(scope="module")
def kit(sensor: bd.Sensor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the kit of a network and a sensor for one board."""
    return BOARD.kit(NAME, tmp_path_factory.mktemp("kit"), tile=TILE_PX, sensor=sensor)


@pytest.fixture(scope="module")
def by_host(kit: Path, image: np.ndarray) -> np.ndarray:
    """Restore the image by the kit's host.py, on a Python with NumPy and onnxruntime alone."""
    np.save(kit / "image.npy", image[None])
    subprocess.run([sys.executable, "-c", BARE, "-", "image.npy", "out.npy"], cwd=kit, check=True)
    return np.asarray(np.load(kit / "out.npy")[0])


@pytest.mark.parametrize(
    ("image", "words"),
    [
        *(
            (np.full(shape, 0.1, np.float32), f"at least 96 x 96 pixels, got shape {shape}.")
            for shape in ((1, 203, 95), (96, 96), (2, 96, 96))
        ),
        # Otherwise all digital numbers would be restored to white.
        (np.full((1, 96, 96), 900, np.uint16), "mostly above full scale. Divide its values"),
        (np.full((1, 96, 96), "a"), "cannot be read as an array of numbers"),
    ],
    ids=["small", "no channel", "two channels", "digital numbers", "texts"],
)
def test_the_host_part_refuses_what_it_cannot_restore(
    image: np.ndarray, words: str, kit: Path, tmp_path: Path
) -> None:
    """An image of a wrong shape, too small for a tile, or not of shares is refused in one sentence.

    No file is written, so that a partial result is never mistaken for a restored image.
    """
    np.save(tmp_path / "image.npy", image)
    host = runpy.run_path(str(kit / "host.py"))
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        host["main"](tmp_path / "image.npy", tmp_path / "out.npy", {}, learn=False)
    assert str(caught.value).isprintable()
    assert not (tmp_path / "out.npy").exists()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("none/out.npy", "no such folder"),
        ("", "is the image or a folder"),
        ("raw-check.npy", "is the image or a folder"),
        # The figures of the self-check would replace it.
        ("raw.npy", "is the image or a folder"),
    ],
)
def test_the_host_part_refuses_an_output_before_the_run(
    name: str, words: str, kit: Path, tmp_path: Path
) -> None:
    """It has no place, or would replace the image; the script then exits with 2."""
    image = tmp_path / "raw-check.npy"
    np.save(image, np.full((1, 96, 96), 0.1, np.float32))
    before = image.read_bytes()
    command = [sys.executable, str(kit / "host.py"), str(image), str(tmp_path / name)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr.startswith("host.py: ")
    assert words in ended.stderr
    assert image.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def facts(folder: Path) -> dict[str, Any]:
    """Return the facts that a kit's host.py reads."""
    return dict(json.loads((folder / "host.json").read_text(encoding="utf-8")))


def test_the_host_part_restores_as_restore_does(
    by_host: np.ndarray, sensor: bd.Sensor, image: np.ndarray
) -> None:
    """The host part runs both steps around the network, and each of them changes the image."""
    restored = partial(bd.restore, image, network=NAME, sensor=sensor, full_scale=1.0, force=True)
    assert_allclose(by_host, restored(), rtol=0, atol=1e-6)
    for without in (restored(exposure=False), restored(consistency=False)):
        assert np.abs(by_host - without).max() > 0.001


def test_each_exposure_has_a_core_and_a_unit(kit: Path, sensor: bd.Sensor) -> None:
    """Each exposure factor has a core of its own weights, and a unit of its own for the result.

    The cores are those of the library's networks for the same factors, and the README states the
    steps.
    """
    content = facts(kit)
    usable = {exposure.factor for exposure in exposures_for(sensor.nominal(), int8=True)}
    assert {1, *map(float, content["exposures"])} == FACTORS == usable
    # A pixel at a strong edge is restored by the unit of other bright pixels.
    assert content["exposures"]["0.5"] == content["unit"]
    assert len(set(content["exposures"].values())) == len(FACTORS) - 1
    for factor, other in bd.Network.load(NAME, sensor=sensor).exposures.items():
        expected = other.core("vck190", TILE_PX).model
        assert onnx.load(kit / f"core-x{factor:g}.onnx") == expected
    golden = onnx.load(kit / "golden" / "int8.onnx")
    assert golden == bd.Network.load(NAME, sensor=sensor).model


def test_the_host_part_chooses_factors_and_corrects_as_the_library_does(
    kit: Path, sensor: bd.Sensor, image: np.ndarray
) -> None:
    """They are equal bit for bit, with saturated pixels and without."""
    host = runpy.run_path(str(kit / "host.py"))
    radius_px = facts(kit)["halo_px"]
    factors = choose_factors(image, sorted(FACTORS), radius_px, 1.0, OFFSET_DN / 4095)
    assert {*np.unique(factors)} == FACTORS
    assert_array_equal(host["factors"](image[None, None]), factors)
    restored = np.clip(image + np.random.default_rng(2).normal(0, 0.01, image.shape), 0, 1).astype(
        np.float32
    )
    other = departing(sensor)
    for profile in (sensor, other):
        host["S"]["consistency"] = consistency_facts(bd.Network.load(NAME), profile)
        step = Consistency.of(profile.nominal(), profile.reference.nominal(), full_scale=1.0)
        assert (step.detail is not None) == (profile is other)
        for raw in (image, np.minimum(image, np.float32(0.95))):
            down, across = (Placed(side, 0, 0, side) for side in image.shape)
            change: np.ndarray = step.correction(raw, restored, down, across, (0, 0))
            expected = np.clip(restored + change, 0, 1)
            assert_array_equal(host["consistent"](raw, restored), expected)


def test_the_host_part_judges_blocks_as_the_library_does(
    kit: Path, by_host: np.ndarray, sensor: bd.Sensor, image: np.ndarray
) -> None:
    """The kit's self-check gives the library's chi2 and sharpening of each block, and the same
    count.

    An engineer so sees on the board what `restore` reports on a workstation.
    """
    blocks = np.load(kit / "out-check.npy")
    check = SelfCheck.of(sensor.nominal(), sensor.reference.nominal(), full_scale=1.0)
    sides = (Placed(side, 0, 0, side) for side in image.shape)
    expected = check.judge(image, by_host, *sides)
    assert_allclose(blocks[0, 0], expected.chi2, rtol=1e-3)
    assert_allclose(blocks[0, 1], expected.sharpening, rtol=1e-3)
    host = runpy.run_path(str(kit / "host.py"))
    count = f"{expected.outside.sum()} of {expected.decidable.sum()} decidable blocks"
    assert count in host["report"](blocks)


def test_a_flipped_weight_of_any_core_shows_in_the_known_tile(kit: Path) -> None:
    """A run that learns writes the checksums, and later ones name each core that differs from them.

    In the noise of an image the flip of a low bit would disappear.
    """
    host = runpy.run_path(str(kit / "host.py"))
    runs = host["cores"]()
    for learn in (False, True, False):
        host["known_tile"](runs, learn)
    core = onnx.load(kit / "core-x4.onnx")
    weights = max(core.graph.initializer, key=lambda tensor: len(tensor.raw_data))
    content = bytearray(weights.raw_data)
    content[len(content) // 2] ^= 1
    weights.raw_data = bytes(content)
    session = open_session(core)
    runs[4.0] = lambda planes: tensors_of(session, None, planes)[0]
    with pytest.raises(SystemExit, match="restored otherwise by x4, whose weights"):
        host["known_tile"](runs, False)


def test_a_sensor_that_does_not_exist_or_changes_nothing_is_one_sentence(tmp_path: Path) -> None:
    """An unknown sensor, and one that the network does not depend on, are refused.

    Nothing is written, so that no kit claims a sensor that it does not know.
    """
    in_memory = bd.Network.load(bd.Network.load(NAME).model)
    with pytest.raises(ProfileError, match=r"no profile 'hubble'\. Give one of"):
        BOARD.kit(NAME, tmp_path / "kit", tile=TILE_PX, sensor="hubble")
    with pytest.raises(OptionError, match="`sensor` blind has no effect"):
        BOARD.kit(in_memory, tmp_path / "kit", tile=TILE_PX, sensor="blind")
    # ESPCN enlarges the image, and a kit's steps work in shares of full scale.
    for name, reason in (("espcn", "neither the"), (NORMALISED, r"host.py .* than \[0, 1\]")):
        with pytest.raises(OptionError, match=f"pleiades-degraded has no effect.* {reason}"):
            host_facts(network(name), TILE_PX, bd.Sensor.load("pleiades-degraded"), {})
    assert not (tmp_path / "kit").exists()


def test_a_host_alone_has_no_kit_and_no_golden_vectors(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="'host-cpu' has no DPU"):
        bd.Board.load("host-cpu").kit(NAME, tmp_path / "kit", tile=TILE_PX)
    with pytest.raises(OptionError, match="'host-cpu' has no DPU"):
        bd.golden(NAME, out=tmp_path / "golden", target="host-cpu")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "tile", "rule"),
    [
        *((NAME, tile, "a whole number of 16 to 8192 px") for tile in (-1, 8, 64.5, "a", 10**6)),
        (NAME, 28, "at least 29 px, .* got 28 px"),
        ("unet", 48, "a multiple of 4 px and at least 52 px, .* got 48 px"),
        ("unet", 66, "a multiple of 4 px and at least 52 px, .* got 66 px"),
    ],
)
def test_a_tile_that_no_core_has_is_refused(
    name: str, tile: Any, rule: str, tmp_path: Path
) -> None:
    """Without room between the halos, `host.py` would leave most of the image unwritten."""
    with pytest.raises(OptionError, match=f"`tile` must be {rule}"):
        BOARD.kit(network(name), tmp_path / "kit", tile=tile)
    assert not (tmp_path / "kit").exists()


def test_nothing_of_an_earlier_kit_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the old facts and record would be read as those of the new cores."""
    folder = BOARD.kit(NAME, tmp_path / "kit", tile=TILE_PX, sensor="pleiades-degraded")
    (folder / "record").mkdir()
    for name in ("known.json", f"record/{RECORD[0]}"):
        (folder / name).write_text("{}", encoding="utf-8")
    # host.py cannot compute the host part of this network.
    monkeypatch.setattr("beers_deploy.kit.board.host_facts", lambda *_: None)
    BOARD.kit(network("unet"), folder, tile=TILE_PX)
    names = {path.name for path in folder.rglob("*")}
    assert not names & {"known.json", "host.json", "host.py", "core-x4.onnx", RECORD[0]}


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "kit").write_text("mine", encoding="utf-8")
    with pytest.raises(MachineError, match=r"kit is not a folder\. Choose another path"):
        BOARD.kit(NAME, tmp_path / "kit")


def test_a_network_for_another_sensor_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A mismatch of network and sensor is no error, but one warning that names both sensors."""
    other = bd.Network.load(NAME, sensor="dior-medium")
    with caplog.at_level(logging.WARNING, "beers_deploy"):
        BOARD.kit(other, tmp_path / "kit", tile=TILE_PX, sensor="pleiades-degraded")
    (warning,) = caplog.messages
    assert "made for dior-medium, not for pleiades-degraded" in warning


def test_for_an_npu_the_core_is_what_its_compiler_reads(tmp_path: Path) -> None:
    """The kit for an NPU has the configuration of its compiler, golden results rounded as it
    rounds, and cores that pass the check of the target.
    """
    folder = bd.Board.load("vek385").kit(
        "convbeers-xs-int8", tmp_path / "kit", tile=48, sensor="dior-medium"
    )
    assert "ve2-xc2ve3858" in (folder / "vitisai_config.json").read_text(encoding="utf-8")
    assert read_golden(folder / "golden").half_even
    assert bd.check(folder / "core.onnx", target="vek385")
    assert bd.check(folder / "core-x8.onnx", target="vek385")
