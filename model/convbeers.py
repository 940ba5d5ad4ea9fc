"""ConvBEERS: a residual network without batch normalisation that undoes blur and noise (paper, section 3.1).

    image -> head -> [conv, ReLU, conv, +] x blocks -> body end, + head -> tail -> correction, + image

A variant of scale S rearranges the image in front of its head, S x S pixels into channels, and the correction back
behind its tail (pixel unshuffle and shuffle; Shi et al., CVPR 2016). The host does both; what lies between runs at
1 / S of the resolution.

Every convolution is 3 x 3 with stride 1 and zero padding 1. 16 blocks of 64 features make 1.2 M parameters.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from model.variants import Variant


def conv3x3(inputs: int, outputs: int) -> nn.Conv2d:
    """A 3 x 3 convolution, stride 1, padding 1: (N, inputs, H, W) to (N, outputs, H, W)."""
    return nn.Conv2d(inputs, outputs, kernel_size=3, padding=1)


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(x))), (N, F, H, W) to the same shape."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = conv3x3(features, features)
        self.second = conv3x3(features, features)

    def forward(self, x: Tensor) -> Tensor:
        """Add the block's correction to x (N, F, H, W); the shape is kept."""
        correction: Tensor = self.second(torch.relu(self.first(x)))
        return x + correction


class ConvBEERS(nn.Module):
    """The network: (N, 1, H, W) in [0, 1] of full scale to the same, not clipped; H and W multiples of its scale."""

    def __init__(self, variant: Variant) -> None:
        super().__init__()
        self.variant = variant
        self.head = conv3x3(variant.pixels, variant.features)
        self.body = nn.Sequential(*(ResidualBlock(variant.features) for _ in range(variant.blocks)))
        self.body_end = conv3x3(variant.features, variant.features)
        self.tail = conv3x3(variant.features, variant.pixels)

    def forward(self, image: Tensor) -> Tensor:
        """Image plus correction, (N, 1, H, W)."""
        shallow = self.entered(image)
        return image + self.left(shallow + self.body_end(self.body(shallow)))

    def entered(self, image: Tensor) -> Tensor:
        """Image (N, 1, H, W) through the head: (N, F, H / S, W / S)."""
        shallow: Tensor = self.head(pixel_unshuffle(image, self.variant.scale))
        return shallow

    def left(self, deep: Tensor) -> Tensor:
        """Maps (N, F, H / S, W / S) through the tail: the correction (N, 1, H, W)."""
        return pixel_shuffle(self.tail(deep), self.variant.scale)


def initialise(network: ConvBEERS, generator: torch.Generator) -> None:
    """Start as (nearly) the identity: He-normal weights, residual branches and correction scaled down.

    Without batch normalisation the stream's variance would otherwise double at each block. The tail is scaled down
    once more where it writes several pixels: what is an offset of one channel is a pattern of several.
    """
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d):
            fan_in = module.in_channels * 9
            scale = 0.1 if name.endswith(("second", "body_end", "tail")) else 1.0
            scale /= network.variant.scale if name == "tail" else 1
            with torch.no_grad():
                module.weight.normal_(0.0, scale * (2 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()


def plain_network(weights: Mapping[str, np.ndarray], variant: Variant) -> ConvBEERS:
    """A network with those weights, by name and of any shape each, in evaluation mode, on the CPU."""
    network = ConvBEERS(variant)
    network.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})
    return network.eval()
