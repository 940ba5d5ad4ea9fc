"""Each rule about operators refuses the network that breaks it, and passes the one that follows
its remedy.
"""

from contextlib import nullcontext

import pytest

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.operators import all_rules, rule_name
from tests.deploy.dpu.draws import (
    CONV,
    as_written,
    behind_conv,
    behind_mean,
    behind_pool,
    behind_sum,
    between_convs,
    broken_rules,
    depthwise,
    placed,
)
from tests.deploy.dpu.graphs import SAME, IntegerSketch, written
from tests.deploy.dpu.test_number_graphs import CASES as NUMBER_CASES

NARROW_ARRAY = "C32B1"


# Each rule with a network that breaks it alone, and the same network with the remedy followed.
CASES: dict[str, tuple[str, str]] = {
    "conv kernel": (
        "y = Conv<pads=[8,0,8,0]>(x, w8x8x17x1)",
        "y = Conv<pads=[7,0,7,0]>(x, w8x8x15x1)",
    ),
    "conv stride": (
        "y = Conv<pads=[1,1,1,1], strides=[9,9]>(x, w)",
        "y = Conv<pads=[1,1,1,1], strides=[3,3]>(x, w)",
    ),
    "conv padding": ("y = Conv<pads=[3,1,1,1]>(x, w)", "y = Conv<pads=[2,1,1,1]>(x, w)"),
    "conv window": ("y = Conv(x, w8x8x9x8)", "y = Conv<pads=[4,4,4,4]>(x, w8x8x8x8)"),
    "conv dilation": (
        "y = Conv<dilations=[513,1], pads=[513,0,513,0]>(x, w8x8x3x1)",
        "y = Conv<dilations=[512,1], pads=[513,0,513,0]>(x, w8x8x3x1)",
    ),
    "conv groups": ("y = Conv<pads=[1,1,1,1], group=2>(x, w8x4x3x3)", CONV),
    "depthwise kernel": (
        depthwise("pads=[15,0,15,0]", 257, 1),
        depthwise("pads=[0,0,0,0]", 255, 1),
    ),
    "depthwise stride": (
        depthwise("pads=[1,1,1,1], strides=[257,1]", 3, 3),
        depthwise("pads=[1,1,1,1]", 3, 3),
    ),
    "depthwise padding": (
        depthwise("pads=[16,1,1,1]", 3, 3),
        depthwise("pads=[15,1,9,9]", 3, 3),
    ),
    "transposed kernel": (
        "y = ConvTranspose<strides=[3,3]>(x, w8x8x2x2)",
        "y = ConvTranspose<strides=[2,2]>(x, w8x8x4x4)",
    ),
    "transposed output padding": (
        "y = ConvTranspose<strides=[2,2], output_padding=[1,1]>(x, w8x8x3x3)",
        "y = ConvTranspose<strides=[2,2], pads=[1,1,1,1]>(x, w8x8x4x4)",
    ),
    "transposed padding": (
        "y = ConvTranspose<pads=[3,0,0,0]>(x, w8x8x2x2)",
        "y = ConvTranspose<pads=[2,0,0,0]>(x, w8x8x2x2)",
    ),
    "pool kernel": (
        "y = MaxPool<kernel_shape=[257,1]>(x)",
        "y = MaxPool<kernel_shape=[17,1]>(x)",
    ),
    "pool stride": (
        "y = MaxPool<kernel_shape=[2,2], strides=[257,1]>(x)",
        "y = MaxPool<kernel_shape=[2,2]>(x)",
    ),
    "pool padding": (
        "y = MaxPool<kernel_shape=[20,20], pads=[16,0,0,0]>(x)",
        "y = MaxPool<kernel_shape=[20,20], pads=[15,0,0,0]>(x)",
    ),
    "activation place": (
        behind_mean("Relu(a)"),
        "a = Relu(x) y = AveragePool<kernel_shape=[2,2]>(a)",
    ),
    "activation of sums": (behind_sum("HardSwish(a)"), behind_sum("Relu(a)")),
    "leaky relu alpha": (
        behind_conv("LeakyRelu<alpha=0.1>(a)"),
        behind_conv("LeakyRelu<alpha=0.1015625>(a)"),
    ),
    "mul constant": ("y = Mul(x, w1x8x3x3)", "y = Mul(x, w1x8x1x1)"),
    "pad mode": ('y = Pad<mode="reflect">(x, around)', 'y = Pad<mode="constant">(x, around)'),
    "resize mode": (
        'y = Resize<mode="cubic">(x, , two)',
        'y = Resize<mode="nearest">(x, , two)',
    ),
    "resize scale": (
        'y = Resize<mode="linear">(x, , three)',
        'y = Resize<mode="linear">(x, , two)',
    ),
    "shuffle place": (
        behind_pool("DepthToSpace<blocksize=1>(a)"),
        "y = DepthToSpace<blocksize=1>(x)",
    ),
    "argmax channels": ("y = ArgMax<axis=1>(x)", behind_conv("Relu(a)")),
    "known operator": (behind_conv("Sigmoid(a)"), behind_conv("HardSigmoid(a)")),
    "operator domain": (behind_conv("com.microsoft.FusedRelu(a)"), behind_conv("Relu(a)")),
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


@pytest.mark.parametrize(
    ("rules", "nodes", "channels"),
    [
        (["conv channels"], "y = Conv(image, w4097x8x1x1)", 8),
        (["conv channels"], "y = Conv(image, w8x4097x1x1)", 4097),
        # A dilation counts times the input channels, whatever the output channels.
        (["conv dilation"], "y = Conv<dilations=[3,1], pads=[3,0,3,0]>(image, w8x1366x3x1)", 1366),
        ([], "y = Conv<dilations=[3,1], pads=[3,0,3,0]>(image, w1366x8x3x1)", 8),
        # Beyond 2048 input channels a window takes twice its positions.
        (
            ["conv weight bank", "conv window"],
            "y = Conv<pads=[2,2,3,3]>(image, w8x2049x6x6)",
            2049,
        ),
        ([], "y = Conv<pads=[2,2,3,3]>(image, w2049x8x6x6)", 8),
        (["conv weight bank"], "y = Conv<pads=[3,3,3,3]>(image, w1x2048x8x8)", 2048),
        (["transposed channels"], "y = ConvTranspose(image, w8x4097x1x1)", 8),
        (
            ["depthwise channels"],
            "y = Conv<pads=[1,1,1,1], group=4097>(image, w4097x1x3x3)",
            4097,
        ),
        (["resize channels"], 'y = Resize<mode="nearest">(image, , two)', 4097),
        # Each convolution in front of the sum is allowed.
        (
            ["elementwise channels"],
            "a = Conv(image, w2049x8x1x1) b = Concat<axis=1>(a, a) y = Add(b, b)",
            8,
        ),
        (
            ["conv channels", "shuffle channels"],
            """a = Conv(image, w4100x8x1x1) b = DepthToSpace<blocksize=2>(a)
            y = Conv(b, w8x1025x1x1)""",
            8,
        ),
    ],
)
def test_wide_layers(rules: list[str], nodes: str, channels: int) -> None:
    """A layer of too many channels or weights is refused by the rule about its own kind alone."""
    with as_written():
        assert broken_rules(written(nodes, channels)) == rules


ENLARGED = f"""
    a = MaxPool<kernel_shape=[2,2], strides=[2,2]>(x) b = Resize(a, , two) c = Add(x, b)
    y = {SAME}(c, w)
"""
"""The sum of a map with itself, halved and enlarged."""
ATTENDED = f"a = GlobalAveragePool(x) b = Conv(a, w8x8x1x1) c = Mul(x, b) y = {SAME}(c, w)"
"""A map times a factor of one value a channel, as channel attention has."""


@pytest.mark.parametrize(
    ("nodes", "tile_px", "rules"),
    [
        # A tile smaller than an unpadded kernel leaves no map, and one of its size leaves one.
        ("y = Conv(x, w)", 2, ["map exists"]),
        ("y = Conv(x, w)", 3, []),
        # An odd tile halved and doubled is another size.
        (ENLARGED, 21, ["maps aligned"]),
        (ENLARGED, 22, []),
        # Maps of two heights, one below the other.
        (f"a = MaxPool<kernel_shape=[2,1]>(x) b = Concat<axis=2>(a, x) y = {SAME}(b, w)", 21, []),
        # The factor needs no map of the same size.
        (ATTENDED, 37, []),
    ],
)
def test_maps_of_the_sizes_of_a_tile(nodes: str, tile_px: int, rules: list[str]) -> None:
    # Behind padding, because the image of a network without any is mirrored.
    model = written(f"x = {SAME}(image, w) {nodes}")
    assert broken_rules(model, tile_px) == rules


def test_a_tile_that_the_memory_cannot_hold() -> None:
    """A tile whose maps exceed the memory is refused, and the remedy's factor makes it fit."""
    model = written(f"a = {SAME}(image, w64x1x3x3) y = {SAME}(a, w1x64x3x3)", 1)
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
    window = "group=2, strides=[9,1], pads=[0,0,20,0]"
    with as_written():
        rules = between_convs(f"y = Conv<{window}>(x, w8x4x17x9)")
    assert rules == ["conv kernel", "conv stride", "conv padding", "conv window", "conv groups"]


def test_a_float_convolution_in_a_quantized_file_is_refused() -> None:
    """A float convolution between integer ones is refused, because a DPU computes no float."""
    sketch = IntegerSketch()
    first = sketch.qconv(sketch.quantized("image"), (4, 1, 3, 3))
    floating = sketch.node("DequantizeLinear", first, *sketch.numbers)
    assert "on integers" in broken_rules(sketch.model(sketch.conv(floating, (1, 4, 3, 3))))


def test_findings_name_the_numbers_and_a_remedy() -> None:
    """A finding states the number that broke the rule, the limit, and what to do."""
    model = written("y = Conv<pads=[8,0,8,0]>(image, w8x8x17x1)")
    (violation,) = placed(model).nodes[0].broken
    assert violation.finding.reason == "kernel (1 x 17) is not in the DPU's range 1 to 16"
    assert "at most 16" in violation.finding.remedy
