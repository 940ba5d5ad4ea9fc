"""Tests of the work that the cost model counts for one layer, against counts by hand."""

import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.cost.work import Work, count_work
from tests.deploy.dpu.draws import as_written, placed
from tests.deploy.dpu.graphs import SAME, written

SIDE_PX = 32
"""A multiple of all rows and columns that an engine computes at once."""


def works_of(
    nodes: str, channels: int, board: str = "vck190", side_px: int = SIDE_PX
) -> list[Work]:
    """Return the work of each layer of a network on a board."""
    dpu = load_dpu(board)
    return list(count_work(placed(written(nodes, channels), side_px, dpu).core, dpu))


def of_kind(works: list[Work], kind: str) -> Work:
    """Return the only work of a kind."""
    (work,) = (work for work in works if work.kind == kind)
    return work


@pytest.mark.parametrize(
    ("channels", "rows", "columns", "inputs"),
    [
        # The ZCU102 reads 16 inputs at a time: three columns of ten channels as 30 of 32.
        (10, 1, 3, 32),
        (10, 1, 5, 32 + 32),
        # One column is left over, for which 16 inputs suffice.
        (10, 1, 7, 32 + 32 + 16),
        # Columns enter together, rows in turn.
        (10, 5, 1, 5 * 16),
        (20, 1, 3, 3 * 32),
    ],
)
def test_the_columns_of_a_window_enter_the_array_together(
    channels: int, rows: int, columns: int, inputs: int
) -> None:
    pads = f"pads={[rows // 2, columns // 2] * 2}"
    nodes = f"y = Conv<{pads}>(image, w16x{channels}x{rows}x{columns})"
    (work,) = works_of(nodes, channels, "zcu102")
    assert work.array_operations == 2 * inputs * 16 * SIDE_PX**2


@pytest.mark.parametrize(
    ("node", "channels", "results", "taps"),
    [
        ("MaxPool<kernel_shape=[3,5], pads=[1,2,1,2]>(a)", 16, 16, 15),
        # Nine channels take the place of 16.
        ("MaxPool<kernel_shape=[3,3], pads=[1,1,1,1]>(a)", 9, 9, 9),
        ("Add(a, b)", 16, 16, 1),
        ("Conv<pads=[1,1,1,1], group=16>(a, w16x1x3x3)", 16, 16, 9),
        # Two results of each channel take two passes.
        ("Conv<pads=[1,1,1,1], group=16>(a, w32x1x3x3)", 16, 32, 18),
    ],
)
def test_the_engine_of_single_values_reads_each_value_of_each_window(
    node: str, channels: int, results: int, taps: int
) -> None:
    size = f"w{channels}x{channels}x3x3"
    nodes = f"a = {SAME}(image, {size}) b = {SAME}(a, {size}) c = {node}"
    # The simplifier would replace a convolution of two results a channel, which other quantisers
    # write.
    with as_written():
        works = works_of(f"{nodes} y = {SAME}(c, w8x{results}x3x3)", channels)
    (work,) = (work for work in works if work.lane_steps)
    assert work.lane_steps == taps * 16 * SIDE_PX**2
    assert work.array_operations == 0


def test_the_rows_of_the_engine_of_single_values_are_filled_up() -> None:
    """The ZCU102's engine computes four rows at once, although its array computes eight."""
    nodes = f"a = {SAME}(image, w16x16x3x3) p = MaxPool<kernel_shape=[1,1]>(a)"
    works = works_of(f"{nodes} y = {SAME}(p, w8x16x3x3)", 16, "zcu102", 17)
    (work,) = (work for work in works if work.lane_steps)
    assert work.lane_steps == 16 * 20 * 17


def test_a_factor_for_each_channel_is_no_second_map() -> None:
    """Channel attention multiplies a map by one value a channel, so no second map is loaded."""
    nodes = f"a = {SAME}(image, w32x32x3x3) m = GlobalAveragePool(a)"
    gate = f"{nodes} f = Conv(m, w32x32x1x1) b = {{}} y = {SAME}(b, w8x32x3x3)"
    side_px = 257
    gated = of_kind(works_of(gate.format("Mul(a, f)"), 32, side_px=side_px), "mul")
    summed = of_kind(works_of(gate.format("Add(a, image)"), 32, side_px=side_px), "add")
    assert summed.serial
    assert not gated.serial


def test_a_sum_does_not_load_what_the_layer_before_it_read() -> None:
    """Three layers read the first map, so it passes through memory. The sum finds it on the chip,
    because the convolution that it is fused with has loaded it.
    """
    nodes = f"""
        x = {SAME}(image, w16x16x3x3) b = {SAME}(x, w16x16x3x3)
        a = {SAME}(x, w16x16x3x3) s = Add(a, x)
        joined = Concat<axis=1>(s, b) y = Conv(joined, w8x32x1x1)
    """
    _, other, fused, summed, *_ = works_of(nodes, 16)
    assert summed.kind == "add"
    map_bytes = 16 * SIDE_PX**2
    assert [work.load_map_bytes for work in (other, fused, summed)] == [map_bytes, map_bytes, 0]
