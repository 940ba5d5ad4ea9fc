"""Runs of an owner's board correct the cost model by one factor for the DPU and
one for the host.
"""

import json
from pathlib import Path

import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.cost.own_runs import SCATTER, OwnRuns, read_own_runs
from beers_deploy.performance.swath import predict_network
from beers_deploy.profiles.errors import OptionError
from tests.deploy.dpu.graphs import Sketch, integer_convbeers

DPU = load_dpu("vck190")
RUN = '{"model": "deep.onnx", "fps": 3}'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that the DPU bounds, and one that the host bounds."""
    path = tmp_path_factory.mktemp("runs")
    integer_convbeers(path / "deep.onnx", 4, 64)
    sketch = Sketch(8)
    sketch.save(path / "flat.onnx", sketch.conv("image", (1, 8, 1, 1)))
    return path


def runs_of(folder: Path, **times_as_fast: float) -> OwnRuns:
    """A run of each network named, so many times as fast as predicted."""
    runs = [
        {
            "model": f"{name}.onnx",
            "tile_px": 320,
            "fps": factor * predict_network(folder / f"{name}.onnx", DPU, 320).fps,
        }
        for name, factor in times_as_fast.items()
    ]
    (folder / "board.json").write_text(json.dumps(runs))
    return read_own_runs(folder / "board.json", DPU)


def test_each_part_is_corrected_by_the_runs_that_it_bounds(folder: Path) -> None:
    """One run tells more of its network than of the board: of the logarithm, a fourth is the
    board's.
    """
    runs = runs_of(folder, deep=0.5, flat=2.0)
    assert (runs.dpu_factor, runs.host_factor) == pytest.approx((0.5**0.25, 2.0**0.25))
    for row in runs.run_rows():
        before, after = (
            abs(row.figures[f"{key} is off by"].value or 0) for key in ("shipped", "corrected")
        )
        assert after < before


@pytest.mark.parametrize("count", [1, 3, 30])
def test_more_runs_move_a_factor_further(folder: Path, count: int) -> None:
    runs_of(folder, deep=0.5)
    entry = json.loads((folder / "board.json").read_text())
    (folder / "board.json").write_text(json.dumps(count * entry))
    assert read_own_runs(folder / "board.json", DPU).dpu_factor == pytest.approx(
        0.5 ** (count / (count + SCATTER))
    )


def test_a_part_without_runs_keeps_its_constants(folder: Path) -> None:
    runs = runs_of(folder, deep=0.5)
    assert runs.host_factor == 1.0
    before, after = (
        predict_network(folder / "deep.onnx", dpu, 320) for dpu in (DPU, runs.applied(DPU))
    )
    assert after.batch_time_s == pytest.approx(2**0.25 * before.batch_time_s)
    assert after.host_s == pytest.approx(before.host_s)
    assert after.width == before.width


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "3",
        '[{"fps": 3}]',
        '[{"model": "deep.onnx", "fps": 0}]',
        '[{"model": "deep.onnx", "fps": true}]',
        '[{"network": "resnet-50", "fps": 3}]',
        '[{"model": "deep.onnx", "fps": 3, "tile_px": 8}]',
        '[{"model": "deep.onnx", "fps": 3, "tile_px": 64.5}]',
        '[{"model": "deep.onnx", "fps": 3, "speed": 8}]',
        '[{"model": "deep.onnx", "fps": 3, "provider": "CPUExecutionProvider"}]',
        '[{"model": "deep.onnx", "fps": 1e-300}]',
        '[{"model": "deep.onnx", "fps": 3, "power_w": "x"}]',
        '[{"model": "deep.onnx", "fps": 1e999}]',
        '[{"model": "deep.onnx", "fps": 3, "tile_px": 1048576}]',
        f'[{{"model": "deep.onnx", "fps": 3, "tile_px": {10**300}}}]',
        '[{"model": "deep.onnx", "fps": 1e-8, "tile_px": 320}]',
        '[{"model": "deep.onnx", "fps": 1e8, "tile_px": 320}]',
        f"[{', '.join(1001 * [RUN])}]",
    ],
)
def test_bad_runs_are_refused(folder: Path, text: str) -> None:
    (folder / "board.json").write_text(text)
    with pytest.raises(OptionError, match=r"board\.json"):
        read_own_runs(folder / "board.json", DPU)
