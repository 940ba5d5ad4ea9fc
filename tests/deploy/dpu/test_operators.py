from pathlib import Path

import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.conv_rules import conv_kernel
from beers_deploy.dpu.checker.operators import all_rules, rule_name, rule_text
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.reading import read_network
from tests.deploy.dpu.draws import (
    TILE_PX,
    Draw,
    behind_conv,
    behind_sum,
    between_convs,
    broken_rules,
    conv,
    node,
    padded,
    resized,
    scaled,
    transposed,
)
from tests.deploy.dpu.graphs import IntegerSketch, Sketch
from tests.deploy.dpu.test_number_graphs import CASES as NUMBER_CASES

DPU = load_dpu("vck190")


# Each rule with a network that breaks it alone, and the same network with the remedy followed.
CASES: dict[str, tuple[Draw, Draw]] = {
    "conv kernel": (conv(8, 8, 17, 1), conv(8, 8, 15, 1)),
    "conv stride": (conv(8, 8, 3, 3, strides=[9, 9]), conv(8, 8, 3, 3, strides=[3, 3])),
    "conv padding": (conv(8, 8, 3, 3, pads=[3, 1, 1, 1]), conv(8, 8, 3, 3, pads=[2, 1, 1, 1])),
    # With padding it would be split, so that no part is too large.
    "conv window": (conv(8, 8, 9, 8, pads=[0] * 4), conv(8, 8, 8, 8)),
    "conv dilation": (
        conv(8, 8, 3, 1, dilations=[513, 1], pads=[513, 0, 513, 0]),
        conv(8, 8, 3, 1, dilations=[512, 1], pads=[513, 0, 513, 0]),
    ),
    "conv groups": (conv(8, 4, 3, 3, group=2), conv(8, 8, 3, 3)),
    "depthwise kernel": (
        conv(8, 1, 257, 1, group=8, pads=[15, 0, 15, 0]),
        conv(8, 1, 255, 1, group=8, pads=[0] * 4),
    ),
    "depthwise stride": (conv(8, 1, 3, 3, group=8, strides=[257, 1]), conv(8, 1, 3, 3, group=8)),
    "depthwise padding": (
        conv(8, 1, 3, 3, group=8, pads=[16, 1, 1, 1]),
        conv(8, 1, 3, 3, group=8, pads=[15, 1, 9, 9]),
    ),
    "transposed kernel": (
        transposed(8, 8, 2, 2, strides=[3, 3]),
        transposed(8, 8, 4, 4, strides=[2, 2]),
    ),
    "transposed output padding": (
        transposed(8, 8, 3, 3, strides=[2, 2], output_padding=[1, 1]),
        transposed(8, 8, 4, 4, strides=[2, 2], pads=[1, 1, 1, 1]),
    ),
    "transposed padding": (
        transposed(8, 8, 2, 2, pads=[3, 0, 0, 0]),
        transposed(8, 8, 2, 2, pads=[2, 0, 0, 0]),
    ),
    "pool kernel": (node("MaxPool", kernel_shape=[257, 1]), node("MaxPool", kernel_shape=[17, 1])),
    "pool stride": (
        node("MaxPool", kernel_shape=[2, 2], strides=[257, 1]),
        node("MaxPool", kernel_shape=[2, 2]),
    ),
    "pool padding": (
        node("MaxPool", kernel_shape=[20, 20], pads=[16, 0, 0, 0]),
        node("MaxPool", kernel_shape=[20, 20], pads=[15, 0, 0, 0]),
    ),
    "activation place": (
        lambda s, x: s.node("Relu", s.node("MaxPool", x, kernel_shape=[2, 2])),
        lambda s, x: s.node("MaxPool", s.node("Relu", x), kernel_shape=[2, 2]),
    ),
    "activation of sums": (behind_sum("HardSwish"), behind_sum("Relu")),
    "leaky relu alpha": (
        behind_conv("LeakyRelu", alpha=0.1),
        behind_conv("LeakyRelu", alpha=26 / 256),
    ),
    "mul constant": (scaled(1, 8, 3, 3), scaled(1, 8, 1, 1)),
    "pad mode": (padded("reflect"), padded("constant")),
    "resize mode": (resized(2, mode="cubic"), resized(2, mode="nearest")),
    "resize scale": (resized(3, mode="linear"), resized(2, mode="linear")),
    "shuffle place": (
        lambda s, x: s.node("DepthToSpace", s.node("MaxPool", x, kernel_shape=[2, 2]), blocksize=1),
        node("DepthToSpace", blocksize=1),
    ),
    "argmax channels": (node("ArgMax", axis=1), behind_conv("Relu")),
    "known operator": (behind_conv("Sigmoid"), behind_conv("HardSigmoid")),
    "operator domain": (
        lambda s, x: s.node("FusedRelu", s.conv(x), domain="com.microsoft"),
        lambda s, x: s.node("Relu", s.conv(x)),
    ),
}
WIDE = {
    "conv channels",
    "conv weight bank",
    "depthwise channels",
    "transposed channels",
    "resize channels",
}
WIDE |= {"elementwise channels", "shuffle channels"}
OTHERS = {"conv area", "int8 operator", "int8 alone", "bias width"}
"""Rules of other boards: tests/deploy/dpu/test_boards.py, test_npu.py."""
SIZES = {"map exists", "maps aligned", "map in memory"}
NUMBERS = {case.split(":")[0] for case in NUMBER_CASES} | {"int32 bias", "on integers"}


