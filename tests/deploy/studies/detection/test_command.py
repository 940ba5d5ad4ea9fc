"""`beers-deploy detect` from options to a page: on drawn scenes, on a labelled folder, and on what
is refused.
"""

from pathlib import Path

import pytest

from beers_deploy.studies.detection.tables import PAPER_TABLE, paper_rows
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.deploy.studies.detection.folders import Object, dior, labelled

pytestmark = pytest.mark.slow


def document(path: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Values by table, row and figure, of a document that the schema takes; 0
    where there is none.
    """
    tables: dict[str, dict[str, dict[str, float]]] = {}
    for row in valid(path)["rows"]:
        tables.setdefault(row["table"], {})[row["name"]] = {
            k: f["value"] or 0.0 for k, f in row["figures"].items()
        }
    return tables


SMALL = ("--sensor", "dior-medium", "--methods", "degraded")
MAP = ("--classes", "Motor-Car=vehicle,Storage tank=tank")


def test_synthetic_scenes_and_the_same_as_pictures_score_alike(tmp_path: Path) -> None:
    """Reading, class names, labels and sites lead to what the scenes lead to, but for 8 bits and
    the clip.
    """
    done("detect", *SMALL, "--drawn", 2, "--out", tmp_path / "a", "--json", tmp_path / "a.json")
    folder = labelled(tmp_path / "pictures", 2)
    outputs = ("--out", tmp_path / "b", "--json", tmp_path / "b.json")
    done("detect", *SMALL, "--images", folder, *MAP, *outputs)
    tables, picture_tables = (document(tmp_path / name) for name in ("a.json", "b.json"))
    scene_rows, picture_rows = (
        document_tables["detection, dior-medium"] for document_tables in (tables, picture_tables)
    )
    assert scene_rows["reference"]["mAP50"] > 50
    for row in ("reference", "degraded"):
        assert picture_rows[row]["mAP50"] == pytest.approx(scene_rows[row]["mAP50"], abs=6)
    assert scene_rows["degraded"]["loss to reference"] > 10
    assert list(tables[PAPER_TABLE]) == [row.name for row in paper_rows()]
    assert {"mAP50 by class, dior-medium", "mAP50 by size, dior-medium"} <= set(tables)
    page = (tmp_path / "a" / "report.html").read_text()
    assert "No interval over sites is shown: of 2" in page
    assert page.count("data:image/png") == 2


def test_dior_s_tree_is_read_and_nothing_in_it_is_written_over(tmp_path: Path) -> None:
    boxes: list[Object] = [("vehicle", 4, 4, 20, 12), ("storagetank", 30, 10, 50, 30)]
    folder = dior(
        tmp_path / "dior", {"test": {"00001": boxes, "00002": boxes[:1]}, "val": {"00003": boxes}}
    )
    names = ("--classes", "storagetank=tank")
    command = [*SMALL, "--images", folder, *names, "--out", tmp_path / "out"]
    done("detect", *command, "--json", tmp_path / "found.json")
    inputs = [entry["name"] for entry in valid(tmp_path / "found.json")["inputs"]]
    assert inputs == ["detector.onnx", "00001.jpg", "00002.jpg"]
    label = folder / "Annotations" / "Horizontal Bounding Boxes" / "00001.xml"
    before = label.read_text()
    refused("detect", *command, "--json", label)
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
        (["--side", "128"], "--side"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    arguments: list[str], word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    message = refused("detect", *arguments, *([] if "--images" in arguments else ["--drawn", 2]))
    assert message.count("beers-deploy: ") == 1
    assert word in message.split("beers-deploy: ")[1]
    assert not (tmp_path / "detection" / "report.html").exists()
