"""Tests of a network of several outputs, of which a user names one."""

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
from tests.quant.quick import one_guess, uniform

OUTPUTS = ["restored", "large"]
PARTS = ["convolution", "relu", "hard-swish", "split gate"]
BLOCKS = np.random.default_rng(1).uniform(0, 1, (4, 1, 4, 4)).astype(np.float32)
SAMPLES = np.kron(BLOCKS, np.ones((8, 8), np.float32))
SIDES = st.integers(5, 23)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a network with an output of its image's size and one of twice that size."""
    path = tmp_path_factory.mktemp("outputs") / "a.onnx"
    return drawn(path, ["relu"], adds_image=True, clips=True, has_two=True)


@settings(max_examples=20)
@given(
    output=st.sampled_from(OUTPUTS),
    sides=st.tuples(SIDES, SIDES),
    parts=st.lists(st.sampled_from(PARTS), max_size=3),
    adds_image=st.booleans(),
)
def test_a_network_with_one_output_computes_the_same(
    tmp_path_factory: pytest.TempPathFactory,
    output: str,
    sides: tuple[int, int],
    parts: list[str],
    adds_image: bool,
) -> None:
    """The network with one output returns what the whole network returns there.

    It has fewer nodes, because a board should not compute the output that nobody reads.
    """
    path = tmp_path_factory.mktemp("drawn") / "a.onnx"
    drawn(path, parts, adds_image=adds_image, clips=False, has_two=True)
    model = load_onnx(path)
    image = uniform(2, 1, *sides)
    expected = open_session(model).run([output], {"image": image})[0]
    kept = bd.Network.load(path).with_output(output)
    graph = kept.model.graph
    assert [value.name for value in graph.output] == [output]
    assert len(graph.node) < len(model.graph.node)
    np.testing.assert_allclose(kept(image), expected, atol=1e-5)
    other = next(name for name in OUTPUTS if name != output)
    assert kept != bd.Network.load(path).with_output(other)


@pytest.mark.parametrize("output", OUTPUTS)
def test_quantize_gate_and_check_agree_on_an_output(network: Path, output: str) -> None:
    """Every command that is given the same output judges the same network.

    The INT8 file names its output, so `gate` of the file alone finds the same error.
    """
    with one_guess():
        int8 = bd.quantize(network, samples=SAMPLES, output=output, progress=False)
    assert bd.check(network, output=output, tile=64)
    verdict = bd.gate(network, int8, samples=SAMPLES, output=output, max_mae=0.1, progress=False)
    again = bd.gate(int8, samples=SAMPLES, max_mae=0.1, progress=False)
    compared = bd.compare(network, int8, samples=SAMPLES, output=output, progress=False)
    mae = verdict.comparison.result.mae
    assert again.comparison.result.mae == mae
    assert compared.result.mae == mae
    assert verdict.arguments["output"] == output
    side_px = 64 if output == "large" else 32
    assert int8(SAMPLES).shape[2:] == (side_px, side_px)


def test_an_output_must_be_named(network: Path, tmp_path: Path) -> None:
    """A network of several outputs is refused until one is named, by the commands and in Python.

    The message lists the outputs. An output other than that of the INT8 file is refused as well.
    """
    with one_guess():
        int8 = bd.quantize(network, samples=SAMPLES, output="large", progress=False)
    with pytest.raises(ModelError, match=r"it has 2: restored, large\. Name the one to keep"):
        bd.quantize(network, samples=SAMPLES, progress=False)
    with pytest.raises(ModelError, match="it has 2: restored, large"):
        bd.gate(network, int8, samples=SAMPLES, progress=False)
    with pytest.raises(OptionError, match=r"must be an output of .*restored, large, got 'x'"):
        bd.check(network, output="x")
    # The results of the other output have another size than those of the INT8 file.
    with pytest.raises(BeersError, match="made from this float network"):
        bd.gate(network, int8, samples=SAMPLES, output="restored", progress=False)
    samples_path = tmp_path / "x.npy"
    int8_path = tmp_path / "b.onnx"
    np.save(samples_path, SAMPLES)
    words = ("quantize", network, "--samples", samples_path, "--out", int8_path)
    assert "keep as --output" in refused(*words)
    assert "keep as --output" in " ".join(done("check", network, "--tile", 64, code=1).split())
    assert "keep as --output" in done("check", network, "--tile", 64, "--quiet", code=1)
    done(*words, "--output", "restored", "--effort", "fast")
    restoring = bd.Network.load(int8_path)
    assert restoring(SAMPLES).shape == SAMPLES.shape
