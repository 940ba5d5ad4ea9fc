"""Test that the gate finds faults of quantised files, and refuses inputs that do not fit."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import numpy_helper

import beers_deploy as bd
from beers_deploy.float_onnx import float_model
from beers_deploy.network import Network
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.shipped import BLIND
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.gate import compare
from beers_deploy.quant.limits import Limits, judge
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session
from beers_deploy.quant.structure import Relus, count_relus, rounded_tensors, saturated_shares
from beers_deploy.verdict import file_checks
from tests.deploy.command_line import done, refused
from tests.quant.quick import change, changed, drawn, quantized_freely, uniform
from tests.quant.simplify.networks import parsed
from tests.shipped import shipped_pair

Corrupt = Callable[[onnx.ModelProto], object]


@pytest.fixture(scope="module")
def reference_model() -> onnx.ModelProto:
    return float_model(shipped_pair("convbeers-xs")[0])


@pytest.fixture(scope="module")
def unseen() -> Patches:
    return drawn(2, seed=7, scene=77)


def failed_checks(reference_model: onnx.ModelProto, unseen: Patches, corrupt: Corrupt) -> set[str]:
    """Return the names of the checks that a corrupted copy of the shipped file fails."""
    model = onnx.load(shipped_pair("convbeers-xs")[1])
    corrupt(model)
    result = compare(open_session(reference_model), open_session(model), unseen)
    limits = Limits(std_over_mae=2.5, saturated=0.001)
    checks = judge(result, limits, shares=saturated_shares(model, unseen.degraded))
    checks += file_checks(
        reference_model, Network(model, "corrupted"), TargetProfile.load("vck190")
    )
    return {check.name for check in checks if not check.passed}


def node(model: onnx.ModelProto, name: str) -> onnx.NodeProto:
    match: onnx.NodeProto = next(n for n in model.graph.node if n.name == name)
    return match


def feed(model: onnx.ModelProto, name: str, place: int, value: np.ndarray) -> str:
    """Let an input of a node be a constant of its own, and return the constant's name."""
    constant = f"{name}.{place}"
    model.graph.initializer.append(numpy_helper.from_array(value, constant))
    node(model, name).input[place] = constant
    return constant


def feeding(name: str, place: int, value: np.ndarray) -> Corrupt:
    return lambda model: feed(model, name, place, value)


def changing(name: str, by: Callable[[np.ndarray], np.ndarray]) -> Corrupt:
    return lambda model: change(model, name, by)


def drop_a_relu(model: onnx.ModelProto) -> None:
    relu = node(model, "body.2.first.relu")
    source = relu.input[0]
    target = relu.output[0]
    model.graph.node.remove(relu)
    for reader in model.graph.node:
        reader.input[:] = [source if name == target else name for name in reader.input]


def give_a_float_scale(model: onnx.ModelProto) -> None:
    scale = feed(model, "body.2.first", 6, np.array(0.0043, np.float32))
    node(model, "body.2.second").input[1] = scale


def clip_an_activation(model: onnx.ModelProto) -> None:
    """Store a block's inner tensor at a scale that is four bits too fine, so that it saturates."""
    conv = node(model, "body.1.first")
    scale = next(
        numpy_helper.to_array(t) for t in model.graph.initializer if t.name == conv.input[6]
    )
    fine = feed(model, conv.name, 6, scale / np.float32(16))
    node(model, "body.1.second").input[1] = fine


def test_the_shipped_file_passes(reference_model: onnx.ModelProto, unseen: Patches) -> None:
    assert failed_checks(reference_model, unseen, lambda _: None) == set()


