"""Restoration and detection on one DPU: times add up, and with them the ends of their intervals."""

from pathlib import Path

import onnx
import pytest

from deploy.bench.pair import pair_on_board
from deploy.dpu.board import load_dpu
from deploy.export import to_onnx
from model.convbeers import ConvBEERS
from model.detection.export import detector_to_onnx
from model.detection.network import DetectorNetwork
from model.variants import Variant
from profiles.errors import ModelError
from profiles.figures import Row

SIDE_PX = 64


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("pair")
    restorer, detector = folder / "restorer.onnx", folder / "detector.onnx"
    onnx.save(to_onnx(ConvBEERS(Variant(2, 8)), {}), restorer)
    onnx.save(detector_to_onnx(DetectorNetwork(2).eval(), ("a", "b"), SIDE_PX, {}), detector)
    return restorer, detector


def interval(row: Row, name: str) -> tuple[float, float, float]:
    figure = row.figures[name]
    assert figure.mode == "predicted"
    assert figure.value is not None
    assert figure.interval is not None
    return figure.interval[0], figure.value, figure.interval[1]


@pytest.mark.parametrize("board", ["vck190", "zcu102"])
def test_the_times_of_the_two_add_up(files: tuple[Path, Path], board: str) -> None:
    restoration, detection, both = pair_on_board(*files, load_dpu(board, None))
    parts = zip(interval(restoration, "time"), interval(detection, "time"), strict=True)
    assert interval(both, "time") == pytest.approx([a + b for a, b in parts])
    for row in (restoration, detection, both):
        times, rates = interval(row, "time"), interval(row, "throughput")
        assert rates == pytest.approx([1e3 / time for time in reversed(times)])
        assert times[0] < times[1] < times[2]
        assert row.text["frame"] == "64 x 64"


def test_the_efficiency_counts_each_pixel_of_the_frame_once(files: tuple[Path, Path]) -> None:
    *_, both = pair_on_board(*files, load_dpu("vck190", None))
    watts, rates = interval(both, "power"), interval(both, "throughput")
    wanted = [SIDE_PX**2 * rate / watt for rate, watt in zip(rates, reversed(watts), strict=True)]
    assert interval(both, "efficiency") == pytest.approx(wanted)


def test_a_detector_of_any_size_is_one_sentence(files: tuple[Path, Path]) -> None:
    with pytest.raises(ModelError, match="a detector of one size"):
        pair_on_board(files[0], files[0], load_dpu("vck190", None))
