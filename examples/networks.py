"""Nine networks of the kinds that users bring, and their export. They are small, but have the
operators of the real ones.

    network = build("unet", torch.Generator().manual_seed(0))
    model = to_onnx("unet", network)

Images are (N, C, H, W) float32, in [0, 1] of full scale. The graphs are those that torch's own
exporter produces from the modules, with all its artefacts: batch normalisation folded or not,
Constant nodes, ReLU6 as Clip, pixel unshuffling as Reshape and Transpose.
"""

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import onnx
import torch
from torch import Tensor, nn
from torch.nn import functional

DPU_SLOPE = 26 / 256
"""The only slope of a LeakyReLU that the DPU supports."""

CORRECTIONS = ("second", "project", "tail")
"""The convolutions whose output is added to their block's input. They start with small weights, so
that a network starts near the identity.
"""


class DnCNN(nn.Module):
    """Convolutions with batch normalisation that estimate the noise, which is subtracted from the
    image (Zhang et al., 2017).
    """

    def __init__(self, layers: int = 8, features: int = 32) -> None:
        super().__init__()
        middle = [_batch_normed(features, features, nn.ReLU()) for _ in range(layers - 2)]
        self.body = nn.Sequential(nn.Conv2d(1, features, 3, padding=1), nn.ReLU(), *middle)
        self.tail = nn.Conv2d(features, 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Restore images (N, 1, H, W). The shape is preserved."""
        noise: Tensor = self.tail(self.body(image))
        return image - noise


class FFDNet(nn.Sequential):
    """A network at half the sampling, between pixel unshuffling and shuffling, without a global add
    (Zhang et al., 2018).

    Its map of noise levels is left out, because one sensor is one level. Batch normalisation is
    left out too, because its batch statistics would hide how bright each image is. It maps images
    (N, 1, H, W) of even sides to the same shape.
    """

    def __init__(self, layers: int = 6, features: int = 32) -> None:
        body = [
            _activated(4 if k == 0 else features, features, nn.ReLU()) for k in range(layers - 1)
        ]
        super().__init__(
            nn.PixelUnshuffle(2), *body, nn.Conv2d(features, 4, 3, padding=1), nn.PixelShuffle(2)
        )


class ESPCN(nn.Sequential):
    """A network that doubles the sampling by one pixel shuffle at the end (Shi et al., 2016), with
    ReLU in place of tanh.

    It maps images (N, 1, H, W) to (N, 1, 2 H, 2 W).
    """

    def __init__(self) -> None:
        head = nn.Conv2d(1, 64, 5, padding=2)
        tail = nn.Conv2d(32, 4, 3, padding=1)
        super().__init__(head, nn.ReLU(), _activated(64, 32, nn.ReLU()), tail, nn.PixelShuffle(2))


class SESR(nn.Module):
    """A network that doubles the sampling, with two long residuals (Bhardwaj et al., 2022), and
    ReLU in place of PReLU.

    Each convolution corresponds to one of their linear blocks, collapsed after training.
    """

    def __init__(self, layers: int = 5, features: int = 16) -> None:
        super().__init__()
        self.head = nn.Sequential(nn.Conv2d(1, features, 5, padding=2), nn.ReLU())
        self.body = nn.Sequential(
            *(_activated(features, features, nn.ReLU()) for _ in range(layers))
        )
        self.tail = nn.Conv2d(features, 4, 5, padding=2)
        self.shuffle = nn.PixelShuffle(2)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to (N, 1, 2 H, 2 W). The image is added to each of the four
        phases.
        """
        shallow = self.head(image)
        enlarged: Tensor = self.shuffle(self.tail(shallow + self.body(shallow)) + image)
        return enlarged


class UNet(nn.Module):
    """A network of three levels: max pooling down, transposed convolutions up, concatenated skips
    (Ronneberger et al., 2015).
    """

    def __init__(self, features: int = 16) -> None:
        super().__init__()
        one = features
        two = 2 * features
        four = 4 * features
        self.down_one = _twice(1, one)
        self.down_two = _twice(one, two)
        self.bottom = _twice(two, four)
        self.up_two = nn.ConvTranspose2d(four, two, 2, stride=2)
        self.up_one = nn.ConvTranspose2d(two, one, 2, stride=2)
        self.join_two = _twice(four, two)
        self.join_one = _twice(two, one)
        self.pool = nn.MaxPool2d(2)
        self.tail = nn.Conv2d(one, 1, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Restore images (N, 1, H, W) of sides that are multiples of 4. The shape is preserved."""
        first = self.down_one(image)
        second = self.down_two(self.pool(first))
        third = self.up_two(self.bottom(self.pool(second)))
        fourth = self.up_one(self.join_two(torch.cat([third, second], dim=1)))
        correction: Tensor = self.tail(self.join_one(torch.cat([fourth, first], dim=1)))
        return image + correction


class EDSR(nn.Module):
    """Residual blocks without batch normalisation over four bands jointly (Lim et al., 2017,
    without upsampling).
    """

    def __init__(self, bands: int = 4, blocks: int = 4, features: int = 32) -> None:
        super().__init__()
        self.head = nn.Conv2d(bands, features, 3, padding=1)
        self.body = nn.Sequential(*(ResidualBlock(features) for _ in range(blocks)))
        self.tail = nn.Conv2d(features, bands, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Restore images (N, bands, H, W). The shape is preserved."""
        correction: Tensor = self.tail(self.body(self.head(image)))
        return image + correction


class ResidualBlock(nn.Module):
    """Two convolutions whose output is added to their input."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = _activated(features, features, nn.ReLU())
        self.second = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map features (N, F, H, W) to the same shape."""
        correction: Tensor = self.second(self.first(x))
        return x + correction


class Mobile(nn.Module):
    """Inverted residuals with ReLU6 and batch normalisation, after MobileNetV2 (Sandler et al.,
    2018).
    """

    def __init__(self, blocks: int = 3, features: int = 24) -> None:
        super().__init__()
        self.head = _batch_normed(1, features, nn.ReLU6())
        self.body = nn.Sequential(*(InvertedResidual(features) for _ in range(blocks)))
        self.tail = nn.Conv2d(features, 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Restore images (N, 1, H, W). The shape is preserved."""
        correction: Tensor = self.tail(self.body(self.head(image)))
        return image + correction


class InvertedResidual(nn.Module):
    """A 1 x 1 convolution to twice the channels, a depthwise one, and a 1 x 1 projection, added to
    the input.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.expand = _batch_normed(features, 2 * features, nn.ReLU6(), kernel=1)
        self.depthwise = _batch_normed(2 * features, 2 * features, nn.ReLU6(), groups=2 * features)
        self.project = nn.Conv2d(2 * features, features, 1, bias=False)
        self.norm = nn.BatchNorm2d(features)

    def forward(self, x: Tensor) -> Tensor:
        """Map features (N, F, H, W) to the same shape."""
        correction: Tensor = self.norm(self.project(self.depthwise(self.expand(x))))
        return x + correction


class Segment(nn.Module):
    """A segmentation network with two classes for each pixel: strides and a dilation down, bilinear
    and nearest upsampling, HardSwish.
    """

    def __init__(self, features: int = 16) -> None:
        super().__init__()
        self.shallow = _activated(1, features, nn.Hardswish(), stride=2)
        self.deep = _activated(features, 2 * features, nn.Hardswish(), stride=2)
        self.context = _activated(2 * features, 2 * features, nn.ReLU(), dilation=2)
        self.narrow = nn.Conv2d(2 * features, features, 1)
        self.merge = _activated(features, features, nn.ReLU())
        self.classes = nn.Conv2d(features, 2, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) of sides that are multiples of 4 to logits (N, 2, H, W)."""
        shallow = self.shallow(image)
        deep = self.narrow(self.context(self.deep(shallow)))
        merged = self.merge(
            shallow + functional.interpolate(deep, scale_factor=2.0, mode="bilinear")
        )
        return functional.interpolate(self.classes(merged), scale_factor=2.0, mode="nearest")


def _activated(
    inputs: int, outputs: int, activation: nn.Module, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    """Return a 3 x 3 convolution followed by an activation."""
    conv = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=dilation, dilation=dilation)
    return nn.Sequential(conv, activation)


def _batch_normed(
    inputs: int,
    outputs: int,
    activation: nn.Module,
    kernel: int = 3,
    stride: int = 1,
    groups: int = 1,
) -> nn.Sequential:
    """Return a convolution without bias, followed by batch normalisation and an activation."""
    conv = nn.Conv2d(
        inputs, outputs, kernel, stride=stride, padding=kernel // 2, groups=groups, bias=False
    )
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), activation)


def _twice(inputs: int, outputs: int) -> nn.Sequential:
    """Return two 3 x 3 convolutions, each followed by the LeakyReLU that the DPU supports."""
    first = _activated(inputs, outputs, nn.LeakyReLU(DPU_SLOPE))
    return nn.Sequential(first, _activated(outputs, outputs, nn.LeakyReLU(DPU_SLOPE)))


@dataclass(frozen=True)
class Example:
    """The facts about a network that are needed to use it.

    Attributes:
        module: creates it, with untrained weights.
        inputs: channels of its input.
        outputs: channels of its output.
        scale: output pixels a side for each input pixel.
        multiple_px: the sides of an input are multiples of this.
        restores: True if the output is the input image, restored or enlarged.
    """

    module: Callable[[], nn.Module]
    inputs: int = 1
    outputs: int = 1
    scale: int = 1
    multiple_px: int = 1
    restores: bool = True


NETWORKS = {
    "dncnn": Example(DnCNN),
    "ffdnet": Example(FFDNet, multiple_px=2),
    "espcn": Example(ESPCN, scale=2),
    "sesr": Example(SESR, scale=2),
    "unet": Example(UNet, multiple_px=4),
    "edsr4": Example(EDSR, inputs=4, outputs=4),
    "mobile": Example(Mobile),
    "segment": Example(Segment, outputs=2, multiple_px=4, restores=False),
}


def build(name: str, generator: torch.Generator) -> nn.Module:
    """Return the network of that name in evaluation mode, with weights drawn from `generator`."""
    network = NETWORKS[name].module()
    with torch.no_grad():
        for path, module in network.named_modules():
            if isinstance(module, nn.BatchNorm2d):
                _draw_statistics(module, generator)
            elif isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu", generator=generator)
                module.weight.mul_(0.1 if path.endswith(CORRECTIONS) else 1.0)
                if module.bias is not None:
                    module.bias.normal_(0.0, 0.02, generator=generator)
    return network.eval()


def _draw_statistics(norm: nn.BatchNorm2d, generator: torch.Generator) -> None:
    """Draw the statistics of batch normalisation as if it had seen images, far enough from the
    identity that an error in folding shows.
    """
    tensors = norm.state_dict()
    for positive in ("weight", "running_var"):
        tensors[positive].uniform_(0.5, 1.5, generator=generator)
    for signed in ("bias", "running_mean"):
        tensors[signed].normal_(0.0, 0.2, generator=generator)


def to_onnx(name: str, network: nn.Module, fold: bool = True, opset: int = 17) -> onnx.ModelProto:
    """Export a network as users do: `input` to `output`, with free batch, and free height and width
    if possible.

    `fold` is the exporter's default for a network in evaluation mode: batch normalisation is folded
    into the convolution before it. Otherwise it remains as nodes.
    """
    example = NETWORKS[name]
    axes = {0: "batch", 2: "height", 3: "width"}
    outer = {0: "batch", 2: "output_height", 3: "output_width"}
    mode = torch.onnx.TrainingMode.EVAL if fold else torch.onnx.TrainingMode.PRESERVE
    image = torch.zeros(1, example.inputs, 32, 32)
    file = io.BytesIO()
    axis_options = {
        "input_names": ["input"],
        "output_names": ["output"],
        "dynamic_axes": {"input": axes, "output": outer},
    }
    how: dict[str, Any] = {
        "opset_version": opset,
        "training": mode,
        "do_constant_folding": fold,
        **axis_options,
    }
    with warnings.catch_warnings():
        # The newer exporter requires onnxscript, another package; this one is what most of today's
        # files come from.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(network, (image,), file, dynamo=False, **how)  # type: ignore[arg-type]
    return onnx.load_model_from_string(file.getvalue())
