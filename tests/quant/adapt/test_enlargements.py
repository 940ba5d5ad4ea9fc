"""Tests that enlargements and mirrored borders which a DPU lacks are replaced and quantised."""

import numpy as np
import pytest

from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.adapt.adaptation import adapt
from beers_deploy.quant.adapt.kinds import Kind, nodes_by_kind
from beers_deploy.quant.adapt.replacements import replaced
from beers_deploy.quant.graph import Resize, read_network
from beers_deploy.quant.onnx.graph import OnnxGraph
from beers_deploy.quant.simplify.simplify import simplify
from tests.quant.adapt.images import BARE, assert_near
from tests.quant.adapt.networks import FROM_IMAGE, INNER, TO_RESULT, enlarging
from tests.quant.quick import image, patches_of, quickly, run_model
from tests.quant.simplify.networks import parsed
from tests.quant.tiling.small_networks import check_tiles


@pytest.mark.parametrize(
    ("where", "factor"), [("align_corners", 2), ("asymmetric", 4), ("half_pixel", 8)]
)
def test_bilinear_enlargement_has_half_pixel_centres(where: str, factor: int) -> None:
    """It is near to the original, and of the network's sizes."""
    model = enlarging("linear", where, factor)
    with pytest.raises(ModelError, match=r"half-pixel centres.*'quantize --adapt'"):
        read_network(model)
    adapted = adapt(model, BARE, BARE)
    assert adapted.rows[0].name == "1 other bilinear enlargement"
    assert_near(adapted, 30)
    resizes = [op for op in read_network(adapted.model).graph if isinstance(op, Resize)]
    assert all(op.bilinear for op in resizes)
    assert [op.factor for op in resizes] == ([4, 2] if factor == 8 else [factor])


@pytest.mark.parametrize(("factor", "adds"), [(2, "result"), (4, "result"), (2, "within"), (2, "")])
def test_bicubic_enlargement_is_a_convolution_of_the_mirrored_image(factor: int, adds: str) -> None:
    """Only the border differs, and the host enlarges what is added to the result."""
    model = enlarging("cubic", "half_pixel", factor, adds)
    with pytest.raises(ModelError, match="'quantize --adapt'"):
        read_network(model)
    kinds = nodes_by_kind(OnnxGraph(model))
    assert {kind: len(nodes) for kind, nodes in kinds.items()} == {Kind.cubic: 1}
    near = replaced(model, {Kind.cubic}, (), {})
    # As bright as the samples that INT8 is calibrated on.
    pixels = BARE.degraded[0][..., :20, :28]
    expected, actual = (run_model(network, pixels) for network in (model, near))
    border_px = 4 * factor
    inner = np.s_[..., border_px:-border_px, border_px:-border_px]
    np.testing.assert_allclose(actual[inner], expected[inner], atol=2e-5)
    split = read_network(near)
    assert (split.base.factor, split.border_px) == (factor if adds == "result" else 1, 2)
    int8 = quickly(near, BARE)
    assert np.abs(run_model(int8.host, pixels) - expected).mean() < 0.02
    check_tiles(int8.host, pixels, (12, 16))


@pytest.mark.parametrize(
    ("mode", "within"), [("edge", "edge"), ("reflect", "reflect"), ("edge", "constant")]
)
def test_zeros_around_the_mirrored_image_change_the_border_alone(mode: str, within: str) -> None:
    """The host mirrors an image that the network pads by its edge, too."""
    nodes = f"""
        p = Pad<mode="{mode}">(image, around) a = Conv(p, w0) b = Relu(a)
        q = Pad<mode="{within}">(b, around) c = Conv(q, w1) d = Relu(c)
        r = Pad<mode="{within}">(d, around) e = Conv(r, w2)
        restored = Add(image, e)
    """
    constants = {
        f"w{k}": np.random.default_rng(k).normal(0, 0.2, shape)
        for k, shape in enumerate([FROM_IMAGE, INNER, TO_RESULT])
    }
    constants["around"] = np.array([0, 0, 1, 1] * 2)
    ends = "float[N,1,H,W] image => float[N,1,H,W] restored"
    original = simplify(parsed(nodes, ends, constants=constants), "g")
    with pytest.raises(ModelError, match="--adapt"):
        read_network(original)
    images = [image(48, 64, seed) for seed in range(4)]
    held_out = patches_of(images)
    adapted = adapt(original, held_out, held_out)
    assert list(adapted.rows[0].text.values()) == [
        "zeros around the mirrored image, not compensated: no fit is nearer"
    ]
    expected, actual = (run_model(model, images[0]) for model in (original, adapted.model))
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual[..., 3:-3, 3:-3], expected[..., 3:-3, 3:-3], atol=1e-6)
    int8 = quickly(adapted.model, held_out)
    assert np.abs(run_model(int8.host, images[0]) - actual).mean() < 0.02
    check_tiles(int8.host, images[0], (24, 32))
