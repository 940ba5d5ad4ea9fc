"""ConvBEERS as ONNX: `image` (N, 1, H, W) in [0, 1] to `restored`, written node by node under readable names.

Also how any float network is had as ONNX: from an ONNX file or from weights, which may be specialised to a sensor.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import onnx

from deploy import __version__
from model.io.tensors import Arrays, Weights, read_conditioned, read_plain
from model.specialise import sensor_vector, specialised
from profiles.errors import ModelError, OptionError
from profiles.sensor import Sensor
from quant.onnx_file import GraphWriter, image_info, load_onnx, make_model
from quant.session import open_session, run

if TYPE_CHECKING:
    from model.convbeers import ConvBEERS

MAX_DIFFERENCE = 1e-5
"""Of full scale: a twentieth of a digital number, above what float32 summation order explains."""


def weights_for(path: Path, sensor: Sensor) -> tuple[Weights, tuple[str, ...]]:
    """The weights of a conditioned network specialised to a sensor.

    Returns:
        Those of a plain network, and a sentence for each value of the sensor outside the range that was trained.

    Raises:
        ModelError: no conditioned network's weights.
    """
    found, vector = read_conditioned(path), sensor_vector(sensor)
    tensors = specialised(found.tensors, found.variant, vector)
    return Weights(tensors, found.variant, found.recipe), vector.outside


def to_onnx(network: "Weights | ConvBEERS", about: dict[str, str], tile_px: int | None = None) -> onnx.ModelProto:
    """A plain network as an ONNX model; `tile_px` fixes one square image, None leaves number and size free.

    Raises:
        OptionError: a tile that is no multiple of the network's scale.
    """
    scale = network.variant.scale
    if tile_px is not None and tile_px % scale:
        remedy = "choose another, or leave it out"
        raise OptionError("--tile", expected=f"a multiple of {scale} px", got=f"{tile_px} px", remedy=remedy)
    writer = GraphWriter()
    for name, value in _arrays(network).items():
        writer.constant(name, value)
    stream = head = _conv(writer, "head", _moved(writer, "SpaceToDepth", "unshuffled", "image", scale))
    for k in range(network.variant.blocks):
        inner = writer.node("Relu", f"body.{k}.relu", [_conv(writer, f"body.{k}.first", stream)])
        stream = writer.node("Add", f"body.{k}.add", [stream, _conv(writer, f"body.{k}.second", inner)])
    deep = writer.node("Add", "body_end.add", [head, _conv(writer, "body_end", stream)])
    correction = _moved(writer, "DepthToSpace", "shuffled", _conv(writer, "tail", deep), scale)
    writer.node("Add", "restored", ["image", correction])
    graph = writer.graph("convbeers", [image_info("image", 1, tile_px)], [image_info("restored", 1, tile_px)])
    return make_model(graph, {"beers_deploy_version": __version__, "precision": "float32", **about})


def _arrays(network: "Weights | ConvBEERS") -> Arrays:
    if isinstance(network, Weights):
        return network.tensors
    return {name: value.numpy() for name, value in network.state_dict().items()}


def parity(network: "ConvBEERS", model: Path | onnx.ModelProto, side_px: int) -> float:
    """Largest absolute difference between torch and onnxruntime on one random image, in [0, 1] of full scale.

    The image's side is the next multiple of the network's scale.

    Raises:
        ModelError: the network gives NaN or infinity; then nothing can be compared.
    """
    import torch  # seconds to load, and a restoration begins with what this module writes

    side_px += -side_px % network.variant.scale
    image = np.random.default_rng(0).random((1, 1, side_px, side_px), dtype=np.float32)
    with torch.inference_mode():
        expected = network(torch.from_numpy(image)).numpy()
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused
        difference = float(np.abs(run(open_session(model), image) - expected).max())
    if not np.isfinite(difference):
        expected_text, remedy = "finite pixels on a random image", "train it again with a lower learning rate"
        raise ModelError("network", expected=expected_text, got="NaN or infinity", remedy=remedy)
    return difference


def require_parity(network: "ConvBEERS", model: Path | onnx.ModelProto, side_px: int) -> float:
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


def _moved(writer: GraphWriter, operator: str, name: str, source: str, scale: int) -> str:
    """Pixels into channels or back, in an order in which ONNX and torch agree: the image has one channel."""
    return writer.node(operator, name, [source], blocksize=scale) if scale > 1 else source


def float_model(path: Path) -> onnx.ModelProto:
    """A float network as ONNX: from an .onnx file, or from the .safetensors file of a plain one.

    Raises:
        ModelError: neither of these.
    """
    if path.suffix != ".safetensors":
        return load_onnx(path)
    weights = read_plain(path)
    return to_onnx(weights, about(path.stem, weights.recipe))


def about(variant: str, recipe: dict[str, object], sensor: str | None = None) -> dict[str, str]:
    """What an exported file says of itself; `sensor` is the name of the one that it was specialised to."""
    return {
        "variant": variant,
        "sensor": sensor if sensor is not None else str(recipe.get("degraded", "")),
        "reference": str(recipe.get("reference", "")),
    }
