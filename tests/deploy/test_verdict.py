"""Test that a CI job can read a verdict, and that a baseline must be the document of a gate that
passed on the same patches.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import beers_deploy as bd
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Bound, Check, Row, measured
from beers_deploy.results import Input, Table
from beers_deploy.verdict import Baseline, junit_text, read_baseline
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.quant.quick import uniform

ASKED: dict[str, Any] = {"sensor": "pleiades-degraded", "images": None, "patches": 2, "seed": 0}


def document(mae: float = 5e-4, **arguments: object) -> dict[str, Any]:
    """Return the document of a gate that passed."""
    figures = {
        "MAE": measured(mae, "of full scale", "here"),
        "PSNR float": measured(50.0, "dB", "here"),
    }
    inputs = (Input("float.onnx", "a" * 64), Input("sensor s", "b" * 64))
    row = Row("gate", "INT8 against float", figures)
    check = Check("MAE", mae, 1.0, "of full scale")
    return Table("gate", {**ASKED, **arguments}, inputs, (row,), (check,)).to_dict()


def write_json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_the_document_of_a_gate_is_a_baseline(tmp_path: Path) -> None:
    baseline = read_baseline(write_json(tmp_path / "b.json", document()), ASKED)
    assert (baseline.mae, baseline.psnr_float_db) == (5e-4, 50.0)
    assert baseline.digests == {"float.onnx": {"a" * 64}, "sensor s": {"b" * 64}}
    assert baseline.checks == {"MAE"}


def failed(content: dict[str, Any]) -> None:
    content["verdict"] = "failed"
    content["checks"][0]["passed"] = False


def another_command(content: dict[str, Any]) -> None:
    content["command"] = "check"


def without_mae(content: dict[str, Any]) -> None:
    del content["rows"][0]["figures"]["MAE"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (failed, "a gate that failed"),
        (another_command, "a document of 'check', not of 'gate'"),
        (without_mae, "has no MAE"),
        (lambda content: content.update(schema_version=1), "schema_version 2 was expected"),
    ],
)
def test_a_document_that_is_no_baseline_is_refused(
    change: Callable[[dict[str, Any]], None], message: str, tmp_path: Path
) -> None:
    content = document()
    change(content)
    with pytest.raises(OptionError, match=message):
        read_baseline(write_json(tmp_path / "b.json", content), ASKED)


def test_a_key_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    text = json.dumps(document())
    (tmp_path / "b.json").write_text(text.replace('"verdict":', '"verdict": 0, "verdict":'))
    with pytest.raises(OptionError, match="key 'verdict' twice"):
        read_baseline(tmp_path / "b.json", ASKED)


@pytest.mark.parametrize(
    "other",
    [{"seed": 1}, {"patches": 3}, {"sensor": "pleiades-variable"}, {"images": Path("aerial")}],
)
def test_a_baseline_of_other_patches_is_refused_and_a_folder_may_lie_elsewhere(
    other: dict[str, object], tmp_path: Path
) -> None:
    path = write_json(tmp_path / "b.json", document(images="/here/ground"))
    asked = {**ASKED, "images": Path("there/ground")}
    assert read_baseline(path, asked).mae == 5e-4
    (name,) = other
    with pytest.raises(OptionError, match=f"other patches: its `{name}` is"):
        read_baseline(path, {**asked, **other})


DIGESTS = {"net.onnx": frozenset({"a" * 64, "d" * 64}), "sensor s": frozenset({"b" * 64})}
BEFORE = Baseline(Path("b.json"), 5e-4, 50.0, DIGESTS)


def test_the_float_network_is_known_by_its_digest_or_its_psnr() -> None:
    BEFORE.require_same("a" * 64, 47.0, [])
    BEFORE.require_same("c" * 64, 50.004, [])
    with pytest.raises(OptionError, match="another float network"):
        BEFORE.require_same("c" * 64, 50.02, [])
    with pytest.raises(OptionError, match="another float network"):
        replace(BEFORE, psnr_float_db=float("nan")).require_same("c" * 64, float("nan"), [])


@pytest.mark.parametrize("digest", ["c" * 64, "a" * 64])
def test_the_other_inputs_of_a_baseline_must_be_the_same(digest: str) -> None:
    BEFORE.require_same("a" * 64, 50.0, [Input("sensor s", "b" * 64)])
    with pytest.raises(OptionError, match="sensor s had other content"):
        BEFORE.require_same("a" * 64, 50.0, [Input("sensor s", digest)])
    with pytest.raises(OptionError, match="a gate without samples"):
        BEFORE.require_same("a" * 64, 50.0, [Input("samples", digest)])
    twice = replace(BEFORE, digests={**DIGESTS, "sensor s": DIGESTS["sensor s"] | {"e" * 64}})
    with pytest.raises(OptionError, match="sensor s had other content"):
        twice.require_same("a" * 64, 50.0, [Input("sensor s", "b" * 64)])


def test_a_baseline_of_other_samples_in_memory_is_refused(model: Path, tmp_path: Path) -> None:
    """This holds also if both networks are files of one name."""
    (tmp_path / "int8").mkdir()
    values = uniform(8, 1, 32, 40)
    int8 = bd.quantize(model, samples=values).save(tmp_path / "int8" / model.name)
    options: dict[str, Any] = {"limits": {"mae": 0.1}}
    before = bd.gate(model, int8, samples=values, **options).save(tmp_path / "before.json")
    options["baseline"] = before
    assert bd.gate(model, int8, samples=values, **options)
    with pytest.raises(OptionError, match="samples in memory had other content"):
        bd.gate(model, int8, samples=values[::-1], **options)
    words = f"gate {model} {int8} --max-mae 0.1 --baseline {before}"
    assert "its --samples is in memory, but here it is None" in refused(words)


def test_a_baseline_limits_the_mae(scenes: Path, tmp_path: Path) -> None:
    first = tmp_path / "first.json"
    second = tmp_path / "again.json"
    command = f"gate --images {scenes} --patches 2"
    done(f"{command} --json {first}")
    before = read_baseline(first, {**ASKED, "images": scenes}).mae
    first.write_text(first.read_text().replace(str(before), str(before / 2)))
    output = " ".join(done(f"{command} --baseline {first} --json {second}", code=1).split())
    verdict = output.rpartition("gate FAILED, ")[2]
    assert f"MAE against the baseline {before:.4g} of full scale" in verdict
    content = valid(second)
    assert content["verdict"] == "failed"
    limits = {check["name"]: (check["value"], check["limit"]) for check in content["checks"]}
    assert limits["MAE against the baseline"] == (before, pytest.approx(1.05 * before / 2))
    assert "a gate that failed" in refused(f"{command} --baseline {second}")


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no such file"), ("", "an empty file"), ("[]", "not of type"), ("{}", "required")],
)
def test_an_invalid_document_is_refused_in_one_sentence(
    content: str | None, words: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / "x.json").write_text(content)
    with pytest.raises(OptionError, match=words) as caught:
        read_baseline(tmp_path / "x.json", ASKED)
    assert "\n" not in str(caught.value)


CHECKS = [
    Check("MAE", 6e-4, 8e-4, "of full scale"),
    Check("PSNR drop", 0.31, 0.25, "dB"),
    Check("nodes <all>", 1, 0, "node", detail="tail: x & y | z\n::error::\x1b[31m"),
    Check("PSNR float-INT8", 61.15, 60, "dB", "at least"),
]


def test_a_job_can_read_the_verdict() -> None:
    suite = ET.fromstring(junit_text("INT8 gate", CHECKS))  # noqa: S314 - our own text
    assert [suite.get(name) for name in ("tests", "failures", "errors")] == ["4", "2", "0"]
    assert [case.find("failure") is not None for case in suite] == [False, True, True, False]


def test_the_last_line_names_only_the_failed_checks() -> None:
    assert Table(command="gate", checks=tuple(CHECKS[:1])).verdict == "gate passed, all 1 checks"
    text = Table(command="gate", checks=tuple(CHECKS)).verdict
    # A node's name may contain commands for a terminal or a CI's log.
    assert text.isprintable()
    assert text.startswith(
        "gate FAILED, 2 of 4 checks: PSNR drop 0.31 dB, allowed at most 0.25; nodes <all> 1 (tail"
    )
    assert "MAE" not in text
    assert "float-INT8" not in text


@pytest.mark.parametrize(
    ("value", "limit", "bound", "expected"),
    [
        (1.0, 1.0, "at most", True),
        (1.0, 1.0, "at least", True),
        (1.1, 1.0, "at most", False),
        (1.1, 1.0, "at least", True),
        (np.nan, np.inf, "at most", False),
        (np.nan, 0.0, "at least", False),
        (np.inf, 60.0, "at least", True),
    ],
)
def test_the_number_decides(value: float, limit: float, bound: Bound, expected: bool) -> None:
    assert Check("x", value, limit, "dB", bound).passed == expected
