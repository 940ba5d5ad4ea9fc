"""Several boards in one table, what meets a time, and networks that are run on whole images."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import tifffile
import torch

from beers_deploy.bench.board import BoardBench, bench_board
from beers_deploy.bench.swath import Swath, predict_network
from beers_deploy.bench.tables import frame_row, sweep_rows, within_words
from beers_deploy.commands.bench import HostTask
from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.cost.model import TASKS
from beers_deploy.profiles import load_sensor
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.target import board_names
from examples.networks import build, to_onnx
from tests.deploy.dpu.graphs import integer_convbeers


def bench(model: Path, target: str = "vck190", **options: Any) -> BoardBench:
    return bench_board(model, target, **{"size": "300x260", "tiles_px": [128], **options})


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return integer_convbeers(tmp_path_factory.mktemp("net") / "net.onnx", 2, 16)


@pytest.fixture(scope="module")
def classifier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("net") / "classifier.onnx"
    onnx.save(to_onnx("classifier", build("classifier", torch.Generator().manual_seed(0))), path)
    return path


def names(rows: list[Row]) -> list[str]:
    return [row.name for row in rows]


def test_all_boards_stand_in_one_table_with_their_processors_and_the_papers_rows(
    network: Path,
) -> None:
    result = bench(network, "all")
    swept = [row for row in result.rows if row.table == "sweep"]
    assert [name.split()[0] for name in names(swept)] == board_names()
    for row in swept:
        low, high = row.figures["latency"].interval or (0.0, 0.0)
        assert 0 < low < (row.figures["latency"].value or 0) < high
        assert {"throughput", "power", "efficiency"} <= set(row.figures)
    processors = [row for row in result.rows if "processor of" in row.name]
    assert len(processors) == len(board_names())
    for row in processors:
        low, high = row.figures["latency"].interval or (0.0, 0.0)
        assert 0 < low < (row.figures["latency"].value or 0) < high < 4 * low
    assert sum(name.startswith("paper") for name in names(result.rows)) == 2


@pytest.mark.slow
def test_the_papers_rows_stand_beside_its_own_board_alone(network: Path) -> None:
    result = bench(network, "kv260")
    assert not any(name.startswith("paper") for name in names(result.rows))
    assert any("kv260" in name for name in names(result.rows))


def test_the_smallest_dpu_that_meets_a_time_is_named(network: Path) -> None:
    boards = [load_dpu("vck190", name) for name in ("C32B1", "C32B3", "C32B6")]
    rows = sweep_rows(network, Swath(3000, 2600, 128, 5), boards, [256, 128])
    sizes = [row.figures["latency"].value or math.inf for row in rows]
    slowest = max(sizes)
    fastest = min(sizes)
    assert "C32B1" in within_words(rows, boards, 10 * slowest)
    assert within_words(rows, boards, fastest / 1000).endswith("none of these")
    words = within_words(rows, boards, fastest)
    name = rows[int(np.argmin(sizes))].name
    assert f"by the prediction {name}" in words
    assert "by the whole interval" not in words


def test_a_network_that_is_not_tiled_is_predicted_by_the_frame(classifier: Path) -> None:
    result = bench(classifier, size=None)
    (frame,) = [row for row in result.rows if row.table == "frames"]
    assert (frame.figures["throughput"].interval or (0, 0))[0] > 0
    layers = [row for row in result.rows if row.table == "layers"]
    work = math.fsum(row.figures["work"].value or 0 for row in layers if "work" in row.figures)
    assert frame.figures["work"].value == pytest.approx(work)
    assert any("whole images" in note and "GlobalAveragePool" in note for note in result.notes)
    assert not any("traditional" in name for name in names(result.rows))
    with pytest.raises(ModelError, match="GlobalAveragePool"):
        # The default size is that of a swath.
        bench(classifier)


def test_a_frame_need_not_be_square(tmp_path: Path, classifier: Path) -> None:
    model = onnx.load(classifier)
    for side, size in zip(
        model.graph.input[0].type.tensor_type.shape.dim[2:], (32, 96), strict=True
    ):
        side.dim_value = size
    onnx.save(model, tmp_path / "wide.onnx")
    dpu = load_dpu("vck190", None)
    square, wide = (
        frame_row(predict_network(path, dpu, None)) for path in (classifier, tmp_path / "wide.onnx")
    )
    assert (wide.figures["work"].value or 0) > 2.5 * (square.figures["work"].value or 0)


def test_one_configuration_or_runs_beside_all_boards_are_refused(
    network: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match="dpu: expected"):
        bench(network, "all", config="C32B3")
    with pytest.raises(OptionError, match="measured"):
        bench(network, "all", measured=tmp_path / "runs.json")


@pytest.mark.slow
def test_a_stated_task_of_the_host_is_that_of_every_row(classifier: Path, network: Path) -> None:
    result = bench(classifier, "all", size=None, host_task="softmax")
    frames = [row for row in result.rows if row.table == "frames"]
    assert {row.text["host's task"] for row in frames} == {"softmax"}
    plain, ranked = (
        [row for row in bench(network, host_task=task).rows if "one-thread latency" in row.figures]
        for task in (None, "sort")
    )
    for before, after in zip(plain, ranked, strict=True):
        assert (
            (after.figures["one-thread latency"].value or 0)
            > (before.figures["one-thread latency"].value or 0)
            > 0
        )


def test_the_commands_names_of_tasks_are_the_models() -> None:
    assert [task.value for task in HostTask] == list(TASKS)


@pytest.mark.parametrize("bits", [12, 14])
def test_the_exposures_of_an_image_are_counted_whatever_the_bits_of_the_sensor(
    network: Path, bits: int, tmp_path: Path
) -> None:
    sensor = load_sensor("pleiades-degraded")
    gain = sensor.gain_dn_per_radiance.low * 2 ** (bits - 12)
    sensor = sensor.replace(bits=bits, gain_dn_per_radiance=gain)
    # These pixels are too bright for x4, unless full scale is that of 14 bits.
    pixels = np.full((128, 256), 2000, np.uint16)
    # These pixels are dark enough for x8, also far from bright ground.
    pixels[:, :128] = 200
    tifffile.imwrite(tmp_path / "image.tif", pixels)
    result = bench(network, size=None, image=tmp_path / "image.tif", full_scale=4095, sensor=sensor)
    (words,) = (note for note in result.notes if "by exposure" in note)
    shares = dict(re.findall(r"(x\d) (\d+)%", words))
    assert shares.keys() == {"x1", "x4", "x8"}
    assert int(shares["x1"]) > 0
    assert int(shares["x8"]) > 0
    assert int(shares["x4"]) == 0
