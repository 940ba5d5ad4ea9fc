"""Networks with operators that a DPU lacks, as exporters write them."""

import re
from collections.abc import Callable, Mapping

import numpy as np
import onnx
from numpy.typing import ArrayLike

from beers_deploy.quant.adapt.kinds import Kind
from beers_deploy.quant.simplify.simplify import simplify
from tests.quant.simplify.networks import parsed

FEATURES = 6
Act = Callable[[str, str], str]
"""A function that writes the nodes of an activation from a tensor to a result."""
SAME = "Conv<pads=[1,1,1,1]>"


def silu(x: str, y: str) -> str:
    return f"{y}_gate = Sigmoid({x}) {y} = Mul({x}, {y}_gate)"


def silu_of_relu(x: str, y: str) -> str:
    return f"{y}_relu = Relu({x}) {silu(f'{y}_relu', y)}"


def mish(x: str, y: str) -> str:
    return f"{y}_soft = Softplus({x}) {y}_gate = Tanh({y}_soft) {y} = Mul({x}, {y}_gate)"


def quick_gelu(x: str, y: str) -> str:
    return f"{y}_x = Mul({x}, quick) {y}_gate = Sigmoid({y}_x) {y} = Mul({y}_gate, {x})"


def gelu_divided(x: str, y: str) -> str:
    return f"""
        {y}_x = Div({x}, root) {y}_erf = Erf({y}_x) {y}_gate = Add({y}_erf, one)
        {y}_both = Mul({x}, {y}_gate) {y} = Mul({y}_both, half)
    """


def gelu_multiplied(x: str, y: str) -> str:
    return f"""
        {y}_x = Mul({x}, inverse_root) {y}_erf = Erf({y}_x) {y}_gate = Add({y}_erf, one)
        {y}_half = Mul(half, {x}) {y} = Mul({y}_half, {y}_gate)
    """


def gelu_halved_in_the_gate(x: str, y: str) -> str:
    """Write x * ((1 + Erf(x / sqrt(2))) / 2), as torch does for opset 19."""
    return f"""
        {y}_x = Div({x}, root) {y}_erf = Erf({y}_x) {y}_gate = Add({y}_erf, one)
        {y}_half = Mul(half, {y}_gate) {y} = Mul({x}, {y}_half)
    """


def gelu_of_tanh(x: str, y: str) -> str:
    """Write the approximation as torch does for opset 17."""
    return f"""
        {y}_cube = Pow({x}, three) {y}_less = Mul(small, {y}_cube) {y}_sum = Add({x}, {y}_less)
        {y}_x = Mul(to_tanh, {y}_sum) {y}_tanh = Tanh({y}_x) {y}_gate = Add({y}_tanh, one)
        {y}_both = Mul({x}, {y}_gate) {y} = Mul(half, {y}_both)
    """


def gelu_of_tanh_half_first(x: str, y: str) -> str:
    """Write the approximation as users do by hand."""
    return f"""
        {y}_half = Mul({x}, half)
        {y}_cube = Pow({x}, three) {y}_less = Mul({y}_cube, small) {y}_sum = Add({x}, {y}_less)
        {y}_x = Mul({y}_sum, to_tanh) {y}_tanh = Tanh({y}_x) {y}_gate = Add(one, {y}_tanh)
        {y} = Mul({y}_half, {y}_gate)
    """


def tanh(x: str, y: str) -> str:
    return f"{y} = Tanh({x})"


def elu(x: str, y: str) -> str:
    """Write an ELU, which nothing replaces."""
    return f"{y} = Elu({x})"


def silu_but_elu_third(x: str, y: str) -> str:
    return elu(x, y) if y == "third" else silu(x, y)


def gated(x: str, y: str) -> str:
    """Write a Sigmoid that multiplies another tensor."""
    return f"""
        {y}_other = {SAME}({x}, {y}_w, {y}_b)
        {y}_gate = Sigmoid({x}) {y} = Mul({y}_other, {y}_gate)
    """


