"""ConvBEERS as ONNX: `image` (N, 1, H, W) in [0, 1] to `restored`, written node by node under readable names.

Also how any float network is had as ONNX: from an ONNX file, from weights, or the shipped one.
"""

from pathlib import Path

import numpy as np
import onnx
import torch

from deploy import __version__
from model.conditioning import fold, tell
from model.convbeers import ConvBEERS
from model.io.weights import is_told, load_network, load_told
from model.shipped import SHIPPED, default_float_weights, float_file, shipped_names, shipped_weights, told_names
from profiles.errors import ModelError
from profiles.sensor_file import load_sensor
from quant.onnx_file import GraphWriter, image_info, is_quantised, load_onnx, make_model, metadata
from quant.session import open_session, run

MAX_DIFFERENCE = 1e-5
"""Of full scale: a twentieth of a digital number, above what float32 summation order explains."""


def network_for(path: Path, sensor: str | None) -> tuple[ConvBEERS, dict[str, object], tuple[str, ...]]:
    """A plain network from a weights file; weights that can be told their sensor are folded for the one named.

    Args:
        path: weights that `train` wrote.
        sensor: a profile's name or .toml file, of which the middle of every range is told; None for plain weights.

    Returns:
        The network, its recipe, and a sentence for each value of the sensor outside the range it was trained for.

    Raises:
        ModelError: told weights without a sensor, or a sensor for plain ones.
        ProfileError: no such sensor.
    """
    if sensor is None:
        return (*load_network(path), ())
    if not is_told(path):
        remedy = f"leave --sensor out, or give weights of 'train --told' or one of {', '.join(told_names())}"
        expected = "weights that can be told their sensor"
        raise ModelError(str(path), expected=expected, got="those of a plain network", remedy=remedy)
    told, recipe = load_told(path)
    profile = load_sensor(sensor)
    found = tell(profile.nominal())
    return fold(told, found.vector), {**recipe, "degraded": profile.name}, found.outside


def to_onnx(network: ConvBEERS, about: dict[str, str], tile_px: int | None = None) -> onnx.ModelProto:
    """The network as an ONNX model; `tile_px` fixes one square image, None leaves number and size free."""
    writer = GraphWriter()
    for name, value in network.state_dict().items():
        writer.constant(name, value.numpy())
    stream = head = _conv(writer, "head", "image")
    for k in range(network.variant.blocks):
        inner = writer.node("Relu", f"body.{k}.relu", [_conv(writer, f"body.{k}.first", stream)])
        stream = writer.node("Add", f"body.{k}.add", [stream, _conv(writer, f"body.{k}.second", inner)])
    deep = writer.node("Add", "body_end.add", [head, _conv(writer, "body_end", stream)])
    writer.node("Add", "restored", ["image", _conv(writer, "tail", deep)])
    graph = writer.graph("convbeers", [image_info("image", 1, tile_px)], [image_info("restored", 1, tile_px)])
    return make_model(graph, {"beers_deploy_version": __version__, "precision": "float32", **about})


def parity(network: ConvBEERS, model: Path | onnx.ModelProto, side_px: int) -> float:
    """Largest absolute difference between torch and onnxruntime on one random image, in [0, 1] of full scale.

    Raises:
        ModelError: the network gives NaN or infinity; then nothing can be compared.
    """
    image = np.random.default_rng(0).random((1, 1, side_px, side_px), dtype=np.float32)
    with torch.inference_mode():
        expected = network(torch.from_numpy(image)).numpy()
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused
        difference = float(np.abs(run(open_session(model), image) - expected).max())
    if not np.isfinite(difference):
        expected_text, remedy = "finite pixels on a random image", "train it again with a lower learning rate"
        raise ModelError("network", expected=expected_text, got="NaN or infinity", remedy=remedy)
    return difference


def require_parity(network: ConvBEERS, model: Path | onnx.ModelProto, side_px: int) -> float:
    """As `parity`, and small.

    Raises:
        ModelError: the network gives NaN or infinity, or both do not compute the same.
    """
    difference = parity(network, model, side_px)
    if difference > MAX_DIFFERENCE:
        expected = f"at most {MAX_DIFFERENCE:g} of full scale from torch"
        remedy = "report it: the export is wrong"
        raise ModelError("exported network", expected=expected, got=f"{difference:g}", remedy=remedy)
    return difference


def _conv(writer: GraphWriter, name: str, source: str) -> str:
    feeds = [source, f"{name}.weight", f"{name}.bias"]
    return writer.node("Conv", name, feeds, pads=[1] * 4, kernel_shape=[3, 3])


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


def other_precision(model: onnx.ModelProto) -> onnx.ModelProto | None:
    """A shipped network of the same variant in the other precision, or None; its weights may be others.

    Time depends on the shapes, not on the weights: for a comparison of time any weights will do.
    """
    variant = metadata(model).get("variant", "")
    if is_quantised(model):
        return float_model(shipped_weights(variant)) if variant in shipped_names() else None
    int8 = SHIPPED / f"{variant}-int8.onnx"
    return load_onnx(int8) if variant and int8.is_file() else None
