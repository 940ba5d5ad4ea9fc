"""Tests that the stress battery passes valid networks and fails broken ones."""

import re
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np
import onnx
import pytest

from beers_deploy.quant.onnx_file import save_onnx
from beers_deploy.quant.tiling.receptive_field import Tiling
from beers_deploy.restoration.plan import make_plan
from beers_deploy.restoration.tiles.exposures import ExposedNetwork
from beers_deploy.restoration.tiles.rows import restore_floats
from beers_deploy.studies.stress.battery import StageResult, run_battery, worst
from beers_deploy.studies.stress.cases import CASES, FULL_DN, Case
from beers_deploy.studies.stress.checks import LIMITATIONS, Measure, differing, local_range, ringing
from beers_deploy.studies.stress.networks import Subject, open_subject
from beers_deploy.studies.stress.stages import STAGES
from docs.make import stability as maker
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.quant.quick import changed
from tests.quant.simplify.networks import parsed

BY_NAME = {case.name: case for case in CASES}
SIDE_PX = 32


def run_cases(subject: Subject, names: list[str], stages: tuple[str, ...]) -> list[StageResult]:
    return run_battery(subject, [BY_NAME[name] for name in names], stages, side_px=SIDE_PX)


@pytest.mark.parametrize(
    "case", [case for case in CASES if not case.large], ids=lambda case: str(case.name)
)
def test_a_small_network_passes_every_case(case: Case, subject: Subject) -> None:
    results = run_cases(subject, [case.name], tuple(STAGES))
    assert not [(o.stage, o.verdict, o.reason) for o in results if o.failed]


@pytest.mark.parametrize(
    "name", ["full scale", "steps", "NaN pixels", "nodata stripes", "1 x 1", "flat 1 x N"]
)
def test_a_network_at_half_resolution_passes(name: str, coarse: Subject) -> None:
    """Odd sizes are included: they are extended to a multiple of the network's scale."""
    results = run_cases(coarse, [name], tuple(STAGES))
    assert not [(o.stage, o.verdict, o.reason) for o in results if o.failed or o.reason]
    assert any(o.measures for o in results if o.stage != "INT8 reference")


@pytest.mark.parametrize("variant", ["convbeers-half", "convbeers-half-xs"])
def test_the_shipped_networks_at_half_resolution_are_calm(variant: str) -> None:
    """To them a checkerboard is four flat planes; an unconstrained network turned it black."""
    subject = open_subject(variant)
    checks = [BY_NAME[name] for name in ("checkerboard", "Siemens star", "SNR 3")]
    results = run_battery(subject, checks, ["float32", "INT8"], side_px=96)
    assert not [(o.stage, o.verdict, o.reason) for o in results if o.failed]
    board = np.indices((96, 96)).sum(axis=0) % 2 * float(FULL_DN)
    assert subject.int8 is not None
    for network in (subject.float32, subject.int8):
        change = network.restore(board) - board
        assert abs(float(change[30:-30, 30:-30].mean())) < 0.08 * FULL_DN


@pytest.mark.parametrize(
    "name", ["steps", "snow", "nodata stripes", "beyond 12 bits", "flat 1 x N"]
)
def test_the_shipped_network_passes(name: str, shipped: Subject) -> None:
    results = run_battery(shipped, [BY_NAME[name]], ["float32", "INT8", "tiling"], side_px=48)
    assert not [(o.stage, o.verdict) for o in results if o.failed]


@pytest.fixture(scope="module")
def shipped() -> Subject:
    return open_subject("convbeers-xs")


@pytest.mark.parametrize(
    ("name", "change", "case", "check"),
    [
        ("tail.weight", lambda w: 3000 * w, "night", "gain"),
        ("tail.weight", lambda w: 300 * w, "no noise", "ringing"),
        ("tail.weight", lambda w: 1e6 * w, "no noise", "error against float64"),
        ("tail.bias", lambda b: b + 0.05, "deciles", "mean moved"),
        ("head.weight", lambda w: w * 1e38, "steps", "refused"),
    ],
)
def test_a_broken_float_network_fails(
    name: str,
    change: Callable[[np.ndarray], np.ndarray],
    case: str,
    check: str,
    float_onnx: onnx.ModelProto,
) -> None:
    broken = open_subject(changed(float_onnx, name, change))
    (result,) = run_cases(broken, [case], ("float32",))
    assert any(measure.check.startswith(check) for measure in result.failed), result.verdict


def test_a_broken_int8_network_fails(pair: list[Path]) -> None:
    broken = changed(onnx.load(pair[1]), "tail.bias", lambda bias: bias + 10_000_000)
    (result,) = run_cases(open_subject(pair[0], broken), ["deciles"], ("INT8",))
    assert "mean moved" in {measure.check for measure in result.failed}


@pytest.mark.parametrize(("bands", "block"), [(3, 1), (1, 2)])
def test_networks_of_several_bands_or_another_size_are_refused(
    bands: int, block: int, tmp_path: Path
) -> None:
    model = parsed(
        f"x = Conv(image, w) restored = DepthToSpace<blocksize={block}>(x)",
        f"float[N,{bands},H,W] image => float[N,{bands},H,W] restored",
        constants={"w": np.ones((bands * block**2, bands, 1, 1))},
    )
    save_onnx(model, tmp_path / "a.onnx")
    assert "make one band of one band, in the same size" in refused("stress", tmp_path / "a.onnx")


