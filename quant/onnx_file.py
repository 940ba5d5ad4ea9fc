"""Read and write ONNX files without trusting them: one sentence for whatever is not a self-contained model."""

from pathlib import Path

import onnx
from google.protobuf.message import DecodeError

from model.files import whole_file
from profiles.errors import ModelError

OPSET = 17
IR_VERSION = 8


def load_onnx(path: Path) -> onnx.ModelProto:
    """Read an ONNX model that carries all its weights.

    Raises:
        ModelError: missing, empty, not ONNX, or pointing at weights in other files.
    """
    remedy = "give a file written by 'beers-deploy export' or 'beers-deploy quantize'"
    if not path.is_file():
        raise ModelError(str(path), expected="an ONNX file", got="no such file", remedy=remedy)
    try:
        model = onnx.load_model(path, load_external_data=False)
        onnx.checker.check_model(model)
    except (DecodeError, onnx.checker.ValidationError, ValueError, OSError) as error:
        got = "an empty file" if path.stat().st_size == 0 else " ".join(str(error).split())[:120]
        raise ModelError(str(path), expected="an ONNX file", got=got or "other bytes", remedy=remedy) from error
    if any(t.data_location == onnx.TensorProto.EXTERNAL for t in model.graph.initializer):
        got = "weights kept in another file"
        raise ModelError(str(path), expected="one self-contained ONNX file", got=got, remedy="save it as one file")
    return model


def save_onnx(model: onnx.ModelProto, path: Path) -> None:
    """Check a model and write it, whole or not at all."""
    onnx.checker.check_model(model)
    with whole_file(path) as temporary:
        onnx.save_model(model, temporary)


def metadata(model: onnx.ModelProto) -> dict[str, str]:
    """The key-value pairs that a model carries about itself."""
    return {item.key: item.value for item in model.metadata_props}


def make_model(graph: onnx.GraphProto, about: dict[str, str], microsoft: bool = False) -> onnx.ModelProto:
    """A model of our opset around a graph; `microsoft` adds onnxruntime's own operator domain."""
    opsets = [onnx.helper.make_opsetid("", OPSET)]
    opsets += [onnx.helper.make_opsetid("com.microsoft", 1)] if microsoft else []
    model = onnx.helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="beers-deploy")
    onnx.helper.set_model_props(model, about)
    return model


def image_info(
    name: str, channels: int, tile_px: int | None, kind: int = onnx.TensorProto.FLOAT
) -> onnx.ValueInfoProto:
    """An (N, channels, H, W) tensor: a fixed tile of one image, or any number and size."""
    shape: list[str | int | None] = [1, channels, tile_px, tile_px] if tile_px else ["N", channels, "H", "W"]
    return onnx.helper.make_tensor_value_info(name, kind, shape)


def fixed_tile_px(model: onnx.ModelProto) -> int | None:
    """The tile side that a model is fixed to, or None when it takes any size.

    Raises:
        ModelError: not one (N, 1, H, W) input, or a fixed size that is not square.
    """
    sizes = [d.dim_value for d in model.graph.input[0].type.tensor_type.shape.dim] if model.graph.input else []
    if len(model.graph.input) != 1 or len(sizes) != 4 or sizes[1] != 1 or sizes[2] != sizes[3]:
        raise ModelError(
            "ONNX model",
            expected="one input (N, 1, H, W)",
            got=f"{sizes}",
            remedy="export it with 'beers-deploy export'",
        )
    return sizes[2] or None


def any_size(model: onnx.ModelProto) -> onnx.ModelProto:
    """A network of convolutions that is fixed to one tile, for images of any size; any other as it is."""
    if fixed_tile_px(model) is None:
        return model
    free = onnx.ModelProto()
    free.CopyFrom(model)
    for value in (*free.graph.input, *free.graph.output):
        for side, name in zip(value.type.tensor_type.shape.dim[2:], ("H", "W"), strict=True):
            side.dim_param = name
    del free.graph.value_info[:]
    return free
