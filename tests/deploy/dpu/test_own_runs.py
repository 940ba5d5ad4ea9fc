"""Test that runs of an owner's board correct the cost model by kinship."""

import json
import math
from pathlib import Path
from typing import Any

import onnx
import pytest

from beers_deploy.dpu.board import Dpu, load_dpu
from beers_deploy.dpu.cost.kinship import SHARES, correction
from beers_deploy.dpu.cost.latency import Prediction
from beers_deploy.dpu.cost.own_runs import OwnRuns, read_own_runs
from beers_deploy.performance.swath import predict_network
from beers_deploy.profiles.errors import OptionError
from tests.deploy.dpu.graphs import integer_convbeers, written

DPU = load_dpu("vck190")
RUN = '{"model": "deep.onnx", "fps": 3}'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a network that the DPU bounds, a smaller one of the same kinds of layers, and one that
    the host bounds.
    """
    path = tmp_path_factory.mktemp("runs")
    integer_convbeers(path / "deep.onnx", 4, 64)
    integer_convbeers(path / "kin.onnx", 3, 48)
    onnx.save_model(written("y = Conv(image, w1x8x1x1)"), path / "flat.onnx")
    return path


def rate(folder: Path, name: str, dpu: Dpu = DPU, tile_px: int = 320) -> Prediction:
    """Return the prediction of a network of the folder."""
    return predict_network(folder / f"{name}.onnx", dpu, tile_px)


def runs_of(folder: Path, factor: float, *more: dict[str, Any], name: str = "deep") -> OwnRuns:
    """Return runs of a network that are `factor` times as fast as predicted, one for each
    `more`.
    """
    runs = []
    for keys in more or ({},):
        dpu = load_dpu(keys.get("target", "vck190"), keys.get("configuration"))
        fps = factor * rate(folder, name, dpu).fps
        runs.append({"model": f"{name}.onnx", "tile_px": 320, "fps": fps, **keys})
    (folder / "board.json").write_text(json.dumps(runs))
    board = load_dpu("zcu102") if "target" in runs[0] else DPU
    return read_own_runs(folder / "board.json", board)


def test_a_run_corrects_by_kinship(folder: Path) -> None:
    """A run corrects the same network most, and less on another configuration or at another size.

    It corrects a network of the same kinds of layers still less, and one that the host bounds not
    at all. A corrected interval is narrower.
    """
    runs = runs_of(folder, 0.5)
    six = load_dpu("vck190", "C32B6")
    for name, dpu, tile_px, kinship in (
        ("deep", DPU, 320, 4),
        ("deep", six, 320, 3),
        ("deep", DPU, 256, 3),
        ("kin", DPU, 320, 2),
        ("flat", DPU, 320, 0),
    ):
        before = rate(folder, name, dpu, tile_px)
        after = rate(folder, name, runs.applied(dpu), tile_px)
        share = sum(SHARES[:kinship])
        assert after.speed == pytest.approx(0.5**share)
        assert after.width == pytest.approx(before.width * math.sqrt(1 - share**2))
        assert after.fps == pytest.approx(before.fps * after.speed)
        assert after.latency_s == pytest.approx(before.latency_s / after.speed)


def test_runs_of_another_board_with_the_same_dpu_count(folder: Path) -> None:
    """The board's own share does not count. A board with another DPU is refused."""
    runs = runs_of(folder, 0.5, {"target": "zcu104"})
    corrected = rate(folder, "deep", runs.applied(load_dpu("zcu102")))
    assert math.log(corrected.speed) / math.log(0.5) == pytest.approx(sum(SHARES[1:3]))
    (folder / "board.json").write_text('[{"model": "deep.onnx", "target": "zcu104", "fps": 3}]')
    with pytest.raises(OptionError, match="whose DPU is not that of"):
        read_own_runs(folder / "board.json", DPU)


@pytest.mark.parametrize("count", [1, 3, 30])
def test_repeated_runs_correct_further_but_not_beyond_their_own_rate(count: int) -> None:
    runs = [((1, 2, 3, 4), math.log(0.5))] * count
    scatter = 1 - sum(SHARES)
    factor, left = correction((1, 2, 3, 4), runs)
    share = sum(SHARES) / (sum(SHARES) + scatter / count)
    assert factor == pytest.approx(0.5**share)
    assert 0 < left < 1
    assert correction((0, 0, 0, 0), runs) == (1.0, 1.0)


def test_each_run_is_compared_with_its_prediction_from_the_others(folder: Path) -> None:
    more = {"configuration": "C32B6", "power_w": 20}
    first, second = runs_of(folder, 0.5, {}, more).run_rows()
    assert second.figures["power"].value == 20
    assert second.figures["power"].mode == second.figures["given"].mode == "measured"
    assert "power" not in first.figures
    for row in (first, second):
        before, after = (
            abs(row.figures[f"{key} is off by"].value or 0)
            for key in ("shipped", "by the other runs")
        )
        assert after < before
    (alone,) = runs_of(folder, 0.5).run_rows()
    assert alone.figures["by the other runs"].value == alone.figures["shipped"].value


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '[{"fps": 3}]',
        '[{"model": "deep.onnx", "fps": true}]',
        '[{"model": "deep.onnx", "fps": 3, "tile_px": 8}]',
        '[{"model": "deep.onnx", "fps": 3, "tile_px": 64.5}]',
        '[{"model": "deep.onnx", "fps": 3, "speed": 8}]',
        '[{"model": "deep.onnx", "fps": 3, "provider": "CPUExecutionProvider"}]',
        '[{"model": "deep.onnx", "fps": 1e999}]',
        '[{"model": "deep.onnx", "fps": 1e-8, "tile_px": 320}]',
        '[{"model": "deep.onnx", "fps": 1e8, "tile_px": 320}]',
        f"[{', '.join(101 * [RUN])}]",
    ],
)
def test_bad_runs_are_refused(folder: Path, text: str) -> None:
    (folder / "board.json").write_text(text)
    with pytest.raises(OptionError, match=r"board\.json"):
        read_own_runs(folder / "board.json", DPU)
