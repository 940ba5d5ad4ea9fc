"""The DPU's rules by kind of operation, their texts, and the check of one node, which reports every
broken rule.

A rule is a small function (`conv_rules`, `other_rules`, `number_rules`). Its docstring is its text,
filled in with the limits of the target profile, so text, check and documentation always agree. A
rule applies to the targets that define the constants its text names, so no rule depends on a
board's name.
"""

import inspect
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain

from beers_deploy.dpu.board import SIZED, Dpu
from beers_deploy.dpu.checker import conv_rules, number_rules, other_rules
from beers_deploy.dpu.checker.finding import Finding, Rule
from beers_deploy.dpu.graph import Kind, Operation
from beers_deploy.profiles.validation import check_keys
from beers_deploy.quant.onnx.window import Window

CONV: tuple[Rule, ...] = (
    conv_rules.conv_kernel,
    conv_rules.conv_stride,
    conv_rules.conv_channels,
    conv_rules.conv_padding,
    conv_rules.conv_weight_bank,
    conv_rules.conv_window,
    conv_rules.conv_area,
    conv_rules.conv_dilation,
    conv_rules.conv_groups,
)
RULES: Mapping[Kind, tuple[Rule, ...]] = {
    **dict.fromkeys(("conv", "grouped conv"), CONV),
    "depthwise": (
        conv_rules.depthwise_kernel,
        conv_rules.depthwise_stride,
        conv_rules.depthwise_padding,
        conv_rules.depthwise_channels,
    ),
    "transposed": (
        conv_rules.transposed_kernel,
        conv_rules.transposed_output_padding,
        conv_rules.transposed_padding,
        conv_rules.transposed_channels,
    ),
    "pool": (other_rules.pool_kernel, other_rules.pool_stride, other_rules.pool_padding),
    "activation": (
        other_rules.activation_place,
        other_rules.activation_of_sums,
        other_rules.leaky_relu_alpha,
    ),
    "add": (other_rules.elementwise_channels,),
    "mul": (other_rules.elementwise_channels, other_rules.mul_constant),
    "concat": (),
    "pad": (other_rules.pad_mode,),
    "resize": (other_rules.resize_mode, other_rules.resize_scale, other_rules.resize_channels),
    "pixel shuffle": (other_rules.shuffle_place, other_rules.shuffle_channels),
    "argmax": (other_rules.argmax_channels,),
    **dict.fromkeys(("quantize", "dequantize", "other"), (other_rules.known_operator,)),
}
"""The rules for a node of each kind, float or quantised."""

SIZES: tuple[Rule, ...] = (
    other_rules.map_exists,
    other_rules.maps_aligned,
    other_rules.map_in_memory,
)
"""The rules about the tile's size, which apply to every node."""

EVERY: tuple[Rule, ...] = (other_rules.operator_domain, other_rules.int8_operator, *SIZES)
"""The rules for a node of any kind."""

NUMBERS: tuple[Rule, ...] = (
    number_rules.on_integers,
    number_rules.symmetric,
    number_rules.int8_alone,
    number_rules.per_tensor,
    number_rules.power_of_two,
    number_rules.one_format,
    number_rules.int8_constants,
)
SUMS = (
    number_rules.int8_bias,
    number_rules.int32_bias,
    number_rules.bias_width,
    number_rules.shift_cut,
    number_rules.shift_bias,
)
SHIFTS: Mapping[Kind, tuple[Rule, ...]] = {
    **dict.fromkeys(("conv", "depthwise", "transposed"), SUMS),
    "add": (number_rules.shift_read, number_rules.shift_write),
    **dict.fromkeys(("concat", "pool"), (number_rules.same_scale,)),
}
"""The additional rules for a quantised node."""


@dataclass(frozen=True)
class Broken:
    """A rule that a node breaks.

    Attributes:
        rule: the name of the rule, such as "conv kernel".
        text: the text of the rule, with the limits of the board.
        finding: why the node breaks it, and what to change.
    """

    rule: str
    text: str
    finding: Finding


