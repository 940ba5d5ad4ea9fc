"""mAP50 as an axis: what `detect` finds with the same method, paired over sites, kept; there only if asked for."""

import csv
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from deploy.cache import Cache
from deploy.cli import app
from deploy.detection.boxes import Boxes
from deploy.detection.detectors import Detector, open_detector
from deploy.detection.differences import differences
from deploy.detection.matching import Image as Looked
from deploy.detection.matching import match
from deploy.detection.study import Sensors, Study, rows_of
from deploy.detection.subjects import read_subjects
from deploy.networks import silent
from deploy.tradeoff.detection import OTHER_HALO, Detected
from deploy.tradeoff.detection import Request as DetectionRequest
from deploy.tradeoff.points import MAP50
from deploy.tradeoff.run import StudyRun, run_study
from deploy.tradeoff.selection import Request
from model.convbeers import ConvBEERS, initialise, save_network
from model.shipped import DETECTOR
from model.simulator.procedural import procedural_scene
from model.variants import Variant
from profiles.figures import Figure
from tests.deploy.detection.drawn import NAMES, drawn_images
from tests.deploy.detection.folders import labelled
from tests.deploy.tradeoff.small import small_studies

pytestmark = pytest.mark.slow

SITES = 6
CLASSES = {"Motor-Car": "vehicle", "Storage tank": "tank"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network, a scene to judge on and to calibrate on, and labelled pictures."""
    folder = tmp_path_factory.mktemp("labelled")
    network = ConvBEERS(Variant(1, 2))
    initialise(network, torch.Generator().manual_seed(3))
    save_network(folder / "narrow.safetensors", network, {"degraded": "pleiades-degraded"})
    scene = procedural_scene(300, 340, np.random.default_rng(0)).radiance.numpy()
    (folder / "images").mkdir()
    Image.fromarray(np.clip(scene, 0, 255).astype(np.uint8)).save(folder / "images" / "sitea.png")
    labelled(folder / "pictures", SITES)
    return folder


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    with small_studies():
        yield


def request(folder: Path, pictures: Path | None) -> Request:
    looked = DetectionRequest(pictures, None, CLASSES) if pictures else None
    files, images = (str(folder / "narrow.safetensors"),), folder / "images"
    sensors = ("dior-medium", "pleiades-reference")
    return Request(files, images, images, *sensors, lpips=None, size_px=(1500, 1200), detection=looked)


@pytest.fixture(scope="module")
def kept(folder: Path, small: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[StudyRun, Path]:  # noqa: ARG001
    """A run with labelled pictures, and the cache that it filled."""
    place = tmp_path_factory.mktemp("cache")
    return run_study(request(folder, folder / "pictures"), Cache(place)), place


def found_by(run: StudyRun) -> dict[str, Figure]:
    return {row.name: row.figures[MAP50] for row in run.study.points if MAP50 in row.figures}


def test_a_point_has_the_map50_that_detect_finds_with_its_method(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    detector, profiles = open_detector(DETECTOR), request(folder, None).profiles
    subjects, _ = read_subjects(detector.names, CLASSES, folder / "pictures")
    weights = str(folder / "narrow.safetensors")
    rows = rows_of(Sensors(*profiles), ["degraded", weights, "traditional-fast"], silent)
    study = Study(detector, DETECTOR, subjects, 0, Cache(tmp_path))
    expected = study.compare(Sensors(*profiles), rows).differences
    figures = found_by(kept[0])
    for name, row in (("narrow float32", weights), ("traditional-fast", "traditional-fast")):
        value = expected.value(row, "ap50")
        assert value.interval is not None
        assert figures[name].value == pytest.approx(100 * value.value)
        assert figures[name].interval == pytest.approx([100 * end for end in value.interval])
    assert f"mAP50: Only {SITES} sites: the intervals are too narrow to be trusted." in kept[0].study.notes
    beside = next(note for note in kept[0].study.notes if "same detector" in note)
    for row in ("reference", "degraded"):
        shown = re.search(rf"{row} ([0-9.]+) \[", beside)
        assert shown is not None
        assert float(shown[1]) == pytest.approx(100 * expected.value(row, "ap50").value, abs=0.01)


def test_what_shows_no_seam_is_measured_and_the_rest_says_why_not(kept: tuple[StudyRun, Path]) -> None:
    for row in kept[0].study.points:
        figure, seams = row.figures[MAP50], row.text["halo"] not in ("exact", "none")
        assert figure.unit == "%"
        lost = row.figures["PSNR"].reason  # what cannot run here, for want of a package, has no quality at all
        expected = ("unavailable", OTHER_HALO) if seams else ("unavailable", lost) if lost else ("measured", "")
        assert (figure.mode, figure.reason) == expected
    assert any(row.figures[MAP50].mode == "measured" for row in kept[0].study.points)
    legal = {row.text["halo"] for row in kept[0].study.points if row.text["precision"] == "INT8 legal"}
    assert {"exact", "0"} <= legal


def test_it_has_fronts_of_its_own_and_what_is_seen_on_the_front_was_measured(kept: tuple[StudyRun, Path]) -> None:
    fronts = {(front.x, front.y): front for front in kept[0].study.fronts if front.y == MAP50}
    assert {x for x, _ in fronts} == {"board latency", "board energy", "host p50"}
    figures = found_by(kept[0])
    for front in fronts.values():
        values = [figures[name].value or 0.0 for name in front.members]
        assert values == sorted(values)
        assert len(values) > 0
        for price in front.prices:
            assert "points [" in price


def test_without_labels_all_else_is_the_same(folder: Path, kept: tuple[StudyRun, Path]) -> None:
    plain = run_study(request(folder, None), Cache(kept[1]))
    assert not found_by(plain)
    for one, other in zip(plain.study.points, kept[0].study.points, strict=True):
        assert (one.name, dict(one.text)) == (other.name, dict(other.text))
        assert list(one.figures.items()) == [(k, f) for k, f in other.figures.items() if k != MAP50]
    assert plain.study.fronts == tuple(front for front in kept[0].study.fronts if front.y != MAP50)
    assert set(kept[0].study.notes) > set(plain.study.notes)


def looks(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """Sizes of the pictures that a detector is shown from here on."""
    seen: list[tuple[int, ...]] = []
    detect = Detector.detect

    def noted(self: Detector, rgb: np.ndarray) -> Boxes:
        seen.append(rgb.shape)
        return detect(self, rgb)

    monkeypatch.setattr(Detector, "detect", noted)
    return seen


def test_a_second_run_looks_at_nothing_and_says_the_same(
    folder: Path, kept: tuple[StudyRun, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = looks(monkeypatch)
    again = run_study(request(folder, folder / "pictures"), Cache(kept[1]))
    assert not seen
    assert found_by(again) == found_by(kept[0])
    assert (again.study.fronts, again.study.notes) == (kept[0].study.fronts, kept[0].study.notes)


def test_other_labels_are_scored_anew_on_the_boxes_that_were_found(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in (folder / "pictures").iterdir():
        content = path.read_bytes()
        (tmp_path / path.name).write_bytes(content.replace(b"SHIP", b"aircraft"))
    seen = looks(monkeypatch)
    other = found_by(run_study(request(folder, tmp_path), Cache(kept[1])))
    assert not seen
    assert (other["narrow float32"].value or 0.0) < (found_by(kept[0])["narrow float32"].value or 0.0)


def test_stopped_it_goes_on_with_the_picture_that_it_was_at(
    folder: Path, kept: tuple[StudyRun, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in [*kept[1].glob("detection-*.json"), *sorted(kept[1].glob("found-*.json"))[:3]]:
        path.unlink()
    seen = looks(monkeypatch)
    again = run_study(request(folder, folder / "pictures"), Cache(kept[1]))
    assert len(seen) == 3
    assert found_by(again) == found_by(kept[0])


def test_scores_are_paired_as_in_a_detection_study() -> None:
    images = drawn_images(np.random.default_rng(1), 12)
    worse = [Looked(each.truth, each.found[::2], each.site) for each in images]
    rows = {"all": match(images, NAMES), "half": match(worse, NAMES)}
    expected = differences(rows, np.random.default_rng(4))
    kept = {
        name: Detected.from_json(json.loads(json.dumps(Detected.of(row, 4).to_json()))) for name, row in rows.items()
    }
    for name, found in kept.items():
        assert found.ap50 == pytest.approx(expected.scores[name].ap50)
        np.testing.assert_allclose(found.draws, expected.drawn[name]["ap50"])
    ends = expected.difference("all", "half", "ap50").interval
    assert ends is not None
    assert kept["all"].gain(kept["half"]) == pytest.approx((100 * ends[0], 100 * ends[1]))
    assert kept["all"].gain(kept["half"]) == tuple(-end for end in kept["half"].gain(kept["all"])[::-1])


def test_four_sites_tell_no_two_apart() -> None:
    images = drawn_images(np.random.default_rng(1), 4)
    found, other = (
        Detected.of(match(each, NAMES), 0) for each in (images, [Looked(i.truth, i.truth, i.site) for i in images])
    )
    assert found.figure.interval is None
    assert found.figure.value == pytest.approx(100 * found.ap50)
    assert other.gain(found) == (-np.inf, np.inf)


def command(folder: Path, kept: tuple[StudyRun, Path], out: Path, *more: object) -> tuple[int, str]:
    options = ["--images", folder / "images", "--calibration", folder / "images", "--sensor", "dior-medium"]
    options += ["--networks", folder / "narrow.safetensors", "--size", "1500x1200", "--cache", kept[1], "--out", out]
    result = CliRunner().invoke(app, ["tradeoff", *map(str, [*options, *more])])
    assert "Traceback" not in result.output
    return result.exit_code, " ".join(result.output.split())


MAP = ("--classes", "Motor-Car=vehicle,Storage tank=tank")


def test_the_command_writes_it_to_page_table_and_document_and_takes_it_as_a_need(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    code, output = command(folder, kept, tmp_path, "--labelled", folder / "pictures", *MAP, "--need", "map50>=1%")
    assert code == 0, output
    assert "For mAP50 at least 1 %: " in output
    assert "front of mAP50 against board latency" in output
    document = json.loads((tmp_path / "tradeoff.json").read_text())
    values = {r["name"]: r["figures"][MAP50]["value"] for r in document["rows"] if r["table"] == "points"}
    assert values == {name: figure.value for name, figure in found_by(kept[0]).items()}
    inputs = [each["name"] for each in document["inputs"]]
    assert {"detector.onnx", *(f"s{k}x.png" for k in range(SITES))} <= set(inputs)
    with (tmp_path / "points.csv").open(newline="") as lines:
        table = {line["point"]: line["mAP50 (%)"] for line in csv.DictReader(lines)}
    assert {name: float(value) for name, value in table.items() if value} == {
        k: v for k, v in values.items() if v is not None
    }
    page = (tmp_path / "tradeoff.html").read_text()
    assert 'data-quality="mAP50"' in page
    assert "The same detector on the same images, measured: reference" in page


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--detector", "any.onnx"], "--detector: expected --labelled beside it"),
        (["--classes", "car=vehicle"], "--classes: expected --labelled beside it"),
        (["--need", "map50>=60"], "--need: expected --labelled beside it for mAP50"),
        (["--budget", "latency<=9s,map50>=60"], "--budget: expected --labelled beside it for mAP50"),
        (["--labelled", "nothing"], "nothing"),
        (["--labelled", "PICTURES", "--classes", "lorry=vehicle"], "lorry"),
        (["--labelled", "PICTURES", "--detector", "none.onnx"], "none.onnx"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    options: list[str], words: str, folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    given = [str(folder / "pictures") if option == "PICTURES" else option for option in options]
    code, output = command(folder, kept, tmp_path / "out", *given)
    assert code == 2
    assert words in output
    assert not list((tmp_path / "out").glob("*"))


def test_without_its_library_it_is_refused_before_anything_is_measured(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycocotools.coco", None)
    code, output = command(folder, kept, tmp_path / "out", "--labelled", folder / "pictures", *MAP)
    assert code == 2
    assert "pip install 'beers-deploy[detect]'" in output
    assert not list((tmp_path / "out").glob("*"))


def test_no_labelled_file_is_written_over(folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path) -> None:
    label = folder / "pictures" / "s0x.xml"
    before = label.read_bytes()
    code, _ = command(folder, kept, tmp_path / "out", "--labelled", folder / "pictures", *MAP, "--json", label)
    assert code == 2
    assert label.read_bytes() == before