def test_a_halo_one_pixel_short_fails(subject: Subject) -> None:
    """With a halo one pixel below the network's receptive radius, tile plans differ."""
    image = BY_NAME["no noise"].draw(48, np.random.default_rng(0))[0]
    radius_px = subject.float32.tiling.halo_px
    at_once = subject.float32.restore(image)
    network = ExposedNetwork({1: subject.float32.infer()})
    for halo_px, same in ((radius_px, True), (radius_px - 1, False)):
        plan = make_plan((1, *image.shape), 2 * radius_px + 9, halo_px, Tiling(halo_px))
        tiled = restore_floats(image, network, plan, FULL_DN)
        assert differing("plans differ", tiled, at_once).holds == same


def test_nan_never_holds_and_is_the_worst() -> None:
    nan = Measure("c", float("nan"), 1)
    assert not nan.holds
    assert worst([Measure("c", 0.5, 1), nan, Measure("c", 7, 1)])[0] is nan
    assert not Measure("c", float("inf"), 1).holds


def test_a_single_pixel_that_differs_fails_and_missing_ones_are_equal() -> None:
    image = np.full((3, 4), np.nan)
    other = image.copy()
    assert differing("c", image, other).holds
    other[1, 2] = 0
    assert not differing("c", image, other).holds


def test_a_limitation_explains_no_more_than_its_ceiling() -> None:
    limit = next(limitation for limitation in LIMITATIONS if limitation.name == "border")
    for value, failed in ((limit.ceiling, 0), (limit.ceiling + 1, 1), (float("nan"), 1)):
        result = StageResult(BY_NAME["deciles"], "INT8", (Measure("border", value, 10),))
        assert len(result.failed) == failed
    elsewhere = StageResult(BY_NAME["deciles"], "tiling", (Measure("border", 20, 10),))
    assert elsewhere.failed


def test_ringing_is_the_excess_over_the_local_range() -> None:
    source = np.zeros((9, 9), np.float32)
    source[:, 5:] = 1000
    low, high = local_range(source, 1)
    assert (low[0, 4], high[0, 4], high[0, 3]) == (0, 1000, 0)
    over = source.copy()
    over[4, 5] = 1000 + 41 + 500
    assert ringing(over, source, 1, 75).value == pytest.approx(50, abs=0.1)
    assert ringing(source, source, 1, 75).value == 0


@pytest.mark.parametrize("case", CASES, ids=lambda case: str(case.name))
def test_cases_repeat_for_a_seed_and_state_whether_their_pixels_are_valid(case: Case) -> None:
    first, second = (case.draw(24, np.random.default_rng(7)) for _ in range(2))
    for image, repeated in zip(first, second, strict=True):
        np.testing.assert_array_equal(image, repeated)
        assert image.dtype == np.float32
        valid = bool(np.isfinite(image).all()) and image.min() >= 0 and image.max() <= FULL_DN
        assert valid == (case.pixels == "valid")


def test_the_command_writes_its_figures_and_fails_by_exit_code(
    pair: list[Path], tmp_path: Path
) -> None:
    few = ["--cases", "night,NaN pixels", "--stages", "float32,INT8,tiling", "--side", "24"]
    files = ["--json", str(tmp_path / "s.json"), "--out", str(tmp_path / "s.md")]
    done("stress", pair[0], pair[1], *few, *files)
    document = valid(tmp_path / "s.json")
    tables = {row["table"] for row in document["rows"]}
    assert {"battery", "worst", "integer layers", "findings"} <= tables
    assert "## Integer layers" in (tmp_path / "s.md").read_text()
    corrupted = changed(onnx.load(pair[0]), "tail.weight", lambda weight: 3000 * weight)
    save_onnx(corrupted, tmp_path / "broken.onnx")
    output = done("stress", tmp_path / "broken.onnx", *few, code=1)
    assert "FAILED failures 1 result (night, float32: gain" in output
    assert "not checked: The INT8 network is missing" in output
    # A float network alone has no sums of integers to prove anything of.
    assert "stress FAILED, 1 of 1" in output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--cases", "fog"], "some of black"),
        (["--stages", "fog"], "some of float32"),
        (["fog"], "shipped weights"),
        (["nowhere.onnx"], "no such file"),
        (["FLOAT", "FLOAT"], "an INT8 network"),
        (["INT8"], "a float network"),
        (["FLOAT", "--stages", "INT8,INT8 reference"], "The INT8 network is missing"),
        (["FLOAT", "INT8", "--cases", "NaN pixels", "--stages", "INT8 reference"], "Choose other"),
    ],
)
def test_bad_input_is_one_sentence(arguments: list[str], words: str, pair: list[Path]) -> None:
    files = dict(zip(("FLOAT", "INT8"), map(str, pair), strict=True))
    assert words in refused("stress", *(files.get(text, text) for text in arguments))


def test_the_page_of_stability_is_fresh() -> None:
    """The page has every case, stage and limitation, and no failure."""
    page = maker.TARGET.read_text(encoding="utf-8")
    blocks = [maker.OPENING.strip(), *maker.limitation_lines()]
    assert [text for text in blocks if text.strip() not in page] == []
    lines = re.findall(rf"^- {': .+?, '.join(STAGES)}: .+?\. (.+)\.$", page, re.MULTILINE)
    names = chain.from_iterable(line.split("; ") for line in lines)
    assert sorted(names) == sorted(case.name for case in CASES)
    assert "FAILED" not in page
