import re
from dataclasses import replace

import numpy as np
import pytest

from beers_deploy.model.io.pictures import busiest_windows, picture_url, stretch_of, strip
from beers_deploy.profiles.figures import Row, measured, predicted, unavailable
from beers_deploy.report.page import Picture, Report, Section, render


def report() -> Report:
    figures = {
        "latency": predicted(1.25, "s", (1.0, 2.0), "a cost model"),
        "PSNR": measured(41.5, "dB", "a pair"),
        "power": unavailable("W", "no counter on this <machine>"),
    }
    table = Section("Times", [Row("bench", "network & more", figures)], "a caption")
    picture = Picture("a crop", picture_url(np.zeros((4, 5), np.uint8)), "what it shows")
    return Report("A title", "A headline.", [table], [picture], ["a note"])


def test_every_number_shows_its_mode_and_source() -> None:
    page = render(report())
    for text in ("1.25 [1, 2]", "predicted", "a cost model", "41.5", "measured", "a note"):
        assert text in page


def test_no_interval_breaks_within_its_brackets() -> None:
    page = render(replace(report(), headline="It takes 7 [4, 11] s."))
    assert "It takes 7 [4,\N{NO-BREAK SPACE}11] s." in page
    assert re.search(r"td\.predicted.*white-space: nowrap", page)
    assert 'class="predicted"' in page


def test_the_page_asks_the_network_for_nothing() -> None:
    page = render(report())
    for word in ("http://", "https://", 'src="/', "<script", "@import", "url("):
        assert word not in page


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("shape", [(1, 1), (1, 90), (30, 1), (2, 2)])
def test_an_image_without_a_gradient_has_one_window(shape: tuple[int, int]) -> None:
    assert busiest_windows(np.ones(shape), 20) == [(0, 0)]


def test_the_busiest_window_lies_on_the_texture() -> None:
    dn = np.full((90, 130), 500.0)
    dn[50:80, 90:120] += np.random.default_rng(0).integers(0, 800, (30, 30))
    (_, _), (top, left) = busiest_windows(dn, 20)
    assert 40 <= top <= 70
    assert 80 <= left <= 110


def test_compared_crops_share_one_stretch() -> None:
    dark = np.full((30, 40), 100.0)
    bright = np.full((30, 40), 900.0)
    stretch = stretch_of(np.concatenate([dark, bright]))
    picture = np.asarray(strip({"dark": dark, "bright": bright}, [(0, 0)], 20, 2, stretch))
    assert picture[-9, 0] < 20
    assert picture[-9, -1] > 235
