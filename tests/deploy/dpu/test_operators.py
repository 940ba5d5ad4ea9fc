"""Each rule about operators refuses the network that breaks it, and passes the one that follows
its remedy.
"""

from contextlib import nullcontext
from pathlib import Path

import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.operators import all_rules, rule_name
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.reading import read_network
from tests.deploy.dpu.draws import (
    TILE_PX,
    Draw,
    as_written,
    behind_conv,
    behind_mean,
    behind_pool,
    behind_sum,
    between_convs,
    broken_rules,
    conv,
    conv_3x3,
    depthwise,
    in_two,
    max_pool,
    mean_pool,
    node,
    padded,
    resized,
    scaled,
    transposed,
)
from tests.deploy.dpu.graphs import IntegerSketch, Sketch
from tests.deploy.dpu.test_number_graphs import CASES as NUMBER_CASES

DPU = load_dpu("vck190")
NARROW_ARRAY = "C32B1"


# Each rule with a network that breaks it alone, and the same network with the remedy followed.
CASES: dict[str, tuple[Draw, Draw]] = {
    "conv kernel": (conv(8, 8, 17, 1), conv(8, 8, 15, 1)),
    "conv stride": (conv_3x3(strides=[9, 9]), conv_3x3(strides=[3, 3])),
    "conv padding": (conv_3x3(pads=[3, 1, 1, 1]), conv_3x3(pads=[2, 1, 1, 1])),
    "conv window": (conv(8, 8, 9, 8, pads=[0] * 4), conv(8, 8, 8, 8)),
    "conv dilation": (
        conv(8, 8, 3, 1, dilations=[513, 1], pads=[513, 0, 513, 0]),
        conv(8, 8, 3, 1, dilations=[512, 1], pads=[513, 0, 513, 0]),
    ),
    "conv groups": (conv(8, 4, 3, 3, group=2), conv_3x3()),
    "depthwise kernel": (
        depthwise(257, 1, pads=[15, 0, 15, 0]),
        depthwise(255, 1, pads=[0] * 4),
    ),
    "depthwise stride": (depthwise(3, 3, strides=[257, 1]), depthwise(3, 3)),
    "depthwise padding": (
        depthwise(3, 3, pads=[16, 1, 1, 1]),
        depthwise(3, 3, pads=[15, 1, 9, 9]),
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
    "pool kernel": (max_pool(257, 1), max_pool(17, 1)),
    "pool stride": (
        max_pool(2, 2, strides=[257, 1]),
        max_pool(2, 2),
    ),
    "pool padding": (
        max_pool(20, 20, pads=[16, 0, 0, 0]),
        max_pool(20, 20, pads=[15, 0, 0, 0]),
    ),
    "activation place": (behind_mean("Relu"), in_two(node("Relu"), mean_pool())),
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
        behind_pool("DepthToSpace", blocksize=1),
        node("DepthToSpace", blocksize=1),
    ),
    "argmax channels": (node("ArgMax", axis=1), behind_conv("Relu")),
    "known operator": (behind_conv("Sigmoid"), behind_conv("HardSigmoid")),
    "operator domain": (
        behind_conv("FusedRelu", domain="com.microsoft"),
        behind_conv("Relu"),
    ),
}
WIDE = {
    "conv channels",
    "conv weight bank",
    "depthwise channels",
    "transposed channels",
    "resize channels",
    "elementwise channels",
    "shuffle channels",
}
REWRITTEN = {
    "activation of sums",
    "activation place",
    "conv groups",
    "conv window",
    "depthwise kernel",
    "shuffle place",
    "transposed output padding",
}
"""Rules that simplified float files keep, and those of other quantisers may break."""
OTHERS = {"conv area", "int8 operator", "int8 alone", "bias width"}
"""Rules of other boards: tests/deploy/dpu/test_boards.py, test_npu.py."""
SIZES = {"map exists", "maps aligned", "map in memory"}
NUMBERS = {case.split(":")[0] for case in NUMBER_CASES} | {"int32 bias", "on integers"}


def test_every_rule_has_a_case() -> None:
    """Every rule of the checker is tested here or in a file that is named here.

    A new rule without a case fails this test.
    """
    names = {rule_name(rule) for rule in all_rules()}
    assert names == set(CASES) | WIDE | SIZES | NUMBERS | OTHERS


@pytest.mark.parametrize("rule", CASES)
def test_each_rule_refuses_its_case_alone_and_following_the_remedy_passes(
    tmp_path: Path, rule: str
) -> None:
    """A network that breaks one rule is refused by that rule and by no other.

    With the remedy followed it passes, so a user who obeys the message gets on.
    """
    breaks, follows = CASES[rule]
    with as_written() if rule in REWRITTEN else nullcontext():
        assert between_convs(tmp_path, breaks) == [rule]
    assert between_convs(tmp_path, follows) == []


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
    """A layer of too many channels or weights is refused by the rule about its own kind alone."""
    sketch = Sketch(channels)
    result = draw(sketch, "image")
    path = sketch.save(tmp_path / "w.onnx", result)
    assert broken_rules(path) == [rule]


