"""Bars of layers: one each, as high as its time, with its words under the pointer."""

import re
from itertools import pairwise
from xml.etree import ElementTree as ET

from deploy.report.layer_bars import SIZE_PX, LayerBars, layer_bars
from profiles.figures import Row, unavailable
from tests.deploy.tradeoff.studies import layer, layers


def drawn(found: LayerBars) -> dict[str, tuple[float, float, float, float]]:
    """Left, top, right and bottom of each bar by its title."""
    boxes = {}
    for group in ET.fromstring(found.svg).iterfind(".//g[@class='dot']"):  # noqa: S314 - our own
        title, path = group.findtext("title") or "", group.find("path")
        assert path is not None
        numbers = [float(number) for number in re.findall(r"-?[\d.]+", path.get("d") or "")]
        xs, ys = numbers[::2], numbers[1::2]
        boxes[title] = (min(xs), min(ys), max(xs), max(ys))
    return boxes


def test_every_layer_has_a_bar_and_the_sum_has_none() -> None:
    rows = layers(19)
    titles = list(drawn(layer_bars("net", rows)))
    assert [title.partition(":")[0] for title in titles] == [row.name for row in rows[:-1]]
    assert len(titles) == 20


def test_bars_are_as_high_as_their_times_and_stand_apart() -> None:
    rows = [layer("a", 1, bound="memory"), layer("b", 4, bound="compute"), layer("c", 0, bound="compute")]
    bars = list(drawn(layer_bars("net", rows)).values())
    heights = [bottom - top for _, top, _, bottom in bars]
    assert abs(heights[0] - heights[1] / 4) < 0.05
    assert 0.9 * SIZE_PX[1] < heights[1] <= SIZE_PX[1]
    assert heights[2] == 0
    assert {bar[3] for bar in bars} == {SIZE_PX[1]}
    assert all(one[2] < other[0] for one, other in pairwise(bars))
    assert bars[-1][2] <= SIZE_PX[0]


def test_the_caption_names_the_longest_layer_and_what_bounds_the_time() -> None:
    rows = [layer("a", 1, bound="memory"), layer("b", 3, bound="compute"), layer("sum", 4)]
    found = layer_bars("net", rows)
    assert found.caption.startswith("4 ms/batch in all; the highest bar is b, 3 [2.4, 4.5] ms/batch.")
    assert found.caption.endswith("compute 75%, memory 25%.")
    assert list(found.bounds) == ["memory", "compute"]
    assert len(set(found.bounds.values())) == 2


def test_layers_without_times_have_no_bars() -> None:
    rows = [Row("layers", "a", {"time": unavailable("ms/batch", "no board")}, {"bound": "memory"})]
    assert drawn(layer_bars("net", rows)) == {}
    assert layer_bars("net", rows).caption == "No layer has a time."
