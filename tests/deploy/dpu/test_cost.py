import math
from pathlib import Path

import pytest

from deploy.bench import PAPER_TILE_PX, predict_file
from deploy.dpu.board import load_dpu
from deploy.dpu.cost import Prediction, layer_time_s
from profiles.errors import ModelError
from tests.deploy.dpu.graphs import (
    Sketch,
    board_convbeers,
    float_convbeers,
    integer_convbeers,
)

DPU = load_dpu()
PAPER_FPS = 7.2

# ResNet-50, 7.7 GOP, 25.5 MB of weights, frames a second by configuration (Vitis-AI issue 672).
RESNET50_FPS = {
    "C32B1": 482,
    "C32B2": 962,
    "C32B3": 1436,
    "C32B4": 1912,
    "C32B5": 2241,
    "C32B6": 2846,
    "C64B1": 627,
    "C64B2": 1244,
    "C64B3": 1861,
    "C64B4": 2477,
    "C64B5": 2717,
}


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's network: 16 blocks of 64 features."""
    return float_convbeers(tmp_path_factory.mktemp("cost") / "convbeers.onnx", 16, 64)


@pytest.fixture(scope="module")
def papers_prediction(papers: Path) -> Prediction:
    return predict_file(papers, DPU, PAPER_TILE_PX)


def test_the_papers_network(papers_prediction: Prediction) -> None:
    """35 convolutions; the 484 GMAC of 34 give 9.1 frames a second, the body end's 15 GMAC more take 3 %."""
    assert papers_prediction.operations == pytest.approx(997.5e9, rel=1e-3)
    assert papers_prediction.streamed_bytes == pytest.approx(2.23e9, rel=1e-2)
    assert papers_prediction.fps == pytest.approx(9.1, rel=0.03)


def test_the_interval_holds_the_published_figure(papers_prediction: Prediction) -> None:
    low, high = papers_prediction.fps_interval
    assert low < PAPER_FPS < high
    assert low < papers_prediction.fps < high


@pytest.mark.parametrize("fps", [PAPER_FPS, 42.0, 98965.0])
def test_no_constant_is_the_published_figure(fps: float) -> None:
    """What the model is compared with must not be in it."""
    constants = [c for table in ("cost", "array", "memory") for c in DPU.target.tables[table].values()]
    assert not [c for c in constants if math.isclose(c.low, fps) or math.isclose(c.high, fps)]


@pytest.mark.parametrize(("configuration", "fps"), RESNET50_FPS.items())
def test_published_resnet50_is_given_back(configuration: str, fps: float) -> None:
    dpu = load_dpu("vck190", configuration)
    batch_time_s = layer_time_s(7.7e9, 25_500_000, 0, dpu) + dpu.value("cost", "overhead_s")
    assert dpu.batch / batch_time_s == pytest.approx(fps, rel=0.17 if dpu.batch == 5 else 0.03)


@pytest.mark.parametrize("configuration", RESNET50_FPS)
def test_layers_and_overhead_sum_to_the_batch(tmp_path: Path, configuration: str) -> None:
    dpu = load_dpu("vck190", configuration)
    prediction = predict_file(integer_convbeers(tmp_path / "i.onnx", 3, 20), dpu, 177)
    parts = [*(layer.time_s for layer in prediction.layers), prediction.overhead_s]
    assert math.fsum(parts) == prediction.batch_time_s
    assert prediction.fps * prediction.batch_time_s == pytest.approx(dpu.batch, rel=1e-12)


def test_the_three_spellings_cost_the_same(tmp_path: Path) -> None:
    makers = (float_convbeers, integer_convbeers, board_convbeers)
    costs = [predict_file(make(tmp_path / f"{k}.onnx", 2, 32), DPU, 192) for k, make in enumerate(makers)]
    assert len({(c.batch_time_s, c.operations, c.streamed_bytes) for c in costs}) == 1


def test_maps_that_fit_the_banks_do_not_stream(tmp_path: Path) -> None:
    """64 channels of 128 x 128 are exactly 1 MiB; one pixel more on a side streams."""
    path = float_convbeers(tmp_path / "f.onnx", 1, 64)
    assert predict_file(path, DPU, 128).streamed_bytes == 0
    assert predict_file(path, DPU, 129).streamed_bytes > 0


def test_an_empty_array_widens_only_the_slow_end(tmp_path: Path) -> None:
    """8 channels use an eighth of the array: frames a second may be fewer than the model says, not more."""
    narrow = predict_file(float_convbeers(tmp_path / "n.onnx", 1, 8), DPU, 96)
    full = predict_file(float_convbeers(tmp_path / "w.onnx", 1, 32), DPU, 96)
    widths = [p.fps / p.fps_interval[0] for p in (narrow, full)]
    assert widths[0] > widths[1] >= 2.37
    assert [p.fps_interval[1] / p.fps for p in (narrow, full)] == pytest.approx([1 / (1 - 0.294)] * 2)
    assert narrow.layers[1].array_use == pytest.approx(8 * 8 / (16 * 32))


def test_more_batch_handlers_gain_less_on_large_maps(papers: Path) -> None:
    """Large maps are bound by memory: twice the engines gave 1.11 x in the published tables."""
    three, six = (predict_file(papers, load_dpu("vck190", name)).fps for name in ("C32B3", "C32B6"))
    assert 1.0 < six / three < 1.3


def test_a_network_that_the_dpu_refuses_has_no_prediction(tmp_path: Path) -> None:
    sketch = Sketch(8)
    path = sketch.save(tmp_path / "s.onnx", sketch.conv(sketch.node("Sigmoid", sketch.conv("image"))))
    with pytest.raises(ModelError, match="check"):
        predict_file(path, DPU)


def test_a_network_without_convolutions_has_no_prediction(tmp_path: Path) -> None:
    sketch = Sketch(8)
    path = sketch.save(tmp_path / "p.onnx", sketch.node("MaxPool", "image", kernel_shape=[2, 2]))
    with pytest.raises(ModelError, match="no convolution"):
        predict_file(path, DPU)
