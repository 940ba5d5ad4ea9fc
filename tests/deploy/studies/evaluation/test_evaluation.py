"""Pairs, methods, scores and targets of an evaluation."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beers_deploy.model.metrics.fidelity import fidelity_db
from beers_deploy.model.raster.writer import write_tiff
from beers_deploy.model.shipped import shipped_names
from beers_deploy.model.simulator.acquire import simulate_pair
from beers_deploy.model.simulator.detector import Draw
from beers_deploy.model.simulator.procedural import procedural_scene
from beers_deploy.network import Network
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.errors import ImageError, OptionError
from beers_deploy.profiles.figures import Row, by_table, measured
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.studies.evaluation import target_scenes
from beers_deploy.studies.evaluation.methods import (
    BLIND,
    KNOWN,
    Method,
    method_named,
    method_without_network,
)
from beers_deploy.studies.evaluation.pairs import (
    NamedPair,
    oversampling_note,
    oversamplings_of,
    read_pairs,
    scenes_at,
    simulate_pairs,
)
from beers_deploy.studies.evaluation.run import (
    Evaluation,
    chosen_pairs,
    evaluation_report,
    strip_of,
)
from beers_deploy.studies.evaluation.scores import (
    BIAS,
    INNER,
    INNER_BORDER_PX,
    INNER_NOISE_FREE,
    LARGEST_BIAS,
    NOISE_FREE,
    READ,
    Instruments,
    bias_percent,
    inner_border_px,
    inner_note,
    score,
    site_rows,
)
from beers_deploy.tables.columns import missing
from beers_deploy.verbs.evaluate import evaluate
from tests.deploy.command_line import done, refused
from tests.deploy.documents import figures_of, valid

DEGRADED = Sensor.load("pleiades-degraded")
REFERENCE = Sensor.load("pleiades-reference")
SENSORS = DEGRADED.nominal(), REFERENCE.nominal()
PLAIN = Instruments({"LPIPS-squeeze": "no weights"})


OTHER = replace(
    SENSORS[0], mtf_nyquist=0.03, gain_dn_per_radiance=0.7 * SENSORS[0].gain_dn_per_radiance
)


def pair(name: str = "site_1.tif", seed: int = 0, noise_dn: float = 20) -> NamedPair:
    generator = np.random.default_rng(seed)
    reference = generator.integers(100, 3000, (37, 45)).astype(np.float32)
    noisy = reference + generator.normal(0, noise_dn, reference.shape)
    return NamedPair(name, np.clip(np.rint(noisy), 0, 4095).astype(np.float32), reference)


def write_pairs(folder: Path, pairs: list[NamedPair]) -> Path:
    for item in pairs:
        for role in ("degraded", "reference"):
            write_tiff(folder / role / item.name, getattr(item, role).astype(np.uint16))
    return folder


def few_targets(patch: pytest.MonkeyPatch) -> None:
    less = {
        "ANGLES_DEG": (5.0, 8.0),
        "REPEATS": 1,
        "SIDE_PX": 100,
        "POINTS_A_SIDE": 3,
        "BAR_CONTRASTS": (0.1,),
        "BAR_PERIODS_PX": (2.0,),
        "ZONE_CONTRASTS": (0.3,),
    }
    for name, value in less.items():
        patch.setattr(target_scenes, name, value)


IDENTITY = Method("degraded", lambda dn: dn, "blind")


@pytest.mark.parametrize(
    ("name", "site"),
    [
        ("brighton_forest_lakeshore_0034.jpg", "brighton_forest_lakeshore"),
        ("dry_rangeland_track_5dded5bc_23.jpg", "dry_rangeland_track"),
        ("agung1_tropical_slope.jpg", "agung1_tropical_slope"),
        ("zoo_mosaic_50cm.png", "zoo_mosaic_50cm"),
        ("0001-drawn-00012.tif", "0001-drawn-00012"),
        ("_12.tif", "_12.tif"),
    ],
)
def test_frames_of_one_site_are_told_by_their_names(name: str, site: str) -> None:
    assert replace(pair(), name=name).site == site


def test_pairs_come_back_from_a_folder(tmp_path: Path) -> None:
    pairs = [pair("a_1.tif", 1), pair("b_2.tif", 2)]
    read_back = read_pairs(write_pairs(tmp_path, pairs))
    assert [item.name for item in read_back] == ["a_1", "b_2"]
    for one, other in zip(read_back, pairs, strict=True):
        assert np.array_equal(one.degraded, other.degraded)
        assert np.array_equal(one.reference, other.reference)


def test_a_pair_without_a_partner_or_of_two_sizes_is_refused(tmp_path: Path) -> None:
    write_pairs(tmp_path, [pair("a.tif"), pair("b.tif")])
    write_tiff(tmp_path / "reference" / "b.tif", np.ones((9, 9), np.uint16))
    with pytest.raises(ImageError, match=r"45 x 37 and 9 x 9"):
        read_pairs(tmp_path)
    (tmp_path / "reference" / "b.tif").unlink()
    with pytest.raises(ImageError, match=r"'b' in only one"):
        read_pairs(tmp_path)
    with pytest.raises(ImageError, match="no such folder"):
        read_pairs(tmp_path / "degraded")


def test_scenes_too_small_are_named_and_all_too_small_is_refused() -> None:
    large, small = (procedural_scene(side, side, np.random.default_rng(0)) for side in (400, 200))
    pairs, left_out = simulate_pairs([large, replace(small, name="small")], DEGRADED, REFERENCE, 0)
    assert len(pairs) == 1
    assert left_out == ["small"]
    assert pairs[0].degraded.shape == pairs[0].reference.shape
    with pytest.raises(ImageError, match="224 pixels"):
        simulate_pairs([small], DEGRADED, REFERENCE, 0)


@pytest.mark.parametrize(
    ("own", "sides", "words"),
    [
        (2, (300, 700), ""),
        (4, (700, 700), ""),
        (
            4,
            (300, 700),
            "4 (1 of 2 images) and 2 (1 of 2 images), where pleiades-degraded states 4",
        ),
        (5, (700, 700), "4 (2 of 2 images), where pleiades-degraded states 5; at most 4 are taken"),
    ],
)
def test_another_oversampling_than_the_profiles_is_said(
    own: int, sides: tuple[int, int], words: str
) -> None:
    profile = replace(DEGRADED, oversampling=Constant(own, "stated", "a test"))
    scenes = [procedural_scene(side, side, np.random.default_rng(0)) for side in sides]
    pairs, _ = simulate_pairs(scenes, profile, REFERENCE, 0, oversamplings_of(profile))
    note = oversampling_note(pairs, profile)
    assert words in note
    assert bool(words) == bool(note)


@pytest.mark.parametrize("name", ["magic", "traditional-superb", "convbeers-huge", ""])
def test_an_unknown_method_is_refused(name: str) -> None:
    with pytest.raises(OptionError, match=r"`methods`|variant"):
        method_named(name, DEGRADED, REFERENCE)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("convbeers-xs", "known"),
        ("convbeers-xs-int8", "known"),
        ("convbeers-xs@blind", "blind"),
        ("convbeers-xs@dior-medium", "another: dior-medium"),
        ("traditional", "known"),
    ],
)
def test_a_shipped_network_knows_the_images_sensor_unless_its_name_says_another(
    name: str, expected: str
) -> None:
    assert method_named(name, DEGRADED, REFERENCE).sensor_known == expected


def test_a_shipped_network_restores_as_it_knows_the_sensor() -> None:
    """Specialised to the sensor that is given, and to no other where its name says one."""
    dn = np.random.default_rng(0).uniform(300, 900, (47, 53)).astype(np.float32)
    blurred = replace(DEGRADED.nominal(), mtf_nyquist=0.03)
    method = method_named("convbeers-xs", DEGRADED, REFERENCE)
    assert method.specialise is not None
    np.testing.assert_allclose(
        method.specialise(DEGRADED.nominal())(dn), method.restore(dn), rtol=0, atol=1
    )
    assert np.abs(method.specialise(blurred)(dn) - method.restore(dn)).max() > 5
    assert method_named("convbeers-xs@blind", DEGRADED, REFERENCE).specialise is None


@pytest.mark.parametrize("name", ["traditional-fast", "deconvolve-first-fast", "wiener"])
def test_a_chain_that_gets_to_know_a_sensor_is_the_one_made_for_it(name: str) -> None:
    """Its gain included: the reference that is aimed at then has it too."""
    dn = np.random.default_rng(0).integers(200, 1800, (40, 47)).astype(np.float32)
    method = method_without_network(name, *SENSORS)
    other = method_without_network(name, OTHER, SENSORS[1].in_units_of(OTHER))
    restored = method.knowing(OTHER).restore(dn)
    assert np.array_equal(restored, other.restore(dn))
    assert not np.array_equal(restored, method.restore(dn))


def test_who_can_know_a_sensor_says_so_and_what_depends_on_none_stays_as_it_is() -> None:
    for fixed in (method_without_network("degraded", *SENSORS), Method("blind", np.sqrt, BLIND)):
        assert fixed.knowing(OTHER) is fixed
    method = Method("net", np.sqrt, BLIND, lambda _: np.abs)
    assert (method.knowing(OTHER).sensor_known, method.sensor_known) == (KNOWN, BLIND)


def test_clipped_pixels_do_not_count() -> None:
    """Trap 17: above full scale the truth is unknown, in the reference as in the input."""
    one = pair()
    reference = one.reference.copy()
    degraded = one.degraded.copy()
    reference[3:9, 5:11] = 4095
    degraded[20:25, 5:11] = 4095
    restored = degraded.copy()
    before = fidelity_db(restored, reference, degraded)
    restored[3:9, 5:11] = 100
    restored[20:25, 5:11] = 100
    assert fidelity_db(restored, reference, degraded) == before
    restored[30, 30] += 500
    assert fidelity_db(restored, reference, degraded) < before
    white = np.full((12, 13), 4095, np.float32)
    # All of the image is clipped: then no pixel is left out.
    assert fidelity_db(white - 1, white, white) == pytest.approx(20 * np.log10(4095))


def test_the_degraded_input_gains_nothing_and_missing_figures_have_a_reason() -> None:
    mean, *images = score(IDENTITY, [pair(f"{'abcde'[s]}.tif", seed=s) for s in range(5)], PLAIN, 0)
    assert mean.figures["PSNR gain"].value == 0
    assert len(images) == 5
    assert mean.figures["LPIPS-squeeze"].reason == "no weights"
    reasons = [f"{NOISE_FREE}, {INNER_NOISE_FREE}: {READ}", "LPIPS-squeeze: no weights"]
    assert missing([mean, *images]) == reasons
    interval = mean.figures["PSNR"].interval
    assert interval is not None
    assert interval[0] <= (mean.figures["PSNR"].value or 0) <= interval[1]
    assert NOISE_FREE not in {row.table.removesuffix(" by site") for row in site_rows(images)}
    few, *_ = score(IDENTITY, [pair(f"{'abcd'[s]}.tif", seed=s) for s in range(4)], PLAIN, 0)
    assert few.figures["PSNR"].interval is None
    assert "no interval: 4 sites, fewer than 5" in few.figures["PSNR"].source


def test_identical_images_are_no_number() -> None:
    perfect = replace(pair(), degraded=pair().reference)
    mean, image = score(IDENTITY, [perfect], PLAIN, 0)
    assert mean.figures["PSNR"].value is None
    assert "identical" in image.figures["PSNR"].reason


def test_the_reference_without_noise_is_the_same_acquisition_otherwise() -> None:
    """What is left between the two is the reference sensor's noise and rounding; the pair's bytes
    are as ever.
    """
    scene = procedural_scene(700, 760, np.random.default_rng(3))
    (one,), _ = simulate_pairs([scene], DEGRADED, REFERENCE, 7)
    expected = simulate_pair(scene.radiance, *SENSORS, 4, Draw(7))
    assert np.array_equal(one.degraded, expected.degraded)
    assert np.array_equal(one.reference, expected.reference)
    assert one.noise_free is not None
    noise = one.reference - one.noise_free
    sensor = SENSORS[1]
    light = np.clip(one.noise_free / sensor.gain_dn_per_radiance, 0, None)
    # Rounding to integers adds a variance of 1/12.
    variance = (sensor.alpha * light + sensor.beta) * sensor.gain_dn_per_radiance**2 + 1 / 12
    unclipped = one.reference < sensor.max_dn
    assert float((noise**2 / variance)[unclipped].mean()) == pytest.approx(1, abs=0.05)
    assert abs(float(noise[unclipped].mean())) < 3 * float(np.sqrt(variance.mean() / noise.size))


def test_errors_in_the_border_are_none_of_inner_pixels() -> None:
    for height, width in ((37, 45), (300, 131)):
        border_px = inner_border_px(height, width)
        reference = (
            np.random.default_rng(height).uniform(100, 3000, (height, width)).astype(np.float32)
        )
        inside = np.zeros((height, width), bool)
        inside[border_px : height - border_px, border_px : width - border_px] = True
        assert inside.sum(0).max() >= height / 2
        restored = reference + np.where(inside, 2, 400).astype(np.float32)
        scores = PLAIN.score(restored, NamedPair("a", reference, reference, noise_free=reference))
        for key in (INNER, INNER_NOISE_FREE):
            assert scores[key] == pytest.approx(20 * np.log10(4095 / 2), abs=1e-3)
        assert (scores["PSNR"] or 0) < 30
        assert scores[BIAS] == pytest.approx(200 / reference[inside].mean(), rel=1e-3)


def test_the_border_covers_what_every_shipped_network_sees_and_is_less_of_small_images() -> None:
    reach_of_the_consistency_step_px = 19
    halos_px = [Network.load(name).tiling.halo_px for name in shipped_names()]
    assert max(halos_px) + reach_of_the_consistency_step_px == INNER_BORDER_PX
    assert inner_border_px(4 * INNER_BORDER_PX, 999) == INNER_BORDER_PX
    assert inner_border_px(101, 60) == 15
    large = NamedPair("large", *(np.ones((4 * INNER_BORDER_PX, 230), np.float32),) * 2)
    assert not inner_note([large])
    assert "(1 of 2)" in inner_note([large, pair()])


@pytest.mark.parametrize("factor", [1.01, 0.97])
def test_a_method_that_multiplies_has_that_bias(factor: float) -> None:
    perfect = [
        replace(pair(f"{name}_1.tif", seed), degraded=pair(seed=seed).reference)
        for seed, name in enumerate("ab")
    ]
    scaled = Method("scaled", lambda dn: dn * np.float32(factor), BLIND)
    mean, *images = score(scaled, perfect, PLAIN, 0)
    for row in (mean, *images):
        assert row.figures[BIAS].value == pytest.approx(100 * (factor - 1), abs=1e-3)
        assert row.figures[BIAS].unit == "%"


def test_the_largest_bias_is_that_of_the_worst_image_with_its_sign() -> None:
    perfect = [
        replace(pair(f"{name}.tif", 1), degraded=pair(seed=1).reference)
        for name in ("a_1", "b_1", "b_2")
    ]
    factors = iter((1.01, 0.96, 1.02))
    mean, *_ = score(
        Method("drifts", lambda dn: dn * np.float32(next(factors)), BLIND), perfect, PLAIN, 0
    )
    assert mean.figures[BIAS].value == pytest.approx(-1 / 3, abs=1e-3)
    assert mean.figures[LARGEST_BIAS].value == pytest.approx(-4, abs=1e-3)
    assert mean.figures[LARGEST_BIAS].source == "one pair of site b"


def test_clipped_pixels_and_the_offset_are_no_bias_and_black_has_none() -> None:
    level = np.full((40, 41), 500, np.float32)
    restored = level.copy()
    unclipped = np.ones(level.shape, bool)
    restored[15:20, 15:20] = 4095
    unclipped[15:20, 15:20] = False
    assert bias_percent(restored, level, unclipped) == 0
    assert bias_percent(restored, level) > 1
    assert bias_percent(level + 4, level, offset_dn=100) == pytest.approx(1)
    black = np.zeros((40, 41), np.float32)
    mean, _ = score(
        Method("lifts", lambda dn: dn + 1, BLIND), [NamedPair("a", black, black)], PLAIN, 0
    )
    assert mean.figures[BIAS].reason == "the reference is black"


def test_noise_of_the_reference_is_no_error_of_a_method_that_leaves_it_out() -> None:
    scene = procedural_scene(700, 760, np.random.default_rng(3))
    (one,), _ = simulate_pairs([scene], DEGRADED, REFERENCE, 7)
    clean = one.noise_free
    assert clean is not None
    oracle = Method("oracle", lambda _: clean + np.float32(2), "known")
    mean, image = score(oracle, [one], PLAIN, 0)
    assert f"{NOISE_FREE} by site" in by_table(site_rows([image]))
    noise_free = mean.figures[NOISE_FREE].value or 0
    assert noise_free == pytest.approx(20 * np.log10(4095 / 2), abs=1e-3)
    assert noise_free > (mean.figures["PSNR"].value or 0) + 5


def test_sites_are_means_of_their_images() -> None:
    pairs = [pair("a_1.tif", 1, 10), pair("a_2.tif", 2, 40), pair("b_1.tif", 3, 20)]
    _, *images = score(IDENTITY, pairs, PLAIN, 0)
    rows = site_rows(images)
    keys = "PSNR", INNER, BIAS, "SSIM"
    assert list(by_table(rows)) == [f"{key} by site" for key in keys]
    first, second = rows[:2]
    levels = [row.figures["PSNR"].value or 0 for row in images]
    assert (first.name, second.name) == ("a", "b")
    assert first.figures["degraded"].value == pytest.approx(sum(levels[:2]) / 2)
    assert second.figures["degraded"].value == pytest.approx(levels[2])
    assert (first.text["images"], second.text["images"]) == ("2", "1")


def test_strips_hold_every_method_and_black_below_the_reference() -> None:
    one = pair()
    strip, white = strip_of(one, [IDENTITY, Method("zero", np.zeros_like, "blind")])
    side = 37 * 2
    assert strip.shape == (22 + 2 * (side + 4), 3 * (side + 4) - 4)
    assert white > 1
    assert strip[22 + side + 4 : 22 + side + 4 + side, 2 * (side + 4) :].max() == 0
    assert strip[22 + side + 4 : 22 + side + 4 + side, :side].max() == 255


def test_one_pair_a_site_is_shown() -> None:
    pairs = [pair(f"{site}_{k}.tif") for site, k in product("abcdef", range(2))]
    assert [item.name for item in chosen_pairs(pairs)] == [
        "a_0.tif",
        "b_0.tif",
        "c_0.tif",
        "d_0.tif",
    ]


def test_tables_of_a_sweep_keep_their_words_on_the_page() -> None:
    mean, *_ = score(IDENTITY, [pair()], PLAIN, 0)
    dim = replace(mean, table="mean, radiance x 0.05")
    rest = [
        Row(name, "nominal", {"degraded": measured(7, "%", "a test")})
        for name in ("targets", "sweep, PSNR")
    ]
    about: dict[str, Any] = {"sensors": (DEGRADED, REFERENCE), "methods": [], "pairs": []}
    report = evaluation_report(Evaluation(rows=(mean, dim, *rest), **about), [])
    titles = ["Means over all pairs", "Mean, radiance x 0.05", "Targets", "Sweep, PSNR"]
    assert [table.title for table in report.tables] == titles
    assert len({table.caption for table in report.tables}) == len(titles)


def test_the_command_on_a_folder_of_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few_targets(monkeypatch)
    folder = write_pairs(tmp_path / "pairs", [pair("a_1.tif", 1), pair("b_1.tif", 2)])
    files = "--json", tmp_path / "e.json", "--out", tmp_path / "out"
    done("evaluate", "--pairs", folder, "--methods", "traditional-fast", *files)
    document = valid(tmp_path / "e.json")
    assert [entry["name"] for entry in document["inputs"]] == ["a_1.tif", "b_1.tif"] * 2
    assert document["arguments"]["methods"] == "degraded,traditional-fast"
    names = [row["name"] for row in document["rows"] if row["table"] == "mean"]
    assert names == ["degraded", "traditional-fast", "paper: traditional", "paper: ConvBEERS"]
    of_paper = [row for row in document["rows"] if row["name"].startswith("paper")]
    modes = {figure["mode"] for figure in figures_of(of_paper)}
    assert modes == {"published", "unavailable"}
    assert (tmp_path / "out" / "report.html").read_text().count("data:image/png") == 2
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.png", "b.png", "report.html"]


def test_brightness_scales_the_scenes_before_they_are_acquired() -> None:
    """The signal is a quarter; the noise is less than that of the full light, and more than a
    quarter of it.
    """
    scenes = [procedural_scene(400, 430, np.random.default_rng(3))]
    (bright,), _ = simulate_pairs(scenes, DEGRADED, REFERENCE, 7)
    (dim,), _ = simulate_pairs(scenes_at(0.25, scenes), DEGRADED, REFERENCE, 7)
    assert bright.noise_free is not None
    assert dim.noise_free is not None
    unclipped = bright.reference < SENSORS[1].max_dn
    np.testing.assert_allclose(
        4 * dim.noise_free[unclipped], bright.noise_free[unclipped], rtol=1e-3, atol=0.1
    )
    noise, dim_noise = (
        float((item.reference - item.noise_free)[unclipped].std()) for item in (bright, dim)
    )
    assert noise / 4 < dim_noise < noise


@pytest.mark.parametrize("brightness", [(0.0,), (1.5,), (-0.25,), (float("nan"),), (float("inf"),)])
def test_a_brightness_out_of_range_is_refused(brightness: tuple[float, ...]) -> None:
    with pytest.raises(OptionError, match=r"`brightness` .* above 0 and at most 1"):
        evaluate(methods=["degraded"], brightness=brightness)


@pytest.mark.parametrize(
    "options", [{"brightness": (1.0, 0.25)}, {"sweep": True}, {"images": "scenes"}]
)
def test_what_simulates_pairs_has_no_effect_with_given_ones(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=f"`{next(iter(options))}` has no effect with `pairs`"):
        evaluate(methods=["degraded"], pairs=[], **options)


@pytest.mark.parametrize("text", [",", "a quarter", "0.25,,0.05"])
def test_a_brightness_that_is_no_number_is_one_sentence(text: str, tmp_path: Path) -> None:
    write_tiff(tmp_path / "scene.tif", np.ones((400, 400), np.uint16))
    message = refused("evaluate", "--images", tmp_path, "--brightness", text)
    assert message.startswith("beers-deploy: --brightness must be numbers separated by commas")


def test_the_command_at_two_brightnesses_on_photographs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few_targets(monkeypatch)
    scene = np.random.default_rng(0).integers(200, 3000, (270, 300)).astype(np.uint16)
    write_tiff(tmp_path / "scenes" / "zebra_DJI_0005.tif", scene)
    write_tiff(tmp_path / "scenes" / "zebra_DJI_0013.tif", scene[::-1])
    dim = ", radiance x 0.05"
    files = ("--images", tmp_path / "scenes", "--json", tmp_path / "e.json")
    done("evaluate", *files, "--methods", "degraded", "--brightness", "0.05")
    document = valid(tmp_path / "e.json")
    assert document["arguments"]["brightness"] == "1,0.05"
    tables: dict[str, list[dict[str, Any]]] = {}
    for row in document["rows"]:
        tables.setdefault(row["table"], []).append(row)
    assert list(tables)[:3] == ["mean", f"mean{dim}", "targets"]
    assert [row["name"] for row in tables["PSNR by site"]] == ["zebra"]
    assert len(tables["images"]) == len(tables[f"images{dim}"]) == 2
    means = [tables[name][0]["figures"] for name in ("mean", f"mean{dim}")]
    # PSNR is over the same full scale at both brightnesses, and noise falls with the light.
    assert means[1]["PSNR"]["value"] > means[0]["PSNR"]["value"] + 10
    assert {"MTF at Nyquist", "SNR at 10 W/m2/sr/um"} <= set(means[0]) - set(means[1])
