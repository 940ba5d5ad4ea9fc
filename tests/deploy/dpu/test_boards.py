"""Tests of each board's own rules: what it refuses, what a remedy repairs, which DPU it names."""

import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.dpu.board import device_of, load_dpu
from beers_deploy.dpu.checker.conv_rules import conv_area, conv_weight_bank
from beers_deploy.dpu.checker.operators import all_rules, applies, rule_name, rule_text
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.remarks import REMARKS
from beers_deploy.dpu.cost.latency import dpu_power
from beers_deploy.dpu.graph import Operation
from beers_deploy.dpu.reading import sized_graph
from beers_deploy.model.shipped import shipped_names
from beers_deploy.performance.swath import efficiency, energy
from beers_deploy.profiles.figures import predicted
from beers_deploy.profiles.shipped import board_names, npu_names
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.onnx_file import load_onnx
from tests.deploy.dpu.draws import (
    as_written,
    behind_conv,
    behind_depthwise,
    behind_mean,
    behind_pool,
    behind_sum,
    between_convs,
    broken_rules,
    depthwise,
)
from tests.deploy.dpu.graphs import written
from tests.shipped import shipped_pair

DPUS = {name: load_dpu(name) for name in board_names()}
ZYNQ = ("kv260", "zcu102", "zcu104")
KINDS = {"DPUCZDX8G": ZYNQ, "DPUCVDX8G": ("vck190",), "DPUCV2DX8G": ("vek280",)}
LEAKY = "LeakyRelu<alpha=0.1015625>(a)"
PRELU = "PRelu(a, w8x1x1)"
UNPADDED = "pads=[0,0,0,0]"


def in_two(rows: int, columns: int) -> str:
    """Return a depthwise convolution as one of its rows and one of its columns."""
    first = f"a = Conv<group=8>(x, w8x1x{rows}x1)"
    return f"{first} y = Conv<group=8>(a, w8x1x1x{columns})"


# Each case: the only boards that refuse it, the rule, the nodes, the nodes with the remedy
# followed, and their channels.
CASES: list[tuple[tuple[str, ...], str, str, str, int]] = [
    (
        ZYNQ,
        "conv weight bank",
        "y = Conv<pads=[3,3,3,3]>(x, w8x672x7x7)",
        "a = Conv(x, w656x672x1x1) y = Conv<pads=[3,3,3,3]>(a, w8x656x7x7)",
        672,
    ),
    (
        (*ZYNQ, "vek280"),
        "depthwise kernel",
        depthwise(UNPADDED, 64, 33),
        in_two(64, 33),
        8,
    ),
    (ZYNQ, "activation place", behind_depthwise(LEAKY), behind_depthwise("Relu(a)"), 8),
    (ZYNQ, "activation of sums", behind_sum(LEAKY), behind_sum("Relu(a)"), 8),
    (
        ("vek280",),
        "conv area",
        "y = Conv<pads=[3,3,3,3]>(x, w8x8x8x8)",
        "y = Conv<pads=[3,3,3,3]>(x, w8x8x7x7)",
        8,
    ),
    (("vek280",), "depthwise kernel", depthwise(UNPADDED, 21, 21), in_two(21, 21), 8),
    (("vek280",), "activation place", "y = PRelu(x, w8x1x1)", behind_conv("Relu(a)"), 8),
    (("vek280",), "activation of sums", behind_sum(PRELU), behind_sum("Relu(a)"), 8),
    (
        ("vck190",),
        "conv window",
        "y = Conv(x, w8x8x9x8)",
        "y = Conv<pads=[3,3,3,3]>(x, w8x8x7x7)",
        8,
    ),
]


@pytest.mark.parametrize(("boards", "rule", "nodes", "remedied", "channels"), CASES)
def test_a_rule_refuses_its_case_on_its_boards_alone_and_the_remedy_passes_on_every_board(
    boards: tuple[str, ...], rule: str, nodes: str, remedied: str, channels: int
) -> None:
    for name, dpu in DPUS.items():
        with as_written():
            rules = between_convs(nodes, dpu, channels)
        # The VEK280 refuses a wide window by its conv area, which is tighter.
        if (name, rule) != ("vek280", "conv window"):
            assert rules == ([rule] if name in boards else [])
        assert between_convs(remedied, dpu, channels) == []


