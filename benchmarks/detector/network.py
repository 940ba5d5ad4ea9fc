"""A detector with 100 k parameters and its ONNX file. It consists of convolutions, ReLU, an
upsampling and a concatenation.

    image -> 2 strided convolutions -> fine (stride 4)
    fine -> strided -> coarse (stride 8) -> enlarged, + fine -> head

Each cell of 4 x 4 input pixels predicts, for an object centred in it, the centre and size of its
box and the probability of each class. The detector is anchor-free, like CenterNet (Zhou et al.,
2019, arXiv 1904.07850). Everything except the decoding of the last map is legal on a DPU.
"""

import io
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn
from torch.nn import functional

DETECTOR = Path(__file__).with_name("detector.onnx")
"""The trained small detector. It finds vehicles, ships, aircraft and tanks in synthetic scenes."""

STRIDE_PX = 4
"""Side of a cell in input pixels."""
PRIOR = 0.02
"""The initial probability of each class (focal loss, Lin et al., 2017, arXiv 1708.02002)."""


class DetectorNetwork(nn.Module):
    """A network that maps images (N, 3, H, W), RGB in [0, 1], to (N, 4 + classes, H / 4, W / 4).
    `decoded` decodes the first four channels.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.fine = nn.Sequential(
            _conv(3, 16, stride=2), _conv(16, 24, stride=2), _conv(24, 24), _conv(24, 24)
        )
        self.coarse = nn.Sequential(_conv(24, 48, stride=2), *(_conv(48, 48) for _ in range(3)))
        self.join = nn.Sequential(_conv(24 + 48, 32), _conv(32, 32))
        self.tail = nn.Conv2d(32, 4 + classes, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Return the map of boxes and logits, not decoded."""
        fine = self.fine(image)
        coarse = functional.interpolate(self.coarse(fine), scale_factor=2.0, mode="nearest")
        joined: Tensor = self.tail(self.join(torch.cat([fine, coarse], dim=1)))
        return joined


def decoded(boxes: Tensor) -> Tensor:
    """Decode boxes from the first four channels of the map: (N, 4, h, w) to cx, cy, w, h in input
    pixels, of the same shape.

    The centre is encoded as the offset from the middle of the cell, in cells. The size is encoded
    as the logarithm of its number of cells.
    """
    rows, columns = (torch.arange(side, dtype=boxes.dtype) + 0.5 for side in boxes.shape[2:])
    x = boxes[:, :1] + columns
    y = boxes[:, 1:2] + rows[:, None]
    return STRIDE_PX * torch.cat([x, y, torch.exp(boxes[:, 2:4])], dim=1)


class Decoding(nn.Module):
    """The network with its decoding, as a file stores it: (N, 3, H, W) to (N, 4 + classes, A). The
    channels are cx, cy, w, h in input pixels, then the scores.
    """

    def __init__(self, network: DetectorNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        """Return what Ultralytics calls the raw output, with one column for each of the A cells."""
        output = self.network(image)
        return torch.cat([decoded(output[:, :4]), torch.sigmoid(output[:, 4:])], dim=1).flatten(2)


def initialise(network: DetectorNetwork, generator: torch.Generator) -> None:
    """Draw He-normal weights. Scale down those of the last layer, and set its biases so that every
    class starts with probability `PRIOR`.
    """
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu", generator=generator)
    with torch.no_grad():
        network.tail.weight.mul_(0.1)
        assert network.tail.bias is not None  # noqa: S101
        network.tail.bias[:4] = 0.0
        network.tail.bias[4:] = -math.log(1 / PRIOR - 1)


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Return a 3 x 3 convolution followed by batch normalisation and ReLU."""
    conv = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ReLU())


def detector_to_onnx(
    network: DetectorNetwork, names: Sequence[str], side_px: int, recipe: str
) -> onnx.ModelProto:
    """Export a detector to ONNX: `images` (1, 3, S, S), RGB in [0, 1], to `output0` (1, 4 +
    classes, S * S / 16).

    Layout and metadata are those of Ultralytics' exporter (ultralytics/engine/exporter.py, read for
    its format; no code is taken from it). A column of the output holds cx, cy, w, h in input
    pixels, then a score in [0, 1] for each class. Batch normalisation is folded into the
    convolutions.

    Args:
        network: the trained network.
        names: the names of the classes, in the network's order.
        side_px: S, a multiple of 8.
        recipe: the settings of the training.
    """
    buffer = io.BytesIO()
    image = torch.zeros(1, 3, side_px, side_px)
    with warnings.catch_warnings():
        # The newer exporter requires onnxscript, another package.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            Decoding(network).eval(),
            (image,),
            buffer,  # type: ignore[arg-type]
            input_names=["images"],
            output_names=["output0"],
            opset_version=17,
            dynamo=False,
        )
    model: onnx.ModelProto = onnx.ModelProto.FromString(buffer.getvalue())
    metadata = {
        "task": "detect",
        "stride": 8,
        "batch": 1,
        "imgsz": [side_px, side_px],
        "channels": 3,
        "names": dict(enumerate(names)),
        "description": "vehicles, ships, aircraft and tanks of drawn scenes",
        "license": "Apache-2.0",
        "recipe": recipe,
    }
    onnx.helper.set_model_props(model, {key: str(value) for key, value in metadata.items()})
    return model
