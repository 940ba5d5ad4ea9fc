"""Tests of the scores of restored pairs: which pixels count, biases, and means by site."""

from dataclasses import replace

import numpy as np
import pytest

from beers_deploy.model.metrics.fidelity import fidelity_db
from beers_deploy.model.shipped import shipped_names
from beers_deploy.network import Network
from beers_deploy.profiles.figures import by_table
from beers_deploy.studies.evaluation.methods import BLIND, Method
from beers_deploy.studies.evaluation.pairs import NamedPair
from beers_deploy.studies.evaluation.scores import (
    BIAS,
    INNER,
    INNER_BORDER_PX,
    INNER_NOISE_FREE,
    LARGEST_BIAS,
    NOISE_FREE,
    READ,
    bias_percent,
    inner_border_px,
    inner_note,
    score,
    site_rows,
)
from beers_deploy.tables.columns import missing
from tests.deploy.studies.evaluation.small_pairs import (
    IDENTITY,
    PLAIN,
    pair,
)


def test_clipped_pixels_do_not_count() -> None:
    """Above full scale the truth is unknown, in the reference as in the input (trap 17)."""
    one = pair()
    one.reference[3:9, 5:11] = 4095
    one.degraded[20:25, 5:11] = 4095
    restored = one.degraded.copy()
    before = fidelity_db(restored, one.reference, one.degraded)
    restored[[*range(3, 9), *range(20, 25)], 5:11] = 100
    assert fidelity_db(restored, one.reference, one.degraded) == before
    restored[30, 30] += 500
    assert fidelity_db(restored, one.reference, one.degraded) < before
    white = np.full((12, 13), 4095, np.float32)
    # If the whole image is clipped, no pixel is left out.
    assert fidelity_db(white - 1, white, white) == pytest.approx(20 * np.log10(4095))


def test_the_degraded_input_gains_nothing_and_missing_figures_have_a_reason() -> None:
    pairs = [pair(f"{site}.tif", seed) for seed, site in enumerate("abcde")]
    mean, *images = score(IDENTITY, pairs, PLAIN, 0)
    assert mean.figures["PSNR gain"].value == 0
    assert len(images) == 5
    assert mean.figures["LPIPS-squeeze"].reason == "no weights"
    reasons = [f"{NOISE_FREE}, {INNER_NOISE_FREE}: {READ}", "LPIPS-squeeze: no weights"]
    assert missing([mean, *images]) == reasons
    low, high = mean.figures["PSNR"].interval or (0, 0)
    assert low <= (mean.figures["PSNR"].value or 0) <= high
    assert NOISE_FREE not in {row.table.removesuffix(" by site") for row in site_rows(images)}
    few, *_ = score(IDENTITY, pairs[:4], PLAIN, 0)
    assert few.figures["PSNR"].interval is None
    assert "no interval: 4 sites, fewer than 5" in few.figures["PSNR"].source


@pytest.mark.parametrize(("height", "width"), [(37, 45), (300, 131)])
def test_errors_in_the_border_do_not_count_for_inner_pixels(height: int, width: int) -> None:
    border_px = inner_border_px(height, width)
    generator = np.random.default_rng(height)
    clean = generator.uniform(100, 3000, (height, width)).astype(np.float32)
    noisy = clean + generator.normal(0, 40, clean.shape).astype(np.float32)
    inside = np.zeros((height, width), bool)
    inside[border_px : height - border_px, border_px : width - border_px] = True
    assert inside.sum(0).max() >= height / 2
    restored = clean + np.where(inside, 2, 400).astype(np.float32)
    scores = PLAIN.score(restored, NamedPair("a", clean, noisy, noise_free=clean))
    assert scores[INNER_NOISE_FREE] == pytest.approx(20 * np.log10(4095 / 2), abs=1e-3)
    assert scores[INNER] == pytest.approx(20 * np.log10(4095 / 40), abs=0.5)
    whole = fidelity_db(restored, clean, clean)
    assert whole < 30
    assert scores[NOISE_FREE] == whole != scores["PSNR"]
    assert scores[BIAS] == pytest.approx(200 / clean[inside].mean(), rel=1e-3)


def test_the_border_covers_every_shipped_networks_halo_and_is_narrower_in_small_images() -> None:
    reach_of_the_consistency_step_px = 19
    halos_px = [Network.load(name).tiling.halo_px for name in shipped_names()]
    assert max(halos_px) + reach_of_the_consistency_step_px == INNER_BORDER_PX
    assert inner_border_px(4 * INNER_BORDER_PX, 999) == INNER_BORDER_PX
    assert inner_border_px(101, 60) == 15
    large = NamedPair("large", *(np.ones((4 * INNER_BORDER_PX, 230), np.float32),) * 2)
    assert not inner_note([large])
    assert "(1 of 2)" in inner_note([large, pair()])


def test_the_largest_bias_is_that_of_the_worst_image_with_its_sign() -> None:
    perfect = [
        replace(pair(f"{name}.tif", 1), degraded=pair(seed=1).reference)
        for name in ("a_1", "b_1", "b_2")
    ]
    factors = iter((1.01, 0.96, 1.02))
    mean, *images = score(
        Method("drifts", lambda dn: dn * np.float32(next(factors)), BLIND), perfect, PLAIN, 0
    )
    for row, percent in zip((mean, *images), (-1 / 3, 1, -4, 2), strict=True):
        assert row.figures[BIAS].value == pytest.approx(percent, abs=1e-3)
        assert row.figures[BIAS].unit == "%"
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
    mean, _ = score(IDENTITY, [NamedPair("a", black, black)], PLAIN, 0)
    assert mean.figures[BIAS].reason == "the reference is black"
    assert mean.figures["PSNR"].value is None
    assert "identical" in mean.figures["PSNR"].reason


def test_sites_are_means_of_their_images() -> None:
    pairs = [pair("a_1.tif", 1, 10), pair("a_2.tif", 2, 40), pair("b_1.tif", 3, 20)]
    _, *images = score(IDENTITY, pairs, PLAIN, 0)
    rows = site_rows(images)
    colon = score(replace(IDENTITY, name="degraded: more"), pairs, PLAIN, 0)[1:]
    both = site_rows([*images, *colon])[0].figures
    assert both["degraded"] == both["degraded: more"] == rows[0].figures["degraded"]
    keys = ["PSNR", INNER, BIAS, "SSIM"]
    assert list(by_table(rows)) == [f"{key} by site" for key in keys]
    known = [replace(one, noise_free=one.reference) for one in pairs]
    more = by_table(site_rows(score(IDENTITY, known, PLAIN, 0)[1:]))
    assert {f"{NOISE_FREE} by site", f"{INNER_NOISE_FREE} by site"} < set(more)
    first, second = rows[:2]
    levels = [row.figures["PSNR"].value or 0 for row in images]
    assert (first.name, second.name) == ("a", "b")
    assert first.figures["degraded"].value == pytest.approx(sum(levels[:2]) / 2)
    assert second.figures["degraded"].value == pytest.approx(levels[2])
    assert (first.text["images"], second.text["images"]) == ("2", "1")