@pytest.mark.parametrize(
    ("nodes", "boards"),
    [
        # The simplifier inserts a convolution that changes nothing in front of the ReLU.
        (behind_mean("Relu(a)"), set(DPUS)),
        # The simplifier moves the ReLU in front of the max pool: the result is the same.
        (behind_pool("Relu(a)"), set(DPUS)),
        (behind_sum("HardSwish(a)"), set(DPUS)),
        (behind_depthwise("HardSwish(a)"), set(DPUS)),
        (behind_conv("HardSigmoid(a)"), set(DPUS)),
        (behind_sum("HardSigmoid(a)"), set(DPUS)),
        ("a = Conv(x, w128x8x1x1) y = ArgMax<axis=1>(a)", {*ZYNQ, "vek280"}),
        ("a = Conv(x, w129x8x1x1) y = ArgMax<axis=1>(a)", {"vek280"}),
        ("y = Conv(x, w4097x8x1x1)", {"vek280"}),
        # The simplifier splits it into parts of three rows.
        ("y = Conv<pads=[7,7,7,7]>(x, w8x8x16x16)", set(DPUS)),
        ("y = Conv(x, w8x8x16x16)", set(DPUS)),
    ],
)
def test_which_boards_accept_an_operator(nodes: str, boards: set[str]) -> None:
    assert {name for name, dpu in DPUS.items() if not between_convs(nodes, dpu)} == boards


@pytest.mark.parametrize(
    ("size", "rules"), [("B512", ["conv channels"]), ("B1152", []), (None, [])]
)
def test_a_smaller_dpu_accepts_fewer_channels(size: str | None, rules: list[str]) -> None:
    model = written("y = Conv(image, w2049x8x1x1)")
    assert broken_rules(model, dpu=load_dpu("zcu102", size)) == rules


@given(st.integers(1, 16), st.integers(1, 16), st.integers(1, 8192))
def test_weights_fit_by_each_manuals_formula(height: int, width: int, channels: int) -> None:
    """The formulas are those of UG1414 3.5, conv2d, and of dpu_op_filter.py for the VCK190."""
    kernel = height, width
    op = Operation("c", "Conv", "conv", ("in",), ("out",), kernel=kernel, channels=(channels, 8))
    area = height * width
    depths = {"zcu102": area * -(-channels // 16), "vek280": area * -(-channels // 32) * 8 + 4}
    depths["vck190"] = area * -(-channels // 16) * 2
    most = {"zcu102": 2048, "vek280": 65528, "vck190": 8192}
    assert {n: conv_weight_bank(op, DPUS[n]) is None for n in most} == {
        n: depths[n] <= most[n] for n in most
    }
    assert (conv_area(op, DPUS["vek280"]) is None) == (256 * area <= 13760)


@pytest.mark.parametrize("name", DPUS)
def test_every_text_names_the_boards_own_dpu(name: str) -> None:
    own = next(kind for kind, boards in KINDS.items() if name in boards)
    rules: list[Callable[..., object]] = [*all_rules(), *REMARKS]
    texts = {
        rule_name(rule): rule_text(rule, DPUS[name]) for rule in rules if applies(rule, DPUS[name])
    }
    kinds = re.findall(r"DPUC\w*8G", "\n".join(texts.values()))
    assert set(kinds) == {own}
    assert not [text for text in texts.values() if "{" in text or "(" not in text]


def test_a_rule_whose_constants_no_file_states_would_be_dead() -> None:
    stating = [*DPUS.values(), *(device_of(TargetProfile.load(name)) for name in npu_names())]
    assert all(any(applies(rule, dpu) for dpu in stating) for rule in all_rules())


@pytest.mark.parametrize("size", TargetProfile.load("zcu102").configurations)
@pytest.mark.parametrize("name", ZYNQ)
def test_a_smaller_dpu_has_a_smaller_array_and_smaller_banks(name: str, size: str) -> None:
    """PG338: the name states the operations per cycle. Banks are 2048 deep and `lanes` wide."""
    dpu = load_dpu(name, size)
    clock_hz = TargetProfile.load(name).value("array", "pl_clock_hz")
    lanes = dpu.input_parallel
    pixels = dpu.whole("array", "pixel_parallel")
    cycle = 2 * lanes * dpu.output_parallel * pixels
    assert size == f"B{cycle}"
    assert dpu.engine_ops_per_s == pytest.approx(cycle * clock_hz, rel=1e-5)
    assert dpu.whole("memory", "feature_map_bytes") == 2048 * lanes * pixels
    assert dpu.whole("memory", "weight_bytes") == 2048 * lanes * dpu.whole("memory", "weight_banks")
    assert dpu.value("memory", "ddr_bytes_per_s") == DPUS[name].value("memory", "ddr_bytes_per_s")


@pytest.mark.parametrize("variant", shipped_names())
def test_the_shipped_files_run_whole_on_every_board(variant: str) -> None:
    network = sized_graph(load_onnx(shipped_pair(variant)[1]), 128)
    for name, dpu in DPUS.items():
        placement = place(network, dpu)
        assert placement.dpu_subgraphs == 1, name
        assert placement.failed == (), name


def test_power_that_nobody_published_is_unavailable_and_so_is_what_follows() -> None:
    latency = predicted(2.0, "s", (1.0, 3.0), "test")
    for name, dpu in DPUS.items():
        published = name != "vek280"
        power = dpu_power(dpu)
        figures = (power, energy(latency, power), efficiency(100, latency, power))
        assert all((figure.value is not None) == published for figure in figures)
        assert published == ("not predictable" in power.source)
        assert all(name in figure.reason for figure in figures if not published)
