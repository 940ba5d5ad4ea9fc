"""Tests of the outputs of a gate: no older verdict stays, a CI job reads errors, and digests are
those of the judged files.
"""

import hashlib
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import onnx
import pytest

import beers_deploy as bd
from beers_deploy import comparison
from beers_deploy.kit.record import bill_of, record_of, write_record
from beers_deploy.network import Network
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.encodings import SENSOR_BIASES
from beers_deploy.quant.onnx_file import load_onnx, metadata, save_onnx
from beers_deploy.quant.samples.own import CALIBRATED_ON
from beers_deploy.quant.sensor_bank.conditioned import WEIGHTS
from beers_deploy.results import Table
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.quant.quick import change, uniform
from tests.shipped import shipped_pair

SMALL = "gate convbeers-xs --patches 1"


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """Copy a shipped float network and its INT8 file to files of a user."""
    paths = tmp_path / "float.onnx", tmp_path / "int8.onnx"
    for source, path in zip(shipped_pair("convbeers-xs"), paths, strict=True):
        shutil.copyfile(source, path)
    return paths


def test_the_digest_is_that_of_the_bytes_that_were_judged(
    pair: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The INT8 file is replaced while the gate runs."""
    int8 = pair[1]
    before = hashlib.sha256(int8.read_bytes()).hexdigest()
    compare = comparison.differences_of  # type: ignore[attr-defined]

    def replaced(*arguments: object) -> object:
        int8.write_bytes(b"another file")
        return compare(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(comparison, "differences_of", replaced)
    done(f"gate --patches 1 --json {tmp_path}/g.json --record {tmp_path}/r", *pair)
    document = valid(tmp_path / "g.json")
    assert {entry["name"]: entry["sha256"] for entry in document["inputs"]}["int8.onnx"] == before
    assert json.loads((tmp_path / "r" / "record.json").read_text())["network"]["sha256"] == before


def test_a_note_is_added_if_the_default_limit_is_exceeded(model: Path) -> None:
    samples = uniform(6, 1, 32, 40)
    verdict = bd.gate(bd.quantize(model, samples=samples), samples=samples)
    (mae,) = (check for check in verdict.checks if check.name == "MAE")
    notes = [note for note in verdict.notes if "`max_mae`" in note]
    assert len(notes) == (not mae.passed)
    # The samples are noise, which this network changes most.
    assert not mae.passed


@pytest.mark.parametrize("claim", ["weights", "none"])
def test_claims_of_weights_are_verified(
    claim: str, pair: tuple[Path, Path], tmp_path: Path
) -> None:
    """Licence and training belong to shipped weights. A file that only claims them has neither."""
    sensor = Sensor.load("pleiades-degraded")
    int8 = Network.load(pair[1])
    digest = metadata(int8.model)[WEIGHTS]
    verdict = bd.gate(Network.load(pair[0]), int8, patches=1)
    assert record_of(verdict, int8, sensor)["weights_sha256"] == digest
    assert record_of(verdict, int8, sensor, Network.load(pair[0]))["training"] is not None
    write_record(verdict, int8, sensor, tmp_path)
    page = (tmp_path / "record.html").read_text()
    assert "training patch_px</td>" in page
    # No dictionary as Python writes it.
    assert "{&#39;" not in page
    other = onnx.ModelProto.FromString(int8.model.SerializeToString())
    if claim == "weights":
        node = next(
            tensor for tensor in other.graph.initializer if tensor.name == "body.1.first.bias"
        )
        node.raw_data = bytes(len(node.raw_data))
    else:
        onnx.helper.set_model_props(
            other, {k: v for k, v in metadata(other).items() if k != WEIGHTS}
        )
    save_onnx(other, tmp_path / "other.onnx")
    record = record_of(verdict, replace(int8, model=load_onnx(tmp_path / "other.onnx")), sensor)
    assert (record["weights_sha256"], record["training"], record["licence"]) == (None, None, None)


def test_a_file_without_its_description_loses_no_check_silently(
    pair: tuple[Path, Path], tmp_path: Path
) -> None:
    """A changed constant of the host part is a fault of the encoding, which only the description
    shows.
    """
    int8 = pair[1]
    baseline = tmp_path / "before.json"
    done(f"gate --patches 1 --json {baseline}", *pair)
    model = load_onnx(int8)
    change(model, "max_dn", lambda value: value * 1.002)
    about = {key: text for key, text in metadata(model).items() if key not in ("core", "precision")}
    save_onnx(model, int8)
    assert "faults of the encoding" in done("gate --patches 1", *pair, code=1)
    onnx.helper.set_model_props(model, about)
    save_onnx(model, int8)
    output = " ".join(done("gate --patches 1", *pair).split())
    assert "not checked: faults of the encoding" in output
    output = done(f"gate --patches 1 --baseline {baseline}", *pair, code=1)
    assert "does not describe its integers" in output
    onnx.helper.set_model_props(model, about | {"core": "{}"})
    save_onnx(model, int8)
    assert "int8.onnx: The metadata 'core'" in refused("gate --patches 1", *pair)


def test_a_refusal_deletes_an_older_verdict_and_the_junit_file_gives_the_reason(
    tmp_path: Path,
) -> None:
    document = tmp_path / "gate.json"
    junit = tmp_path / "gate.xml"
    file = tmp_path / "file"
    file.touch()
    outputs = f"--json {document} --junit {junit}"
    record = tmp_path / "record"
    done(f"{SMALL} {outputs} --record {record}")
    assert {path.name for path in record.iterdir()} == {
        f"record.{suffix}" for suffix in ("cdx.json", "html", "json")
    }
    for words in ("--sensor=", "--max-mae nan", f"--samples {file} --patches 2"):
        Table("gate").save(document)
        message = refused(f"gate convbeers-xs {outputs} --record {record} {words}")
        assert not document.exists()
        assert list(record.iterdir()) == []
        suite = ET.fromstring(junit.read_text())  # noqa: S314 - our own text
        assert [suite.get(name) for name in ("tests", "failures", "errors")] == ["1", "0", "1"]
        error = suite.find("testcase/error")
        assert error is not None
        assert error.text
        assert message.endswith(error.text)
    for words in (f"{outputs} --record {file}", f"--json {document} --junit {tmp_path}"):
        Table("gate").save(document)
        junit.write_text("<testsuite/>")
        refused(f"{SMALL} {words}")
        assert not document.exists()
        assert junit.exists() == (str(junit) not in words)


def test_a_record_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = tmp_path / "gate.json"
    folder = tmp_path / "record"

    def failing(*_: object, **__: object) -> str:
        raise RuntimeError("moved")

    monkeypatch.setattr("cyclonedx.output.json.JsonV1Dot6.output_as_string", failing)
    done(f"{SMALL} --json {document} --record {folder}", code=70)
    assert not document.exists()
    assert not folder.exists()
    monkeypatch.setitem(sys.modules, "cyclonedx.output.json", None)
    message = refused(f"{SMALL} --json {document} --record {folder}")
    assert "the package cyclonedx, which does not load" in message


def test_claims_of_the_file_are_shown_as_claims(pair: tuple[Path, Path], tmp_path: Path) -> None:
    claims = {
        "sha256": "0" * 64,
        "name": "convbeers-gold",
        CALIBRATED_ON: "deadbeef cafe",
        SENSOR_BIASES: "garbage",
        "sensor": "s" * 100_000,
    }
    model = load_onnx(pair[1])
    onnx.helper.set_model_props(model, {**metadata(model), **claims})
    save_onnx(model, tmp_path / "int8.onnx")
    int8 = Network.load(tmp_path / "int8.onnx")
    verdict = bd.gate(Network.load(pair[0]), int8, patches=1)
    write_record(
        verdict, int8, Sensor.load("pleiades-degraded"), tmp_path / "r", verdict.comparison.floating
    )
    record = json.loads((tmp_path / "r" / "record.json").read_text())
    assert record["sensors_in_range"] is None
    assert record["says"][CALIBRATED_ON] == "deadbeef cafe"
    assert "calibration_samples" not in record
    facts, claims_shown = (
        (tmp_path / "r" / "record.html").read_text().split("What the file says of itself")
    )
    assert int8.sha256 in facts
    assert "0" * 64 not in facts
    assert "convbeers-gold" in claims_shown
    assert len(claims_shown) < 100_000


def test_a_bill_names_two_inputs_of_one_name(pair: tuple[Path, Path]) -> None:
    int8 = Network.load(pair[1])
    verdict = bd.gate(Network.load(pair[0]), int8, patches=1)
    record = record_of(verdict, int8, Sensor.load("pleiades-degraded"))
    for entry in record["results"]["inputs"][:2]:
        entry["name"] = "net.onnx"
    bill = json.loads(bill_of(record))
    (depends,) = (entry["dependsOn"] for entry in bill["dependencies"] if "dependsOn" in entry)
    assert set(depends) == {entry["bom-ref"] for entry in bill["components"]}
    assert len(depends) == len(record["results"]["inputs"])
