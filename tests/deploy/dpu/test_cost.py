import math
from pathlib import Path

import numpy as np
import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.cost.host import placed_work
from beers_deploy.dpu.cost.latency import WIDTHS
from beers_deploy.dpu.cost.model import PARTS, frame_rate, shares_of
from beers_deploy.dpu.cost.work import BURST_BYTES, Work, count_work
from beers_deploy.performance.swath import predict_network
from beers_deploy.profiles.errors import ModelError
from tests.deploy.dpu.draws import DPU, placed
from tests.deploy.dpu.graphs import (
    SAME,
    board_convbeers,
    float_convbeers,
    integer_convbeers,
    written,
)

PAPER_FPS = 7.2


def test_the_papers_network(tmp_path: Path) -> None:
    """The network has 35 convolutions and 17 adds. Every map of 26.2 MB is stored and loaded again,
    and each add loads one.

    The interval contains the rate that the paper measured, although no constant was fitted to it.
    """
    prediction = predict_network(float_convbeers(tmp_path / "f.onnx", 16, 64), DPU)
    assert prediction.operations == pytest.approx(997.5e9, rel=1e-3)
    wide = 64 * 640 * 640
    image = 640 * 640
    moves = image + wide + 33 * 2 * wide + 17 * wide + wide + image
    assert prediction.streamed_bytes == moves
    low, high = prediction.fps_interval
    assert low < PAPER_FPS < high


def test_the_three_encodings_cost_the_same(tmp_path: Path) -> None:
    makers = (float_convbeers, integer_convbeers, board_convbeers)
    costs = [
        predict_network(make(tmp_path / f"{k}.onnx", 2, 32), DPU, 192)
        for k, make in enumerate(makers)
    ]
    assert len({(c.batch_time_s, c.operations, c.streamed_bytes) for c in costs}) == 1


def test_maps_that_fit_the_banks_do_not_stream(tmp_path: Path) -> None:
    """64 channels of 128 x 128 are exactly 1 MiB; one pixel more streams.

    Three operations read the head's result, so it is always stored once and loaded three times, by
    a convolution and two adds.
    """
    path = float_convbeers(tmp_path / "f.onnx", 1, 64)
    assert predict_network(path, DPU, 128).streamed_bytes == 2 * 128 * 128 + 4 * 64 * 128 * 128
    assert predict_network(path, DPU, 129).streamed_bytes == 2 * 129 * 129 + 10 * 64 * 129 * 129


@pytest.mark.parametrize(
    ("board", "rows", "columns", "parallel"),
    [("vck190", 8, 4, 32), ("zcu102", 8, 1, 16), ("vek280", 4, 8, 32)],
)
def test_unused_rows_columns_and_channels_of_the_array_take_time_too(
    tmp_path: Path, board: str, rows: int, columns: int, parallel: int
) -> None:
    """The three columns of the first layer's one channel enter the array together, not in turn."""
    path = float_convbeers(tmp_path / "f.onnx", 1, 40)
    head, wide = (layer.work for layer in predict_network(path, load_dpu(board), 97).layers[:2])
    pixels = (math.ceil(97 / rows) * rows) * (math.ceil(97 / columns) * columns)
    channels = math.ceil(40 / parallel) * parallel
    assert head.array_operations == 2 * 3 * parallel * channels * pixels
    assert wide.array_operations == 2 * 9 * channels**2 * pixels
    assert wide.array_use == 2 * 9 * 40**2 * 97**2 / wide.array_operations


def works_of(nodes: str, channels: int, side_px: int) -> tuple[Work, ...]:
    """Return the work of each layer of a network."""
    return count_work(placed(written(nodes, channels), side_px).core, DPU)


def moved(works: tuple[Work, ...]) -> int:
    """Return the map bytes that an image moves."""
    return sum(work.map_bytes for work in works)


def test_the_input_of_three_branches_passes_through_memory() -> None:
    """Three branches load their stored input three times. The input of two stays on the chip."""
    maps = {}
    burst = BURST_BYTES / 16
    for branches in (2, 3):
        names = [f"b{k}" for k in range(branches)]
        nodes = f"""
            stem = {SAME}(image, w16x16x3x3)
            {" ".join(f"{name} = Conv(stem, w16x16x1x1)" for name in names)}
            joined = Concat<axis=1>({", ".join(names)}) y = Conv(joined, w8x{16 * branches}x1x1)
        """
        maps[branches] = moved(works_of(nodes, 16, 32)) / (16 * 32 * 32)
    image = 1
    result = 0.5
    assert maps == {2: image + 2 * burst + 2 + result, 3: image + 1 + 3 + 3 * burst + 3 + result}


