"""The DPU's rules by kind of operation, their texts, and the judgement of one node: all broken rules, not the first.

A rule is a small function (`conv_rules`, `other_rules`, `size_rules`, `number_rules`, `constant_rules`) whose
docstring is its text, filled in with the limits of the target profile: text, check and documentation cannot drift
apart.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from deploy.dpu.board import Dpu
from deploy.dpu.checker import conv_rules as c
from deploy.dpu.checker import number_rules as k
from deploy.dpu.checker import number_rules as n
from deploy.dpu.checker import other_rules as o
from deploy.dpu.checker import other_rules as s
from deploy.dpu.checker.finding import Finding, Rule
from deploy.dpu.graph import Kind, Operation

CONV: tuple[Rule, ...] = (
    c.conv_kernel,
    c.conv_stride,
    c.conv_channels,
    c.conv_padding,
    c.conv_weight_bank,
    c.conv_window,
    c.conv_dilation,
    c.conv_groups,
)
RULES: Mapping[Kind, tuple[Rule, ...]] = {
    "conv": CONV,
    "grouped conv": CONV,
    "depthwise": (c.depthwise_kernel, c.depthwise_stride, c.depthwise_padding, c.depthwise_channels),
    "transposed": (
        c.transposed_kernel,
        c.transposed_output_padding,
        c.transposed_padding,
        c.transposed_channels,
    ),
    "pool": (o.pool_kernel, o.pool_stride, o.pool_padding),
    "activation": (o.activation_place, o.activation_of_sums, o.leaky_relu_alpha),
    "add": (),
    "mul": (o.mul_constant,),
    "concat": (),
    "pad": (o.pad_mode,),
    "resize": (o.resize_mode, o.resize_scale, o.resize_channels),
    "pixel shuffle": (o.pixel_shuffle,),
    "quantise": (o.known_operator,),
    "dequantise": (o.known_operator,),
    "other": (o.known_operator,),
}
"""What a node of each kind has to keep, float or quantised."""

SIZES: tuple[Rule, ...] = (s.map_exists, s.maps_aligned, s.map_in_memory)
"""What the tile's size has to allow every node."""

NUMBERS: tuple[Rule, ...] = (n.on_integers, n.symmetric, n.per_tensor, n.power_of_two, n.one_format, k.int8_constants)
SHIFTS: Mapping[Kind, tuple[Rule, ...]] = {
    "conv": (k.int8_bias, k.int32_bias, n.shift_cut, n.shift_bias),
    "depthwise": (k.int8_bias, k.int32_bias, n.shift_cut, n.shift_bias),
    "transposed": (k.int8_bias, k.int32_bias, n.shift_cut, n.shift_bias),
    "add": (n.shift_read, n.shift_write),
    "mul": (),
    "concat": (n.same_scale,),
    "pool": (n.same_scale,),
}
"""What a quantised node has to keep besides."""


@dataclass(frozen=True)
class Broken:
    """A rule that a node breaks."""

    rule: str
    text: str
    finding: Finding


def judge(op: Operation, dpu: Dpu, quantised: bool) -> tuple[Broken, ...]:
    """Every rule that a node breaks; the rules of numbers only where the file holds quantised ones."""
    rules = RULES[op.kind] + SIZES
    if quantised and op.kind != "other":
        rules += NUMBERS + SHIFTS.get(op.kind, ())
    findings = ((rule, rule(op, dpu)) for rule in rules)
    return tuple(Broken(rule_name(rule), rule_text(rule, dpu), found) for rule, found in findings if found)


def all_rules() -> Iterator[Rule]:
    """Every rule once, in the order of the tables."""
    chains = [*RULES.values(), SIZES, NUMBERS, *SHIFTS.values()]
    yield from dict.fromkeys(rule for chain in chains for rule in chain)


def rule_name(rule: Rule) -> str:
    """The rule's name in tables, such as "conv kernel"."""
    return rule.__name__.replace("_", " ")


def rule_text(rule: Callable[..., object], dpu: Dpu) -> str:
    """The text of a rule or a remark, with the target's limits filled in."""
    return " ".join((inspect.getdoc(rule) or "").split()).format(**dpu.target.tables)
