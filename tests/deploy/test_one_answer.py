"""Test that check, quantize, gate, bench and restore agree on which networks they accept."""

import logging
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from onnx import helper

import beers_deploy as bd
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.quant.input_range import from_shares, to_shares
from tests.deploy.dpu.graphs import SAME
from tests.quant.quick import fix_sizes, one_guess
from tests.quant.simplify.networks import parsed

SAMPLES = np.random.default_rng(1).uniform(0, 1, (8, 1, 32, 32)).astype(np.float32)
GENERATOR = np.random.default_rng(5)
SHAPES = {
    "first": (4, 1, 3, 3),
    "second": (4, 1, 3, 3),
    "w": (4, 4, 3, 3),
    "wide": (8, 4, 3, 3),
    "four": (4, 4, 3, 3),
    "one": (1, 4, 3, 3),
    "one_of_eight": (1, 8, 3, 3),
}
CONSTANTS: dict[str, Any] = {
    **{name: GENERATOR.normal(0, 0.3, shape) for name, shape in SHAPES.items()},
    "broad": np.full((4, 4, 9, 9), 0.01),
    "halves": np.full((4, 1, 1), 2.0),
    "zero": 0.0,
    "three": 3.0,
    "six": 6.0,
    "twos": [2, 2],
    "minus_twos": [-2, -2],
    "sides": [2, 3],
    "double": [1.0, 1.0, 2.0, 2.0],
}
ENDS = "float[N,1,H,W] image => float[N,1,P,Q] y"
TWO = f"a = {SAME}(image, first) b = {SAME}(image, second)"
BLOCKS = 'coordinate_transformation_mode="asymmetric", nearest_mode="floor"'
PARTS = {
    "convolution": "{y} = {conv}({x}, w)",
    "valid": "{y} = Conv({x}, w)",
    "large kernel": "{y} = Conv<pads=[4,4,4,4]>({x}, broad)",
    "crop": "{y} = Slice({x}, twos, minus_twos, sides)",
    "relu": "{y} = Relu({x})",
    "one-sided clip": "{y} = Clip({x}, zero)",
    "larger of two": "{y} = Max({x}, zero)",
    # As exporters spell it out.
    "hard-swish": """{y}a = Add({x}, three) {y}b = Clip({y}a, zero, six) {y}c = Div({y}b, six)
        {y} = Mul({x}, {y}c)""",
    # NAFNet's gate.
    "split gate": """{y}a = {conv}({x}, wide) {y}b, {y}c = Split<axis=1>({y}a)
        {y} = Mul({y}b, {y}c)""",
    "less itself": "{y}a = {conv}({x}, w) {y} = Sub({y}a, {x})",
    "over a constant": "{y} = Div({x}, halves)",
    "down and up": """{y}a = MaxPool<kernel_shape=[2,2], strides=[2,2]>({x})
        {y} = Resize<{blocks}>({y}a, , double)""",
    "one channel": "{y}a = Conv<pads=[1,1,1,1]>({x}, one) {y} = Mul({x}, {y}a)",
    "leaky": "{y} = LeakyRelu<alpha=0.3>({x})",
    "hard sigmoid": "{y} = HardSigmoid<alpha=0.2>({x})",
    "mean over channels": "{y}a = ReduceMean<axes=[1]>({x}) {y} = Sub({x}, {y}a)",
    "sine": "{y} = Sin({x})",
}
"""Operations from a map `x` of four channels to another one, `y`, in ONNX's text format."""


RANGES = [(0.0, 1.0), (-1.0, 1.0), (0.0, 255.0), (-2.1, 2.6)]


