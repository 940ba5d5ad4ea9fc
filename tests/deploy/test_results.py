import json
import math
import platform
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import beers_deploy as bd
from beers_deploy.model.processor import processor_name
from beers_deploy.performance.board import Bench
from beers_deploy.profiles.figures import (
    Check,
    Figure,
    Row,
    measured,
    predicted,
    published,
    unavailable,
)
from beers_deploy.quant.gate import GateResult, Spread, gate_row
from beers_deploy.quant.limits import Limits, judge
from beers_deploy.quant.samples.coverage import SampleRange
from beers_deploy.results import SCHEMA_PATH, Table, host

SCHEMA = json.loads(SCHEMA_PATH.read_text())


def document(**figures: Figure) -> dict[str, object]:
    return Table(
        "test", {"tile": 640, "image": Path("a.tif")}, (), (Row("t", "row", figures),)
    ).to_dict()


def test_every_mode_validates() -> None:
    content = document(
        a=measured(1.5, "s", "here"),
        b=predicted(2, "s", (1, 3), "a model"),
        c=published(42, "s", "the paper"),
        d=unavailable("W", "no counter"),
    )
    jsonschema.validate(content, SCHEMA)
    assert json.loads(json.dumps(content)) == content


@pytest.mark.parametrize(
    "figure",
    [
        Figure(2.0, "s", "predicted", "a model"),
        Figure(None, "s", "measured", "here"),
        Figure(None, "W", "unavailable"),
        Figure(1.0, "s", "measured"),
        Figure(1.0, "s", "published", "a paper", (0.0, 2.0)),
    ],
)
def test_a_figure_without_what_its_mode_needs_is_invalid(figure: Figure) -> None:
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document(a=figure), SCHEMA)


def test_inputs_are_named_by_their_digest(tmp_path: Path) -> None:
    (tmp_path / "model.onnx").write_bytes(b"abc")
    row = Row("t", "row", {"a": measured(1, "s", "here")})
    inputs = Table("test", {}, (tmp_path / "model.onnx",), (row,)).to_dict()["inputs"]
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert inputs == [{"name": "model.onnx", "sha256": digest}]


def strictly(text: str) -> object:
    """Parse strict JSON, which has neither NaN nor Infinity."""

    def refuse(name: str) -> None:
        raise ValueError(name)

    return json.loads(text, parse_constant=refuse)


def test_a_saved_table_is_a_valid_document(tmp_path: Path) -> None:
    row = Row("t", "row", {"a": measured(1.5, "s", "here")}, {"remedy": "none"})
    table = Table("test", {"seed": 0, "json": None}, (), (row,))
    assert table.save(tmp_path / "made" / "a.json") == tmp_path / "made" / "a.json"
    content = strictly((tmp_path / "made" / "a.json").read_text())
    jsonschema.validate(content, SCHEMA)
    assert [p.name for p in (tmp_path / "made").iterdir()] == ["a.json"]


