"""ConvBEERS as ONNX: `image` (N, 1, H, W) in [0, 1] to `restored`, written node by node under
readable names.

The module also converts any float network to ONNX, from an ONNX file, from weights, which may need
to be conditioned on a sensor, or from a torch module.
"""

import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx

from beers_deploy import __version__
from beers_deploy.model.bank import FILTERS, in_places, network_bank
from beers_deploy.model.family import sensor_vector
from beers_deploy.model.io.tensors import Weights, read_conditioned, read_plain
from beers_deploy.model.levels import INTERVAL
from beers_deploy.profiles.errors import ModelError, OptionError, optional, reason_of
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.quant.domains import OPSET
from beers_deploy.quant.onnx.image_input import image_info
from beers_deploy.quant.onnx_file import GraphWriter, load_onnx, make_model, read_onnx
from beers_deploy.quant.untrusted import times

if TYPE_CHECKING:
    import torch

    from beers_deploy.model.convbeers import ConvBEERS


def float_for(path: Path, name: str, sensor: Sensor, tile_px: int | None = None) -> onnx.ModelProto:
    """Compute the float32 network of one sensor from weights that serve every sensor.

    Args:
        path: the .safetensors file of sensor-conditioned weights.
        name: the name of the network in the metadata.
        sensor: the sensor whose images are to be restored. The middle of each range is used.
        tile_px: side in pixels of the only image size that the network accepts; None for any
            number and size of images.

    Raises:
        ModelError: the weights are for one sensor only.
        OptionError: the network cannot move the pixels of such a tile into channels.
    """
    weights = read_conditioned(path)
    return banked_to_onnx(weights, sensor.nominal(), about(name, weights, sensor.name), tile_px)


def to_onnx(
    network: "Weights | ConvBEERS", about: dict[str, str], tile_px: int | None = None
) -> onnx.ModelProto:
    """Convert a plain ConvBEERS, one that is not conditioned on a sensor, to an ONNX model.

    Args:
        network: its weights, or the torch module.
        about: metadata to write into the model.
        tile_px: side in pixels of the only image size that the network accepts; None for any
            number and size of images.

    Raises:
        OptionError: the network cannot move the pixels of such a tile into channels.
    """
    scale = network.variant.scale
    tile_px = require_tile(tile_px, scale)
    writer = GraphWriter()
    arrays = network.tensors if isinstance(network, Weights) else network.state_dict()
    for name, value in arrays.items():
        writer.constant(name, np.asarray(value))
    unshuffled = _moved(writer, "SpaceToDepth", "unshuffled", "image", scale)
    deep = _deep(writer, network.variant.blocks, unshuffled)
    return _ended(writer, _conv(writer, "tail", deep), scale, about, tile_px)


