"""Test that check, quantize, gate, bench and restore agree on which networks they accept."""

import logging
from collections.abc import Callable
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
from beers_deploy.quant.onnx.image_input import image_info
from beers_deploy.quant.onnx_file import GraphWriter, make_model
from tests.quant.quick import fix_sizes, one_guess

CHANNELS = 4
GENERATOR = 5
SAMPLES = np.random.default_rng(1).uniform(0, 1, (8, 1, 32, 32)).astype(np.float32)


class Drawn(GraphWriter):
    """Writes a network of drawn weights."""

    def __init__(self, pad: int) -> None:
        """Begin a network whose convolutions are padded by `pad` unless they state another
        number.
        """
        super().__init__()
        self._pad = pad
        self._generator = np.random.default_rng(GENERATOR)

    def number(self, value: float, *shape: int) -> str:
        """Write a constant of one value and return its name."""
        name = f"number_{len(self.nodes)}_{value}"
        return self.constant(name, np.full(shape, value, np.float32))

    def integers(self, *values: int) -> str:
        """Write a constant list and return its name."""
        return self.constant(f"integers_{len(self.nodes)}_{values}", np.array(values))

    def add(self, kind: str, *sources: str, **attributes: Any) -> str:
        """Write a node and return its result."""
        return self.node(kind, f"t{len(self.nodes)}", list(sources), **attributes)

    def conv(
        self, source: str, outputs: int, inputs: int, pad: int | None = None, gain: float = 1
    ) -> str:
        """Write a convolution of 3 x 3 with drawn weights and return its result."""
        pad = self._pad if pad is None else pad
        weight = gain * self._generator.normal(0, 0.3, (outputs, inputs, 3, 3))
        name = self.constant(f"w{len(self.nodes)}", weight.astype(np.float32))
        return self.add("Conv", source, name, pads=[pad] * 4)

    def save(self, path: Path, *results: str) -> Path:
        """Write the network with these results of one channel to a file."""
        infos = [
            helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["N", 1, None, None])
            for name in results
        ]
        graph = self.graph("drawn", [image_info("image", 1, None)], infos)
        onnx.save(make_model(graph, {}), path)
        return path


Part = Callable[[Drawn, str], str]
"""Writes operations behind a map of `CHANNELS` channels, and returns another such map."""


def split_gate(w: Drawn, source: str) -> str:
    """Write NAFNet's gate."""
    wide = w.conv(source, 2 * CHANNELS, CHANNELS)
    names = [f"{wide}.a", f"{wide}.b"]
    node = helper.make_node("Split", [wide], names, f"{wide}.split", axis=1)
    w.nodes.append(node)
    return w.add("Mul", *names)


def hard_swish(w: Drawn, source: str) -> str:
    """Write HardSwish as exporters spell it out."""
    clipped = w.add("Clip", w.add("Add", source, w.number(3)), w.number(0), w.number(6))
    return w.add("Mul", source, w.add("Div", clipped, w.number(6)))


PARTS: dict[str, Part] = {
    "convolution": lambda w, x: w.conv(x, CHANNELS, CHANNELS),
    "valid": lambda w, x: w.conv(x, CHANNELS, CHANNELS, pad=0),
    "large kernel": lambda w, x: w.add(
        "Conv", x, w.number(0.01, CHANNELS, CHANNELS, 9, 9), pads=[4] * 4
    ),
    "crop": lambda w, x: w.add("Slice", x, *(w.integers(k, k) for k in (2, -2)), w.integers(2, 3)),
    "relu": lambda w, x: w.add("Relu", x),
    "one-sided clip": lambda w, x: w.add("Clip", x, w.number(0)),
    "larger of two": lambda w, x: w.add("Max", x, w.number(0)),
    "hard-swish": hard_swish,
    "split gate": split_gate,
    "less itself": lambda w, x: w.add("Sub", w.conv(x, CHANNELS, CHANNELS), x),
    "over a constant": lambda w, x: w.add("Div", x, w.number(2, CHANNELS, 1, 1)),
    "down and up": lambda w, x: w.add(
        "Resize",
        w.add("MaxPool", x, kernel_shape=[2, 2], strides=[2, 2]),
        "",
        w.constant("twice", np.array([1, 1, 2, 2], np.float32)),
        mode="nearest",
        coordinate_transformation_mode="asymmetric",
        nearest_mode="floor",
    ),
    "one channel": lambda w, x: w.add("Mul", x, w.conv(x, 1, CHANNELS, pad=1)),
    "leaky": lambda w, x: w.add("LeakyRelu", x, alpha=0.3),
    "hard sigmoid": lambda w, x: w.add("HardSigmoid", x, alpha=0.2),
    "mean over channels": lambda w, x: w.add("Sub", x, w.add("ReduceMean", x, axes=[1])),
    "sine": lambda w, x: w.add("Sin", x),
}


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
    w = Drawn(int(padded))
    size = ends[1] - ends[0]
    first = w.add("Relu", "image") if is_active else "image"
    last = w.conv(first, CHANNELS, 1, gain=1 / size)
    for part in parts:
        last = PARTS[part](w, last)
    large = w.conv(last, 4, CHANNELS, gain=size)
    last = w.conv(last, 1, CHANNELS, gain=size)
    # Without padding the result has another size than the image.
    if adds_image and padded:
        last = w.add("Add", "image", last)
    if clips:
        last = w.add("Clip", last, *map(w.number, ends))
    names = [w.node("Identity", "restored", [last])]
    if has_two:
        names.append(w.node("DepthToSpace", "large", [large], blocksize=2))
    return w.save(path, *names)