def broken_rules(op: Operation, dpu: Dpu, quantized: bool) -> tuple[Broken, ...]:
    """Check one operation against all rules for its kind.

    A compiler may convert an operation to another form (`forms`), so it passes if one of its forms
    breaks no rule.

    Args:
        op: the operation.
        dpu: the device, with the limits of its rules.
        quantized: True to check the rules about integers and scales too.

    Returns:
        The rules that the operation breaks as it is written; empty if it passes.
    """
    breaches = []
    for form in forms(op, dpu):
        rules = RULES[form.kind] + EVERY
        # The results of these two kinds are no numbers of 8 bits.
        if quantized and form.kind not in ("other", "argmax"):
            rules += NUMBERS + SHIFTS.get(form.kind, ())
        broken = (
            Broken(rule_name(rule), rule_text(rule, dpu), finding)
            for rule in rules
            if applies(rule, dpu) and (finding := rule(form, dpu))
        )
        breaches.append(tuple(broken))
    # The first form is the operation as the file has it: the report is about that one.
    return breaches[0] if all(breaches) else ()


def forms(op: Operation, dpu: Dpu) -> Iterator[Operation]:
    """Yield the operation as it is written, then the other forms that a compiler may convert it to.

    A fully connected layer is a convolution as large as its map. It is also a 1 x 1 convolution
    over the flattened map: a matrix product becomes a convolution if that fits the hardware (UG1414
    1.4.1, Operators Supported by TensorFlow). Its outputs are independent, so they may be computed
    in parts. That this happens is inferred from a rate. The last layer of Ultrafast lanes has 14472
    outputs. At 392 images a second with one thread (Vitis-AI 2.5, model_zoo/README.md, VCK190), the
    DPU's batch of six leaves the processor 15 ms for 356 MFLOP, more than its two cores can do.
    """
    yield op
    # An NPU's file does not state the array that it would fit.
    if "array" in dpu.tables and fully_connected(op):
        values = math.prod(op.in_shape or ())
        outputs = min(op.channels[1], dpu.channels_max)
        part = replace(op, channels=(op.channels[0], outputs), out_shape=(outputs, 1, 1))
        yield part
        yield replace(
            part,
            in_shapes=((values, 1, 1),),
            kernel=(1, 1),
            window=Window(),
            channels=(values, outputs),
        )


def fully_connected(op: Operation) -> bool:
    """Return True if an operation is a fully connected layer: a convolution whose kernel is as
    large as its input, without pads and dilations, so that its result has one pixel.
    """
    return (
        op.kind == "conv"
        and op.in_shape is not None
        and op.kernel == op.in_shape[1:]
        and op.window.dilations == (1, 1)
        and not any(op.window.pads)
    )


def all_rules() -> Iterator[Rule]:
    """Yield every rule of any DPU once, in the order of RULES, EVERY, NUMBERS and SHIFTS."""
    tables = [*RULES.values(), EVERY, NUMBERS, *SHIFTS.values()]
    yield from dict.fromkeys(chain.from_iterable(tables))


def require_known_constants(dpu: Dpu) -> None:
    """Raise ProfileError if the board's file has a constant that no rule names.

    A misspelt constant would silently disable the rule that it is meant for.
    """
    keys = defaultdict[str, set[str]](set)
    for rule in all_rules():
        for table, key in _named(rule):
            keys[table].add(key)
    for table in keys.keys() - set(SIZED):
        check_keys(f"{dpu.target.name} [{table}]", dpu.tables.get(table, {}), (), keys[table])


def rule_name(rule: Callable[..., object]) -> str:
    """Return the name of a rule in tables: that of its function, such as "conv kernel"."""
    return getattr(rule, "__name__", "").replace("_", " ")


def applies(rule: Callable[..., object], dpu: Dpu) -> bool:
    """Return True if a rule holds on a device.

    A rule's docstring names constants, such as {conv[kernel]}. It holds on the devices whose board
    file defines all of them; otherwise it is a rule of other DPUs.
    """
    return all(key in dpu.facts.get(table, {}) for table, key in _named(rule))


def rule_text(rule: Callable[..., object], dpu: Dpu) -> str:
    """Return the text of a rule or a remark: its docstring, in which the limits and documents of
    the device's board are filled in.
    """
    return _template(rule).format(**dpu.facts)


@cache
def _template(rule: Callable[..., object]) -> str:
    # Without docstrings (python -OO) the command line has no help either, and does not start.
    return " ".join(str(inspect.getdoc(rule)).split())


@cache
def _named(rule: Callable[..., object]) -> tuple[tuple[str, str], ...]:
    """Return table and key of each constant in the rule's text: "{conv[kernel].source}" refers to
    ("conv", "kernel").
    """
    return tuple(re.findall(r"{(\w+)\[(\w+)]", _template(rule)))
