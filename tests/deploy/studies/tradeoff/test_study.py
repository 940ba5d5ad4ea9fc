"""A whole study of a tiny network: unbroken, stopped and resumed, and by its command."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from beers_deploy.dpu.board import boards_of
from beers_deploy.model.convbeers import save_network
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.model.variants import Variant as Shape
from beers_deploy.network import Network
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.sensor_file import load_sensor, reference_for
from beers_deploy.profiles.target import board_names
from beers_deploy.restoration.method import Restore
from beers_deploy.studies.evaluation.methods import method_named
from beers_deploy.studies.evaluation.pairs import NamedPair, pairs_of_scenes
from beers_deploy.studies.evaluation.scores import Instruments
from beers_deploy.studies.tradeoff.advice import TOO_FEW, parse_constraints
from beers_deploy.studies.tradeoff.measure import (
    SEAM_ERROR,
    Benchmark,
    make_int8,
)
from beers_deploy.studies.tradeoff.page import Tradeoff
from beers_deploy.studies.tradeoff.run import Study, run_tradeoff
from beers_deploy.verbs.tradeoff import tradeoff
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.deploy.studies.tradeoff.small import small_studies
from tests.model.networks import plain

pytestmark = pytest.mark.slow

SITES = 2
SENSOR = "pleiades-degraded"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network, two scenes to judge on and one to calibrate on."""
    folder = tmp_path_factory.mktemp("tiny")
    save_network(folder / "narrow.safetensors", plain(Shape(1, 2), seed=3), {"degraded": SENSOR})
    for number in range(SITES + 1):
        scene = procedural_scene(300, 340, np.random.default_rng(number)).radiance
        place = (
            folder / ("images" if number < SITES else "calibration") / f"site{'abc'[number]}.png"
        )
        place.parent.mkdir(exist_ok=True)
        Image.fromarray(np.clip(scene, 0, 255).astype(np.uint8)).save(place)
    return folder


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    with small_studies():
        yield


def studied(
    folder: Path, out: Path, *, target: str = "vck190", budget: str | None = None, **changed: Any
) -> Tradeoff:
    """Run a study of the tiny network, with its measurements in a folder."""
    degraded = load_sensor(SENSOR)
    asked = Study(
        networks=[str(folder / "narrow.safetensors")],
        boards=boards_of(target),
        sensors=(degraded, reference_for(degraded)),
        scenes=folder / "images",
        lpips=None,
        calibration=folder / "calibration",
        size=(1500, 1200),
        budget=parse_constraints("budget", budget),
        need=[],
        seed=0,
    )
    return run_tradeoff(replace(asked, **changed), out)


@pytest.fixture(scope="module")
def study(
    folder: Path,
    small: None,  # noqa: ARG001
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Tradeoff, Path]:
    """An unbroken run, and where its measurements lie."""
    out = tmp_path_factory.mktemp("study")
    return studied(folder, out), out


def test_every_figure_is_a_number_or_has_a_reason(study: tuple[Tradeoff, Path]) -> None:
    points = study[0].points
    assert len({point.name for point in points}) == len(points) > 12
    for point in points:
        for key, figure in point.figures.items():
            assert figure.unit, key
            assert figure.source if figure.value is not None else figure.reason
    on_board = next(point for point in points if point.text["configuration"] == "C32B3")
    assert {key for key, figure in on_board.figures.items() if figure.value is None} == {
        "LPIPS-squeeze"
    }
    assert {point.text["sensor"] for point in points} == {"known"}


def test_exact_halos_give_one_picture_and_smaller_ones_show_seams(
    study: tuple[Tradeoff, Path],
) -> None:
    points = [point for point in study[0].points if "INT8" in point.name]
    exact = {point.value("PSNR") for point in points if point.text["halo"] == "exact"}
    (without_halo,) = [point for point in points if point.text["halo"] == "0"]
    assert len(exact) == 1
    assert without_halo.value("PSNR") not in exact
    assert without_halo.value(SEAM_ERROR) > 0
    assert all(SEAM_ERROR not in point.figures for point in points if point.text["halo"] == "exact")


