"""Tests of a board with an NPU: AMD's table and the file's format decide, remarks name what is
unknown, and nothing is predicted.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest

import beers_deploy as bd
from beers_deploy.dpu.checker.table import Checked
from beers_deploy.float_onnx import to_onnx
from beers_deploy.model.variants import Variant
from beers_deploy.profiles.shipped import board_names
from tests.deploy.command_line import done, refused
from tests.deploy.documents import figures_of, valid
from tests.deploy.dpu.draws import rules_of
from tests.deploy.dpu.graphs import QdqSketch, behind_qdq_conv
from tests.model.networks import plain
from tests.quant.quick import fix_sizes, uniform

Draw = Callable[[QdqSketch, str], str]


def activated(op_type: str, zero: int = 0, kind: type = np.int8) -> Draw:
    """Draw an activation whose result has a zero point, and a convolution that reads it."""

    def draw(s: QdqSketch, x: str) -> str:
        slopes = [s.stored(np.ones((4, 1, 1), np.int8))] if op_type == "PRelu" else []
        middle = s.node("QuantizeLinear", s.node(op_type, x, *slopes), *s.scale(6, zero, kind))
        return s.qdq_conv(s.node("DequantizeLinear", middle, *s.scale(6, zero, kind)))

    return draw


def biased(size: int) -> Draw:
    """Draw a convolution whose bias is shifted by 8 bits."""

    def draw(s: QdqSketch, x: str) -> str:
        weight = s.stored(np.ones((4, 4, 3, 3), np.int8))
        bias = s.stored(np.full(4, -size, np.int8), 6)
        return s.pair(s.node("Conv", x, weight, bias, pads=[1] * 4))

    return draw


def network(draw: Draw, opset: int = 17, side: int | None = 31) -> onnx.ModelProto:
    """Build `draw` behind a convolution, for images of `side` or of any size."""
    model = behind_qdq_conv(draw)
    model.opset_import[0].version = opset
    if side:
        for value in (*model.graph.input, *model.graph.output):
            fix_sizes(value, 1, 4, side, side)
    return model


def faults(checked: Checked) -> set[str]:
    failed_checks = {check.name for check in checked.checks[1:] if not check.passed}
    return failed_checks | set(rules_of(checked.refused))


# The rules that DPUs have too are tested in test_number_graphs.py. docs/reference/operators.md
# states that they apply here.
REFUSED: dict[str, tuple[Draw, Draw]] = {
    "int8 alone": (activated("Relu", 128, np.uint8), activated("Relu")),
    "int8 operator": (activated("PRelu"), activated("LeakyRelu")),
    "bias width": (biased(128), biased(127)),
}


@pytest.mark.parametrize("rule", REFUSED)
def test_each_case_is_refused_for_its_rule_and_passes_without_it(rule: str) -> None:
    faulty, remedied = (bd.check(network(draw), target="vek385") for draw in REFUSED[rule])
    assert (faults(faulty), bool(faulty)) == ({rule}, False)
    assert (faults(remedied), bool(remedied)) == (set(), True)


def test_an_open_size_and_a_new_opset_are_refused(tmp_path: Path) -> None:
    left_open = network(QdqSketch.qdq_conv, side=None)
    assert faults(bd.check(left_open, target="vek385")) == {"sizes left open"}
    assert bd.check(network(QdqSketch.qdq_conv, opset=20), target="vek385")
    onnx.save(network(QdqSketch.qdq_conv, opset=21), tmp_path / "n.onnx")
    output = done(f"check {tmp_path}/n.onnx --target vek385", code=1)
    assert " ".join(output.split()).rpartition("check FAILED: ")[2].startswith("opset 21 (Xilinx")


def mixed(s: QdqSketch, x: str) -> str:
    """Draw a depthwise convolution, one left in float, and an operator that the table lacks."""
    deep = s.pair(
        s.node("Conv", x, s.stored(np.ones((4, 1, 3, 3), np.int8)), group=4, pads=[1] * 4)
    )
    return s.qdq_conv(
        s.pair(s.node("Sub", s.pair(s.node("Conv", deep, s.weight(4, 4, 1, 1))), deep))
    )


def test_what_is_legal_but_worth_knowing_is_a_note(tmp_path: Path) -> None:
    onnx.save(network(mixed), tmp_path / "n.onnx")
    output = done(f"check {tmp_path}/n.onnx --target vek385 --json {tmp_path}/o.json")
    rows = valid(tmp_path / "o.json")["rows"]
    devices = {row["text"]["device"] for row in rows if row["table"] == "nodes"}
    by_default = "float, BF16 by the compiler's default"
    assert devices == {"host", "NPU by AMD's table", "not read in AMD's table", by_default}
    remarks = [row["name"] for row in rows if row["table"] == "remarks"]
    assert remarks == ["unread", "depthwise", "float_islands", "unknown"]
    assert "no limits published" in output
    assert " runs" not in output


def test_no_limit_of_a_dpu_is_applied() -> None:
    """Every DPU refuses so many channels, and its array decides on a kernel as large as the map."""
    s = QdqSketch(4)
    narrow = s.conv(s.conv("image", (9000, 4, 1, 1)), (4, 9000, 1, 1))
    model = s.model(s.conv(narrow, (4, 4, 31, 31), pads=[0] * 4))
    assert bd.check(model, target="vek385", tile=31)
    assert not any(bd.check(model, target=board, tile=31) for board in board_names())


def test_nothing_is_predicted_and_what_is_published_is_quoted(tmp_path: Path) -> None:
    assert "--dpu cannot be 'C32B3' for vek385" in refused("check --target vek385 --dpu C32B3")
    done(f"bench convbeers-xs --target vek385 --json {tmp_path}/o.json")
    own, *quoted = valid(tmp_path / "o.json")["rows"]
    assert {figure["mode"] for figure in own["figures"].values()} == {"unavailable"}
    figures = [(figure["mode"], figure["value"]) for figure in figures_of(quoted)]
    assert figures == [("published", value) for value in (10.69, 23.363, 1.56, 265.49)]


def test_quantize_writes_vint8_and_the_configuration_of_the_compiler(tmp_path: Path) -> None:
    network, samples, core = (tmp_path / name for name in ("f.onnx", "s.npy", "core.onnx"))
    onnx.save(to_onnx(plain(Variant(blocks=1, features=4), seed=3), {}), network)
    np.save(samples, uniform(4, 1, 48, 48))
    command = f"quantize {network} --samples {samples} --out {tmp_path}/i.onnx --target vek385"
    assert "--tile" in refused(f"{command} --board-file {core}")
    assert "--board-file" in refused(f"{command} --tile 33")
    done(f"{command} --board-file {core} --tile 33")
    assert "check passed" in done(f"check {core} --target vek385")
    config = json.loads((tmp_path / "vitisai_config.json").read_text(encoding="utf-8"))
    assert config["passes"][1]["vaiml_config"] == {"device": "ve2-xc2ve3858", "optimize_level": 2}
    checks = bd.gate(network, tmp_path / "i.onnx", target="vek385", samples=samples).checks
    assert "nodes that break a rule" in {check.name for check in checks if check.passed}
