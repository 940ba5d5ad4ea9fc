"""The gate catches what goes wrong in quantised files, and tells a CI job so."""

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import onnx
import pytest
from onnx import numpy_helper
from typer.testing import CliRunner

from deploy.cli import app
from deploy.defaults import float_model
from deploy.gate import structure_checks
from deploy.gate_baseline import baseline_mae
from deploy.gate_report import junit, markdown
from deploy.results import Document, Row, measured
from deploy.shipped import default_int8, shipped_pair
from model.shipped import SHIPPED
from model.simulator.procedural import procedural_scene
from profiles import load_sensor
from profiles.errors import OptionError
from quant.calibration import Patches, draw_patches
from quant.free import quantise_free
from quant.gate import compare
from quant.host_reader import read_core
from quant.limits import Check, Limits, judge, judge_saturation, read_limits
from quant.onnx_file import image_info, save_onnx
from quant.relus import Relus, count_relus
from quant.saturation import rounded_tensors, saturated_shares
from quant.session import open_session

SENSORS = load_sensor("pleiades-degraded"), load_sensor("pleiades-reference")


@pytest.fixture(scope="module")
def reference_model() -> onnx.ModelProto:
    return float_model(None)


@pytest.fixture(scope="module")
def unseen() -> Patches:
    return draw_patches([procedural_scene(900, 900, np.random.default_rng(77))], *SENSORS, 4, 7)


def failed(
    reference_model: onnx.ModelProto, unseen: Patches, folder: Path, spoil: Callable[[onnx.ModelProto], None]
) -> set[str]:
    """The names of the checks that a spoilt copy of the shipped file fails."""
    model = onnx.load(default_int8())
    spoil(model)
    save_onnx(model, folder / "spoilt.onnx")
    result = compare(open_session(reference_model), open_session(model), unseen.pairs)
    limits = Limits(std_over_mae=2.5, saturated=0.001)
    checks = judge(result, limits) + judge_saturation(saturated_shares(model, unseen.degraded), limits)
    checks += structure_checks(reference_model, folder / "spoilt.onnx", model, "vck190")
    return {check.name for check in checks if not check.passed}


def constant(model: onnx.ModelProto, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    tensor = next(t for t in model.graph.initializer if t.name == name)
    value = numpy_helper.to_array(tensor)
    tensor.CopyFrom(numpy_helper.from_array(change(value).astype(value.dtype), name))


def node(model: onnx.ModelProto, name: str) -> onnx.NodeProto:
    found: onnx.NodeProto = next(n for n in model.graph.node if n.name == name)
    return found


def own_constant(model: onnx.ModelProto, name: str, value: np.ndarray) -> str:
    model.graph.initializer.append(numpy_helper.from_array(value, name))
    return name


def nothing(_model: onnx.ModelProto) -> None:
    """Leave the file as it is."""


def drop_a_relu(model: onnx.ModelProto) -> None:
    relu = node(model, "body.2.first.relu")
    source, target = relu.input[0], relu.output[0]
    model.graph.node.remove(relu)
    for reader in model.graph.node:
        reader.input[:] = [source if name == target else name for name in reader.input]


def give_a_float_scale(model: onnx.ModelProto) -> None:
    node(model, "body.4.first").input[6] = own_constant(model, "odd_scale", np.array(0.0043, np.float32))
    node(model, "body.4.second").input[1] = "odd_scale"


def clip_an_activation(model: onnx.ModelProto) -> None:
    """A block's inner tensor at a position three too fine: it saturates."""
    conv, reader = node(model, "body.1.first"), node(model, "body.1.second")
    scale = next(numpy_helper.to_array(t) for t in model.graph.initializer if t.name == conv.input[6])
    conv.input[6] = own_constant(model, "scale_too_fine", scale / np.float32(8))
    reader.input[1] = "scale_too_fine"


def shift_a_bias(model: onnx.ModelProto) -> None:
    constant(model, "body_end.twice.bias", lambda bias: bias * 2)


def swap_the_planes(model: onnx.ModelProto) -> None:
    constant(model, "head.weight", lambda weight: weight[:, [1, 0, 2]])


def test_the_shipped_file_passes(reference_model: onnx.ModelProto, unseen: Patches, tmp_path: Path) -> None:
    assert failed(reference_model, unseen, tmp_path, nothing) == set()


@pytest.mark.parametrize(
    ("spoil", "check"),
    [
        (drop_a_relu, "ReLUs kept"),
        (give_a_float_scale, "legal on the DPU"),
        (clip_an_activation, "MAE"),
        (clip_an_activation, "saturated results"),
        (shift_a_bias, "MAE"),
        (swap_the_planes, "MAE"),
    ],
)
def test_a_spoilt_file_is_stopped(
    spoil: Callable[[onnx.ModelProto], None],
    check: str,
    reference_model: onnx.ModelProto,
    unseen: Patches,
    tmp_path: Path,
) -> None:
    assert check in failed(reference_model, unseen, tmp_path, spoil)


def test_limits_come_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "gate.toml"
    path.write_text("mae = 0.0007\npsnr_drop_db = 0.25\n")
    limits = read_limits(path, None)
    assert (limits.mae, limits.psnr_drop_db, limits.p999) == (0.0007, 0.25, None)
    assert read_limits(path, 0.001).mae == 0.001
    assert read_limits(None, None) == Limits()


@pytest.mark.parametrize(
    "text", ["mae = 'small'", "mae = true", "mea = 0.1", "mae = -1", "mae = nan", "= 3", "[mae]"]
)
def test_limits_that_are_none_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "gate.toml").write_text(text)
    with pytest.raises(OptionError, match=r"gate\.toml"):
        read_limits(tmp_path / "gate.toml", None)
    with pytest.raises(OptionError, match="no such file"):
        read_limits(tmp_path / "none.toml", None)


