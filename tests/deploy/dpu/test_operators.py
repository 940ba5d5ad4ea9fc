"""Each rule about operators refuses the network that breaks it, and passes the one that follows
its remedy.
"""

from contextlib import nullcontext

import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.operators import all_rules, rule_name
from tests.deploy.dpu.draws import (
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
    doubled,
    in_two,
    max_pool,
    mean_pool,
    node,
    padded,
    placed,
    resized,
    scaled,
    transposed,
)
from tests.deploy.dpu.graphs import SAME, IntegerSketch, Sketch, written
from tests.deploy.dpu.test_number_graphs import CASES as NUMBER_CASES

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
def test_each_rule_refuses_its_case_alone_and_following_the_remedy_passes(rule: str) -> None:
    """A network that breaks one rule is refused by that rule and by no other.

    With the remedy followed it passes, so a user who obeys the message gets on.
    """
    breaks, follows = CASES[rule]
    with as_written() if rule in REWRITTEN else nullcontext():
        assert between_convs(breaks) == [rule]
    assert between_convs(follows) == []


def joined(sketch: Sketch, source: str) -> str:
    return sketch.node("Concat", source, source, axis=1)


@pytest.mark.parametrize(
    ("rules", "draw", "channels"),
    [
        (["conv channels"], conv(4097, 8, 1, 1), 8),
        (["conv weight bank"], conv(1, 2048, 8, 8, pads=[3] * 4), 2048),
        (["transposed channels"], transposed(8, 4097, 1, 1), 8),
        (["depthwise channels"], conv(4097, 1, 3, 3, group=4097), 4097),
        (["resize channels"], resized(2, mode="nearest"), 4097),
        # Each convolution in front of the sum is allowed.
        (["elementwise channels"], in_two(conv(2049, 8, 1, 1), in_two(joined, doubled)), 8),
        (
            ["conv channels", "shuffle channels"],
            in_two(
                conv(4100, 8, 1, 1),
                in_two(node("DepthToSpace", blocksize=2), conv(8, 1025, 1, 1)),
            ),
            8,
        ),
    ],
)
def test_wide_layers(rules: list[str], draw: Draw, channels: int) -> None:
    """A layer of too many channels or weights is refused by the rule about its own kind alone."""
    sketch = Sketch(channels)
    assert broken_rules(sketch.model(draw(sketch, "image"))) == rules


def halved_and_enlarged(sketch: Sketch, source: str) -> str:
    """Draw a sum of a map with itself, halved and enlarged."""
    half = sketch.node("MaxPool", source, kernel_shape=[2, 2], strides=[2, 2])
    return sketch.node("Add", source, resized(2)(sketch, half))


def attended(sketch: Sketch, source: str) -> str:
    """Draw a factor of one value a channel, as channel attention has."""
    mean = sketch.node("GlobalAveragePool", source)
    return sketch.node("Mul", source, sketch.conv(mean, (8, 8, 1, 1)))


@pytest.mark.parametrize(
    ("draw", "tile_px", "rules"),
    [
        # A tile smaller than an unpadded kernel leaves no map, and one of its size leaves one.
        (conv_3x3(pads=[0] * 4), 2, ["map exists"]),
        (conv_3x3(pads=[0] * 4), 3, []),
        # An odd tile halved and doubled is another size.
        (in_two(halved_and_enlarged, conv_3x3()), 21, ["maps aligned"]),
        (in_two(halved_and_enlarged, conv_3x3()), 22, []),
        # The factor needs no map of the same size.
        (in_two(attended, conv_3x3()), 37, []),
    ],
)
def test_maps_of_the_sizes_of_a_tile(draw: Draw, tile_px: int, rules: list[str]) -> None:
    sketch = Sketch(8)
    # Behind padding, because the image of a network without any is mirrored.
    stream = sketch.conv("image")
    assert broken_rules(sketch.model(draw(sketch, stream)), tile_px) == rules


def test_a_tile_that_the_memory_cannot_hold() -> None:
    """A tile whose maps exceed the memory is refused, and the remedy's factor makes it fit."""
    nodes = f"a = {SAME}(image, first) y = {SAME}(a, last)"
    model = written(nodes, 1, first=(64, 1, 3, 3), last=(1, 64, 3, 3))
    tile_px = 7001
    (violation,) = placed(model, tile_px).nodes[0].broken
    assert violation.rule == "map in memory"
    factor = float(violation.finding.remedy.split()[-4])
    allowed_px = int(tile_px * factor)
    # The remedy states its factor to two digits only.
    assert broken_rules(model, allowed_px - 70) == []
    # This DPU has one image at a time in memory.
    assert broken_rules(model, tile_px, load_dpu("vck190", NARROW_ARRAY)) == []


def test_all_broken_rules_of_a_node_are_listed() -> None:
    """All faults of a node are reported at once, so that a user does not find them one by one."""
    draw = conv(8, 4, 17, 9, group=2, strides=[9, 1], pads=[0, 0, 20, 0])
    with as_written():
        rules = between_convs(draw)
    assert rules == ["conv kernel", "conv stride", "conv padding", "conv window", "conv groups"]


def test_a_float_convolution_in_a_quantized_file_is_refused() -> None:
    """A float convolution between integer ones is refused, because a DPU computes no float."""
    sketch = IntegerSketch()
    first = sketch.qconv(sketch.quantized("image"), (4, 1, 3, 3))
    floating = sketch.node("DequantizeLinear", first, *sketch.numbers)
    assert "on integers" in broken_rules(sketch.model(sketch.conv(floating, (1, 4, 3, 3))))


def test_findings_name_the_numbers_and_a_remedy() -> None:
    """A finding states the number that broke the rule, the limit, and what to do."""
    model = written("y = Conv<pads=[8,0,8,0]>(image, long)", long=(8, 8, 17, 1))
    (violation,) = placed(model).nodes[0].broken
    assert violation.finding.reason == "kernel (1 x 17) is not in the DPU's range 1 to 16"
    assert "at most 16" in violation.finding.remedy