@pytest.mark.parametrize(
    ("corrupt", "checks"),
    [
        (drop_a_relu, {"ReLUs lost or added"}),
        (give_a_float_scale, {"faults of the encoding"}),
        (clip_an_activation, {"MAE", "saturated results"}),
        (changing("body.2.first.bias", lambda bias: bias * 4), {"MAE"}),
        # The planes are swapped.
        (changing("bank.weight", lambda weight: weight[:, [0, 2, 1, 3]]), {"MAE"}),
        # These faults hardly change pixels, but are found in the file.
        (
            feeding("body.1.first.relu", 1, np.array(130, np.uint8)),
            {"ReLUs lost or added", "faults of the encoding"},
        ),
        (
            feeding("body.1.second", 1, np.array(2.0**-6, np.float32)),
            {"faults of the encoding"},
        ),
        (changing("gain", lambda _: np.array(4)), {"faults of the encoding"}),
        (changing("max_dn", lambda _: np.array(4096)), {"faults of the encoding"}),
        (changing("fine_max", lambda _: np.array(0.25)), {"faults of the encoding"}),
    ],
)
def test_a_corrupted_file_fails(
    corrupt: Corrupt,
    checks: set[str],
    reference_model: onnx.ModelProto,
    unseen: Patches,
) -> None:
    assert checks <= failed_checks(reference_model, unseen, corrupt)


def test_without_8_bit_results_a_limit_on_them_fails() -> None:
    result = bd.compare("convbeers-xs", patches=1).result
    unlimited = len(judge(result, Limits(), shares={}))
    *others, check = judge(result, Limits(saturated=0.5), shares={})
    assert len(others) == unlimited
    assert not check.passed
    assert "none is 8-bit" in check.actual


def test_options_that_do_not_go_together_are_refused(tmp_path: Path) -> None:
    (tmp_path / "gate.toml").write_text("mae = 0.01\nmae_growth = 1.0001\n")
    assert "'mae_growth' needs a --baseline" in refused(f"gate --limits {tmp_path}/gate.toml")


def test_results_that_are_no_images_are_not_clipped_and_other_shapes_are_refused() -> None:
    def shifted(by: float, channels: int = 1) -> ort.InferenceSession:
        constants = {"w": np.ones((channels, 1, 1, 1)), "b": np.full(channels, by, np.float32)}
        ends = f"float[N,1,H,W] x => float[N,{channels},H,W] y"
        return open_session(parsed("y = Conv(x, w, b)", ends, constants=constants))

    image = uniform(1, 1, 8, 9)
    patches = Patches([(image, np.empty(0, np.float32))], [image])
    assert compare(shifted(-2), shifted(-3), patches).mae == pytest.approx(1)
    with pytest.raises(ModelError, match="1 x 3 x 8 x 9"):
        compare(shifted(0), shifted(0, 3), patches)


SMALL = "convbeers-xs"
SAMPLES = np.random.default_rng(0).uniform(0.1, 0.9, (2, 1, 40, 40)).astype(np.float32)


def test_a_baseline_shows_a_wrong_bias_in_nearly_any_layer(unseen: Patches) -> None:
    """A doubled bias may pass a limit on the MAE, but seldom a limit of 5 % over the baseline.

    The two biases that are left out only change how a copy is rounded.
    """
    weights, path = shipped_pair(SMALL, BLIND)
    session = open_session(float_model(weights))
    intact = onnx.load(path)
    before = compare(session, open_session(intact), unseen).mae
    biases = [node.input[8] for node in intact.graph.node if node.op_type == "QLinearConv"]
    names = [name for name in biases if name not in ("bank.bias", "analytic.bias")]
    assert len(names) == 11
    hidden = set()
    for name in names:
        model = changed(intact, name, lambda bias: bias * 2)
        checks = judge(compare(session, open_session(model), unseen), Limits(), before)
        hidden |= {name.removesuffix(".bias")} if all(check.passed for check in checks) else set()
    assert hidden == {"body.2.second", "body.3.second", "body.3.first"}


def test_the_constants_of_an_int8_file_may_be_nodes() -> None:
    by_initializers = onnx.load(shipped_pair(SMALL)[1])
    by_nodes = onnx.load(shipped_pair(SMALL)[1])
    constants = [
        onnx.helper.make_node("Constant", [], [t.name], name=f"of.{t.name}", value=t)
        for t in by_nodes.graph.initializer
    ]
    nodes = [*constants, *by_nodes.graph.node]
    del by_nodes.graph.initializer[:], by_nodes.graph.node[:]
    by_nodes.graph.node.extend(nodes)
    assert count_relus(by_nodes) == count_relus(by_initializers) == Relus(4, 0)
    names = [tensor.name for tensor in rounded_tensors(by_initializers)]
    assert [tensor.name for tensor in rounded_tensors(by_nodes)] == names
    assert read_core(by_nodes).frac_bits == read_core(by_initializers).frac_bits


