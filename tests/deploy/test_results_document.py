"""A results document is read as it was written; anything else gets one sentence."""

from pathlib import Path

import pytest

from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import Check, Row, measured, predicted
from beers_deploy.results import Table
from beers_deploy.verdict import read_document


def test_a_document_is_read_as_it_was_written(tmp_path: Path) -> None:
    rows = (
        Row("gate", "network", {"MAE": measured(0.0006, "of full scale", "patches")}),
        Row("bench", "network", {"latency": predicted(42, "s", (30, 60), "model")}),
    )
    table = Table(
        "gate", {"model": "a.onnx"}, (), rows, (Check("MAE", 6e-4, 7e-4, "of full scale"),)
    )
    table.save(tmp_path / "a.json")
    document = read_document(tmp_path / "a.json")
    assert document["rows"] == table.to_dict()["rows"]


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no such file"), ("", "an empty file"), ("[]", "not of type"), ("{}", "required")],
)
def test_what_is_no_document_gets_one_sentence(
    content: str | None, words: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / "x.json").write_text(content)
    with pytest.raises(OptionError, match=words) as caught:
        read_document(tmp_path / "x.json")
    assert "\n" not in str(caught.value)
