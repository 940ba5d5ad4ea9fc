"""A board with an NPU: AMD's table and the format decide, notes say the rest, and nothing is predicted."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

import beers_deploy as bd
from beers_deploy.dpu.board import ruled
from beers_deploy.dpu.checker.table import Checked, check
from beers_deploy.export import to_onnx
from beers_deploy.model.variants import Variant
from beers_deploy.profiles import load_target
from beers_deploy.profiles.errors import OptionError
from beers_deploy.profiles.target import board_names, npu_names
from tests.deploy.command_line import done, refused
from tests.deploy.documents import valid
from tests.deploy.dpu.graphs import QdqSketch, float_convbeers
from tests.model.networks import plain

Draw = Callable[[QdqSketch, str], str]


def conv(**numbers: object) -> Draw:
    return lambda s, x: s.qdq_conv(x, **numbers)  # type: ignore[arg-type]


def in_uint8(s: QdqSketch, x: str) -> str:
    numbers = s.scale(7, 128, np.uint8)
    middle = s.node("QuantizeLinear", s.node("Relu", x), *numbers)
    return s.qdq_conv(s.node("DequantizeLinear", middle, *numbers))


def learnt_slope(s: QdqSketch, x: str) -> str:
    return s.pair(s.node("PRelu", x, s.stored(np.ones((4, 1, 1), np.int8))))


def joined(output: float) -> Draw:
    return lambda s, x: s.pair(s.node("Concat", x, s.qdq_conv(x), axis=1), output)


def read_elsewhere(s: QdqSketch, x: str) -> str:
    return s.qdq_conv(s.pair(s.node("Relu", x), 6, read=(4, 0)))


def written(path: Path, draw: Draw, opset: int = 17, side: int | None = 31) -> Path:
    """What `draw` puts behind a convolution, as a file of one image of one size, or of any."""
    sketch = QdqSketch(4)
    model = onnx.load(sketch.save(path, draw(sketch, sketch.qdq_conv(sketch.pair("image")))))
    model.opset_import[0].version = opset
    for value in (*model.graph.input, *model.graph.output):
        if side:
            for dim, size in zip(value.type.tensor_type.shape.dim, (1, 4, side, side), strict=True):
                dim.dim_value = size
    onnx.save(model, path)
    return path


def faults(found: Checked) -> set[str]:
    broken = {rule.rule for node in found.failed for rule in node.broken}
    return broken | {each.name for each in found.checks[1:] if not each.passed}


REFUSED: dict[str, tuple[Draw, Draw]] = {
    "per tensor": (conv(weight=[7, 7, 6, 7]), conv(weight=7)),
    "power of two": (conv(weight=-math.log2(0.3)), conv(weight=7)),
    "int8 alone": (in_uint8, lambda s, x: s.qdq_conv(s.pair(s.node("Relu", x)))),
    "int8 operator": (learnt_slope, lambda s, x: s.pair(s.node("LeakyRelu", x))),
    "same scale": (joined(6), joined(7)),
    "one format": (read_elsewhere, lambda s, x: s.qdq_conv(s.pair(s.node("Relu", x), 6))),
    "int8 bias": (conv(bias_kind=np.int32), conv()),
    "bias width": (lambda s, x: biased(s, x, 128), lambda s, x: biased(s, x, 127)),
    "shift read": (lambda s, x: added(s, x, 8), lambda s, x: added(s, x, 7)),
}


def added(s: QdqSketch, x: str, apart: int) -> str:
    return s.pair(s.node("Add", s.qdq_conv(x, output=0), s.qdq_conv(x, output=apart)), 0)


def biased(s: QdqSketch, x: str, size: int) -> str:
    """A bias that is shifted by 8 bits."""
    weight, bias = s.stored(np.ones((4, 4, 3, 3), np.int8)), s.stored(np.full(4, -size, np.int8), 6)
    return s.pair(s.node("Conv", x, weight, bias, pads=[1] * 4))


@pytest.mark.parametrize("rule", REFUSED)
def test_each_case_is_refused_for_its_rule_and_passes_without_it(rule: str, tmp_path: Path) -> None:
    wrong, right = (check(written(tmp_path / "n.onnx", draw), "vek385") for draw in REFUSED[rule])
    assert faults(wrong) == {rule}
    assert not wrong
    assert faults(right) == set()
    assert right


def test_an_open_size_and_a_new_opset_are_refused(tmp_path: Path) -> None:
    assert faults(check(written(tmp_path / "n.onnx", conv(), side=None), "vek385")) == {"sizes left open"}
    assert faults(check(written(tmp_path / "n.onnx", conv(), opset=21), "vek385")) == {"opset"}
    assert faults(check(written(tmp_path / "n.onnx", conv(), opset=20), "vek385")) == set()
    said = done("check", written(tmp_path / "n.onnx", conv(), opset=21), "--target", "vek385", code=1)
    assert "check FAILED: opset 21 (Xilinx" in said.splitlines()[-1]


def mixed(s: QdqSketch, x: str) -> str:
    """A depthwise convolution, one left in float, and an operator that the table as read does not have."""
    kernel = s.stored(np.ones((4, 1, 3, 3), np.int8))
    deep = s.pair(s.node("Conv", x, kernel, group=4, pads=[1] * 4))
    island = s.node("Conv", deep, s.weight(4, 4, 1, 1))
    return s.qdq_conv(s.pair(s.node("Sub", s.pair(island), deep)))


def test_what_is_legal_but_worth_knowing_is_a_note(tmp_path: Path) -> None:
    output = done("check", written(tmp_path / "n.onnx", mixed), "--target", "vek385", "--json", tmp_path / "o.json")
    rows = valid(tmp_path / "o.json")["rows"]
    devices = {row["text"]["operator"]: row["text"]["device"] for row in rows if row["table"] == "nodes"}
    assert devices["Sub"] == "not read in AMD's table"
    remarks = {row["name"]: row["text"]["remark"] for row in rows if row["table"] == "remarks"}
    assert list(remarks) == ["unread", "depthwise", "float_islands", "unknown"]
    assert remarks["unread"].startswith("Sub:")
    assert remarks["depthwise"].startswith("1 depthwise")
    assert "no limits published" in output
    assert "NPU by AMD's table" in output
    assert not {"subgraphs", "cuts"} & {row["table"] for row in rows}
    assert " runs" not in output


def test_no_limit_of_a_dpu_is_applied(tmp_path: Path) -> None:
    """Channels that every DPU refuses, and a kernel as large as its map, which would be asked for the array."""
    sketch = QdqSketch(4)
    narrow = sketch.conv(sketch.conv("image", (9000, 4, 1, 1)), (4, 9000, 1, 1))
    path = sketch.save(tmp_path / "n.onnx", sketch.conv(narrow, (4, 4, 31, 31), pads=[0] * 4))
    assert check(path, "vek385", tile=31)
    assert not any(check(path, board, tile=31) for board in board_names())
    assert check(float_convbeers(tmp_path / "f.onnx", 1, 4), "vek385")


@pytest.mark.parametrize("name", npu_names())
def test_what_predicts_refuses_a_board_without_a_cost_model(name: str, tmp_path: Path) -> None:
    assert name not in board_names()
    with pytest.raises(OptionError, match="none beside"):
        ruled(load_target(name), "C32B3")
    assert "a target with a DPU" in refused("tradeoff", "--target", name, "--out", tmp_path / "study")
    assert "a board with a DPU" in refused("check", "--target", name, "--picture", tmp_path / "p.svg")


def test_bench_predicts_nothing_and_quotes(tmp_path: Path) -> None:
    done("bench", "convbeers-xs", "--target", "vek385", "--json", tmp_path / "o.json")
    own, *quoted = valid(tmp_path / "o.json")["rows"]
    assert {figure["mode"] for figure in own["figures"].values()} == {"unavailable"}
    figures = [figure for row in quoted for figure in row["figures"].values()]
    assert {figure["mode"] for figure in figures} == {"published"}
    assert sorted(figure["value"] for figure in figures) == [1.56, 10.69, 23.363, 265.49]


def test_quantize_writes_vint8_and_what_the_compiler_is_told(tmp_path: Path) -> None:
    network, core, config = (tmp_path / name for name in ("f.onnx", "core.onnx", "vitisai_config.json"))
    onnx.save(to_onnx(plain(Variant(blocks=1, features=4), seed=3), {}), network)
    np.save(tmp_path / "s.npy", np.random.default_rng(0).random((4, 1, 48, 48), np.float32))
    words = ["quantize", network, "--samples", tmp_path / "s.npy", "--out", tmp_path / "i.onnx", "--target", "vek385"]
    assert "--tile" in refused(*words, "--board-file", core)
    assert "--board-file" in refused(*words, "--tile", 33)
    done(*words, "--board-file", core, "--tile", 33)
    assert "check passed" in done("check", core, "--target", "vek385")
    told = json.loads(config.read_text(encoding="utf-8"))
    assert told["passes"][1]["vaiml_config"] == {"device": "ve2-xc2ve3858", "optimize_level": 2}
    int8 = bd.Network.load(tmp_path / "i.onnx")
    assert int8.core("vek385", 33).model == onnx.load(core)
    judged = bd.gate(int8, tmp_path / "f.onnx", board="vek385", samples=tmp_path / "s.npy").checks
    assert "nodes that break a rule" in {each.name for each in judged if each.passed}


def test_export_writes_vint8_of_a_shipped_network(tmp_path: Path) -> None:
    words = ["export", "--network", "convbeers-half-xs-int8", "--out", tmp_path / "i.onnx", "--target", "vek385"]
    assert "--board-file" in refused(*words)
    assert "--tile" in refused(*words, "--board-file", tmp_path / "core.onnx")
    done(*words, "--board-file", tmp_path / "core.onnx", "--tile", 62)
    assert "check passed" in done("check", tmp_path / "core.onnx", "--target", "vek385")
    assert "multiple of 2" in refused(*words, "--board-file", tmp_path / "core.onnx", "--tile", 63)