def test_results_that_are_never_below_zero_need_no_relu() -> None:
    """An 8-bit range from zero may contain a ReLU or not. The count in float decides."""
    relus = Relus(explicit=1, folded=2)
    assert [relus.off_by(count) for count in range(6)] == [1, 0, 0, 0, 1, 2]


def test_a_file_of_another_quantizer_is_judged_without_the_rules_of_a_dpu(model: Path) -> None:
    reference_model = load_onnx(model)
    free = Network(quantized_freely(reference_model, per_channel=True), "free")
    checks = file_checks(reference_model, free, TargetProfile.load("host-cpu"))
    assert [(c.name, c.passed) for c in checks] == [
        ("ReLUs lost or added", True),
        ("layers computed in float", True),
        ("optimised against unoptimised", True),
    ]
    (rules,) = {
        c.name
        for c in file_checks(reference_model, free, TargetProfile.load("vck190"))
        if not c.passed
    }
    assert rules == "nodes the DPU refuses"


def test_two_networks_of_one_kind_are_refused() -> None:
    for path, expected in zip(shipped_pair("convbeers-xs"), ("an INT8", "a float"), strict=True):
        assert f"must be {expected} network" in refused("gate", path, path)


def test_samples_without_references_have_no_loss_and_no_limit_on_it(
    tmp_path: Path,
) -> None:
    samples = tmp_path / "samples.npy"
    limits = tmp_path / "limits.toml"
    np.save(samples, SAMPLES)
    command = f"gate convbeers-xs --samples {samples} --max-mae 0.1"
    output = done(command)
    assert "gate passed" in output
    assert "nan" not in output.lower()
    limits.write_text("psnr_drop_db = 0.25\n", encoding="utf-8")
    message = refused(f"{command} --limits {limits}")
    assert "--samples must have references for the limit 'psnr_drop_db'" in message


def test_a_metric_without_a_limit_is_noted_as_not_judged(tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", image=SAMPLES, reference=SAMPLES)
    limits = tmp_path / "limits.toml"
    command = f"gate {SMALL} --samples {tmp_path / 's.npz'} --metric mae --limits {limits}"
    note = "not judged: mae lost, because --limits sets no 'metric_loss'"
    for text, unjudged in (("mae = 0.1\n", True), ("mae = 0.1\nmetric_loss = 0.5\n", False)):
        limits.write_text(text, encoding="utf-8")
        assert (note in " ".join(done(command).split())) == unjudged


def test_a_float_network_without_a_gain_is_noted_as_not_judged_by_its_gain(tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", image=SAMPLES, reference=SAMPLES)
    np.save(tmp_path / "s.npy", SAMPLES)
    note = "not judged: PSNR drop over gain, because the float network's PSNR is not above"
    for name, noted in (("s.npz", True), ("s.npy", False)):
        output = done(f"gate {SMALL} --samples {tmp_path / name} --max-mae 0.1")
        assert (note in " ".join(output.split())) == noted


def test_references_that_do_not_fit_are_refused_and_the_sample_is_named(tmp_path: Path) -> None:
    path = tmp_path / "s.npz"
    limits = tmp_path / "limits.toml"
    limits.write_text("mae = 0.1\npsnr_drop_db = 20\n", encoding="utf-8")
    command = f"gate {SMALL} --samples {path}"
    np.savez(path, image=SAMPLES, reference=SAMPLES * 4095)
    assert "reference of s.npz[0]" in refused(f"{command} --limits {limits}")
    np.savez(path, image=SAMPLES, reference=SAMPLES[..., :20])
    message = refused(f"{command} --limits {limits}")
    assert "s.npz[0] must have a reference of the size" in message
    assert "the limit 'psnr_drop_db'" in message
    assert "1 x 40 x 20" in message
    # Without a limit on the PSNR drop no check needs the references.
    assert "gate passed" in done(f"{command} --max-mae 0.1")
