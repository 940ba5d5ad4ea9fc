from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx.helper import set_model_props

from beers_deploy.dpu.reading import own_tile_px, read_sized_graph, usual_tile_px
from beers_deploy.profiles.errors import ModelError
from beers_deploy.quant.encodings import BORDER_PX, PLACE_PX, board_model
from beers_deploy.quant.onnx_file import metadata, save_onnx
from tests.deploy.dpu.graphs import MYSTERY, SAME, board_convbeers, written
from tests.quant.quick import fix_sizes
from tests.quant.simplify.networks import parsed
from tests.quant.tiling.small_networks import quantized_half_resolution


def test_a_board_file_keeps_only_the_conversions_at_its_border_and_its_numbers(
    tmp_path: Path,
) -> None:
    first, *middle, last = read_sized_graph(
        board_convbeers(tmp_path / "b.onnx", 3, 8), 64
    ).operations
    assert (first.kind, last.kind) == ("quantize", "dequantize")
    assert {op.kind for op in middle}.isdisjoint(("quantize", "dequantize"))
    conv = next(op for op in middle if op.kind == "conv")
    assert conv.integer
    assert {role: scale.frac_bits for role, scale in conv.scales.items()} == dict.fromkeys(
        ("input 0", "weight", "bias", "output"), 7
    )


def test_an_unknown_operator_hides_the_shape_but_not_the_network(tmp_path: Path) -> None:
    onnx.save(written(MYSTERY), tmp_path / "m.onnx")
    after = read_sized_graph(tmp_path / "m.onnx", 30).operations[-1]
    assert after.out_shape is None
    with pytest.raises(ModelError, match="hides the shape"):
        _ = after.operations


@pytest.mark.parametrize(
    ("axis", "shape"), [(1, (16, 30, 30)), (2, (8, 60, 30)), (-1, (8, 30, 60)), (-3, (16, 30, 30))]
)
def test_maps_are_joined_along_any_axis(axis: int, shape: tuple[int, ...], tmp_path: Path) -> None:
    model = written(f"a = {SAME}(image, w) b = {SAME}(image, w) y = Concat<axis={axis}>(a, b)")
    onnx.save(model, tmp_path / "j.onnx")
    assert read_sized_graph(tmp_path / "j.onnx", 30).operations[-1].out_shape == shape


def test_a_model_fixed_to_another_tile_is_refused_with_its_tile(tmp_path: Path) -> None:
    model = written(f"y = {SAME}(image, w)")
    fix_sizes(model.graph.input[0], 48, 48)
    onnx.save(model, tmp_path / "f.onnx")
    assert read_sized_graph(tmp_path / "f.onnx", 48).operations[0].out_shape == (8, 48, 48)
    with pytest.raises(ModelError, match="`tile` 48"):
        read_sized_graph(tmp_path / "f.onnx", 640)


def test_inputs_that_are_no_images_are_refused(tmp_path: Path) -> None:
    model = written("y = Add(image, w1)")
    del model.graph.input[0].type.tensor_type.shape.dim[3]
    onnx.save(model, tmp_path / "i.onnx")
    with pytest.raises(ModelError, match="inputs"):
        read_sized_graph(tmp_path / "i.onnx")


@pytest.mark.parametrize("on_board", [False, True])
def test_the_core_of_a_network_at_half_resolution_has_maps_of_half_the_tile(
    on_board: bool, tmp_path: Path
) -> None:
    """The host's file only describes the core. The board's file begins behind SpaceToDepth."""
    network = quantized_half_resolution()
    model = board_model(network.core, {}) if on_board else network.host
    save_onnx(model, tmp_path / "half.onnx")
    convolutions = [
        op for op in read_sized_graph(tmp_path / "half.onnx", 64).operations if op.kind == "conv"
    ]
    assert {op.out_shape[1:] for op in convolutions if op.out_shape} == {(32, 32)}
    assert convolutions[0].channels[0] == 3 * 4
    with pytest.raises(ModelError, match=r"`tile` must be a multiple of 2 px .*got 63 px"):
        read_sized_graph(tmp_path / "half.onnx", 63)


def test_a_core_at_half_resolution_that_is_fixed_to_a_tile_is_fixed_to_half_of_it(
    tmp_path: Path,
) -> None:
    model = quantized_half_resolution()
    fixed = board_model(model.core, {}, 64)
    assert [d.dim_value for d in fixed.graph.input[0].type.tensor_type.shape.dim[2:]] == [32, 32]
    assert own_tile_px(fixed) == 64
    save_onnx(fixed, tmp_path / "fixed.onnx")
    with pytest.raises(ModelError, match=r"fixed to 64 x 64 pixels.*Give `tile` 64"):
        read_sized_graph(tmp_path / "fixed.onnx", 66)


@pytest.mark.parametrize(("place_px", "border_px"), [(1, 0), (3, 0), (3, 2), (7, 5)])
def test_the_usual_tile_has_whole_places(place_px: int, border_px: int, tmp_path: Path) -> None:
    """The tile has at least 640 pixels, and is the smallest such multiple of the place."""
    model = board_model(quantized_half_resolution().core, {})
    numbers = {PLACE_PX: str(place_px), BORDER_PX: str(border_px)}
    set_model_props(model, {**metadata(model), **numbers})
    tile_px = usual_tile_px(model)
    assert 640 <= tile_px < 640 + place_px
    save_onnx(model, tmp_path / "core.onnx")
    assert read_sized_graph(tmp_path / "core.onnx", tile_px).operations
    fixed = board_model(quantized_half_resolution().core, {}, 64)
    assert usual_tile_px(fixed) == 64


def test_the_usual_tile_is_one_that_the_network_accepts() -> None:
    nodes = "c = Conv<strides=[3,3]>(x, third) y = ConvTranspose<strides=[3,3]>(c, third)"
    third = np.ones((1, 1, 3, 3), np.float32)
    model = parsed(nodes, "float[N,1,H,W] x => float[N,1,H,W] y", constants={"third": third})
    assert usual_tile_px(model) == 642


@pytest.mark.parametrize("text", ["0", "half", "1000000"])
def test_impossible_places_are_refused(text: str, tmp_path: Path) -> None:
    model = board_model(quantized_half_resolution().core, {})
    next(entry for entry in model.metadata_props if entry.key == PLACE_PX).value = text
    save_onnx(model, tmp_path / "half.onnx")
    with pytest.raises(ModelError, match="contradict"):
        read_sized_graph(tmp_path / "half.onnx", 64)
