"""Tests of shipped networks by name, conditioned on any sensor, in float32 and in INT8."""

import logging
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import beers_deploy as bd
from beers_deploy.comparison import pair_of
from beers_deploy.conditioned_file import conditioned_on
from beers_deploy.model.io.files import sha256
from beers_deploy.model.shipped import (
    INT8,
    SENSOR,
    SHIPPED,
    VARIANT,
    shipped_names,
    shipped_weights,
)
from beers_deploy.network import Network
from beers_deploy.network_files import int8_for_sensor, other_sensor, weights_file
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.sensor import Sensor, numbers_of
from beers_deploy.profiles.shipped import BLIND, BLIND_PROFILE
from beers_deploy.quant.onnx_file import load_onnx, metadata
from beers_deploy.quant.sensor_bank import calibrate
from beers_deploy.quant.sensor_bank.conditioned import WEIGHTS
from tests.deploy.command_line import done, refused
from tests.profiles.own_sensor import own_sensor
from tests.shipped import shipped_pair

KNOWN = Sensor.load(SENSOR)


def test_the_same_numbers_are_the_same_sensor_and_others_are_not(
    conditioned: Path, tmp_path: Path
) -> None:
    """Sources and descriptions change no network. A number does, though the files have one name."""
    networks = []
    for folder, old, new in (
        ("a", "", ""),
        ("b", "Raw", "My raw"),
        ("c", "value = 0.07", "value = 0.08"),
    ):
        (tmp_path / folder).mkdir()
        sensor = Sensor.load(own_sensor(tmp_path / folder, (old, new)))
        networks.append(Network.load(conditioned, sensor=sensor))
    weights = [
        [tensor.raw_data for tensor in network.model.graph.initializer] for network in networks
    ]
    assert weights[0] == weights[1]
    assert weights[2] != weights[0]


@pytest.mark.slow
def test_int8_is_calibrated_once_and_then_conditioned_on_any_sensor(
    conditioned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibrate, "PATCHES", 3)
    monkeypatch.chdir(tmp_path)
    done(f"quantize {conditioned} --sensor {SENSOR} --patches 1 --out base.onnx")
    base = load_onnx(Path("base.onnx"))
    sensor = own_sensor(tmp_path, ("value = 0.07", "value = 0.05"))
    done(f"export --network base.onnx --out mine.onnx --sensor {sensor} --delta mine.delta")
    done("export --network base.onnx --out applied.onnx --apply mine.delta")
    assert Path("applied.onnx").read_bytes() == Path("mine.onnx").read_bytes()
    assert Path("mine.delta").stat().st_size < 3000
    other = load_onnx(Path("mine.onnx"))
    assert (metadata(base)["sensor"], metadata(other)["sensor"]) == (
        SENSOR,
        Sensor.load(sensor).name,
    )
    again = int8_for_sensor(other, KNOWN)
    assert again.SerializeToString(deterministic=True) == base.SerializeToString(deterministic=True)


def test_only_quantize_calibrates_weights_of_users(conditioned: Path) -> None:
    with pytest.raises(
        ModelError, match=r"float weights, but an INT8 network is needed.*beers-deploy quantize"
    ):
        Network.load(conditioned, sensor=KNOWN, int8=True)


@pytest.mark.parametrize("name", shipped_names())
def test_the_shipped_int8_files_are_of_these_weights(name: str) -> None:
    """Other weights need other files, which docs/make/int8.py writes."""
    header = metadata(load_onnx(SHIPPED / f"{name}{INT8}.onnx"))
    assert header[WEIGHTS] == sha256(shipped_weights(name))
    assert header["variant"] == name
    assert Network.load(name, sensor=KNOWN, int8=True).sensor == SENSOR