@pytest.mark.parametrize("channels", [(16, 48), (64, 100), (200, 3)])
def test_the_inputs_of_a_concat_are_stored_in_bursts_and_loaded_again(
    channels: tuple[int, int],
) -> None:
    first, second = channels
    nodes = f"""
        a = {SAME}(image, w{first}x8x3x3) b = {SAME}(image, w{second}x8x3x3)
        joined = Concat<axis=1>(a, b) y = Conv(joined, w8x{first + second}x1x1)
    """
    works = works_of(nodes, 8, 33)
    padded_channels = [BURST_BYTES * math.ceil(count / BURST_BYTES) for count in channels]
    assert [work.store_map_bytes for work in works] == [
        33 * 33 * count for count in (*padded_channels, 0, 8)
    ]
    assert works[-1].load_map_bytes == 33 * 33 * sum(channels)


@pytest.mark.parametrize(("side", "maps"), [(97, 0), (257, 1)])
@pytest.mark.parametrize("convs", [1, 2])
def test_an_add_of_maps_beyond_the_chip_loads_one_of_them(side: int, maps: int, convs: int) -> None:
    """The other map comes from the operation before. Maps that fit on the chip are not moved."""
    chain = " ".join(f"x{k + 1} = {SAME}(x{k}, w32x32x3x3)" for k in range(convs))
    nodes = f"x0 = {SAME}(image, w32x32x3x3) {chain}"
    without, added = (
        moved(works_of(f"{nodes} sum = {last} y = Conv(sum, w8x32x1x1)", 32, side))
        for last in (f"Identity(x{convs})", f"Add(x{convs}, x0)")
    )
    assert added - without == maps * 32 * side * side


@pytest.mark.parametrize("board", ["vck190", "zcu104"])
def test_the_load_of_an_add_is_not_hidden(tmp_path: Path, board: str) -> None:
    """The load takes two to three times as long as a convolution's maps of the same size."""
    path = float_convbeers(tmp_path / "f.onnx", 1, 64)
    layers = predict_network(path, load_dpu(board), 640).layers
    add = next(layer for layer in layers if layer.work.serial)
    conv = layers[1]
    assert not conv.work.serial
    pace = (add.memory_s / add.work.map_bytes) / (conv.memory_s / conv.work.map_bytes)
    assert 1.9 < pace < 3.1


