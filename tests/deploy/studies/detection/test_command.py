"""Tests of `evaluate --detector` from options to a page, of its refusals, and of the demonstration
of the small detector on drawn scenes.
"""

from pathlib import Path

import pytest

from beers_deploy.studies.detection.tables import PAPER_TABLE
from benchmarks.detector import demonstration
from benchmarks.detector.network import DETECTOR
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.deploy.studies.detection.folders import Object, dior, labelled, voc

pytestmark = pytest.mark.slow


def document(path: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Return the values of a valid document by table, row and figure; 0 for a missing value."""
    tables: dict[str, dict[str, dict[str, float]]] = {}
    for row in valid(path)["rows"]:
        tables.setdefault(row["table"], {})[row["name"]] = {
            k: f["value"] or 0.0 for k, f in row["figures"].items()
        }
    return tables


DETECT = ("evaluate", "--detector", DETECTOR)
SMALL = ("--sensor", "dior-medium", "--methods", "degraded")
MAP = ("--classes", "Motor-Car=vehicle,Storage tank=tank")


def test_scenes_and_their_pictures_have_similar_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading, class names, labels and sites lead to the scores of the scenes themselves, apart
    from 8 bits and clipping.
    """
    outputs = ("--out", tmp_path / "a", "--json", tmp_path / "a.json")
    words = ["demonstration", *SMALL, "--drawn", 2, *outputs]
    monkeypatch.setattr("sys.argv", list(map(str, words)))
    demonstration.main()
    folder = labelled(tmp_path / "pictures", 2)
    outputs = ("--out", tmp_path / "b", "--json", tmp_path / "b.json")
    output = done(*DETECT, *SMALL, "--images", folder, *MAP, *outputs)
    assert "dior-medium: mAP50 is" in output
    assert f"wrote {tmp_path / 'b' / 'report.html'}" in output
    tables, picture_tables = (document(tmp_path / name) for name in ("a.json", "b.json"))
    scene_rows, picture_rows = (
        document_tables["detection, dior-medium"] for document_tables in (tables, picture_tables)
    )
    assert scene_rows["reference"]["mAP50"] > 50
    for row in ("reference", "degraded"):
        assert picture_rows[row]["mAP50"] == pytest.approx(scene_rows[row]["mAP50"], abs=6)
    assert scene_rows["degraded"]["loss to reference"] > 10
    assert {"mAP50 by class, dior-medium", PAPER_TABLE} <= set(picture_tables)
    page = (tmp_path / "a" / "report.html").read_text()
    assert "No interval over sites is shown: of 2" in page
    assert page.count("data:image/png") == 2


def test_dior_s_tree_is_read_and_nothing_in_it_is_written_over(tmp_path: Path) -> None:
    boxes: list[Object] = [("vehicle", 4, 4, 20, 12), ("storagetank", 30, 10, 50, 30)]
    folder = dior(
        tmp_path / "dior", {"test": {"00001": boxes, "00002": boxes[:1]}, "val": {"00003": boxes}}
    )
    names = ("--classes", "storagetank=tank")
    command = [*DETECT, *SMALL, "--images", folder, *names]
    done(*command, "--json", tmp_path / "found.json")
    inputs = [entry["name"] for entry in valid(tmp_path / "found.json")["inputs"]]
    assert inputs == ["detector.onnx", "00001.jpg", "00002.jpg"]
    label = folder / "Annotations" / "Horizontal Bounding Boxes" / "00001.xml"
    before = label.read_text()
    assert "is an input of this run" in refused(*command, "--json", label)
    assert label.read_text() == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--methods", "nothing"], "'nothing' in --methods is not a method"),
        (["--sensor", ","], "profile"),
        (["--classes", "car"], "--classes must be LABELLED=DETECTOR"),
        (["--labels", "none"], "none is no folder of VOC labels"),
        (["--side", "128"], "--side must be 256 px"),
        (["--brightness", "0.5"], "--brightness has no effect with --detector"),
    ],
)
def test_a_wrong_option_is_refused_in_one_sentence(
    arguments: list[str], words: str, working_folder: Path
) -> None:
    voc(working_folder / "ships")
    command = [
        "evaluate",
        "--detector",
        str(DETECTOR),
        "--images",
        "ships",
        "--out",
        "detection",
    ]
    for name, value in zip(arguments[::2], [*arguments[1::2], None], strict=False):
        if name in command:
            command[command.index(name) + 1] = str(value)
        else:
            command += [name] if value is None else [name, value]
    message = refused(*command)
    assert message.count("beers-deploy: ") == 1
    assert words in message.split("beers-deploy: ")[1]
    assert not (working_folder / "detection" / "report.html").exists()


def test_a_detector_needs_images() -> None:
    assert "--detector needs --images" in refused("evaluate", "--detector", DETECTOR)
