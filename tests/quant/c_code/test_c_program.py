"""Tests that a core in C computes the reference's integers, with any C99 compiler."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beers_deploy.model.shipped import shipped_names
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.c_code import c_program
from beers_deploy.quant.c_code.layers import LayerWriter
from beers_deploy.quant.c_code.program import share_buffers
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.graph import CORRECTION, PLANES
from beers_deploy.quant.integer.reference import run_core
from beers_deploy.quant.onnx_file import load_onnx
from benchmarks.executors import run_c
from tests.quant.c_code.compiled import FAST, SANITIZED, needs_compiler
from tests.quant.c_code.drawn import KINDS, cores
from tests.quant.quick import uniform
from tests.shipped import shipped_pair


def assert_equal(core: IntCore, tile_px: int, planes: np.ndarray, compiler: list[str]) -> None:
    """Check that the compiled program gives the reference's integers."""
    expected = run_core(core, planes)[0][CORRECTION]
    text = c_program(core, tile_px, "network.onnx")
    result = run_c(compiler, text, planes, expected.shape[1:])
    np.testing.assert_array_equal(result, expected)


def extremes(shape: tuple[int, ...]) -> np.ndarray:
    """Return planes (2, P, H, W) of random int8 values, and of the two ends of int8 alone."""
    generator = np.random.default_rng(0)
    planes = generator.integers(-128, 128, (2, *shape[1:]))
    planes[1] = generator.choice([-128, 127], shape[1:])
    return planes.astype(np.int8)


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
@settings(max_examples=2)
def test_each_kind_of_operation_equals_the_reference(kind: str, data: st.DataObject) -> None:
    """Each kind of operation, with few others around it, computes the integers of the reference.

    The compiler's sanitizers find overflows that a right result would hide.
    """
    core, tile_px = data.draw(cores((kind,), 2))
    assert_equal(core, tile_px, extremes((1, 3, tile_px, tile_px)), SANITIZED)


@needs_compiler
@given(drawn=cores())
@settings(max_examples=6)
def test_any_network_equals_the_reference(drawn: tuple[IntCore, int]) -> None:
    """Operations in any order compute the integers of the reference, though maps share buffers."""
    core, tile_px = drawn
    assert_equal(core, tile_px, extremes((1, 3, tile_px, tile_px)), SANITIZED)


def shipped_core(name: str) -> IntCore:
    """Return the core of a shipped network."""
    return read_core(load_onnx(shipped_pair(name)[1]))


def planes_of(core: IntCore, tile_px: int) -> np.ndarray:
    """Return planes (2, P, H, W) of a tile: those of an image of noise, and the ends of int8."""
    shape = (1, core.host_part.image_channels, tile_px, tile_px)
    image = uniform(*shape)
    planes = core.host_part.encode(image)
    return np.concatenate([planes, extremes(planes.shape)[1:]])


@needs_compiler
def test_a_shipped_network_equals_the_reference() -> None:
    """A shipped network computes the integers of the reference on an image and on extremes."""
    core = shipped_core("convbeers-xs")
    assert_equal(core, 12, planes_of(core, 12), SANITIZED)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", shipped_names())
def test_every_shipped_network_equals_the_reference(name: str) -> None:
    """Each is run on a small tile with sanitizers, and on a larger one without."""
    core = shipped_core(name)
    assert_equal(core, 64, planes_of(core, 64), FAST)
    assert_equal(core, 16, planes_of(core, 16), SANITIZED)


def test_the_file_states_what_it_is_and_no_name_ends_a_comment() -> None:
    """Names in a network cannot inject code into the file, and its memory figures are right.

    The file includes one header of integers only, because a target may have no others.
    """
    core = shipped_core("convbeers-xs")
    first = replace(core.convolutions[0], name="*/ int x; /* ??/")
    text = c_program(replace(core, ops=(first, *core.ops[1:])), 32, "a.onnx */\n int y;")
    assert "int x" not in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    assert "int y" not in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    assert "??" not in text
    assert "#include" not in text.replace("#include <stdint.h>", "")
    assert not re.search(r"\b(float|double|malloc|free)\b", text)
    constants = sum(op.weight.size + 4 * op.bias.size for op in core.convolutions)
    assert f"{constants} bytes of constants" in text
    buffers = sum(map(int, re.findall(r"^static int8_t buffer_\d+\[(\d+)\];$", text, re.MULTILINE)))
    assert f"{buffers} bytes of maps" in text.replace("\n * ", " ")


def test_sums_that_int32_does_not_hold_are_refused() -> None:
    """A layer whose sums exceed int32 is refused by name: signed overflow is undefined in C."""
    core = shipped_core("convbeers-xs")
    conv = core.convolutions[2]
    # The largest weights, and enough channels for sums of 2^31.
    weight = np.full((1, 1 << 14, 3, 3), 127, np.int8)
    large = replace(conv, weight=weight, bias=conv.bias[:1])
    writer = LayerWriter(core, dict.fromkeys(core.frac_bits, (1, 8, 8)))
    with pytest.raises(ModelError, match=r"body.0.first need 3\d\.\d bits"):
        writer.write(1, large)


def test_tensors_that_are_needed_at_once_share_no_buffer() -> None:
    """No buffer is written while its tensor is still read, and few buffers suffice for all
    tensors.
    """
    core = shipped_core("convbeers")
    size = {PLANES: 4, CORRECTION: 6} | {op.output: 16 for op in core.ops[:-1]}
    number, buffers = share_buffers(core, size)
    assert len(buffers) == 5
    holds = {number[PLANES]: PLANES}
    for op in core.ops:
        assert {holds[number[name]] for name in op.inputs} == set(op.inputs)
        assert buffers[number[op.output]] >= size[op.output]
        holds[number[op.output]] = op.output
    assert holds[number[CORRECTION]] == CORRECTION