def test_every_rule_has_a_case() -> None:
    assert {rule_name(rule) for rule in all_rules()} == set(CASES) | WIDE | SIZES | NUMBERS | OTHERS


@pytest.mark.parametrize("rule", CASES)
def test_each_rule_refuses_its_case_alone_and_following_the_remedy_passes(
    tmp_path: Path, rule: str
) -> None:
    assert [between_convs(tmp_path, draw) for draw in CASES[rule]] == [[rule], []]


@pytest.mark.parametrize(
    ("rule", "draw", "channels"),
    [
        ("conv channels", conv(4097, 8, 1, 1), 8),
        ("conv weight bank", conv(1, 2048, 8, 8, pads=[3] * 4), 2048),
        ("transposed channels", transposed(8, 4097, 1, 1), 8),
        ("depthwise channels", conv(4097, 1, 3, 3, group=4097), 4097),
        ("resize channels", resized(2, mode="nearest"), 4097),
    ],
)
def test_wide_layers(tmp_path: Path, rule: str, draw: Draw, channels: int) -> None:
    sketch = Sketch(channels)
    assert broken_rules(sketch.save(tmp_path / "w.onnx", draw(sketch, "image"))) == [rule]


def test_too_many_channels_for_sums_and_shuffles(tmp_path: Path) -> None:
    sketch = Sketch(8)
    half = sketch.conv("image", (2049, 8, 1, 1))
    joined = sketch.node("Concat", half, half, axis=1)
    assert broken_rules(sketch.save(tmp_path / "w.onnx", sketch.node("Add", joined, joined))) == [
        "elementwise channels"
    ]
    sketch = Sketch(8)
    deep = sketch.node("DepthToSpace", sketch.conv("image", (4100, 8, 1, 1)), blocksize=2)
    path = sketch.save(tmp_path / "s.onnx", sketch.conv(deep, (8, 1025, 1, 1)))
    assert broken_rules(path) == ["conv channels", "shuffle channels"]


def test_a_tile_too_small_for_a_window(tmp_path: Path) -> None:
    sketch = Sketch(8)
    # Behind padding, because the image of a network without any is mirrored.
    unpadded = sketch.conv(sketch.conv("image"), (8, 8, 3, 3), pads=[0] * 4)
    path = sketch.save(tmp_path / "s.onnx", unpadded)
    assert broken_rules(path, tile_px=2) == ["map exists"]
    assert broken_rules(path, tile_px=3) == []