@pytest.mark.parametrize("block", [2, 4])
def test_a_pixel_shuffle_costs_the_bursts_of_its_pieces(block: int) -> None:
    """The three channels of each pixel take a burst. The host shuffles at the network's end."""
    map_bytes = {}
    wide = f"w{3 * block**2}x3x3x3"
    nodes = f"a = {SAME}(image, {wide}) b = DepthToSpace<blocksize={block}>(a)"
    for place_in, end, count in (("end", "Identity(b)", 1), ("middle", "Conv(b, w3x3x1x1)", 2)):
        works = works_of(f"{nodes} y = {end}", 3, 512)
        assert len(works) == count
        map_bytes[place_in] = works[0].store_map_bytes
    values = 3 * block**2 * 512 * 512
    assert map_bytes == {"end": values, "middle": values // 3 * BURST_BYTES}


@pytest.mark.parametrize(("kernel", "stride", "taps"), [(2, 2, 1), (3, 2, 2), (4, 2, 2), (9, 3, 3)])
def test_a_transposed_convolution_runs_as_one_convolution_for_each_phase(
    kernel: int, stride: int, taps: int
) -> None:
    """Each phase has every s-th tap, padded, and as many output pixels as the image has.

    So the DPU computes no inserted zeros.
    """
    window = f"strides={[stride] * 2}, pads={[0, 0, kernel - stride, kernel - stride]}"
    grown = f"y = ConvTranspose<{window}>(image, w32x32x{kernel}x{kernel})"
    (work,) = works_of(grown, 32, 64)
    phase = f"y = Conv<pads={[0, 0, taps - 1, taps - 1]}>(image, w32x32x{taps}x{taps})"
    (other,) = works_of(phase, 32, 64)
    assert work.array_operations == stride**2 * other.array_operations
    assert (work.array_operations == work.operations) is (kernel % stride == 0)


def test_the_width_is_the_mean_of_the_widths_of_the_parts(tmp_path: Path) -> None:
    """Each part counts by how much the rate follows it: the DPU's parts for large maps, the host
    for a network with a softmax.
    """
    widths = [DPU.value("cost", WIDTHS[part]) for part in PARTS]
    path = float_convbeers(tmp_path / "f.onnx", 3, 32)
    large = predict_network(path, DPU, 640)
    ranked = predict_network(path, DPU, 128, "softmax")
    assert (large.bound, ranked.bound) == ("DPU", "host")
    for prediction in (large, ranked):
        assert min(widths) < prediction.width < max(widths)
        spread = math.exp(prediction.width)
        ends = (prediction.fps / spread, prediction.fps * spread)
        assert prediction.fps_interval == pytest.approx(ends)
    assert ranked.width == pytest.approx(DPU.value("cost", WIDTHS["task"]), rel=0.1)


def test_beyond_the_fitted_networks_the_interval_is_no_narrower_than_the_widest(
    tmp_path: Path,
) -> None:
    path = float_convbeers(tmp_path / "f.onnx", 3, 32)
    inside, outside = (predict_network(path, DPU, side) for side in (640, 1024))
    assert inside.outside == ()
    assert any("largest map" in word for word in outside.outside)
    assert outside.width == DPU.value("cost", WIDTHS["outside"]) > inside.width


@pytest.mark.parametrize("contention_exponent", [2.0, 4.0])
def test_a_share_is_how_much_the_rate_follows_the_part(contention_exponent: float) -> None:
    """If a part takes 0.01 % longer, the rate falls by its share of 0.01 %."""
    parts = np.array([3.0, 0.5, 2, 0.1, 1.5, 2])
    shares = shares_of(parts[None, :4], parts[None, 4:], contention_exponent)[0]
    assert shares.sum() == pytest.approx(1)
    for k, share in enumerate(shares):
        longer = parts * np.where(np.arange(6) == k, 1.0001, 1)
        rates = [frame_rate(p[:4].sum(), p[4:].sum(), contention_exponent) for p in (parts, longer)]
        assert math.log(rates[0] / rates[1]) == pytest.approx(share * 1e-4, rel=1e-3)
    alone = shares_of(parts[None, :4], np.zeros((1, 2)), contention_exponent)[0]
    assert alone == pytest.approx([*(parts[:4] / parts[:4].sum()), 0, 0])


def test_a_network_without_convolutions_has_no_prediction() -> None:
    with pytest.raises(ModelError, match="no convolution"):
        predict_network(written("y = MaxPool<kernel_shape=[2,2]>(image)"), DPU)


@pytest.mark.parametrize(
    ("channels", "read"), [((255,), 3), ((255, 255), 6), ((80,), 80), ((3,), 3), ((324, 16), 340)]
)
def test_of_the_maps_of_yolo_a_sort_reads_one_score_for_each_box(
    channels: tuple[int, ...], read: int
) -> None:
    """YOLO has three boxes a pixel. Of other maps, such as the classes of SSD, a sort reads all."""
    maps = [f"y{k} = {SAME}(image, w{count}x8x3x3)" for k, count in enumerate(channels)]
    model = written(" ".join(maps), results=tuple(f"y{k}" for k in range(len(maps))))
    assert placed_work(placed(model, 32), "sort")[5] == pytest.approx(read * 32 * 32)


def test_latency_is_that_of_one_core_and_one_thread(tmp_path: Path) -> None:
    """Cores share the memory and the host, so one core and one thread are no slower alone."""
    path = float_convbeers(tmp_path / "n.onnx", 2, 16)
    zcu102 = load_dpu("zcu102")
    prediction = predict_network(path, zcu102)
    single = predict_network(path, load_dpu("kv260"))
    assert prediction.alone_s <= prediction.batch_time_s
    assert single.alone_s == pytest.approx(single.batch_time_s)
    assert prediction.latency_s == pytest.approx(
        prediction.alone_s + prediction.host_s * zcu102.whole("cpu", "cores")
    )
    assert 1 / prediction.latency_s < prediction.fps
