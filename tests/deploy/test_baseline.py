"""A baseline is the document of a gate that passed, on the same patches: everything else is refused."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import beers_deploy as bd
from beers_deploy.baseline import Baseline, files_input, read_baseline, sensor_input
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Check, Row, measured
from beers_deploy.results import Input, Table
from tests.deploy.command_line import done, refused

ASKED: dict[str, Any] = {"sensor": "pleiades-degraded", "images": None, "patches": 2, "seed": 0}


def document(mae: float = 5e-4, **arguments: object) -> dict[str, Any]:
    """What a gate writes that passed."""
    figures = {"MAE": measured(mae, "of full scale", "here"), "PSNR float": measured(50.0, "dB", "here")}
    inputs = (Input("float.onnx", "a" * 64), Input("sensor s", "b" * 64))
    row, check = Row("gate", "INT8 against float", figures), Check("MAE", mae, 1.0, "of full scale")
    return Table("gate", {**ASKED, **arguments}, inputs, (row,), (check,)).to_dict()


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_what_a_gate_wrote_is_read(tmp_path: Path) -> None:
    found = read_baseline(written(tmp_path / "b.json", document()), ASKED)
    assert (found.mae, found.psnr_float_db) == (5e-4, 50.0)
    assert found.digests == {"float.onnx": "a" * 64, "sensor s": "b" * 64}


def failed(content: dict[str, Any]) -> None:
    content["verdict"] = "failed"
    content["checks"][0]["passed"] = False


def another_command(content: dict[str, Any]) -> None:
    content["command"] = "check"


def figure(key: str, value: object) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content["rows"][0]["figures"]["MAE"][key] = value

    return change


def without_mae(content: dict[str, Any]) -> None:
    del content["rows"][0]["figures"]["MAE"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (failed, "a gate that passed, got failed"),
        (another_command, "got one of check"),
        (without_mae, "no MAE"),
        (figure("unit", "dB"), "a measured MAE of full scale"),
        (figure("value", 1.5), "a measured MAE of full scale"),
        (figure("value", -1e-9), "a measured MAE of full scale"),
        (figure("value", "inf"), "a results document"),
        (figure("mode", "published"), "a measured MAE of full scale"),
    ],
)
def test_a_document_that_is_no_baseline_is_refused(
    change: Callable[[dict[str, Any]], None], said: str, tmp_path: Path
) -> None:
    content = document()
    change(content)
    with pytest.raises(OptionError, match=said):
        read_baseline(written(tmp_path / "b.json", content), ASKED)


@settings(max_examples=60, deadline=None)
@given(path=st.sampled_from(["schema", "command", "inputs", "rows", "checks", "verdict"]), junk=st.none() | st.text())
def test_whatever_stands_in_a_place_of_the_document_it_ends_in_one_sentence(
    path: str, junk: object, tmp_path_factory: pytest.TempPathFactory
) -> None:
    content = {**document(), path: junk}
    with pytest.raises(OptionError):
        read_baseline(written(tmp_path_factory.mktemp("b") / "b.json", content), ASKED)


def test_files_that_are_no_document_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="no such file"):
        read_baseline(tmp_path / "none.json", ASKED)
    contents: list[object] = [{}, [], "gate", 3]
    for content in contents:
        with pytest.raises(OptionError, match="another document"):
            read_baseline(written(tmp_path / "b.json", content), ASKED)


@pytest.mark.parametrize(
    "other", [{"seed": 1}, {"patches": 3}, {"sensor": "pleiades-variable"}, {"images": Path("aerial")}]
)
def test_a_baseline_of_other_patches_is_refused_and_a_folder_may_lie_elsewhere(
    other: dict[str, object], tmp_path: Path
) -> None:
    path = written(tmp_path / "b.json", document(images="/here/ground"))
    same = {**ASKED, "images": Path("there/ground")}
    assert read_baseline(path, same).mae == 5e-4
    (name,) = other
    with pytest.raises(OptionError, match=f"same patches \\({name}"):
        read_baseline(path, {**same, **other})


BEFORE = Baseline(Path("b.json"), 5e-4, 50.0, {"float.onnx": "a" * 64, "sensor s": "b" * 64})


def test_the_float_network_is_known_by_its_digest_or_its_psnr() -> None:
    BEFORE.require_same("a" * 64, 47.0, [])
    BEFORE.require_same("c" * 64, 50.004, [])
    with pytest.raises(OptionError, match="another's"):
        BEFORE.require_same("c" * 64, 50.02, [])
    with pytest.raises(OptionError, match="another's"):
        replace(BEFORE, psnr_float_db=float("nan")).require_same("c" * 64, float("nan"), [])


@pytest.mark.parametrize("digest", ["c" * 64, "a" * 64])
def test_what_else_it_rests_on_must_be_the_same(digest: str) -> None:
    BEFORE.require_same("a" * 64, 50.0, [Input("sensor s", "b" * 64)])
    with pytest.raises(OptionError, match="the same sensor s"):
        BEFORE.require_same("a" * 64, 50.0, [Input("sensor s", digest)])
    with pytest.raises(OptionError, match="rests on samples"):
        BEFORE.require_same("a" * 64, 50.0, [Input("samples", digest)])


def test_a_sensor_of_the_same_name_and_other_numbers_is_another() -> None:
    sensor = load_sensor("pleiades-degraded")
    other = sensor.replace(gain_dn_per_radiance=2 * sensor.gain_dn_per_radiance.low)
    assert sensor_input(sensor).name == sensor_input(other).name
    assert sensor_input(sensor).sha256 != sensor_input(other).sha256


@pytest.mark.parametrize("change", ["content", "name", "one more", "none"])
def test_a_folder_is_known_by_its_files(change: str, tmp_path: Path) -> None:
    folder = tmp_path / "ground"
    folder.mkdir()
    (folder / "a.tif").write_bytes(b"1")
    (folder / "b.tif").write_bytes(b"2")
    before = files_input("scenes", folder)
    if change == "content":
        (folder / "a.tif").write_bytes(b"3")
    elif change == "name":
        (folder / "a.tif").rename(folder / "c.tif")
    elif change == "one more":
        (folder / "c.tif").write_bytes(b"")
    assert (files_input("scenes", folder) == before) == (change == "none")


def test_a_baseline_holds_the_mae(scenes: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first.json", tmp_path / "again.json"
    command = ["gate", "--images", scenes, "--patches", 2]
    done(*command, "--json", first)
    before = read_baseline(first, {**ASKED, "images": scenes}).mae
    first.write_text(first.read_text().replace(str(before), str(before / 2)))
    said = done(*command, "--baseline", first, "--json", second, code=1).splitlines()[-1]
    assert f"MAE against the baseline {before:.4g} of full scale" in said
    content = json.loads(second.read_text())
    assert content["verdict"] == "failed"
    limits = {check["name"]: (check["value"], check["limit"]) for check in content["checks"]}
    assert limits["MAE against the baseline"] == (before, pytest.approx(1.05 * before / 2))
    assert "got failed" in refused(*command, "--baseline", second)


def test_the_baseline_of_another_float_network_is_refused(scenes: Path, tmp_path: Path) -> None:
    command = ["--images", scenes, "--patches", 2]
    done("gate", "convbeers-s", *command, "--json", tmp_path / "s.json")
    assert "another's" in refused("gate", "convbeers-xs", *command, "--baseline", tmp_path / "s.json")


def test_the_baseline_of_other_samples_is_refused(model: Path, tmp_path: Path) -> None:
    samples, int8, before = (tmp_path / name for name in ("s.npy", "int8.onnx", "before.json"))
    np.save(samples, np.random.default_rng(0).random((12, 1, 32, 40), np.float32))
    bd.quantize(model, samples).save(int8)
    done("gate", model, int8, "--samples", samples, "--max-mae", 0.1, "--json", before)
    np.save(samples, np.random.default_rng(1).random((12, 1, 32, 40), np.float32))
    assert "same samples" in refused("gate", model, int8, "--samples", samples, "--baseline", before)