def test_a_document_without_rows_is_invalid() -> None:
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(Table("test", {}, (), ()).to_dict(), SCHEMA)


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0])
def test_a_gate_on_a_network_gone_wrong_still_writes_json(value: float, tmp_path: Path) -> None:
    """If a network returns NaN, the MAE is unavailable with a reason, in valid JSON."""
    coverage = SampleRange(0, 0, 1, 1, 0)
    spread = Spread(np.ones(1), np.zeros(1), np.zeros(1))
    values: Any = [*[value] * 8, 1, coverage, spread]
    result = GateResult(*values)
    checks = tuple(judge(result, Limits(mae=1.0)))
    Table("gate", {}, (), (gate_row(result),), checks).save(tmp_path / "gate.json")
    jsonschema.validate(strictly((tmp_path / "gate.json").read_text()), SCHEMA)
    assert checks[0].passed == (value == 0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_figure_is_other_than_finite(value: float) -> None:
    """A figure that is not finite cannot be built. Instead it is unavailable, with the reason."""
    for mode in ("measured", "predicted", "published"):
        with pytest.raises(ValueError, match="not finite"):
            Figure(value, "s", mode, "here", (0, 1))
    with pytest.raises(ValueError, match="not finite"):
        Figure(1.0, "s", "predicted", "here", (0, value))
    for figure in (measured(value, "dB", "one pair"), predicted(value, "dB", (1, 2), "one pair")):
        assert (figure.value, figure.mode) == (None, "unavailable")
        assert "not a finite number" in figure.reason
        assert "one pair" in figure.reason
    assert predicted(1, "s", (0, value), "a model").mode == "unavailable"
    assert measured(1, "s", "here", (0, value)).interval is None
    assert measured(1, "s", "here", (0, 2)).interval == (0, 2)


CHECKS = (
    Check("MAE", 6e-4, 7e-4, "of full scale"),
    Check("PSNR drop", math.nan, 0.25, "dB", detail="of a layer"),
)


def judged(*checks: Check, command: str = "gate") -> dict[str, Any]:
    row = Row("t", "row", {"a": measured(1, "s", "here")})
    return Table(command, {}, (), (row,), checks).to_dict()


@pytest.mark.parametrize(("checks", "verdict"), [(CHECKS[:1], "passed"), (CHECKS, "failed")])
def test_a_document_has_its_verdict_and_its_checks(checks: tuple[Check, ...], verdict: str) -> None:
    content = judged(*checks)
    jsonschema.validate(strictly(json.dumps(content, allow_nan=False)), SCHEMA)
    assert content["verdict"] == verdict
    assert [check["passed"] for check in content["checks"]] == [True, False][: len(checks)]
    first = {
        "name": "MAE",
        "value": 6e-4,
        "limit": 7e-4,
        "unit": "of full scale",
        "bound": "at most",
    }
    assert content["checks"][0] == {**first, "passed": True, "detail": ""}
    assert content["checks"][-1]["value"] == (6e-4 if verdict == "passed" else None)


@pytest.mark.parametrize("command", ["gate", "check"])
def test_a_command_that_judges_has_a_verdict(command: str) -> None:
    with pytest.raises(jsonschema.ValidationError, match="'verdict' is a required"):
        jsonschema.validate(judged(command=command), SCHEMA)
    jsonschema.validate(judged(command="bench"), SCHEMA)


@pytest.mark.parametrize(
    "change",
    [
        {"verdict": "failed"},
        {"verdict": "perhaps"},
        {"checks": []},
        {"checks": [{**CHECKS[1].to_json(), "passed": False}]},
        {"checks": [{**CHECKS[0].to_json(), "value": None, "limit": "0.0007"}]},
        {"schema_version": 1},
        {"host": {"system": "Linux"}},
    ],
)
def test_a_verdict_that_contradicts_its_checks_is_invalid(change: dict[str, object]) -> None:
    content = judged(CHECKS[0])
    jsonschema.validate(content, SCHEMA)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**content, **change}, SCHEMA)


def test_a_printed_table_shows_its_figures_and_notes() -> None:
    rows = (
        Row("speed", "here", {"time": measured(1.5, "s", "a clock")}),
        Row("size", "there", {}, {"word": "small"}),
    )
    text = str(Table("bench", {}, (), rows, notes=("a note\nof two lines",)))
    for word in ("speed", "here", "time", "1.5", "size", "there", "small"):
        assert word in text
    assert text.endswith("\na note\\nof two lines")
    assert not any(line != line.rstrip() for line in text.splitlines())


def test_results_name_the_processor_and_its_load(monkeypatch: pytest.MonkeyPatch) -> None:
    assert host()["processor"] == processor_name()
    monkeypatch.setattr(platform, "system", lambda: "Windows")
    # On Windows, psutil first returns a zero that means unknown.
    assert host()["load_1_min"] is None


def test_a_caption_follows_its_table() -> None:
    rows = tuple(Row(name, "a row", {"size": measured(1, "px", "here")}) for name in ("a", "b"))
    table = Table(rows=rows, headings={"a": "First"}, captions={"First": "What ok means."})
    lines = table.to_markdown().splitlines()
    assert lines.index("## First") < lines.index("What ok means.") < lines.index("## b")
    text = str(table)
    assert text.index("First") < text.index("What ok means.") < text.rindex("a row")
    assert "<p>What ok means.</p>" in table._repr_html_()


def test_a_failed_check_shows_another_value_than_its_limit() -> None:
    check = Check("MAE", 0.00070001, 0.0007, "of full scale")
    assert str(check) == "MAE 0.00070001 of full scale, allowed at most 0.0007"
    assert replace(check, value=0.00069999).actual == "0.0007 of full scale"


def test_a_table_with_arrays_equals_its_copy_and_no_other() -> None:
    """Arrays have no single answer to `==`."""
    verdict, other = (bd.gate("convbeers-xs", patches=2, seed=seed) for seed in (0, 1))
    assert verdict == deepcopy(verdict)
    assert verdict != other
    image = Bench(dn=np.zeros((2, 3)))
    assert image == deepcopy(image)