def test_too_many_channels_for_sums_and_shuffles(tmp_path: Path) -> None:
    """Sums and shuffles of too many channels are refused, though each convolution in front is
    allowed.
    """
    sketch = Sketch(8)
    half = sketch.conv("image", (2049, 8, 1, 1))
    joined = sketch.node("Concat", half, half, axis=1)
    added = sketch.node("Add", joined, joined)
    path = sketch.save(tmp_path / "w.onnx", added)
    assert broken_rules(path) == ["elementwise channels"]
    sketch = Sketch(8)
    wide = sketch.conv("image", (4100, 8, 1, 1))
    deep = sketch.node("DepthToSpace", wide, blocksize=2)
    result = sketch.conv(deep, (8, 1025, 1, 1))
    path = sketch.save(tmp_path / "s.onnx", result)
    assert broken_rules(path) == ["conv channels", "shuffle channels"]


def test_a_tile_too_small_for_a_window(tmp_path: Path) -> None:
    """A tile smaller than an unpadded kernel leaves no map, and one of its size leaves one."""
    sketch = Sketch(8)
    # Behind padding, because the image of a network without any is mirrored.
    stream = sketch.conv("image")
    unpadded = sketch.conv(stream, pads=[0] * 4)
    path = sketch.save(tmp_path / "s.onnx", unpadded)
    assert broken_rules(path, tile_px=2) == ["map exists"]
    assert broken_rules(path, tile_px=3) == []


def test_a_tile_that_the_stride_does_not_divide(tmp_path: Path) -> None:
    """A sum of maps of different sizes is refused: an odd tile halved and doubled is another
    size.
    """
    sketch = Sketch(8)
    stream = sketch.conv("image")
    half = sketch.node("MaxPool", stream, kernel_shape=[2, 2], strides=[2, 2])
    enlarged = resized(2)(sketch, half)
    added = sketch.node("Add", stream, enlarged)
    path = sketch.save(tmp_path / "u.onnx", sketch.conv(added))
    assert broken_rules(path, tile_px=21) == ["maps aligned"]
    assert broken_rules(path, tile_px=22) == []


def test_a_factor_for_a_whole_channel_meets_any_map(tmp_path: Path) -> None:
    """A factor of one value a channel, as channel attention has, needs no map of the same size."""
    sketch = Sketch(8)
    stream = sketch.conv("image")
    mean = sketch.node("GlobalAveragePool", stream)
    factor = sketch.conv(mean, (8, 8, 1, 1))
    scaled_stream = sketch.node("Mul", stream, factor)
    path = sketch.save(tmp_path / "f.onnx", sketch.conv(scaled_stream))
    assert broken_rules(path, tile_px=37) == []


def test_a_tile_that_the_memory_cannot_hold(tmp_path: Path) -> None:
    """A tile whose maps exceed the memory is refused, and the remedy's factor makes it fit."""
    sketch = Sketch(1)
    wide = sketch.conv("image", (64, 1, 3, 3))
    path = sketch.save(tmp_path / "m.onnx", sketch.conv(wide, (1, 64, 3, 3)))
    tile_px = 7001
    (violation,) = place(read_network(path, tile_px), DPU).nodes[0].broken
    assert violation.rule == "map in memory"
    factor = float(violation.finding.remedy.split()[-4])
    allowed_px = int(tile_px * factor)
    # The remedy states its factor to two digits only.
    assert broken_rules(path, tile_px=allowed_px - 70) == []
    # This DPU has one image at a time in memory.
    assert broken_rules(path, load_dpu("vck190", NARROW_ARRAY), tile_px) == []


def test_all_broken_rules_of_a_node_are_listed(tmp_path: Path) -> None:
    """All faults of a node are reported at once, so that a user does not find them one by one."""
    draw = conv(8, 4, 17, 9, group=2, strides=[9, 1], pads=[0, 0, 20, 0])
    with as_written():
        rules = between_convs(tmp_path, draw)
    assert rules == ["conv kernel", "conv stride", "conv padding", "conv window", "conv groups"]


def test_a_float_convolution_in_a_quantized_file_is_refused(tmp_path: Path) -> None:
    """A float convolution between integer ones is refused, because a DPU computes no float."""
    sketch = IntegerSketch()
    image = sketch.quantized("image")
    first = sketch.qconv(image, (4, 1, 3, 3))
    floating = sketch.node("DequantizeLinear", first, *sketch.numbers)
    last = sketch.conv(floating, (1, 4, 3, 3))
    path = sketch.save(tmp_path / "f.onnx", last)
    assert "on integers" in broken_rules(path)


def test_findings_name_the_numbers_and_a_remedy(tmp_path: Path) -> None:
    """A finding states the number that broke the rule, the limit, and what to do."""
    sketch = Sketch(8)
    path = sketch.save(tmp_path / "k.onnx", sketch.conv("image", (8, 8, 17, 1)))
    (violation,) = place(read_network(path, TILE_PX), DPU).nodes[0].broken
    assert violation.finding.reason == "kernel (1 x 17) is not in the DPU's range 1 to 16"
    assert "at most 16" in violation.finding.remedy