def test_an_unknown_name_is_refused_with_the_names_that_exist() -> None:
    for name in ("convbeers-z", "convbeers-z-int8"):
        with pytest.raises(
            ModelError, match=r"shipped network \(convbeers, convbeers-half, .*convbeers-xs"
        ):
            Network.load(name)
    with pytest.raises(ModelError, match="no such file"):
        Network.load("none.safetensors")


def test_blind_is_the_middle_of_a_range_of_sensors() -> None:
    blind = Sensor.load(BLIND)
    assert (blind.name, numbers_of(blind)) == (BLIND, numbers_of(Sensor.load(BLIND_PROFILE)))
    floating = [Network.load("convbeers-xs", sensor=name).model for name in (BLIND, BLIND_PROFILE)]
    weights = [[tensor.raw_data for tensor in model.graph.initializer] for model in floating]
    assert weights[0] == weights[1]


def test_a_value_outside_the_training_is_reported_each_time(
    conditioned: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sensor = Sensor.load(own_sensor(tmp_path, ("value = 0.07", "value = 0.004")))
    for _ in range(2):
        Network.load(conditioned, sensor=sensor)
    assert [record.levelno for record in caplog.records] == 4 * [logging.WARNING]
    sentences = [
        f"mtf_{axis} 0.004 is outside the range of the training, 0.015 to 0.15"
        for axis in ("across", "along")
    ]
    for message, sentence in zip(caplog.messages, 2 * sentences, strict=True):
        assert message.startswith(sentence)


def test_a_network_for_one_sensor_refuses_a_sensor_for_each_band(
    tmp_path: Path,
) -> None:
    bands = np.full((2, 20, 30), 900, np.uint16)
    tifffile.imwrite(tmp_path / "in.tif", bands, planarconfig="separate", photometric="minisblack")
    words = ["--network", shipped_pair("convbeers-xs")[0], "--sensor", f"B0={SENSOR},B1={SENSOR}"]
    assert "Give one sensor for all bands" in refused(
        f"restore {tmp_path}/in.tif {tmp_path}/out.tif", *words
    )
    assert not (tmp_path / "out.tif").exists()


@pytest.mark.parametrize("name", ["convbeers-xs", "convbeers-s"])
@pytest.mark.usefixtures("working_folder")
def test_a_name_is_the_shipped_network_unless_a_file_has_it(name: str) -> None:
    for given, int8, precision in (
        (name, None, "float32"),
        (name, True, "int8"),
        (f"{name}-int8", None, "int8"),
        (f"{name}-int8", False, "float32"),
    ):
        network = Network.load(given, sensor=KNOWN, int8=int8)
        assert (network.precision, network.sensor) == (precision, SENSOR)
    assert weights_file(Path(name)) == shipped_weights(name)
    Path(name).write_bytes(b"mine")
    with pytest.raises(ModelError, match="an ONNX file"):
        Network.load(name)
    assert weights_file(Path(name)) == Path(name)


def test_none_is_the_default_network() -> None:
    assert Network.load(None) == Network.load(f"{VARIANT}{INT8}")


@pytest.mark.parametrize(
    ("floating", "int8"),
    [
        ("convbeers-xs", None),
        ("convbeers-xs-int8", None),
        ("convbeers-xs", "convbeers-xs"),
        ("convbeers-xs", "convbeers-xs-int8"),
    ],
)
def test_one_name_loads_a_shipped_pair(floating: str, int8: str | None) -> None:
    pair = pair_of(floating, int8, KNOWN)
    assert [each.name for each in pair] == ["convbeers-xs", "convbeers-xs-int8"]
    assert [each.precision for each in pair] == ["float32", "int8"]
    assert {each.sensor for each in pair} == {SENSOR}


def test_export_writes_a_shipped_networks_integers_for_the_host_and_the_board(
    tmp_path: Path,
) -> None:
    done(f"export --network convbeers-xs --out {tmp_path}/net.onnx")
    assert metadata(load_onnx(tmp_path / "net.onnx"))["variant"] == "convbeers-xs"
    host = str(tmp_path / "int8.onnx")
    board = str(tmp_path / "core.onnx")
    network = "--network convbeers-half-xs-int8 --sensor blind"
    done(f"export --tile 64 --out {host} --board-file {board} {network}")
    assert metadata(load_onnx(Path(host)))["sensor"] == "blind"
    for path in (host, board):
        done(f"check {path}")


def test_a_tile_that_a_network_cannot_rearrange_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "x.onnx"
    words = f"--network convbeers-half-xs-int8 --tile 65 --out {out}"
    assert "--tile must be a multiple of 2 px" in refused(f"export {words}")
    assert not out.exists()


@pytest.mark.parametrize("as_array", [False, True])
def test_a_run_parses_and_opens_a_network_once(
    as_array: bool, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: Counter[str] = Counter()

    def counted(module: str, name: str) -> None:
        original = getattr(import_module(module), name)

        def counting(*arguments: Any, **options: Any) -> Any:
            counts[name] += 1
            return original(*arguments, **options)

        monkeypatch.setattr(f"{module}.{name}", counting)

    counted("beers_deploy.quant.onnx_file", "parse_onnx")
    counted("beers_deploy.network", "tiling_of")
    counted("onnxruntime", "InferenceSession")
    pixels = np.random.default_rng(0).integers(0, 4096, (61, 83)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "in.tif", pixels)
    # How the processor adds is tested once a process, with another network.
    if as_array:
        bd.restore(pixels, network=model, tile=23)
    else:
        bd.restore(tmp_path / "in.tif", tmp_path / "out.tif", network=model, tile=23)
    assert counts == {"parse_onnx": 1, "tiling_of": 1, "InferenceSession": 1}


@pytest.mark.slow
def test_an_int8_file_for_every_sensor_restores_and_is_judged_as_the_shipped_name(
    tmp_path: Path,
) -> None:
    """A recipe's INT8 file is named by its path, and must not restore for the middle sensor."""
    sensor = "dior-medium"
    copy = tmp_path / "int8.onnx"
    copy.write_bytes((SHIPPED / "convbeers-xs-int8.onnx").read_bytes())
    # Dark ground needs the exposures as well.
    pixels = np.random.default_rng(0).integers(40, 400, (61, 83)).astype(np.uint16)
    restored = bd.restore(pixels, network=copy, sensor=sensor, tile=48)
    assert np.array_equal(
        restored, bd.restore(pixels, network="convbeers-xs-int8", sensor=sensor, tile=48)
    )
    stored = bd.restore(pixels, network=copy, tile=48)
    assert not np.array_equal(restored, stored)
    files = bd.gate(shipped_weights("convbeers-xs"), copy, sensor=sensor, patches=4)
    pair = bd.gate("convbeers-xs", sensor=sensor, patches=4)
    assert "INT8 against float" in [row.name for row in pair.rows]
    assert [row.figures for row in files.rows] == [row.figures for row in pair.rows]
    # Two networks that were loaded without a sensor are not conditioned on the given one.
    unknown = bd.gate(
        Network.load("convbeers-xs"), Network.load("convbeers-xs-int8"), sensor=sensor, patches=4
    )
    assert [row.figures for row in unknown.rows] != [row.figures for row in pair.rows]
    errors = [table.rows[0].figures["MAE"].value for table in (unknown, pair)]
    assert errors[0] is not None
    assert errors[1] is not None
    assert errors[0] < 2 * errors[1]


def test_an_int8_file_that_was_conditioned_on_a_sensor_keeps_it() -> None:
    """Only a file for every sensor is conditioned again."""
    own = int8_for_sensor(load_onnx(SHIPPED / "convbeers-xs-int8.onnx"), Sensor.load("dior-medium"))
    network = Network.load(own)
    assert conditioned_on(network, KNOWN) is network
    assert "made for dior-medium" in other_sensor(own, KNOWN)
