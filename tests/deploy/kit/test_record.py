"""Tests of the record, which states what a network is and what was checked."""

import json
from pathlib import Path

import onnx
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

import beers_deploy as bd
from beers_deploy.kit import RECORD
from tests.deploy.command_line import done
from tests.deploy.kit.test_golden import network


def test_a_record_states_what_a_network_is_and_what_was_checked(tmp_path: Path) -> None:
    """The record names licence, training images, hashes and checks, and its bill of materials is
    valid.

    A reviewer can so trace the network without asking its authors.
    """
    pair = "convbeers-xs", "convbeers-xs-int8"
    done("gate", *pair, "--patches", 2, "--record", tmp_path / "gate")
    record = json.loads((tmp_path / "gate" / RECORD[0]).read_text(encoding="utf-8"))
    assert record["passed"]
    assert record["licence"] == "Apache-2.0"
    assert len(record["training"]["images"]) >= 50
    assert record["network"]["sha256"] in {entry["sha256"] for entry in record["results"]["inputs"]}
    assert len(record["tool"]["code_sha256"]) == 64
    text = (tmp_path / "gate" / RECORD[2]).read_text(encoding="utf-8")
    assert JsonStrictValidator(SchemaVersion.V1_6).validate_str(text) is None
    assert "All checks passed" in (tmp_path / "gate" / RECORD[1]).read_text(encoding="utf-8")


def test_unknown_facts_of_a_users_network_are_recorded_as_unknown(tmp_path: Path) -> None:
    folder = bd.Board.load("zcu102").kit(network("unet"), tmp_path / "kit", tile=64, record=True)
    record = json.loads((folder / "record" / RECORD[0]).read_text(encoding="utf-8"))
    assert record["results"]["command"] == "check"
    for fact in ("training", "licence", "weights_sha256", "sensors_in_range"):
        assert record[fact] is None
    assert len(record["says"]["calibration_samples"].split()) == 3
    onnx.checker.check_model(onnx.load(folder / "core.onnx"))
