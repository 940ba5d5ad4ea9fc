"""Compare an exported network with the torch network that it was exported from."""

from pathlib import Path
from typing import cast

import numpy as np
import onnx
import torch

from beers_deploy.model.bank import network_bank
from beers_deploy.model.convbeers import (
    BankedConvBEERS,
    ConvBEERS,
    OfOneSensor,
    for_sensor,
    network_of,
    vector_tensor,
)
from beers_deploy.model.io.tensors import read_conditioned, read_plain
from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.instrument import Instrument
from beers_deploy.quant.session import open_session, run

MAX_DIFFERENCE = 1e-5
"""Share of full scale: a twentieth of a digital number.

That is more than the order of sums in float32 explains.
"""


def torch_network(path: Path, sensor: Instrument | None) -> ConvBEERS | OfOneSensor:
    """Load weights as a torch network, to compare an exported ONNX model with it.

    Args:
        path: the .safetensors file.
        sensor: the sensor to condition the network on; None for weights of one sensor only.

    Returns:
        A torch module that accepts images (N, 1, H, W) in [0, 1].
    """
    network = network_of(read_plain(path) if sensor is None else read_conditioned(path))
    if sensor is not None and isinstance(network, BankedConvBEERS):
        return for_sensor(network, vector_tensor(sensor), network_bank(sensor, network.kernels))
    # `read_plain` reads no other network.
    return cast(ConvBEERS, network)


def require_parity(
    network: ConvBEERS | OfOneSensor, model: Path | onnx.ModelProto, side_px: int
) -> float:
    """Check that an exported model computes the same as torch, on one random image.

    Args:
        network: the torch network.
        model: the ONNX model that was exported from it.
        side_px: side of the image in pixels. It is rounded up to the next multiple of the square of
            pixels that the network moves into channels.

    Returns:
        The largest absolute difference of a pixel, as a share of full scale.

    Raises:
        ModelError: pixels are not finite, or differ by more than MAX_DIFFERENCE.
    """
    side_px += -side_px % network.variant.scale
    image = np.random.default_rng(0).random((1, 1, side_px, side_px), dtype=np.float32)
    with torch.inference_mode():
        expected = network(torch.from_numpy(image)).numpy()
    # Values that are not finite are refused below.
    with np.errstate(invalid="ignore", over="ignore"):
        difference = float(np.abs(run(open_session(model), image) - expected).max())
    if not np.isfinite(difference):
        raise ModelError(
            "The network returns NaN or infinity for a random image. Train it again with a lower "
            "learning rate."
        )
    if difference > MAX_DIFFERENCE:
        raise ModelError(
            f"The exported network differs from torch by {difference:g} of full scale, but at "
            f"most {MAX_DIFFERENCE:g} is allowed. The export is wrong: report it."
        )
    return difference
