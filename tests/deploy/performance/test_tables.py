import math
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import tifffile

from beers_deploy.dpu.board import load_dpu
from beers_deploy.performance.board import TRAFFIC
from beers_deploy.performance.swath import Swath, efficiency, parse_size, predict_network
from beers_deploy.performance.tables import (
    layer_rows,
    parse_tiles,
    predicted_rows,
    published_rows,
    sweep_rows,
)
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.figures import measured, predicted, unavailable
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.deploy.dpu.graphs import float_convbeers, integer_convbeers
from tests.deploy.performance.test_host import value

DPU = load_dpu("vck190")


def test_a_swath_is_predicted_as_the_paper_counts_and_in_whole_tiles(tmp_path: Path) -> None:
    prediction = predict_network(float_convbeers(tmp_path / "f.onnx", 16, 64), DPU)
    swath = Swath(13600, 9016, 640, 35)
    fraction, tiled = predicted_rows("ConvBEERS", prediction, swath)
    # At the published 7.2 tiles a second that is the published 42 s.
    assert value(fraction, "tiles") == pytest.approx(299.36, abs=0.01)
    assert value(fraction, "latency") == pytest.approx(swath.frames / prediction.fps)
    assert value(tiled, "tiles") == 384
    assert value(tiled, "latency") == pytest.approx(128 * prediction.batch / prediction.fps)
    for row in (fraction, tiled):
        assert {figure.mode for figure in row.figures.values()} == {"predicted"}
        low, high = row.figures["latency"].interval or (0, 0)
        assert low < value(row, "latency") < high
    # The paper publishes 42 s for this swath, and 98,965 pixels a second and watt.
    low, high = fraction.figures["latency"].interval or (0, 0)
    assert low < 42 < high
    low, high = fraction.figures["efficiency"].interval or (0, 0)
    assert low < 98965 < high


def test_a_last_batch_that_is_not_full_still_takes_its_time(tmp_path: Path) -> None:
    prediction = predict_network(float_convbeers(tmp_path / "f.onnx", 1, 16), DPU, 64)
    _, tiled = predicted_rows("net", prediction, Swath(64, 64, 64, 5))
    assert value(tiled, "latency") == pytest.approx(prediction.batch / prediction.fps)


def test_published_rows_are_the_papers_and_agree_with_each_other() -> None:
    traditional, network = published_rows()
    assert value(traditional, "latency") / value(network, "latency") == pytest.approx(41, abs=0.5)
    for row in (traditional, network):
        rate = 13600 * 9016 / value(row, "latency") / value(row, "power")
        assert rate == pytest.approx(value(row, "efficiency"), rel=0.01)
        assert {figure.mode for figure in row.figures.values()} == {"published"}


def test_efficiency_is_only_as_good_as_its_parts() -> None:
    time = predicted(2.0, "s", (1.0, 4.0), "model")
    power = measured(5.0, "W", "counter")
    assert efficiency(1000, time, unavailable("W", "no counter")).reason == "no counter"
    mixed = efficiency(1000, time, power)
    assert (mixed.mode, mixed.value, mixed.interval) == ("predicted", 100.0, (50.0, 200.0))


def test_bench_writes_a_valid_document(tmp_path: Path) -> None:
    image = tmp_path / "raw.tif"
    out = tmp_path / "out.json"
    tifffile.imwrite(image, np.random.default_rng(0).integers(300, 900, (51, 63), dtype=np.uint16))
    model = integer_convbeers(tmp_path / "net.onnx", 1, 8)
    done(f"bench {model} --image {image} --tile 32 --json {out}")
    document = valid(out)
    assert [entry["name"] for entry in document["inputs"]] == ["net.onnx", "raw.tif"]
    names = [str(row["name"]) for row in document["rows"]]
    assert sum(name.startswith("paper, 13600 x 9016:") for name in names) == 2
    assert any("halo 5 px" in name for name in names)
    assert names[-1] == "traditional pipeline on this CPU"


def test_layers_are_shown_in_detail_and_written_always(tmp_path: Path) -> None:
    model = integer_convbeers(tmp_path / "net.onnx", 1, 8)
    out = tmp_path / "out.json"
    command = f"bench {model} --size 41x33 --tile 32 --no-traditional --json {out}"
    brief = done(command)
    assert {"bench", "layers"} <= {row["table"] for row in valid(out)["rows"]}
    detailed = done(f"{command} -v")
    assert ("LdFM" in brief, "LdFM" in detailed) == (False, True)
    # Several tiles are compared, and the layers of none of them are shown.
    assert "LdFM" not in done(f"{command} --tile 32,48 -v")
    assert {row["table"] for row in valid(out)["rows"]} == {"sweep", "bench"}


