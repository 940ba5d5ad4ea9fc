"""Interleaved times, and ratios of them."""

import time

import numpy as np
import pytest

from deploy.tradeoff.host_time import ROUNDS, Times, host_figures, ratio_interval, time_variants
from model.evaluation.methods import Restore


def times(scale: float = 1.0, session: str = "one") -> Times:
    wall_s = scale * (1 + 0.5 * np.random.default_rng(0).random(ROUNDS))
    return Times(session, tuple(wall_s.tolist()), tuple(wall_s.tolist()), 10_000)


def test_variants_are_interleaved_after_one_run_for_warm_up() -> None:
    ran = []

    def method(name: str, pause_s: float) -> Restore:
        def restore(dn: np.ndarray) -> np.ndarray:
            ran.append(name)
            time.sleep(pause_s)
            return dn

        return restore

    ticks = []
    found = time_variants([method("a", 0), method("b", 0.005)], np.zeros((4, 5), np.float32), lambda: ticks.append(1))
    assert ran == ["a", "b"] * (ROUNDS + 1)
    assert len(ticks) == ROUNDS + 1
    assert found[0].session == found[1].session
    assert min(found[1].wall_s) >= 0.005
    assert max(found[1].cpu_s) < min(found[1].wall_s)  # it slept
    assert found[0].pixels == 20


def test_times_come_back_and_damage_is_refused() -> None:
    kept = times()
    assert Times.from_json(kept.to_json()) == kept
    for key, spoilt in (("wall_s", []), ("cpu_s", [1.0])):
        with pytest.raises(ValueError, match="no rounds"):
            Times.from_json({**kept.to_json(), key: spoilt})


def test_figures_are_for_a_megapixel_of_the_image_halo_included() -> None:
    plain, doubled = (host_figures(times(), factor, "a runtime", 0) for factor in (1.0, 2.0))
    assert plain["host p50"].value == pytest.approx(100 * np.median(times().wall_s))
    assert doubled["host p50"].value == pytest.approx(2 * (plain["host p50"].value or 0))
    for figures in (plain, doubled):
        low, high = figures["host p50"].interval or (0, 0)
        assert low <= (figures["host p50"].value or 0) <= high
        assert (figures["host p90"].value or 0) >= (figures["host p50"].value or 0)


def test_in_one_session_what_hits_both_cancels() -> None:
    """Rounds that scatter by a half do not hide a tenth, because both met the same rounds."""
    a, b = times(1.1).per_megapixel(1), times().per_megapixel(1)
    assert ratio_interval(a, b, paired=True, seed=0) == pytest.approx((1.1, 1.1))
    low, high = ratio_interval(a, b, paired=False, seed=0)
    assert low < 1 < 1.1 < high