def test_without_8_bit_results_no_limit_on_them_is_kept() -> None:
    assert judge_saturation({}, Limits()) == []
    (check,) = judge_saturation({}, Limits(saturated=0.5))
    assert not check.passed
    assert "none is 8-bit" in check.found


CHECKS = [Check("MAE", True, "0.0006", "at most 0.0008"), Check("legal <all>", False, "tail: x & y", "the rules")]


def test_a_job_can_read_the_verdict() -> None:
    text = markdown("INT8 gate", CHECKS)
    assert "FAILED" in text
    assert "| MAE | 0.0006 | at most 0.0008 | ok |" in text
    suite = ET.fromstring(junit("INT8 gate", CHECKS))  # noqa: S314 - our own text
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    assert [case.find("failure") is not None for case in suite] == [False, True]


def test_one_file_alone_is_no_pair(tmp_path: Path) -> None:
    (tmp_path / "float.onnx").touch()
    done = CliRunner().invoke(app, ["gate", str(tmp_path / "float.onnx")])
    assert done.exit_code == 2
    assert "expected the INT8 network of float.onnx" in " ".join(done.output.split())
    done = CliRunner().invoke(app, ["gate", *map(str, shipped_pair("convbeers-xs")), "--variant", "convbeers-s"])
    assert done.exit_code == 2
    assert "--variant: expected it without files" in " ".join(done.output.split())
    assert shipped_pair("convbeers-xs") == (SHIPPED / "convbeers-xs.safetensors", SHIPPED / "convbeers-xs-int8.onnx")


ASKED = {"sensor": "pleiades-degraded", "images": None, "patches": 2, "seed": 0}


def test_a_baseline_holds_the_mae(tmp_path: Path) -> None:
    runner, first = CliRunner(), tmp_path / "first.json"
    done = runner.invoke(app, ["gate", "--patches", "2", "--json", str(first), "--junit", str(tmp_path / "j.xml")])
    assert done.exit_code == 0, done.output
    before = baseline_mae(first, ASKED)
    assert ET.parse(tmp_path / "j.xml").getroot().get("failures") == "0"  # noqa: S314
    first.write_text(first.read_text().replace(str(before), str(before / 2)))
    again = runner.invoke(
        app, ["gate", "--patches", "2", "--baseline", str(first), "--summary", str(tmp_path / "s.md")]
    )
    assert again.exit_code == 1
    assert "**failed**" in (tmp_path / "s.md").read_text()
    with pytest.raises(OptionError, match="no such file"):
        baseline_mae(tmp_path / "none.json", ASKED)
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(OptionError, match="another document"):
        baseline_mae(tmp_path / "other.json", ASKED)


@pytest.mark.parametrize(
    "other", [{"seed": 1}, {"patches": 3}, {"sensor": "pleiades-variable"}, {"images": Path("aerial")}]
)
def test_a_baseline_of_other_patches_is_refused(other: dict[str, object], tmp_path: Path) -> None:
    row = Row("gate", "INT8 against float", {"MAE": measured(5e-4, "of full scale", "here")})
    Document("gate", ASKED, (), (row,)).write(tmp_path / "before.json")
    assert baseline_mae(tmp_path / "before.json", ASKED) == 5e-4
    (name,) = other
    with pytest.raises(OptionError, match=f"same patches \\({name}"):
        baseline_mae(tmp_path / "before.json", {**ASKED, **other})


def test_a_folder_of_images_may_lie_elsewhere(tmp_path: Path) -> None:
    row = Row("gate", "INT8 against float", {"MAE": measured(5e-4, "of full scale", "here")})
    Document("gate", {**ASKED, "images": "/here/aerial"}, (), (row,)).write(tmp_path / "before.json")
    assert baseline_mae(tmp_path / "before.json", {**ASKED, "images": Path("there/aerial")}) == 5e-4


SMALL = "convbeers-xs"