def hard_sigmoid(slope: float, offset: float) -> Act:
    """Return a HardSigmoid that multiplies another tensor."""
    return lambda x, y: (
        f"""
        {y}_other = {SAME}({x}, {y}_w, {y}_b)
        {y}_gate = HardSigmoid<alpha={slope:.9f}, beta={offset:.9f}>({x})
        {y} = Mul({y}_other, {y}_gate)
    """
    )


def leaky(slope: float) -> Act:
    return lambda x, y: f"{y} = LeakyRelu<alpha={slope:.9f}>({x})"


def prelu(*slopes: float) -> Act:
    """Return a PReLU of one slope, or of one for each channel."""
    numbers = ", ".join(f"{slope:.9f}" for slope in slopes)
    value = f"float[{len(slopes)},1,1] {{{numbers}}}"
    return lambda x, y: f"{y}_slope = Constant<value = {value}>() {y} = PRelu({x}, {y}_slope)"


INNER = (FEATURES, FEATURES, 3, 3)
POINT = (FEATURES, FEATURES, 1, 1)
FROM_IMAGE = (FEATURES, 1, 3, 3)
TO_RESULT = (1, FEATURES, 3, 3)
NUMBERS: dict[str, ArrayLike] = {
    "quick": 1.702,
    "half": 0.5,
    "one": 1.0,
    "two": 2.0,
    "three": 3.0,
    "small": 0.044715,
    "to_tanh": (2 / np.pi) ** 0.5,
    "root": 2**0.5,
    "inverse_root": 2**-0.5,
    "rows": [2],
    "columns": [3],
}


def built(
    nodes: str, shapes: Mapping[str, tuple[int, ...]], px: int | None = None, **constants: ArrayLike
) -> onnx.ModelProto:
    """Return a network from `image` to `restored`, simplified.

    A convolution that reads NAME_w and NAME_b has random weights, which its name determines.

    Args:
        nodes: in ONNX's text format.
        shapes: the shapes of weights by NAME, if they are not INNER.
        px: the sides of the image; None for any size.
        constants: further constants, by name.
    """
    size = "N,1,H,W" if px is None else f"1,1,{px},{px}"
    for name in re.findall(r"(\w+)_w\b", nodes):
        constants |= weights(name, shapes.get(name, INNER))
    ends = f"float[{size}] image => float[N,1,P,Q] restored"
    return simplify(parsed(nodes, ends, constants=NUMBERS | constants), "g")


def weights(name: str, shape: tuple[int, ...]) -> dict[str, ArrayLike]:
    """Return the weights and the bias of a convolution, which keep the size of the values."""
    generator = np.random.default_rng(sum(map(ord, name)))
    bound = np.prod(shape[1:]) ** -0.5
    weight = generator.normal(0, bound, shape)
    return {f"{name}_w": weight, f"{name}_b": generator.normal(0, 0.1, shape[0])}


def network(act: Act) -> onnx.ModelProto:
    """Build three convolutions, with activations behind the first two and behind a sum."""
    nodes = f"""
        a = {SAME}(image, a_w, a_b)
        {act("a", "first")}
        b = {SAME}(first, b_w, b_b)
        {act("b", "second")}
        sum = Add(first, second)
        {act("sum", "third")}
        c = {SAME}(third, c_w, c_b)
        restored = Add(image, c)
    """
    return built(nodes, {"a": FROM_IMAGE, "c": TO_RESULT})


