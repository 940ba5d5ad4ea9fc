"""A network of several outputs, of which one is kept."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import beers_deploy as bd
from beers_deploy.profiles.errors import BeersError, ModelError, OptionError
from beers_deploy.quant.onnx_file import load_onnx
from beers_deploy.quant.session import open_session
from tests.deploy.command_line import done, refused
from tests.deploy.test_one_answer import drawn
from tests.quant.quick import one_guess

OUTPUTS = ["restored", "large"]
PARTS = ["convolution", "relu", "hard-swish", "split gate"]
SAMPLES = np.kron(
    np.random.default_rng(1).uniform(0, 1, (4, 1, 4, 4)), np.ones((8, 8), np.float32)
).astype(np.float32)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("outputs") / "a.onnx"
    return drawn(path, ["relu"], adds_image=True, clips=True, has_two=True)


@settings(max_examples=20, deadline=None)
@given(
    output=st.sampled_from(OUTPUTS),
    sides=st.tuples(st.integers(5, 23), st.integers(5, 23)),
    parts=st.lists(
        st.sampled_from(["convolution", "relu", "hard-swish", "split gate"]), max_size=3
    ),
    adds_image=st.booleans(),
)
def test_what_is_kept_computes_the_same(
    tmp_path_factory: pytest.TempPathFactory,
    output: str,
    sides: tuple[int, int],
    parts: list[str],
    adds_image: bool,
) -> None:
    path = tmp_path_factory.mktemp("drawn") / "a.onnx"
    drawn(path, parts, adds_image=adds_image, clips=False, has_two=True)
    image = np.random.default_rng(0).random((2, 1, *sides), np.float32)
    expected = open_session(load_onnx(path)).run([output], {"image": image})[0]
    kept = bd.Network.load(path).with_output(output)
    assert [value.name for value in kept.model.graph.output] == [output]
    assert len(kept.model.graph.node) < len(load_onnx(path).graph.node)
    np.testing.assert_allclose(kept(image), expected, atol=1e-5)


@pytest.mark.parametrize("output", OUTPUTS)
def test_quantize_gate_and_check_agree_on_an_output(network: Path, output: str) -> None:
    with one_guess():
        int8 = bd.quantize(network, samples=SAMPLES, output=output, progress=False)
    assert bd.check(network, output=output, tile=64)
    verdict = bd.gate(network, int8, samples=SAMPLES, output=output, max_mae=0.1, progress=False)
    again = bd.gate(int8, samples=SAMPLES, max_mae=0.1, progress=False)
    compared = bd.compare(network, int8, samples=SAMPLES, output=output, progress=False)
    assert verdict.comparison.result.mae == again.comparison.result.mae == compared.result.mae
    assert verdict.arguments["output"] == output
    side_px = 64 if output == "large" else 32
    assert int8(SAMPLES).shape[2:] == (side_px, side_px)


def test_an_output_must_be_named(network: Path, tmp_path: Path) -> None:
    with one_guess():
        int8 = bd.quantize(network, samples=SAMPLES, output="large", progress=False)
    with pytest.raises(ModelError, match=r"it has 2: restored, large\. Name the one to keep"):
        bd.quantize(network, samples=SAMPLES, progress=False)
    with pytest.raises(ModelError, match="it has 2: restored, large"):
        bd.gate(network, int8, samples=SAMPLES, progress=False)
    with pytest.raises(OptionError, match=r"must be an output of .*restored, large, got 'x'"):
        bd.check(network, output="x")
    # Of another output than that of the INT8 file the results have another size.
    with pytest.raises(BeersError, match="made from this float network"):
        bd.gate(network, int8, samples=SAMPLES, output="restored", progress=False)
    np.save(tmp_path / "x.npy", SAMPLES)
    words = ("quantize", network, "--samples", tmp_path / "x.npy", "--out", tmp_path / "b.onnx")
    assert "keep as --output" in refused(*words)
    done(*words, "--output", "restored", "--effort", "fast")
    assert bd.Network.load(tmp_path / "b.onnx")(SAMPLES).shape == SAMPLES.shape
