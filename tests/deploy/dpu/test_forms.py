import pytest

from beers_deploy.dpu.checker.operators import forms, fully_connected
from beers_deploy.dpu.checker.placement import PlacedNode
from tests.deploy.dpu.draws import DPU, placed
from tests.deploy.dpu.graphs import written


def placed_conv(weight: tuple[int, ...], tile_px: int, *pads: int) -> PlacedNode:
    """Place a convolution over a map of `tile_px` pixels a side."""
    name = "x".join(map(str, weight))
    nodes = f"y = Conv<pads={[*pads] or [0] * 4}>(image, w{name})"
    return placed(written(nodes, weight[1]), tile_px).nodes[-1]


def test_a_layer_as_large_as_its_map_is_also_one_pixel_of_all_its_values() -> None:
    op = placed_conv((10, 8, 20, 20), 20).op
    assert fully_connected(op)
    shapes = [(form.kernel, form.channels) for form in forms(op, DPU)]
    assert shapes[1:] == [((20, 20), (8, 10)), ((1, 1), (3200, 10))]
    padded = placed_conv((10, 8, 20, 20), 20, 0, 0, 1, 1)
    assert not fully_connected(padded.op)
    assert padded.broken


@pytest.mark.parametrize(
    ("weight", "tile_px", "rules"),
    [
        # The kernel is larger than any that the DPU has; the layer reads 3200 values.
        ((10, 8, 20, 20), 20, set()),
        # The kernel is the same, but the result has four pixels.
        ((10, 8, 20, 20), 21, {"conv kernel", "conv window"}),
        # This layer reads 4400 values.
        ((10, 11, 20, 20), 20, {"conv kernel", "conv window"}),
        # The DPU computes this layer in four parts.
        ((14472, 16, 1, 1), 1, set()),
        ((14472, 16, 1, 1), 2, {"conv channels"}),
        # VGG's first layer of 4096 is like this: it fits as it is, but not laid flat.
        ((64, 512, 7, 7), 7, set()),
    ],
)
def test_a_fully_connected_layer_is_accepted_in_any_form_that_fits(
    weight: tuple[int, ...], tile_px: int, rules: set[str]
) -> None:
    node = placed_conv(weight, tile_px)
    assert {violation.rule for violation in node.broken} == rules
    assert node.device == ("CPU" if rules else "DPU")
