"""Tests of the figures of networks that are measured on this machine, interleaved."""

from dataclasses import replace
from pathlib import Path

import onnx
import pytest

from beers_deploy.model.consistency.step import Consistency
from beers_deploy.network import Network, other_precision
from beers_deploy.performance.host import host_rows
from beers_deploy.profiles.constant import Constant
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import TargetProfile
from tests.deploy.dpu.graphs import SAME, float_convbeers, written
from tests.shipped import shipped_pair

SHORT = {"min_time_s": Constant(0.05, "stated", "test"), "min_runs": Constant(3, "stated", "test")}
QUICK = replace(TargetProfile.load("host-cpu"), tables={"measurement": SHORT})


def value(row: Row, key: str) -> float:
    number = row.figures[key].value
    assert number is not None
    return number


def test_float_and_int8_are_interleaved() -> None:
    rows = host_rows(shipped_pair()[1], QUICK, 48, threads=1)
    assert rows[0].name == "convbeers-s-int8, 48 x 48"
    assert rows[1].name == "float32 of the same shape, 48 x 48"
    for row in rows[:2]:
        assert value(row, "p50") <= value(row, "p90")
        assert 0 <= value(row, "CPU load") <= 100
        assert value(row, "threads") == 1
    assert value(rows[2], "ratio") == pytest.approx(value(rows[1], "p50") / value(rows[0], "p50"))
    for row in rows:
        modes = {figure.mode for key, figure in row.figures.items() if key != "power"}
        assert modes <= {"measured", "unavailable"}


def test_the_other_precision_is_a_shipped_network_of_the_same_variant() -> None:
    floating, integer = map(Network.load, shipped_pair())
    float32 = other_precision(integer)
    assert float32 is not None
    back = other_precision(float32)
    assert back is not None
    assert (float32.precision, back.precision) == ("float32", "int8")
    shapes = [
        sorted(
            tuple(tensor.dims)
            for tensor in network.model.graph.initializer
            if len(tensor.dims) == 4
        )
        for network in (floating, float32)
    ]
    assert shapes[0] == shapes[1]


def test_a_network_that_is_not_shipped_runs_alone(tmp_path: Path) -> None:
    path = float_convbeers(tmp_path / "f.onnx", 1, 8)
    assert other_precision(Network.load(path)) is None
    assert [row.name for row in host_rows(path, QUICK, 32, 1) if row.table == "host"] == [
        "f, 32 x 32"
    ]


STEP = "consistency step, 32 x 32"


@pytest.mark.parametrize(
    ("nodes", "bands"),
    [
        (f"y = {SAME}(image, w3x3x3x3)", 3),
        (f"wide = {SAME}(image, w12x3x3x3) y = DepthToSpace<blocksize=2>(wide)", 0),
        (f"y = {SAME}(image, w1x3x3x3)", 0),
    ],
)
def test_the_step_is_timed_for_every_band_of_a_network_that_it_can_follow(
    nodes: str, bands: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    monkeypatch.setattr(Consistency, "correction", lambda *_: calls.append(1))
    onnx.save_model(written(nodes, 3), tmp_path / "bands.onnx")
    once = {
        "min_time_s": Constant(1e-9, "stated", "test"),
        "min_runs": Constant(2, "stated", "test"),
    }
    target = replace(QUICK, tables={"measurement": once})
    rows = host_rows(tmp_path / "bands.onnx", target, 32, 1, Sensor.load("pleiades-degraded"))
    assert (STEP in [row.name for row in rows]) == (bands > 0)
    # One run is for warm-up.
    assert len(calls) == bands * (1 + 2)
