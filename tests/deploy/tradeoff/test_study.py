"""A whole study of two tiny networks: unbroken, stopped and resumed, warm, and with something changed."""

import json
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from deploy.cache import Cache
from deploy.cli import app
from deploy.compare import compare, read_document
from deploy.export import float_model
from deploy.tradeoff import measurements
from deploy.tradeoff.run import StudyRun, run_study
from deploy.tradeoff.selection import Request
from model.convbeers import ConvBEERS, initialise, save_network
from model.simulator.procedural import procedural_scene
from model.variants import Variant
from profiles.figures import Row
from quant.onnx_file import GraphWriter, image_info, load_onnx, make_model, save_onnx
from tests.deploy.dpu.graphs import Sketch
from tests.deploy.tradeoff.small import small_studies

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two networks, two scenes to judge on and one to calibrate on."""
    folder = tmp_path_factory.mktemp("tiny")
    for name, variant in (("narrow", Variant(1, 2)), ("wide", Variant(2, 2))):
        network = ConvBEERS(variant)
        initialise(network, torch.Generator().manual_seed(3))
        save_network(folder / f"{name}.safetensors", network, {"degraded": "pleiades-degraded"})
    for number in range(3):
        scene = procedural_scene(300, 340, np.random.default_rng(number)).radiance.numpy()
        place = folder / ("images" if number < 2 else "calibration") / f"site{'abc'[number]}.png"
        place.parent.mkdir(exist_ok=True)
        Image.fromarray(np.clip(scene, 0, 255).astype(np.uint8)).save(place)
    return folder


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    with small_studies():
        yield


def request(folder: Path, *names: str, **more: object) -> Request:
    files = tuple(str(folder / f"{name}.safetensors") for name in names or ("narrow", "wide"))
    sensors = ("pleiades-degraded", "pleiades-reference")
    options = {"lpips": None, "size_px": (1500, 1200)} | more
    return Request(files, folder / "images", folder / "calibration", *sensors, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def kept(folder: Path, small: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[StudyRun, Path]:  # noqa: ARG001
    """An unbroken run, and the cache that it filled."""
    place = tmp_path_factory.mktemp("cache")
    return run_study(request(folder), Cache(place)), place


def plain(rows: Sequence[Row]) -> list[tuple[object, ...]]:
    return [(row.table, row.name, dict(row.figures), dict(row.text)) for row in rows]


def measured_again(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names what is measured from here on."""
    seen: list[str] = []

    def noted(name: str, work: Callable[..., object]) -> Callable[..., object]:
        def noting(*arguments: object) -> object:
            seen.append(name)
            return work(*arguments)

        return noting

    for name in ("measure", "measure_images", "measure_mae", "time_variants"):
        monkeypatch.setattr(measurements, name, noted(name, getattr(measurements, name)))
    return seen


def test_every_figure_of_every_point_is_a_number_or_has_a_reason(kept: tuple[StudyRun, Path]) -> None:
    points = kept[0].study.points
    assert len({row.name for row in points}) == len(points) > 20
    for row in points:
        assert len(row.figures) == 13
        for key, figure in row.figures.items():
            assert figure.unit, key
            if figure.value is None:
                assert figure.reason
            else:
                assert np.isfinite(figure.value)
                assert figure.source
    legal = next(row for row in points if "wide INT8 legal" in row.name)
    assert all(figure.value is not None for key, figure in legal.figures.items() if key != "LPIPS-squeeze")
    assert legal.text["sensor"] == "known"


def test_two_sites_give_no_interval_and_images_smaller_than_the_profile_asks_for_are_owned_up_to(
    kept: tuple[StudyRun, Path],
) -> None:
    study = kept[0].study
    for row in study.points:
        psnr = row.figures["PSNR"]
        assert psnr.mode != "measured" or psnr.interval is None
    assert not any("dB [" in sentence for front in study.fronts for sentence in front.prices)
    notes = " ".join(study.notes)
    assert "No interval over sites is shown, and pictures distinguish no two points: of 2, fewer than 5" in notes
    assert "Scene pixels per pixel: 2 (2 of 2 images), where pleiades-degraded states 5" in notes


def test_accuracy_knows_no_configuration_and_seams_show(kept: tuple[StudyRun, Path]) -> None:
    points = [row for row in kept[0].study.points if row.text["method"] == "wide" and "legal" in row.name]
    exact = [row.figures["PSNR"] for row in points if row.text["halo"] == "exact"]
    assert len({figure.value for figure in exact}) == 1
    assert {figure.mode for figure in exact} == {"measured"}
    cut = [row.figures["PSNR"] for row in points if row.text["halo"] == "0"]
    assert {figure.mode for figure in cut} == {"predicted"}
    assert all(figure.value != exact[0].value for figure in cut)