def drawn(
    path: Path,
    parts: list[str],
    *,
    adds_image: bool,
    clips: bool,
    padded: bool = True,
    ends: tuple[float, float] = (0.0, 1.0),
    has_two: bool = False,
    is_active: bool = False,
) -> Path:
    """Write a network of these parts between two convolutions, for images of a range.

    It may have an output of twice the sampling too, and an activation of the image.
    """
    conv = f"Conv<pads={[int(padded)] * 4}>"
    source = "active" if is_active else "image"
    nodes = ["active = Relu(image)"] if is_active else []
    nodes.append(f"x0 = {conv}({source}, first)")
    for number, part in enumerate(parts):
        names = {"x": f"x{number}", "y": f"x{number + 1}"}
        nodes.append(PARTS[part].format(**names, conv=conv, blocks=BLOCKS))
    nodes.append(f"pixels = {conv}(x{len(parts)}, four) result = {conv}(x{len(parts)}, one)")
    result = "result"
    # Without padding the result has another size than the image.
    if adds_image and padded:
        nodes.append(f"sum = Add(image, {result})")
        result = "sum"
    if clips:
        nodes.append(f"clipped = Clip({result}, low, high)")
        result = "clipped"
    nodes.append(f"restored = Identity({result})")
    outputs = "float[N,1,P,Q] restored"
    if has_two:
        nodes.append("large = DepthToSpace<blocksize=2>(pixels)")
        outputs += ", float[N,1,R,S] large"
    size = ends[1] - ends[0]
    constants = {**CONSTANTS, "first": CONSTANTS["first"] / size, "low": ends[0], "high": ends[1]}
    constants |= {name: size * CONSTANTS[name] for name in ("four", "one")}
    model = parsed(" ".join(nodes), f"float[N,1,H,W] image => {outputs}", constants=constants)
    onnx.save(model, path)
    return path


def quickly(
    network: Path | onnx.ModelProto, samples: np.ndarray = SAMPLES, **options: Any
) -> bd.Network:
    """Quantise a network without a search."""
    with one_guess():
        return bd.quantize(network, samples=samples, progress=False, **options)


@settings(max_examples=15)
@given(
    parts=st.lists(st.sampled_from(sorted(PARTS)), max_size=3),
    adds_image=st.booleans(),
    clips=st.booleans(),
    padded=st.booleans(),
    is_active=st.booleans(),
    ends=st.sampled_from(RANGES),
    output=st.sampled_from([None, "restored", "large"]),
)
def test_commands_do_not_contradict_each_other(
    tmp_path_factory: pytest.TempPathFactory,
    parts: list[str],
    ends: tuple[float, float],
    output: str | None,
    **shape: bool,
) -> None:
    """If check accepts a network, it also accepts the quantised network, which runs.

    If check refuses it, quantize refuses it too, or check refuses the quantised network.
    """
    path = tmp_path_factory.mktemp("drawn") / "a.onnx"
    drawn(path, parts, ends=ends, has_two=output is not None, **shape)
    blocks = np.random.default_rng(1).uniform(0, 1, (4, 1, 4, 4)).astype(np.float32)
    shares = np.kron(blocks, np.ones((8, 8), np.float32))
    samples = from_shares(shares, (ends,))
    fits = bool(bd.check(path, tile=64, output=output))
    try:
        int8 = quickly(path, samples, input_range=ends, output=output)
    except ModelError:
        int8 = None
    # A network that a board does not run may be quantised: an activation behind a resize, for one.
    assert fits == (int8 is not None and bool(bd.check(int8, tile=64)))
    if not fits:
        return
    try:
        bd.gate(path, int8, samples=samples, output=output, progress=False)
    except OptionError as error:
        assume("more contrast" not in str(error))
        raise
    assert int8 is not None
    for network in (path, int8):
        bd.bench(network, tile=64, traditional=False)
    restored = bd.restore(shares[0, 0], network=int8, full_scale=1, progress=False, force=True)
    # The whole image is one tile.
    expected = np.clip(to_shares(int8(samples[:1])[0, 0][None], (ends,)), 0, 1)[0]
    np.testing.assert_allclose(restored, expected, atol=0.01)


def fixed(model: onnx.ModelProto, side_px: int) -> onnx.ModelProto:
    """Return a network that is fixed to images of a size."""
    fix_sizes(model.graph.input[0], side_px, side_px)
    return onnx.shape_inference.infer_shapes(model)


def test_unpadded_networks_of_a_fixed_size_get_one_answer(tmp_path: Path) -> None:
    """Every command accepts a network without padding at a fixed size, as it does at any size."""
    path = drawn(
        tmp_path / "a.onnx", ["relu", "valid"], adds_image=False, clips=False, padded=False
    )
    model = fixed(onnx.load(path), 32)
    assert bd.check(model)
    int8 = quickly(model)
    assert int8.table is not None
    assert not any("`restore`" in note for note in int8.table.notes)
    assert int8(SAMPLES[:1]).shape == SAMPLES[:1].shape
    assert bd.gate(model, int8, samples=SAMPLES, max_mae=0.1, progress=False)
    how: dict[str, Any] = {"full_scale": 1, "progress": False, "force": True, "tile": 32}
    image = np.tile(SAMPLES[0, 0], (2, 2))
    for network in (model, int8):
        swath = bd.bench(network, tile=32, traditional=False)
        assert not any("whole images" in note for note in swath.notes)
        assert bd.restore(image, network=network, **how).shape == image.shape


