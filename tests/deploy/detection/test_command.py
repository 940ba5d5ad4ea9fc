"""`beers-deploy detect` from options to a page: on drawn scenes, on a labelled folder, and on what is refused."""

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

from deploy.cli import app
from deploy.detection.rows import PAPER_TABLE, paper_rows
from deploy.results import SCHEMA_PATH
from tests.deploy.detection.folders import Object, dior, labelled, text, xml

pytestmark = pytest.mark.slow


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["detect", *map(str, arguments)])


def document(path: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Values by table, row and figure, of a document that the schema takes; 0 where there is none."""
    found = json.loads(path.read_text())
    jsonschema.validate(found, json.loads(SCHEMA_PATH.read_text()))
    tables: dict[str, dict[str, dict[str, float]]] = {}
    for row in found["rows"]:
        tables.setdefault(row["table"], {})[row["name"]] = {k: f["value"] or 0.0 for k, f in row["figures"].items()}
    return tables


SMALL = ("--sensor", "dior-medium", "--methods", "degraded")
MAP = ("--classes", "Motor-Car=vehicle,Storage tank=tank")


def test_drawn_scenes_and_the_same_as_pictures_score_alike(tmp_path: Path) -> None:
    """Reading, class names, labels and sites lead to what the drawn scenes lead to, but for 8 bits and the clip."""
    drawn = run(*SMALL, "--drawn", 2, "--out", tmp_path / "a", "--json", tmp_path / "a.json")
    folder = labelled(tmp_path / "pictures", 2)
    read = run(*SMALL, "--images", folder, *MAP, "--out", tmp_path / "b", "--json", tmp_path / "b.json")
    assert (drawn.exit_code, read.exit_code) == (0, 0), drawn.output + read.output
    one, other = (document(tmp_path / name)["detection, dior-medium"] for name in ("a.json", "b.json"))
    assert one["reference"]["mAP50"] > 50
    for row in ("reference", "degraded"):
        assert other[row]["mAP50"] == pytest.approx(one[row]["mAP50"], abs=6)
    assert one["degraded"]["loss to reference"] > 10


def test_a_page_and_every_table_are_written_and_a_second_run_finds_the_same(tmp_path: Path) -> None:
    command = [*SMALL, "--drawn", 2, "--out", tmp_path, "--json", tmp_path / "found.json"]
    assert run(*command).exit_code == 0
    tables, page = document(tmp_path / "found.json"), (tmp_path / "report.html").read_text()
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()}
    assert len(kept) == 4  # two rows of two scenes
    assert list(tables[PAPER_TABLE]) == [row.name for row in paper_rows()]
    assert {"detection, dior-medium", "mAP50 by class, dior-medium", "mAP50 by size, dior-medium"} <= set(tables)
    assert "no interval over sites is shown: of 2" in page
    assert page.count("data:image/png") == 2
    assert run(*command).exit_code == 0
    assert document(tmp_path / "found.json") == tables
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").iterdir()} == kept


def test_the_four_photographs_run_from_end_to_end(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "detection"
    if not folder.is_dir():
        pytest.skip("no folder shared/data/detection beside the repository")
    found = run(
        *SMALL,
        "--images",
        folder,
        "--classes",
        "car=vehicle,minibus=vehicle",
        "--out",
        tmp_path,
        "--json",
        tmp_path / "j",
    )
    assert found.exit_code == 0, found.output
    assert "left out: Tree" in found.output
    rows = document(tmp_path / "j")["detection, dior-medium"]
    assert 0 < rows["reference"]["mAP50"] < 100


def test_dior_s_tree_is_read_and_nothing_in_it_is_written_over(tmp_path: Path) -> None:
    boxes: list[Object] = [("vehicle", 4, 4, 20, 12), ("storagetank", 30, 10, 50, 30)]
    folder = dior(tmp_path / "dior", {"test": {"00001": boxes, "00002": boxes[:1]}, "val": {"00003": boxes}})
    command = [*SMALL, "--images", folder, "--classes", "storagetank=tank", "--out", tmp_path / "out"]
    found = run(*command, "--json", tmp_path / "found.json")
    assert found.exit_code == 0, found.output
    inputs = [each["name"] for each in json.loads((tmp_path / "found.json").read_text())["inputs"]]
    assert inputs == ["detector.onnx", "00001.jpg", "00002.jpg"]
    label = folder / "Annotations" / "Horizontal Bounding Boxes" / "00001.xml"
    before = label.read_text()
    assert run(*command, "--json", label).exit_code == 2
    assert label.read_text() == before


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--methods", "nothing"], "--methods"),
        (["--sensor", "nowhere"], "nowhere"),
        (["--sensor", ","], "profile"),
        (["--methods", ","], "--methods"),
        (["--detector", "none.onnx"], "none.onnx"),
        (["--classes", "car"], "--classes"),
        (["--classes", "lorry=vehicle"], "lorry"),
        (["--images", "none"], "none"),
        (["--size", "128"], "--size"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    arguments: list[str], word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = run(*arguments, *([] if "--images" in arguments else ["--drawn", 2]))
    lines = [line for line in found.stderr.splitlines() if line.startswith("beers-deploy: ")]
    assert found.exit_code == 2, found.output
    assert len(lines) == 1
    assert word in lines[0]
    assert not (tmp_path / "detection" / "report.html").exists()


def test_a_labelled_class_that_no_detector_knows_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.full((40, 60, 3), 90, np.uint8)).save(tmp_path / "a.png")
    text(tmp_path / "a.xml", xml([("windmill", 2, 3, 12, 9)]))
    found = run(*SMALL, "--images", tmp_path, "--out", tmp_path / "out")
    assert found.exit_code == 2
    assert "windmill" in found.stderr
