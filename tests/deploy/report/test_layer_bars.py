from itertools import pairwise

from deploy.report.layer_bars import HEIGHT, WIDTH, layer_bars
from profiles.figures import Row, unavailable
from tests.deploy.report.studies import layer, layers


def test_every_layer_has_a_bar_and_the_sum_has_none() -> None:
    rows = layers(19)
    bars = layer_bars(rows).bars
    assert len(bars) == 20
    assert not any(bar.title.startswith("sum") for bar in bars)
    assert [bar.title.partition(":")[0] for bar in bars] == [row.name for row in rows[:-1]]


def test_bars_are_as_high_as_their_times_and_stand_apart() -> None:
    rows = [layer("a", 1, bound="memory"), layer("b", 4, bound="compute"), layer("c", 0, bound="compute")]
    bars = layer_bars(rows).bars
    assert [bar.height for bar in bars] == [HEIGHT / 4, HEIGHT, 0]
    assert all(bar.y + bar.height == HEIGHT for bar in bars)
    assert all(one.x + one.width < other.x for one, other in pairwise(bars))
    assert bars[-1].x + bars[-1].width <= WIDTH


def test_the_caption_names_the_longest_layer_and_what_bounds_the_time() -> None:
    rows = [layer("a", 1, bound="memory"), layer("b", 3, bound="compute"), layer("sum", 4)]
    found = layer_bars(rows)
    assert found.caption.startswith("4 ms/batch in all; the highest bar is b, 3 [2.4, 4.5] ms/batch.")
    assert found.caption.endswith("compute 75%, memory 25%.")
    assert found.bounds == ("memory", "compute")


def test_layers_without_times_have_no_bars() -> None:
    rows = [Row("layers", "a", {"time": unavailable("ms/batch", "no board")}, {"bound": "memory"})]
    assert layer_bars(rows).bars == ()
    assert layer_bars(rows).caption == "No layer has a time."
