"""What commands use when nothing is given: the shipped convbeers-s, and drawn scenes."""

from pathlib import Path

import onnx

from deploy.export import to_onnx
from model.io.weights import load_network
from model.shipped import SHIPPED, default_float_weights, float_file, shipped_names, shipped_weights
from profiles.errors import ModelError
from quant.onnx_file import load_onnx, metadata

HELD_OUT_SEED = 1000
"""Added to a run's seed where patches must be others than calibration's."""


def float_model(path: Path | None) -> onnx.ModelProto:
    """A float network as ONNX: from an .onnx or a .safetensors file, or the shipped one.

    Raises:
        ModelError: neither of these.
    """
    path = float_file(path) if path else default_float_weights()
    if path.suffix != ".safetensors":
        return load_onnx(path)
    network, recipe = load_network(path)
    return to_onnx(network, about(path.stem, recipe))


def about(variant: str, recipe: dict[str, object]) -> dict[str, str]:
    """What an exported file says of itself."""
    return {
        "variant": variant,
        "sensor": str(recipe.get("degraded", "")),
        "reference": str(recipe.get("reference", "")),
    }


def counterpart(model: onnx.ModelProto) -> onnx.ModelProto | None:
    """A shipped network of the same variant in the other precision, or None; its weights may be others.

    Time depends on the shapes, not on the weights: for a comparison of time any weights will do.
    """
    variant = metadata(model).get("variant", "")
    if is_quantised(model):
        return float_model(shipped_weights(variant)) if variant in shipped_names() else None
    int8 = SHIPPED / f"{variant}-int8.onnx"
    return load_onnx(int8) if variant and int8.is_file() else None


def is_quantised(model: onnx.ModelProto) -> bool:
    """Whether any node computes on, makes or reads quantised numbers."""
    kinds = {node.op_type.lower() for node in model.graph.node}
    return any(mark in kind for kind in kinds for mark in ("qlinear", "quantizelinear", "integer"))


def require_quantised(model: onnx.ModelProto, path: Path, wanted: bool) -> None:
    """Refuse the float network in the place of the INT8 one, and the other way round.

    Raises:
        ModelError: it is the other kind.
    """
    if is_quantised(model) != wanted:
        expected, got = ("an INT8 network", "a float one") if wanted else ("a float network", "an INT8 one")
        remedy = "give the float model first, the INT8 model second"
        raise ModelError(str(path), expected=expected, got=got, remedy=remedy)
