from pathlib import Path

import pytest

from deploy.bench.tables import predict_file
from deploy.dpu.board import load_dpu
from deploy.dpu.cost.latency import counted_power, image_energy_j, layer_energy_j
from tests.deploy.dpu.graphs import float_convbeers

DPU = load_dpu("vck190")


def test_energy_counts_products_and_bytes(tmp_path: Path) -> None:
    """One 3 x 3 layer of 32 features that stays on chip: products and a third of its weights."""
    prediction = predict_file(float_convbeers(tmp_path / "f.onnx", 1, 32), DPU, 96)
    low, high = layer_energy_j(prediction.layers[2], DPU)
    products, weights = 9 * 32 * 32 * 96 * 96, 9 * 32 * 32
    assert low == pytest.approx(products * 0.023e-12 + weights / 3 * 162.5e-12)
    assert high == pytest.approx(products * 0.23e-12 + weights / 3 * 325e-12)


def test_counted_power_lies_below_the_published_run(tmp_path: Path) -> None:
    """It leaves out control, clocks and leakage: more than the whole board's would be a fault."""
    prediction = predict_file(float_convbeers(tmp_path / "f.onnx", 16, 64), DPU)
    low, high = counted_power(prediction, DPU).interval or (0, 0)
    assert 0 < low < high < DPU.value("power", "dpu_run_w")
    assert image_energy_j(prediction, DPU)[1] == pytest.approx(high / prediction.fps)