def banked_to_onnx(
    weights: Weights, sensor: Instrument, about: dict[str, str], tile_px: int | None = None
) -> onnx.ModelProto:
    """Convert sensor-conditioned weights to the ONNX model of one sensor.

    The first convolution of the model is the filter bank: filters computed from the sensor's blur
    and noise (see `model.bank`). It returns the image, four planes of detail and the analytic
    restoration, which is the image sharpened by a linear filter. Another convolution picks the
    analytic restoration. The last convolution reads it at one tap, together with the output of the
    trained layers. The borders of the image are mirrored before the first convolution.

    Args:
        weights: the weights of a `BankedConvBEERS`.
        sensor: the sensor whose images are restored.
        about: metadata to write into the model.
        tile_px: side in pixels of the only image size that the network accepts; None for any
            number and size of images.

    Raises:
        OptionError: the network cannot move the pixels of such a tile into channels.
    """
    variant = weights.variant
    bank = network_bank(sensor, weights.kernels)
    scale = variant.scale
    pixels = variant.pixels
    tile_px = require_tile(tile_px, scale)
    vector = np.array(sensor_vector(sensor).values, np.float32)
    tensors = dict(weights.tensors)
    # The head does not read the analytic restoration, hence weights of 0 for its planes.
    unread = np.zeros((variant.features, pixels, 3, 3), np.float32)
    tensors["head.weight"] = np.concatenate([tensors["head.weight"], unread], 1)
    tensors["head.bias"] = tensors["head.bias"] + tensors.pop("bias.weight") @ vector
    # The last convolution adds the analytic restoration at its middle tap alone.
    added = np.zeros((pixels, pixels, 3, 3), np.float32)
    added[range(pixels), range(pixels), 1, 1] = 1
    tensors["tail.weight"] = np.concatenate([tensors["tail.weight"], added], 1) * np.float32(
        bank.unit
    )
    tensors["analytic.weight"] = np.zeros((pixels, (2 + FILTERS) * pixels, 1, 1), np.float32)
    tensors["analytic.weight"][range(pixels), range(-pixels, 0)] = 1
    tensors["tail.bias"] = tensors["tail.bias"] * np.float32(bank.unit)
    tensors["bank.weight"] = in_places(bank.kernels, scale).astype(np.float32)
    # The body reads the image less 0.5, as it did in training.
    tensors["bank.bias"] = np.repeat(np.array([-0.5, *[0] * (1 + FILTERS)], np.float32), pixels)
    writer = GraphWriter()
    for name, value in tensors.items():
        writer.constant(name, value)
    side = tensors["bank.weight"].shape[-1]
    around = writer.constant("around", np.array([0, 0, *[side // 2 * scale] * 2] * 2))
    widened = writer.node("Pad", "widened", ["image", around], mode="reflect")
    unshuffled = _moved(writer, "SpaceToDepth", "unshuffled", widened, scale)
    bank_output = writer.node(
        "Conv",
        "bank",
        [unshuffled, "bank.weight", "bank.bias"],
        pads=[0] * 4,
        kernel_shape=[side, side],
    )
    reach, wide_reach = bank.reach(weights.kernels)
    planes = _clip(writer, "planes", bank_output, reach)
    picked = writer.node("Conv", "picked", [bank_output, "analytic.weight"], kernel_shape=[1, 1])
    analytic = _clip(writer, "analytic", picked, wide_reach)
    deep = writer.node("Concat", "deep", [_deep(writer, variant.blocks, planes), analytic], axis=1)
    return _ended(writer, _conv(writer, "tail", deep), scale, about, tile_px)


def _clip(writer: GraphWriter, name: str, source: str, most: float) -> str:
    """Write a Clip node that limits a tensor to [-most, most]."""
    ends = [(f"{name}.low", -most), (f"{name}.high", most)]
    limits = [writer.constant(end, np.array(value, np.float32)) for end, value in ends]
    return writer.node("Clip", name, [source, *limits])


def _deep(writer: GraphWriter, blocks: int, source: str) -> str:
    """Write the head, the blocks and the end of the body."""
    stream = head = _conv(writer, "head", source)
    for k in range(blocks):
        inner = writer.node("Relu", f"body.{k}.relu", [_conv(writer, f"body.{k}.first", stream)])
        stream = writer.node(
            "Add", f"body.{k}.add", [stream, _conv(writer, f"body.{k}.second", inner)]
        )
    return writer.node("Add", "body_end.add", [head, _conv(writer, "body_end", stream)])


def _ended(
    writer: GraphWriter, correction: str, scale: int, about: dict[str, str], tile_px: int | None
) -> onnx.ModelProto:
    """Return the model that adds a correction to the image."""
    shuffled = _moved(writer, "DepthToSpace", "shuffled", correction, scale)
    writer.node("Add", "restored", ["image", shuffled])
    graph = writer.graph(
        "convbeers", [image_info("image", 1, tile_px)], [image_info("restored", 1, tile_px)]
    )
    return make_model(graph, {"beers_deploy_version": __version__, "precision": "float32", **about})


def require_tile(tile_px: int | None, scale: int) -> int | None:
    """Return the side of a tile, or raise OptionError if it is not made of whole squares of pixels.

    Args:
        tile_px: side of the tile in pixels; None for any size, which passes.
        scale: side of the squares that the network moves into channels, so that its layers have
            1 / `scale` of the resolution.
    """
    if tile_px is None:
        return None
    if not isinstance(tile_px, int | np.integer) or tile_px < 1 or tile_px % scale:
        raise OptionError(
            f"`tile` must be a multiple of {scale} px, but it is {tile_px!r} px. Choose another "
            "`tile`, or leave it out."
        )
    # ONNX accepts no integer of NumPy as a size.
    return int(tile_px)


def _conv(writer: GraphWriter, name: str, source: str) -> str:
    feeds = [source, f"{name}.weight", f"{name}.bias"]
    return writer.node("Conv", name, feeds, pads=[1] * 4, kernel_shape=[3, 3])


def _moved(writer: GraphWriter, operator: str, name: str, source: str, scale: int) -> str:
    """Write the node that moves pixels into channels or back. ONNX and torch agree in the order
    because the image has one channel.
    """
    return writer.node(operator, name, [source], blocksize=scale) if scale > 1 else source


def float_model(path: Path) -> onnx.ModelProto:
    """Load a network as ONNX, from an .onnx file or from weights that are for one sensor.

    Args:
        path: the .onnx file, or the .safetensors file of a plain ConvBEERS.

    Raises:
        ModelError: the file is not valid, or its weights need a sensor to be conditioned on.
    """
    if path.suffix != ".safetensors":
        return load_onnx(path)
    weights = read_plain(path)
    return to_onnx(weights, about(path.stem, weights))


def about(variant: str, weights: Weights, sensor: str | None = None) -> dict[str, str]:
    """Return the metadata of an exported file.

    Args:
        variant: the name of the network.
        weights: the weights of the network, with the recipe of their training.
        sensor: the name of the sensor that the network is conditioned on; None for the sensor that
            the recipe names.

    Returns:
        The names of the network, its sensor and its reference, and the calibrated interval of its
        pixels if the weights have one, by metadata key.
    """
    recipe = weights.recipe
    interval = {INTERVAL: weights.interval} if weights.interval else {}
    return {
        "variant": variant,
        "sensor": sensor if sensor is not None else str(recipe.get("degraded", "")),
        "reference": str(recipe.get("reference", "")),
        **interval,
    }


def exported(module: Any, example: "Sequence[int] | torch.Tensor") -> onnx.ModelProto:
    """Export a torch module to ONNX, for any number and size of images.

    Args:
        module: the torch.nn.Module. Its training mode is restored afterwards.
        example: an input (N, C, H, W) that the module accepts, or its shape.

    Returns:
        The ONNX model, with the input `image` and the output `restored`.

    Raises:
        ModelError: `module` is not a torch module, or torch cannot export it.
        MissingExtraError: torch is not installed.
    """
    if not hasattr(module, "state_dict"):
        raise ModelError(
            "`network` must be a Network, a ModelProto, a torch.nn.Module, a file or a shipped "
            f"name, got {type(module).__name__}."
        )
    torch = optional("torch", "network")
    free = {name: {0: "N", 2: "H", 3: "W"} for name in ("image", "restored")}
    stream = io.BytesIO()
    training = module.training
    # torch.onnx.export itself accepts the input.
    shape = getattr(example, "shape", ())
    sizes = shape if len(shape) == 4 else example
    with warnings.catch_warnings():
        # The exporter's own warnings do not count, because its file is checked below.
        warnings.simplefilter("ignore")
        try:
            names = {"input_names": ["image"], "output_names": ["restored"], "dynamic_axes": free}
            # A notebook may have another default type.
            image = torch.zeros(tuple(sizes), dtype=torch.float32)
            torch.onnx.export(
                module.eval(), (image,), stream, opset_version=OPSET, dynamo=False, **names
            )
        # The code of a module may raise anything.
        except Exception as error:
            reason = reason_of(error)
            raise ModelError(
                f"torch cannot export the module {type(module).__name__}: {reason}. Check that it "
                f"accepts an image of {times(sizes)}, or load it first with "
                "Network.load(module, example=(N, C, H, W))."
            ) from error
        finally:
            # `eval` changed the caller's own module.
            module.train(training)
    return read_onnx(stream.getvalue(), type(module).__name__)