def quickly(network: Path, samples: np.ndarray = SAMPLES, **options: Any) -> bd.Network:
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


def fixed(path: Path, side_px: int) -> Path:
    """Write the network of a file again, fixed to images of a size."""
    model = onnx.load(path)
    fix_sizes(model.graph.input[0], side_px, side_px)
    onnx.save(onnx.shape_inference.infer_shapes(model), path.with_name("fixed.onnx"))
    return path.with_name("fixed.onnx")


def test_unpadded_networks_of_a_fixed_size_get_one_answer(tmp_path: Path) -> None:
    """Every command accepts a network without padding at a fixed size, as it does at any size."""
    path = drawn(
        tmp_path / "a.onnx", ["relu", "valid"], adds_image=False, clips=False, padded=False
    )
    path = fixed(path, 32)
    assert bd.check(path)
    int8 = quickly(path)
    assert int8.table is not None
    assert not any("`restore`" in note for note in int8.table.notes)
    assert int8(SAMPLES[:1]).shape == SAMPLES[:1].shape
    assert bd.gate(path, int8, samples=SAMPLES, max_mae=0.1, progress=False)
    how: dict[str, Any] = {"full_scale": 1, "progress": False, "force": True, "tile": 32}
    image = np.tile(SAMPLES[0, 0], (2, 2))
    for network in (path, int8):
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


def test_quantize_notes_that_restore_leaves_seams(tmp_path: Path) -> None:
    """A network that pools over its whole image has integers, and independent tiles alone."""
    w = Drawn(1)
    first = w.conv("image", CHANNELS, 1)
    gate = w.add("HardSigmoid", w.conv(w.add("GlobalAveragePool", first), CHANNELS, CHANNELS))
    w.nodes[-1].attribute.append(helper.make_attribute("alpha", 1 / 6))
    last = w.conv(w.add("Mul", first, gate), 1, CHANNELS)
    int8 = quickly(fixed(w.save(tmp_path / "a.onnx", last), 32))
    assert int8.table is not None
    assert any("restores its tiles independently" in note for note in int8.table.notes)
    restore = partial(bd.restore, network=int8, full_scale=1, tile=32, force=True, progress=False)
    one_tile = SAMPLES[0, 0]
    assert restore(one_tile).shape == one_tile.shape
    larger = np.tile(one_tile, (1, 2))
    with pytest.raises(OptionError, match=r"cannot be tiled.* give `halo` a number"):
        restore(larger)
    assert restore(larger, halo="4").shape == larger.shape


def test_quantize_warns_of_what_the_board_refuses(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The file is written, because other hardware may run it, but the user is warned."""
    w = Drawn(1)
    first, second = (w.conv("image", CHANNELS, 1) for _ in range(2))
    leaky = w.add("LeakyRelu", w.add("Add", first, second), alpha=26 / 256)
    path = w.save(tmp_path / "a.onnx", w.conv(leaky, 1, CHANNELS))
    board = "zcu102"
    with caplog.at_level(logging.WARNING, "beers_deploy"):
        int8 = quickly(path, target=board)
    (warning,) = caplog.messages
    assert warning.startswith(f"{board} does not run it: check FAILED")
    assert "LeakyRelu stands behind add" in warning
    assert not bd.check(int8, target=board)


@pytest.mark.parametrize("kind", ["Add", "Mul", "Concat", "AveragePool"])
def test_a_network_after_adapt_passes_behind_any_operation(kind: str, tmp_path: Path) -> None:
    """`check` advises `--adapt`, so the result of `--adapt` must pass."""
    w = Drawn(1)
    feeds = [w.conv("image", CHANNELS, 1) for _ in range(2)]
    attributes: dict[str, Any] = {"axis": 1} if kind == "Concat" else {}
    if kind == "AveragePool":
        feeds = feeds[:1]
        attributes = {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1], "count_include_pad": 1}
    source = w.add(kind, *feeds, **attributes)
    silu = w.add("Mul", source, w.add("Sigmoid", source))
    last = w.conv(silu, 1, CHANNELS * (2 if kind == "Concat" else 1))
    path = w.save(tmp_path / "a.onnx", last)
    assert bd.check(quickly(path, adapt=True))