@pytest.mark.parametrize("fault", ["twice the bias", "no bias"])
def test_a_baseline_shows_a_wrong_bias_in_any_layer(fault: str, unseen: Patches) -> None:
    """A bias off by one position, or lost, may hide below a limit on the MAE, not in a twentieth of what it was."""
    weights, path = shipped_pair(SMALL)
    session, sound = open_session(float_model(weights)), onnx.load(path)
    before = compare(session, open_session(sound), unseen.pairs).mae
    names = [node.input[8] for node in sound.graph.node if node.op_type == "QLinearConv"]
    assert len(names) == 12
    for name in names:
        model = onnx.ModelProto()
        model.CopyFrom(sound)
        constant(model, name, lambda bias: bias * (2 if fault == "twice the bias" else 0))
        checks = judge(compare(session, open_session(model), unseen.pairs), Limits(), before)
        assert not all(check.passed for check in checks), name


def raise_a_floor(model: onnx.ModelProto) -> None:
    node(model, "body.1.first.relu").input[1] = own_constant(model, "floor", np.array(130, np.uint8))


def as_nodes(model: onnx.ModelProto) -> onnx.ModelProto:
    """The same network, its constants held by nodes."""
    held = [
        onnx.helper.make_node("Constant", [], [t.name], name=f"of.{t.name}", value=t) for t in model.graph.initializer
    ]
    nodes = [*held, *model.graph.node]
    del model.graph.initializer[:], model.graph.node[:]
    model.graph.node.extend(nodes)
    return model


def test_constants_may_be_nodes() -> None:
    sound, other = onnx.load(default_int8()), as_nodes(onnx.load(default_int8()))
    assert count_relus(other) == count_relus(sound) == Relus(8, 0)
    assert [t.name for t in rounded_tensors(other)] == [t.name for t in rounded_tensors(sound)]
    assert read_core(other).positions == read_core(sound).positions


@pytest.mark.parametrize("spelt", [["x", "zero"], ["zero", "x"]])
def test_a_relu_is_the_larger_of_zero_whatever_comes_first(spelt: list[str]) -> None:
    node_, zero = (
        onnx.helper.make_node("Max", spelt, ["y"]),
        numpy_helper.from_array(np.zeros((), np.float32), "zero"),
    )
    ends = image_info("x", 1, None), image_info("y", 1, None)
    model = onnx.helper.make_model(onnx.helper.make_graph([node_], "g", [ends[0]], [ends[1]], [zero]))
    assert count_relus(model) == Relus(1, 0)


def test_results_that_are_never_below_zero_need_no_relu() -> None:
    """An 8-bit range from zero may be a ReLU folded in, or none: both are told apart by what was there in float."""
    found = Relus(spelt=1, folded=2)
    assert [found.may_be(wanted) for wanted in range(5)] == [False, True, True, True, False]


def change_the_host(name: str, value: float) -> Callable[[onnx.ModelProto], None]:
    return lambda model: constant(model, name, lambda _: np.array(value))


def read_at_another_scale(model: onnx.ModelProto) -> None:
    reader = node(model, "body.1.second")
    reader.input[1] = own_constant(model, "other_scale", np.array(2.0**-6, np.float32))


@pytest.mark.parametrize(
    ("spoil", "check"),
    [
        (raise_a_floor, "ReLUs kept"),
        (raise_a_floor, "spelling"),
        (read_at_another_scale, "spelling"),
        (change_the_host("gain", 4), "spelling"),
        (change_the_host("max_dn", 4096), "spelling"),
        (change_the_host("fine_max", 0.25), "spelling"),
    ],
)
def test_what_hardly_shows_in_pixels_is_seen_in_the_file(
    spoil: Callable[[onnx.ModelProto], None],
    check: str,
    reference_model: onnx.ModelProto,
    unseen: Patches,
    tmp_path: Path,
) -> None:
    assert check in failed(reference_model, unseen, tmp_path, spoil)


def test_a_free_file_is_judged_without_the_rules_of_a_dpu(
    reference_model: onnx.ModelProto, unseen: Patches, tmp_path: Path
) -> None:
    path = tmp_path / "free.onnx"
    save_onnx(quantise_free(reference_model, unseen, {}, lambda: None), path)
    checks = structure_checks(reference_model, path, onnx.load(path), "host-cpu")
    assert [(c.name, c.passed) for c in checks] == [("ReLUs kept", True), ("optimised equals unoptimised", True)]
    (rules,) = {c.name for c in structure_checks(reference_model, path, onnx.load(path), "vck190") if not c.passed}
    assert rules == "legal on the DPU"


def test_two_networks_of_one_kind_are_refused(reference_model: onnx.ModelProto, tmp_path: Path) -> None:
    path = tmp_path / "float.onnx"
    save_onnx(reference_model, path)
    for pair, expected in (([path, path], "an INT8"), ([default_int8()] * 2, "a float")):
        done = CliRunner().invoke(app, ["gate", *map(str, pair)])
        assert done.exit_code == 2
        assert f"expected {expected} network" in " ".join(done.output.split())
