import json
from pathlib import Path

import jsonschema
import pytest
from rich.console import Console

from deploy.results import SCHEMA_PATH, Document, Figure, Row, measured, number, predicted, published, unavailable
from deploy.tables import print_rows

SCHEMA = json.loads(SCHEMA_PATH.read_text())


def document(**figures: Figure) -> dict[str, object]:
    return Document("test", {"tile": 640, "image": Path("a.tif")}, (), (Row("t", "row", figures),)).to_json()


def test_every_mode_validates() -> None:
    whole = document(
        a=measured(1.5, "s", "here"),
        b=predicted(2, "s", (1, 3), "a model"),
        c=published(42, "s", "the paper"),
        d=unavailable("W", "no counter"),
    )
    jsonschema.validate(whole, SCHEMA)
    assert json.loads(json.dumps(whole)) == whole


@pytest.mark.parametrize(
    "wrong",
    [
        Figure(2.0, "s", "predicted", "a model"),
        Figure(None, "s", "measured", "here"),
        Figure(None, "W", "unavailable"),
        Figure(1.0, "s", "measured"),
        Figure(1.0, "s", "measured", "here", (0.0, 2.0)),
    ],
)
def test_a_figure_without_what_its_mode_needs_is_invalid(wrong: Figure) -> None:
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document(a=wrong), SCHEMA)


def test_inputs_are_named_by_their_digest(tmp_path: Path) -> None:
    (tmp_path / "model.onnx").write_bytes(b"abc")
    row = Row("t", "row", {"a": measured(1, "s", "here")})
    inputs = Document("test", {}, (tmp_path / "model.onnx",), (row,)).to_json()["inputs"]
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert inputs == [{"name": "model.onnx", "sha256": digest}]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(98965, 12, "98,965"), (571991.3, 3, "572,000"), (0.07258, 3, "0.0726"), (36.161, 4, "36.16"), (0, 4, "0")],
)
def test_numbers_read_well(value: float, digits: int, text: str) -> None:
    assert number(value, digits) == text


@pytest.mark.parametrize("width", [40, 80, 200])
def test_tables_show_values_modes_and_reasons(width: int) -> None:
    console = Console(width=width, record=True, quiet=True)
    console.quiet = False
    with console.capture() as capture:
        rows = [
            Row("t", "one", {"latency": predicted(2, "s", (1, 3), "m"), "power": unavailable("W", "no [counter]")}),
            Row("t", "two", {"latency": published(42, "s", "paper")}, {"remedy": "none"}),
        ]
        print_rows("a title", rows, console)
    shown = capture.get()
    for word in ("42 d", "a title", "no [counter]"):
        assert word in shown