def attention_network(free: bool) -> onnx.ModelProto:
    """Build RLFN's attention behind a convolution, for images of 48 pixels or of any size."""
    nodes = f"""
        a = {SAME}(image, a_w, a_b)
        stride = Cast<to=1>(tenths)
        tenth = Div(stride, ten)
        less = Conv<strides=[2,2]>(a, tenth)
        largest = MaxPool<kernel_shape=[7,7], strides=[3,3]>(less)
        b = {SAME}(largest, b_w, b_b)
        r = Relu(b)
        c = {SAME}(r, c_w, c_b)
        {"sizes = Shape(a)" if free else ""}
        wide = Resize<mode="linear">(c, , , sizes)
        d = Conv(wide, d_w, d_b)
        gate = Sigmoid(d)
        attended = Mul(a, gate)
        e = {SAME}(attended, e_w, e_b)
        restored = Add(image, e)
    """
    tenths = np.random.default_rng(3).integers(-5, 6, INNER)
    constants: dict[str, ArrayLike] = {"tenths": tenths, "ten": 10.0}
    if not free:
        constants["sizes"] = [1, FEATURES, 48, 48]
    shapes = {"a": FROM_IMAGE, "d": POINT, "e": TO_RESULT}
    return built(nodes, shapes, None if free else 48, **constants)


def contrast_network(px: int, factor: float) -> onnx.ModelProto:
    """Build IMDN's attention (CCA) behind a convolution: its variance is scaled by a factor."""
    nodes = f"""
        a = {SAME}(image, a_w, a_b)
        m_row = ReduceSum(a, columns) m_sum = ReduceSum(m_row, rows) mean = Div(m_sum, count)
        difference = Sub(a, mean)
        square = Pow(difference, two)
        v_row = ReduceSum(square, columns) v_sum = ReduceSum(v_row, rows) v = Div(v_sum, count)
        {"scaled = Identity(v)" if factor == 1 else "scaled = Mul(v, factor)"}
        deviation = Pow(scaled, half)
        contrast = Add(deviation, mean)
        d = Conv(contrast, d_w, d_b)
        gate = Sigmoid(d)
        attended = Mul(a, gate)
        e = {SAME}(attended, e_w, e_b)
        restored = Add(image, e)
    """
    shapes = {"a": FROM_IMAGE, "d": POINT, "e": TO_RESULT}
    return built(nodes, shapes, px, count=float(px**2), factor=float(factor))


def enlarging(mode: str, where: str, factor: int, adds: str = "") -> onnx.ModelProto:
    """Build convolutions of the enlarged image, to which the "result" or a map "within" is added if
    asked.
    """
    how = f'mode="{mode}", coordinate_transformation_mode="{where}", cubic_coeff_a=-0.75'
    nodes = f"""
        wide = Resize<{how}>(image, , scales)
        a = {SAME}(wide, a_w, a_b)
        first = Relu(a)
        b = {SAME}(first, b_w, b_b)
        sum = Add(b, {"wide" if adds else "b"})
        {f"c = {SAME}(sum, c_w, c_b)" if adds == "within" else "c = Identity(sum)"}
        restored = Identity(c)
    """
    shapes = {"a": FROM_IMAGE, "b": TO_RESULT, "c": (1, 1, 3, 3)}
    return built(nodes, shapes, scales=[1.0, 1.0, factor, factor])


REPLACED: dict[str, tuple[Act, Kind]] = {
    "SiLU": (silu, Kind.silu),
    "quick GELU": (quick_gelu, Kind.silu),
    "GELU, divided": (gelu_divided, Kind.silu),
    "GELU, multiplied": (gelu_multiplied, Kind.silu),
    "GELU, halved in the gate": (gelu_halved_in_the_gate, Kind.silu),
    "GELU of Tanh": (gelu_of_tanh, Kind.silu),
    "GELU of Tanh, half first": (gelu_of_tanh_half_first, Kind.silu),
    "Sigmoid": (gated, Kind.sigmoid),
    "Mish": (mish, Kind.silu),
    "Tanh": (tanh, Kind.tanh),
    "LeakyReLU": (leaky(0.2), Kind.leaky_relu),
    "PReLU": (prelu(*np.linspace(0.05, 0.3, FEATURES)), Kind.prelu),
}
"""Activations that `adapt` replaces, and the kind that it calls them."""