def test_a_tile_that_the_stride_does_not_divide(tmp_path: Path) -> None:
    sketch = Sketch(8)
    stream = sketch.conv("image")
    half = sketch.node("MaxPool", stream, kernel_shape=[2, 2], strides=[2, 2])
    path = sketch.save(
        tmp_path / "u.onnx", sketch.conv(sketch.node("Add", stream, resized(2)(sketch, half)))
    )
    assert broken_rules(path, tile_px=21) == ["maps aligned"]
    assert broken_rules(path, tile_px=22) == []


def test_a_factor_for_a_whole_channel_meets_any_map(tmp_path: Path) -> None:
    sketch = Sketch(8)
    stream = sketch.conv("image")
    factor = sketch.conv(sketch.node("GlobalAveragePool", stream), (8, 8, 1, 1))
    path = sketch.save(tmp_path / "f.onnx", sketch.conv(sketch.node("Mul", stream, factor)))
    assert broken_rules(path, tile_px=37) == []


def test_a_tile_that_the_memory_cannot_hold(tmp_path: Path) -> None:
    sketch = Sketch(1)
    path = sketch.save(
        tmp_path / "m.onnx", sketch.conv(sketch.conv("image", (64, 1, 3, 3)), (1, 64, 3, 3))
    )
    node = place(read_network(path, 7001), DPU).nodes[0]
    assert [violation.rule for violation in node.broken] == ["map in memory"]
    allowed_px = int(7001 * float(node.broken[0].finding.remedy.split()[-4]))
    # The remedy states its factor to two digits only.
    assert broken_rules(path, tile_px=allowed_px - 70) == []
    # This DPU has one image at a time in memory.
    assert broken_rules(path, load_dpu("vck190", "C32B1"), 7001) == []


def test_all_broken_rules_of_a_node_are_listed(tmp_path: Path) -> None:
    draw = conv(8, 4, 17, 9, group=2, strides=[9, 1], pads=[0, 0, 20, 0])
    rules = between_convs(tmp_path, draw)
    assert rules == ["conv kernel", "conv stride", "conv padding", "conv window", "conv groups"]


def test_a_wider_array_needs_more_of_the_weight_bank(tmp_path: Path) -> None:
    sketch = Sketch(1024)
    path = sketch.save(tmp_path / "w.onnx", sketch.conv("image", (4, 1024, 8, 8)))
    assert broken_rules(path, load_dpu("vck190", "C32B1")) == []
    assert broken_rules(path, load_dpu("vck190", "C64B1")) == ["conv weight bank"]


def test_a_float_convolution_in_a_quantized_file_is_refused(tmp_path: Path) -> None:
    sketch = IntegerSketch()
    first = sketch.qconv(sketch.quantized("image"), (4, 1, 3, 3))
    path = sketch.save(
        tmp_path / "f.onnx",
        sketch.conv(sketch.node("DequantizeLinear", first, *sketch.numbers), (1, 4, 3, 3)),
    )
    assert "on integers" in broken_rules(path)


def test_rules_read_with_the_targets_limits() -> None:
    text = rule_text(conv_kernel, DPU)
    assert text == "Kernel height and width are 1 to 16 (UG1414 3.5, DPUCVDX8G, conv2d)."


def test_findings_name_the_numbers_and_a_remedy(tmp_path: Path) -> None:
    sketch = Sketch(8)
    path = sketch.save(tmp_path / "k.onnx", sketch.conv("image", (8, 8, 17, 1)))
    (violation,) = place(read_network(path, TILE_PX), DPU).nodes[0].broken
    assert violation.finding.reason == "kernel (1 x 17) is not in the DPU's range 1 to 16"
    assert "at most 16" in violation.finding.remedy