def test_a_second_run_measures_nothing_and_says_the_same(
    folder: Path, kept: tuple[StudyRun, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = measured_again(monkeypatch)
    again = run_study(request(folder), Cache(kept[1]))
    assert not seen
    assert plain(again.rows) == plain(kept[0].rows)
    assert (again.study.fronts, again.study.advice) == (kept[0].study.fronts, kept[0].study.advice)
    for one, other in zip(again.study.crops, kept[0].study.crops, strict=True):
        assert np.array_equal(one.dn, other.dn)


@pytest.mark.parametrize("jobs", [2, 11])
def test_stopped_and_resumed_it_says_the_same(
    jobs: int, folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped while the next measurement was under way; INT8 files were made before, or take as long again."""
    for made in kept[1].glob("*.onnx"):
        shutil.copy(made, tmp_path)
    done: list[str] = []
    keep = Cache.keep

    def stop(self: Cache, kind: str, key: object, value: object) -> None:
        if len(done) == jobs:
            raise KeyboardInterrupt
        done.append(kind)
        keep(self, kind, key, value)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(Cache, "keep", stop)
        with pytest.raises(KeyboardInterrupt):
            run_study(request(folder), Cache(tmp_path))
    seen = measured_again(monkeypatch)
    resumed = run_study(request(folder), Cache(tmp_path))
    assert plain(resumed.rows) == plain(kept[0].rows)
    whole = [path for path in tmp_path.glob("*.json") if not path.name.startswith("host")]
    assert len(seen) == len(whole) + 1 - jobs  # one turn of times; nothing of what was kept is measured again


def test_a_damaged_measurement_is_made_again_and_no_other(
    folder: Path, kept: tuple[StudyRun, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    next(kept[1].glob("mae-*.json")).write_text("{")
    seen = measured_again(monkeypatch)
    assert plain(run_study(request(folder), Cache(kept[1])).rows) == plain(kept[0].rows)
    assert seen == ["measure_mae"]


def test_a_new_network_is_measured_and_the_old_ones_are_not(
    folder: Path, kept: tuple[StudyRun, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "copy.safetensors").write_bytes((folder / "narrow.safetensors").read_bytes())
    seen = measured_again(monkeypatch)
    found = run_study(request(folder, "narrow", "copy"), Cache(kept[1]))
    assert seen.count("measure") == 3 + (1 if has_bf16(found) else 0)
    assert seen.count("time_variants") == 1
    by_name = {row.name: row.figures["PSNR"].value for row in found.study.points}
    for name, value in by_name.items():
        if name.startswith("copy"):
            assert value == by_name[name.replace("copy", "narrow")]


def has_bf16(result: StudyRun) -> bool:
    return any(row.text["precision"] == "bf16" and row.figures["PSNR"].value for row in result.study.points)


def test_other_images_are_measured_anew_and_times_are_not(
    folder: Path, kept: tuple[StudyRun, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    other = tmp_path / "images"
    other.mkdir()
    (other / "sitea.png").write_bytes((folder / "images" / "sitea.png").read_bytes())
    seen = measured_again(monkeypatch)
    run_study(replace(request(folder), images=other), Cache(kept[1]))
    assert seen.count("measure") >= 8
    assert "time_variants" not in seen


def test_a_variants_scores_are_those_of_its_own_restoration(folder: Path, kept: tuple[StudyRun, Path]) -> None:
    """The legal file made on the way, measured by hand."""
    from deploy.methods import method_named
    from deploy.tradeoff.run import make_benchmark
    from model.evaluation.scores import Instruments, fidelity_db
    from profiles import load_sensor

    benchmark, _ = make_benchmark(request(folder))
    sensors = load_sensor("pleiades-degraded"), load_sensor("pleiades-reference")
    restore = method_named(str(folder / "wide.safetensors"), *sensors).restore
    values = [fidelity_db(restore(p.degraded), p.reference, p.degraded) for p in benchmark.pairs]
    row = next(row for row in kept[0].study.points if row.name == "wide float32")
    assert row.figures["PSNR"].value == pytest.approx(np.mean(values))
    assert isinstance(benchmark.instruments, Instruments)


def test_crops_show_one_place_and_end_with_the_reference(kept: tuple[StudyRun, Path]) -> None:
    crops = kept[0].study.crops
    assert [crops[0].point, crops[-1].point] == ["degraded", "reference"]
    assert crops[-1].psnr_db is None
    assert len({crop.dn.shape for crop in crops}) == 1
    assert {crop.dn.dtype for crop in crops} == {np.dtype(np.float32)}
    names = {row.name for row in kept[0].study.points}
    assert {crop.point for crop in crops[1:-1]} <= names
    assert len(crops) >= 4


def test_an_int8_file_is_taken_as_it_is(folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path) -> None:
    legal = next(kept[1].glob("int8-legal-*.onnx"))
    given = tmp_path / "given.onnx"
    save_onnx(load_onnx(legal), given)
    found = run_study(replace(request(folder), networks=(str(given),)), Cache(kept[1]))
    points = [row for row in found.study.points if row.text["method"] == "given"]
    assert {row.text["precision"] for row in points} == {"INT8 legal"}
    assert points[0].figures["float-INT8 MAE"].reason == "no float network of it at hand"
    assert points[0].figures["board latency"].value


def test_a_missing_library_leaves_a_point_with_its_reason(
    folder: Path, kept: tuple[StudyRun, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    points = {row.name: row for row in run_study(request(folder), Cache(kept[1])).study.points}
    lost = points["wide bf16"].figures
    assert {figure.mode for figure in lost.values()} == {"unavailable"}
    assert "openvino" in lost["PSNR"].reason
    assert points["wide float32"].figures["PSNR"].value


def command(folder: Path, kept: tuple[StudyRun, Path], out: Path, *more: str) -> tuple[int, str]:
    names = ",".join(str(folder / f"{name}.safetensors") for name in ("narrow", "wide"))
    options = ["--images", folder / "images", "--calibration", folder / "calibration", "--networks", names]
    options += ["--size", "1500x1200", "--cache", kept[1], "--out", out, *more]
    result = CliRunner().invoke(app, ["tradeoff", *map(str, options)])
    assert "Traceback" not in result.output
    return result.exit_code, " ".join(result.output.split())


def test_the_command_writes_a_report_and_a_document_that_compare_reads(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    code, output = command(
        folder, kept, tmp_path / "a", "--budget", "latency<=100s", "--json", str(tmp_path / "x.json")
    )
    assert code == 0
    assert "For board latency at most 100 s" in output
    documents = [read_document(path) for path in (tmp_path / "x.json", tmp_path / "a" / "tradeoff.json")]
    assert documents[0] == documents[1] | {"host": documents[0]["host"]}
    found = compare(*documents)
    assert found.both
    assert not found.changed
    assert any(place[0] == "points" and place[2] == "board energy" for place in (c.place for c in found.both))
    assert list((tmp_path / "a").glob("*.html"))


def test_several_boards_stand_in_the_document_and_as_a_choice_on_the_page(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    code, output = command(folder, kept, tmp_path / "b", "--target", "vck190,zcu104")
    assert code == 0
    assert "figures of vck190 are predicted" in (tmp_path / "b/tradeoff.html").read_text(encoding="utf-8")
    rows = json.loads((tmp_path / "b/tradeoff.json").read_text(encoding="utf-8"))["rows"]
    points = {row["name"]: row["figures"] for row in rows if row["table"] == "points"}
    boards = [row for row in rows if row["table"] == "boards"]
    assert {row["text"]["board"] for row in boards} == {"vck190", "zcu104"}
    own = [row for row in boards if row["text"]["configuration"] == "C32B3"]
    assert own
    for row in own:
        same = f"{row['text']['method']} INT8 legal, C32B3, tile {row['text']['tile']}, halo exact"
        assert row["figures"]["board latency"] == points[same]["board latency"]
        assert row["figures"]["PSNR"] == points[same]["PSNR"]
    assert 'id="boards"' in (tmp_path / "b/tradeoff.html").read_text(encoding="utf-8")
    assert "zcu104" not in output  # the study on the terminal is about the first


def rows_of(out: Path) -> dict[str, dict[str, dict[str, dict[str, object]]]]:
    """The rows of a document by table and name."""
    found: dict[str, dict[str, dict[str, dict[str, object]]]] = {}
    for row in json.loads((out / "tradeoff.json").read_text(encoding="utf-8"))["rows"]:
        found.setdefault(row["table"], {})[row["name"]] = row
    return found


def test_what_to_take_stands_on_the_terminal_on_the_page_and_in_the_document_for_each_board(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    code, output = command(folder, kept, tmp_path / "e", "--target", "vck190,zcu104", "--budget", "latency<=100s")
    page = (tmp_path / "e/tradeoff.html").read_text(encoding="utf-8").replace("\N{NO-BREAK SPACE}", " ")
    rows = rows_of(tmp_path / "e")["recommendations"]
    assert code == 0
    assert list(rows) == [f"{key} on {board}" for board in ("vck190", "zcu104") for key in ("PSNR", "SSIM")]
    for name, row in rows.items():
        sentence = str(row["text"]["sentence"])
        assert sentence.startswith("For board latency at most 100 s take ")
        assert sentence in page
        assert (sentence in output) == name.endswith("vck190")
        assert row["text"]["take"]


def test_all_are_held_against_the_best_chain_or_the_method_that_is_named(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    for options, method in (((), "traditional-fast"), (("--against", "narrow"), "narrow")):
        assert command(folder, kept, tmp_path / method, *options)[0] == 0
        rows = rows_of(tmp_path / method)
        assert all(row["text"]["against"].startswith(method) for row in rows["differences"].values())  # type: ignore[attr-defined]
        assert rows["differences"].keys() == rows["points"].keys()
        values = {name: row["figures"]["PSNR"]["value"] for name, row in rows["points"].items()}  # type: ignore[index]
        against = str(next(iter(rows["differences"].values()))["text"]["against"])
        for name, row in rows["differences"].items():
            if values[name] is not None:
                assert row["figures"]["PSNR difference"]["value"] == pytest.approx(values[name] - values[against])  # type: ignore[index]
        assert "front of PSNR against board latency" in rows


def test_a_network_of_the_users_stands_beside_those_that_are_named(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    """In every precision, or as the INT8 file that it is."""
    mine, given = tmp_path / "mine.onnx", tmp_path / "given.onnx"
    save_onnx(float_model(folder / "narrow.safetensors"), mine)
    save_onnx(load_onnx(next(kept[1].glob("int8-legal-*.onnx"))), given)
    code, _ = command(folder, kept, tmp_path / "o", "--network", str(mine), "--network", str(given))
    assert code == 0
    points = rows_of(tmp_path / "o")["points"].values()
    found = {name: {row["text"]["precision"] for row in points if row["text"]["method"] == name} for name in METHODS}
    assert {"float32", "INT8 legal"} <= found["mine"] == found["narrow"] == found["wide"]
    assert found["given"] == {"INT8 legal"}


METHODS = ("narrow", "wide", "mine", "given")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: path.write_text("not a network"), "network.onnx"),
        (lambda _: None, "network.onnx"),
        (lambda path: save_onnx(with_sigmoid(path), path), "a network that the DPU of vck190 runs"),
        (lambda path: save_onnx(without_layers(), path), "--network"),
    ],
)
def test_a_network_that_cannot_be_a_point_gets_one_sentence(
    make: Callable[[Path], object], words: str, folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    make(tmp_path / "network.onnx")
    code, output = command(folder, kept, tmp_path / "c", "--network", str(tmp_path / "network.onnx"))
    assert code == 2, output
    assert words in output
    assert not list((tmp_path / "c").glob("*"))


def with_sigmoid(path: Path) -> onnx.ModelProto:
    """A float network with an operator that no DPU has."""
    sketch = Sketch(1)
    inner = sketch.node("Sigmoid", sketch.conv("image", (8, 1, 3, 3)))
    return onnx.load(sketch.save(path, sketch.conv(inner, (1, 8, 3, 3))))


def without_layers() -> onnx.ModelProto:
    """A network that hands its image on."""
    writer = GraphWriter()
    writer.node("Relu", "restored", ["image"])
    return make_model(writer.graph("none", [image_info("image", 1, None)], [image_info("restored", 1, None)]), {})


def test_a_need_that_nothing_meets_exits_1_and_writes_the_report(
    folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    code, output = command(folder, kept, tmp_path / "b", "--need", "psnr>=99")
    assert code == 1
    assert "No point keeps PSNR at least 99 dB" in output
    assert json.loads((tmp_path / "b" / "tradeoff.json").read_text())["command"] == "tradeoff"
    assert list((tmp_path / "b").glob("*.html"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--budget", "speed<=3"], "one of psnr"),
        (["--need", "psnr"], "NAME<=NUMBER"),
        (["--size", "wide"], "WIDTHxHEIGHT"),
        (["--networks", "nothing"], "a shipped network"),
        (["--network", "nothing"], "an ONNX or safetensors file"),
        (["--network", "nothing.onnx"], "nothing.onnx"),
        (["--against", "nothing"], "a method of this study (narrow, wide, traditional-fast, nl-means)"),
        (["--sensor", "nothing"], "nothing"),
        (["--lpips", "nothing.npz"], "nothing.npz"),
        (["--images", "nothing"], "no such folder"),
        (["--calibration", "nothing"], "no such folder"),
    ],
)
def test_bad_input_gets_one_sentence(
    options: list[str], words: str, folder: Path, kept: tuple[StudyRun, Path], tmp_path: Path
) -> None:
    code, output = command(folder, kept, tmp_path / "c", *options)
    assert code == 2
    assert words in output
    assert not list((tmp_path / "c").glob("*"))
