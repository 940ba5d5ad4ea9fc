"""Tests that the prices of a DPU's restrictions sum to the loss of INT8."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beers_deploy.profiles.figures import Row
from beers_deploy.quant import price
from beers_deploy.quant.core import build_core
from beers_deploy.quant.encodings import host_model
from beers_deploy.quant.gate import compare
from beers_deploy.quant.graph import PLANES, Conv
from beers_deploy.quant.passes.selection import Passes
from beers_deploy.quant.price import Measured, grid_of, price_rows, rounded_weight
from beers_deploy.quant.quantize import Quantized
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import open_session, result_of
from tests.quant.quick import patches_of, quickly, without_references

CLIPPED = "clipping, of INT8 as written"


def prices(rows: list[Row]) -> dict[str, float]:
    """Return the price of each step that has one, by the name of the step."""
    values = {row.name: row.figures["price"].value for row in rows}
    return {name: value for name, value in values.items() if value is not None}


def test_steps_add_up_to_what_the_gate_measures(
    quantized: Quantized, float_onnx: onnx.ModelProto, unseen: Patches
) -> None:
    """The prices sum to the loss that the gate measures, so none is missing and none is counted
    twice.
    """
    rows = price_rows(quantized, unseen)
    assert [row.name for row in rows] == [*price.STEPS, "INT8 as written", CLIPPED]
    gate = compare(open_session(float_onnx), open_session(quantized.host), unseen)
    last = rows[-2].figures
    assert last["MAE"].value == pytest.approx(gate.mae, rel=1e-3)
    assert last["PSNR drop"].value == pytest.approx(gate.drop_db, abs=1e-3)
    assert sum(prices(rows[:-1]).values()) == pytest.approx(gate.drop_db, abs=1e-3)
    assert all(row.figures["price"].mode == "measured" for row in rows)


def test_simulated_integers_are_those_of_the_network(quantized: Quantized, unseen: Patches) -> None:
    """The simulation of INT8 in float errs as the integers in the file do, but for the rounding of
    ties.

    Without this the step "INT8 as written" would be the price of another network.
    """
    samples = Measured.of(quantized, unseen.pairs)
    session = open_session(quantized.host)
    written = samples.cost(result_of(session, image) for image in unseen.degraded)
    simulated = samples.cost_of_integers(quantized, clips=True)
    # onnxruntime rounds ties to even, a DPU up.
    assert simulated.mae == pytest.approx(written.mae, rel=0.02)
    assert simulated.drop_db == pytest.approx(written.drop_db, abs=0.02)


def test_with_many_bits_nothing_is_lost(
    quantized: Quantized, unseen: Patches, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 18 bits instead of 8 the steps of the float network lose almost nothing.

    So the prices are those of rounding, and not of a fault in the simulation.
    """
    few = float_errors(quantized, unseen)
    monkeypatch.setattr(price, "BITS", 18)
    many = float_errors(quantized, unseen)
    for name, mae in many.items():
        assert mae < few[name] / 200


def float_errors(quantized: Quantized, unseen: Patches) -> dict[str, float]:
    """Return the MAE of each of the four steps before the integers."""
    rows = price_rows(quantized, unseen)[:4]
    return {row.name: row.figures["MAE"].value or 0 for row in rows}


def with_equal_channels(quantized: Quantized) -> Quantized:
    """Return the network with weights of the same range in each output channel."""

    ops = list(quantized.network.graph)
    for place, op in enumerate(ops):
        if isinstance(op, Conv):
            largest = np.abs(op.weight).max((1, 2, 3), keepdims=True)
            ops[place] = replace(op, weight=(op.weight * (0.25 / largest)).astype(np.float32))
    return replace(quantized, network=replace(quantized.network, graph=tuple(ops)))


def test_one_scale_for_equal_channels_costs_nothing(quantized: Quantized, unseen: Patches) -> None:
    """One scale for a layer is free if its channels are of equal size, and the missing zero
    point still costs.
    """
    price_of = prices(price_rows(with_equal_channels(quantized), unseen))
    assert price_of["one scale for the weights of a layer"] == pytest.approx(0, abs=1e-3)
    assert abs(price_of["no zero point"]) > 1e-3


def test_without_references_prices_are_differences_of_the_mae(
    quantized: Quantized, unseen: Patches
) -> None:
    """Without references there is no PSNR, so prices are MAE against the float network and add
    up too.
    """
    rows = price_rows(quantized, without_references(unseen))
    assert {row.figures["price"].unit for row in rows} == {"of full scale"}
    assert all("PSNR drop" not in row.figures for row in rows)
    assert sum(prices(rows[:-1]).values()) == pytest.approx(rows[-2].figures["MAE"].value)


def test_clipping_costs_nothing_where_nothing_is_clipped_and_much_elsewhere(
    float_onnx: onnx.ModelProto, patches: Patches
) -> None:
    """The price of clipping is near 0 for scales that clip nothing, and most of the loss for
    finer ones.
    """
    passes = Passes(dual_range=False, least_squares=False, equalization=False)
    unclipped = quickly(float_onnx, patches, passes=passes)
    images = without_references(patches_of(list(patches.degraded)[:3]))
    rows = price_rows(unclipped, images)
    # Channels are scaled by a quantile of their sizes, so a few values may be clipped.
    assert abs(prices(rows)[CLIPPED]) < 0.01 * (rows[-2].figures["MAE"].value or 0)
    finer = {name: bits + 3 * (name != PLANES) for name, bits in unclipped.core.frac_bits.items()}
    core = build_core(unclipped.graph, finer, host_part=unclipped.core.host_part)
    clipped = replace(unclipped, core=core, host=host_model(core, {}))
    rows = price_rows(clipped, images)
    assert prices(rows)[CLIPPED] > 0.5 * (rows[-2].figures["MAE"].value or 0)


@given(low=st.floats(-10, 0), high=st.floats(0, 10), zero_point=st.booleans(), powers=st.booleans())
def test_a_grid_holds_its_range_and_zero(
    low: float, high: float, zero_point: bool, powers: bool
) -> None:
    """A grid of 256 steps covers its range to half a step, and has an exact zero, which padding
    needs.
    """
    grid = grid_of(low, high, zero_point, powers)
    slack = 0.51 * grid.scale
    assert grid.low * grid.scale <= low + slack
    assert grid.high * grid.scale >= high - slack
    assert grid.low <= 0 <= grid.high
    assert grid.high - grid.low == 255


@given(seed=st.integers(0, 2**32 - 1))
def test_weights_are_rounded_by_less_than_a_step(seed: int) -> None:
    """Weights err by half a step of their scale, and by a whole one where scales are powers of
    two.
    """
    weight = np.random.default_rng(seed).normal(0, 1, (3, 2, 2, 2)).astype(np.float32)
    weight[0] *= 10
    for axes in ((1, 2, 3), None):
        largest = np.abs(weight).max(axes, keepdims=True)
        for powers, most in ((False, 0.501), (True, 1.001)):
            error = np.abs(rounded_weight(weight, axes, powers) - weight)
            assert (error <= most * largest / 127).all()
