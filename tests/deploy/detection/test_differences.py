"""Differences between rows are paired by draw, and their intervals say no more than the sites allow."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.detection.boxes import Boxes
from deploy.detection.differences import Differences, differences
from deploy.detection.matching import Image, Matched, match
from deploy.detection.scores import score
from tests.deploy.detection.drawn import NAMES, drawn_images

ONE = np.array([[10.0, 10.0, 40.0, 40.0]])


def row(shares: list[float], objects: int = 10) -> Matched:
    """A site an entry, of `objects` objects of which that share is found, and nothing false."""
    corners = np.array([[50.0 * i, 0, 50.0 * i + 30, 30] for i in range(objects)])
    truth = Boxes.of(corners, np.zeros(objects))
    images = [Image(truth, truth[: round(share * objects)], f"site {i}") for i, share in enumerate(shares)]
    return match(images, ("ship",))


def compared(rows: dict[str, Matched], draws: int = 200) -> Differences:
    return differences(rows, np.random.default_rng(0), draws)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_each_draw_is_the_score_of_the_images_drawn(seed: int) -> None:
    images = drawn_images(np.random.default_rng(seed), 4)
    found = differences({"a": match(images, NAMES)}, np.random.default_rng(seed), 5)
    drawn = np.random.default_rng(seed).multinomial(4, [0.25] * 4, size=5)
    for number, counts in enumerate(drawn):
        copies = [image for image, count in zip(images, counts, strict=True) for _ in range(count)]
        expected = score(match(copies, NAMES), confidence=found.confidence).figures()
        for figure, values in found.drawn["a"].items():
            np.testing.assert_allclose(values[number], expected[figure], rtol=0, atol=1e-12, err_msg=figure)


def test_a_row_does_not_differ_from_itself() -> None:
    matched = match(drawn_images(np.random.default_rng(1), 12), NAMES)
    found = compared({"reference": matched, "same": matched})
    for figure in found.scores["same"].figures():
        estimate = found.difference("same", "reference", figure)
        assert (estimate.value, estimate.interval) == (0.0, (0.0, 0.0))
        assert not estimate.told_from_zero


def test_pairing_tells_what_two_intervals_do_not() -> None:
    sites = np.linspace(0.1, 0.8, 12)
    found = compared({"reference": row(list(sites + 0.1)), "degraded": row(list(sites))})
    apart = [found.value(name, "ap50").interval for name in ("degraded", "reference")]
    assert apart[0] is not None
    assert apart[1] is not None
    assert apart[0][1] > apart[1][0]
    assert found.difference("degraded", "reference", "ap50").told_from_zero


def test_the_share_regained_is_that_of_the_loss() -> None:
    rows = {"reference": row([0.9] * 12), "degraded": row([0.3] * 12), "restored": row([0.6] * 12)}
    found = compared(rows)
    estimate = found.regained("restored", "degraded", "reference", "recall")
    assert estimate is not None
    assert estimate.value == pytest.approx(0.5)
    assert estimate.interval == pytest.approx((0.5, 0.5))


def test_no_share_is_given_of_a_loss_that_could_be_none() -> None:
    unsure = {"reference": row([0.9, 0.1] * 6), "degraded": row([0.1, 0.9] * 6), "restored": row([0.5] * 12)}
    found = compared(unsure)
    assert found.regained("restored", "degraded", "reference", "recall") is None
    assert not found.difference("degraded", "reference", "recall").told_from_zero


def test_frames_of_a_site_are_drawn_together() -> None:
    matched = row([0.9, 0.9, 0.1, 0.1])
    together = replace(matched, sites=("a", "a", "b", "b"))
    recalls = set(np.round(compared({"r": together}).drawn["r"]["recall"], 6))
    assert recalls == {0.1, 0.5, 0.9}


def test_a_class_that_no_site_of_a_draw_holds_drops_out_of_every_row() -> None:
    images = [Image(Boxes.of(ONE, [0]), Boxes.of(ONE, [0]), f"ship {i}") for i in range(3)]
    images += [Image(Boxes.of(ONE, [1]), Boxes.none(), f"tank {i}") for i in range(2)]
    found = compared({"reference": match(images, ("ship", "tank"))}, 400)
    assert set(found.drawn["reference"]["ap50"]) == {0.0, 0.5, 1.0}
    absent = np.isnan(found.drawn["reference"]["ap50 of tank"])
    assert 0 < absent.sum() < len(absent)
    assert found.value("reference", "ap50 of tank").interval == (0.0, 0.0)


def test_below_five_sites_there_is_no_interval_and_below_ten_it_is_said_to_be_narrow() -> None:
    four = compared({"r": row([0.5, 0.2, 0.9, 0.4])}, 50)
    assert four.value("r", "ap50").interval is None
    assert not four.difference("r", "r", "ap50").told_from_zero
    assert four.regained("r", "r", "r", "ap50") is None
    assert "of 4 sites, fewer than 5" in (four.warning or "")
    five = compared({"r": row([0.5, 0.2, 0.9, 0.4, 0.1])}, 50)
    assert five.value("r", "ap50").interval is not None
    assert "Only 5 sites" in (five.warning or "")
    assert "Only 9 sites" in (compared({"r": row([0.5] * 9)}, 3).warning or "")
    assert compared({"r": row([0.5] * 10)}, 3).warning is None


def test_every_row_is_read_at_the_first_one_s_confidence() -> None:
    images = drawn_images(np.random.default_rng(7), 10)
    halved = [replace(i, found=Boxes.of(i.found.corners, i.found.classes, i.found.scores / 2)) for i in images]
    first, other = match(images, NAMES), match(halved, NAMES)
    found = compared({"reference": first, "halved": other}, 5)
    assert found.confidence == score(first).confidence
    assert found.scores["halved"].fixed == score(other, confidence=found.confidence).fixed
    assert found.scores["halved"].fixed != found.scores["halved"].own


def test_the_same_generator_gives_the_same_intervals() -> None:
    matched = match(drawn_images(np.random.default_rng(2), 10), NAMES)
    values = [differences({"a": matched}, np.random.default_rng(5), 20).value("a", "ap") for _ in range(2)]
    assert values[0] == values[1]
    assert differences({"a": matched}, np.random.default_rng(6), 20).value("a", "ap") != values[0]


def test_rows_of_other_images_are_not_compared() -> None:
    with pytest.raises(ValueError, match="same images"):
        compared({"a": row([0.5, 0.5]), "b": row([0.5])})