@pytest.mark.parametrize(
    ("sizes", "remedy"),
    [
        ([1, 1, "H", 32], "with free or with equal height and width"),
        ([4, 1, "H", "W"], "for one image, or for any number of them"),
        ([1, "C", "H", "W"], "with a fixed number of channels"),
    ],
)
def test_an_input_that_is_no_image_has_one_remedy(
    sizes: list[int | str], remedy: str, tmp_path: Path
) -> None:
    """Every command states the same reason, `check` in a table if the sizes fit a tile."""
    path = drawn(tmp_path / "a.onnx", ["relu"], adds_image=True, clips=False)
    int8 = quickly(path)
    model = onnx.load(path)
    (image,) = model.graph.input
    image.CopyFrom(helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, sizes))
    onnx.save(model, path)

    def check() -> None:
        checked = bd.check(path)
        assert not checked
        raise ModelError(checked.verdict)

    for command in (
        check,
        lambda: quickly(path),
        lambda: bd.gate(path, int8, samples=SAMPLES, progress=False),
        lambda: bd.bench(path, size="64x64", traditional=False),
        lambda: bd.restore(SAMPLES[0, 0], network=path, full_scale=1, progress=False),
    ):
        with pytest.raises(ModelError, match=f"The input 'image' must .* network {remedy}"):
            command()


def test_quantize_notes_that_restore_leaves_seams() -> None:
    """A network that pools over its whole image has integers, and independent tiles alone."""
    nodes = f"""
        a = {SAME}(image, first) mean = GlobalAveragePool(a) b = {SAME}(mean, w)
        gate = HardSigmoid<alpha=0.16666667>(b) gated = Mul(a, gate) y = {SAME}(gated, one)
    """
    int8 = quickly(fixed(parsed(nodes, ENDS, constants=CONSTANTS), 32))
    assert int8.table is not None
    assert any("restores its tiles independently" in note for note in int8.table.notes)
    restore = partial(bd.restore, network=int8, full_scale=1, tile=32, force=True, progress=False)
    one_tile = SAMPLES[0, 0]
    assert restore(one_tile).shape == one_tile.shape
    larger = np.tile(one_tile, (1, 2))
    with pytest.raises(OptionError, match=r"cannot be tiled.* give `halo` a number"):
        restore(larger)
    assert restore(larger, halo="4").shape == larger.shape


def test_quantize_warns_of_what_the_board_refuses(caplog: pytest.LogCaptureFixture) -> None:
    """The file is written, because other hardware may run it, but the user is warned."""
    nodes = f"{TWO} c = Add(a, b) leaky = LeakyRelu<alpha=0.1015625>(c) y = {SAME}(leaky, one)"
    model = parsed(nodes, ENDS, constants=CONSTANTS)
    board = "zcu102"
    with caplog.at_level(logging.WARNING, "beers_deploy"):
        int8 = quickly(model, target=board)
    (warning,) = caplog.messages
    assert warning.startswith(f"{board} does not run it: check FAILED")
    assert "LeakyRelu stands behind add" in warning
    assert not bd.check(int8, target=board)


@pytest.mark.parametrize(
    ("operation", "last"),
    [
        ("Add(a, b)", "one"),
        ("Mul(a, b)", "one"),
        ("Concat<axis=1>(a, b)", "one_of_eight"),
        ("AveragePool<kernel_shape=[3,3], pads=[1,1,1,1], count_include_pad=1>(a)", "one"),
    ],
)
def test_a_network_after_adapt_passes_behind_any_operation(operation: str, last: str) -> None:
    """`check` advises `--adapt`, so the result of `--adapt` must pass."""
    nodes = f"{TWO} c = {operation} s = Sigmoid(c) silu = Mul(c, s) y = {SAME}(silu, {last})"
    assert bd.check(quickly(parsed(nodes, ENDS, constants=CONSTANTS), adapt=True))