def test_the_scores_are_those_of_the_method_that_evaluate_takes(
    folder: Path, study: tuple[Tradeoff, Path]
) -> None:
    degraded = load_sensor(SENSOR)
    reference = reference_for(degraded)
    restore = method_named(str(folder / "narrow.safetensors"), degraded, reference).restore
    pairs, _ = pairs_of_scenes(folder / "images", degraded, reference, 0)
    instruments = Instruments({})
    expected = [instruments.score(restore(pair.degraded), pair)["PSNR"] for pair in pairs]
    narrow = next(point for point in study[0].points if point.name == "narrow float32")
    assert [image["PSNR"] for image in narrow.images] == expected


def test_two_sites_give_no_interval_and_it_is_said(study: tuple[Tradeoff, Path]) -> None:
    result = study[0]
    assert all(point.figures["PSNR"].interval is None for point in result.points)
    assert {row.text["gain over the next cheaper"] for row in result.front_rows} <= {
        "cheapest",
        TOO_FEW,
    }
    notes = " ".join(result.notes)
    assert "No interval over sites is shown: of 2, fewer than 5" in notes
    assert "Scene pixels per pixel: 2 (2 of 2 images), where pleiades-degraded states 5" in notes


def test_a_stopped_run_goes_on_and_says_the_same(
    folder: Path, study: tuple[Tradeoff, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unbroken, out = study
    stored = json.loads((out / "measurements.json").read_text())
    first_two = dict(list(stored["measurements"].items())[:2])
    (tmp_path / "measurements.json").write_text(json.dumps({**stored, "measurements": first_two}))
    counts = list[bool]()
    score = Benchmark.score

    def counted(
        benchmark: Benchmark, restore: Restore, exact: Restore | None = None
    ) -> list[dict[str, float | None]]:
        counts.append(exact is None)
        return score(benchmark, restore, exact)

    monkeypatch.setattr(Benchmark, "score", counted)
    resumed = studied(folder, tmp_path)
    assert resumed.rows == unbroken.rows
    assert json.loads((tmp_path / "measurements.json").read_text()) == stored
    assert sum(counts) == 1
    studied(folder, tmp_path)
    assert sum(counts) == 1


def test_a_measurement_depends_on_its_inputs(tmp_path: Path) -> None:
    degraded = load_sensor(SENSOR)
    sensors = degraded, reference_for(degraded)
    weights = tmp_path / "squeezenet.safetensors"
    weights.write_bytes(b"weights")
    pair = NamedPair("scene", np.zeros((9, 9), np.float32), np.ones((9, 9), np.float32))
    benches = [
        Benchmark([pair], *sensors, None, 0),
        Benchmark([replace(pair, degraded=pair.degraded + 1)], *sensors, None, 0),
        Benchmark([replace(pair, name="other")], *sensors, None, 0),
        Benchmark([pair], *sensors, weights, 0),
    ]
    assert len({bench.digest for bench in benches}) == 4


def test_an_int8_file_is_made_once(folder: Path, tmp_path: Path) -> None:
    def made() -> Path:
        network = Network.load(folder / "narrow.safetensors")
        int8 = make_int8(network, tmp_path, folder / "calibration", load_sensor(SENSOR), 0)
        assert int8.path is not None
        return int8.path

    path = made()
    time_ns = path.stat().st_mtime_ns
    assert made() == path
    assert path.stat().st_mtime_ns == time_ns


def test_two_boards_give_the_same_answer_in_either_order(
    folder: Path, study: tuple[Tradeoff, Path]
) -> None:
    """The VCK190 is faster, and takes more power than this budget allows."""
    budget = "latency<=60s,power<=20W"
    one, other = (
        studied(folder, study[1], target=order, budget=budget)
        for order in ("vck190,zcu104", "zcu104,vck190")
    )
    assert one.best is not None
    assert one.best.text["board"] == "zcu104"
    assert one.line == other.line
    assert one.front_rows == other.front_rows
    assert sorted(map(str, one.board_rows)) == sorted(map(str, other.board_rows))
    reason = "vck190: no point within board power <= 20 W: the least is"
    assert any(note.startswith(reason) for note in one.notes)


def test_the_quality_is_measured_once_for_all_boards(
    folder: Path, study: tuple[Tradeoff, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Benchmark, "score", lambda *_: pytest.fail("measured again"))
    result = studied(folder, study[1], target="all", budget="latency<=60s")
    assert {row.name for row in result.board_rows} == set(board_names())
    values = {
        point.value("PSNR")
        for point in result.points
        if "INT8" in point.name and point.text["halo"] == "exact"
    }
    assert len(values) == 1
    assert all("board power" in row.figures for row in result.front_rows)


def test_a_board_named_twice_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"`target` .* two are named 'vck190'"):
        studied(folder, tmp_path, target="vck190,vck190")


def test_the_papers_runs_stand_beside_its_own_swath_and_compare_with_nothing(
    folder: Path, study: tuple[Tradeoff, Path]
) -> None:
    result = studied(folder, study[1], size=(13600, 9016))
    published = [point for point in result.points if point.point is None]
    assert sorted(point.figures["board latency"].value or 0 for point in published) == [42, 1724]
    assert all(math.isnan(point.value("board latency")) for point in published)
    assert not any(point.point is None for point in study[0].points)


@pytest.mark.parametrize(("budget", "code"), [("latency<=20s", 0), ("latency<=0.001s", 1)])
def test_the_command_recommends_in_one_line_and_writes_its_files(
    folder: Path, study: tuple[Tradeoff, Path], budget: str, code: int
) -> None:
    out = study[1]
    network = ("--network", folder / "narrow.safetensors", "--size", "1500x1200")
    images = ("--images", folder / "images", "--calibration", folder / "calibration")
    figures = out / "figures.json"
    outputs = ("--out", out, "--json", figures)
    output = done("tradeoff", *network, *images, *outputs, "--budget", budget, code=code)
    line = valid(figures)["rows"][0]["text"]["line"]
    assert line.startswith(
        f"{'nothing to recommend' if code else 'recommended'} for board latency <= "
    )
    assert [text for text in output.splitlines() if "recommend" in text] == [line]
    assert f"wrote {out / 'tradeoff.html'}\n" in output
    assert valid(figures)["verdict"] == ("failed" if code else "passed")
    figures.unlink()
    names = {"tradeoff.html", "tradeoff.svg", "tradeoff.json", "measurements.json", "int8"}
    assert {path.name for path in out.iterdir()} == names
    assert valid(out / "tradeoff.json")["rows"][0]["text"]["line"] == line
    assert line[1:40] in (out / "tradeoff.html").read_text().replace("&lt;", "<")


def test_a_preview_counts_what_is_measured_and_writes_nothing(
    folder: Path, study: tuple[Tradeoff, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    table = tradeoff(
        network=str(folder / "narrow.safetensors"),
        images=folder / "images",
        calibration=folder / "calibration",
        size=(1500, 1200),
        dry_run=True,
        progress=False,
    )
    (row,) = table.rows
    assert row.figures["points"].value == len(study[0].points)
    assert row.figures["images"].value == SITES
    assert row.figures["time here"].mode == "predicted"
    assert (row.figures["time here"].value or 0.0) > 0
    assert list(tmp_path.iterdir()) == []


def test_a_preview_has_no_folder(tmp_path: Path) -> None:
    message = refused("tradeoff", "--dry-run", "--out", tmp_path / "study")
    assert "--out has no effect with --dry-run" in message
    assert not (tmp_path / "study").exists()