def test_layer_rows_have_the_columns_of_vaitrace_and_sum_to_their_last(tmp_path: Path) -> None:
    rows = layer_rows(predict_network(integer_convbeers(tmp_path / "i.onnx", 2, 64), DPU, 333))
    columns = {"work", "time", "rate", "LdFM", "LdWB", "StFM", "bandwidth", "array use"}
    assert all(set(row.figures) == columns for row in rows[:-1])
    assert all(word in TRAFFIC for word in columns if word[:2] in ("Ld", "St"))
    assert {row.text["bound"] for row in rows[:-1]} <= {"compute", "memory", "overhead"}
    assert any(row.name.startswith("qlinearadd") and value(row, "time") > 0 for row in rows[:-1])
    *parts, total = (value(row, "time") for row in rows)
    assert math.fsum(parts) == pytest.approx(total, rel=1e-12)


def test_small_tiles_keep_maps_on_chip_and_cost_work(tmp_path: Path) -> None:
    path = integer_convbeers(tmp_path / "net.onnx", 1, 64)
    boards = [load_dpu("vck190", name) for name in ("C32B3", "C32B6")]
    tiles = (640, 128, 64)
    rows = sweep_rows(path, [Swath(700, 600, tile, 5) for tile in tiles], boards)
    assert [row.name for row in rows] == [
        f"vck190 {dpu.name}, tiles of {tile}" for dpu, tile in product(boards, tiles)
    ]
    layers = [value(row, "layers on chip") for row in rows]
    factors = [value(row, "work factor") for row in rows]
    assert layers[0] == 0 < layers[1] <= layers[2]
    assert 1 < factors[1] < factors[2]
    for row in rows:
        assert value(row, "latency") >= value(row, "tiles") / value(row, "throughput") * (1 - 1e-12)
        assert set(row.text) == {"bound", "fitted range"}


@pytest.mark.parametrize(
    ("parse", "message", "texts"),
    [
        (parse_size, "13600x9016", ["13600", "0x5", "ax5", "13600x", "1x2x3", "-4x4"]),
        (parse_tiles, "tile", ["", "640,", "640,8", "640;320", "-64"]),
    ],
)
def test_bad_sizes_and_tiles_are_refused(
    parse: Callable[[str], object], message: str, texts: list[str]
) -> None:
    for text in texts:
        with pytest.raises(OptionError, match=message):
            parse(text)


@pytest.mark.slow
def test_bench_on_this_machine(tmp_path: Path) -> None:
    model = integer_convbeers(tmp_path / "net.onnx", 1, 8)
    out = tmp_path / "host.json"
    assert "no proxy" in done(f"bench {model} --target host --tile 32 --json {out}")
    row, *_ = valid(out)["rows"]
    assert isinstance(row["figures"], dict)
    assert row["figures"]["p50"]["value"] <= row["figures"]["p90"]["value"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--target host --tile 64,32", "--tile must be one side with --target host, got 2."),
        ("--dpu C1B1", "--dpu"),
        ("--tile 16 --halo 8", "--tile"),
        ("--image colour.tif", "one band"),
        ("--image half.tif", "floats of at most 0.5"),
    ],
)
def test_bench_refuses_what_does_not_go_together(
    options: str, message: str, working_folder: Path
) -> None:
    tifffile.imwrite("colour.tif", np.zeros((8, 9, 3), np.uint8), photometric="rgb")
    tifffile.imwrite("half.tif", np.full((8, 9), 0.5, np.float32))
    integer_convbeers(working_folder / "net.onnx", 1, 8)
    assert message in refused(f"bench net.onnx {options}")


@pytest.mark.parametrize(
    ("halo_px", "tiles"),
    [(0, 330), (11, 330), (12, 345), (20, 345), (21, 368), (25, 368), (26, 384), (38, 384)],
)
def test_whole_tiles_of_the_published_swath(halo_px: int, tiles: int) -> None:
    assert Swath(13600, 9016, 640, halo_px).tiles == tiles
