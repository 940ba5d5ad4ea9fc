"""The feature layers of SqueezeNet 1.1, AlexNet and VGG16, named as in torchvision.

Written here because torchvision does not import beside the CPU build of torch. The weights come from a user's file
(`backbone_files`): ImageNet weights are never shipped or fetched.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from profiles.errors import OptionError


@dataclass(frozen=True)
class BackboneSpec:
    """What is known of a backbone before any weights are there."""

    file_stem: str  # what torchvision calls it, and the start of its file's name
    taps: tuple[int, ...]  # which feature layers are compared
    min_side_px: int  # a smaller image leaves nothing for the last pooling


BACKBONES: Mapping[str, BackboneSpec] = {
    "squeeze": BackboneSpec("squeezenet1_1", (1, 4, 7, 9, 10, 11, 12), min_side_px=17),
    "alex": BackboneSpec("alexnet", (1, 4, 7, 9, 11), min_side_px=31),
    "vgg": BackboneSpec("vgg16", (3, 8, 15, 22, 29), min_side_px=16),
}


def backbone_spec(network: str) -> BackboneSpec:
    """The spec of "squeeze", "alex" or "vgg".

    Raises:
        OptionError: no such network.
    """
    if network not in BACKBONES:
        expected = f"one of {', '.join(BACKBONES)}"
        raise OptionError("perceptual network", expected=expected, got=repr(network), remedy="choose one of them")
    return BACKBONES[network]


class Fire(nn.Module):
    """SqueezeNet's block: a narrow 1x1 convolution, then 1x1 and 3x3 ones side by side."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, 2 expanded, H, W)."""
        x = functional.relu(self.squeeze(x))
        return functional.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1))


class L2Pool(nn.Module):
    """DISTS's pooling: root of the Hanning-weighted mean of squares, stride 2 (Hénaff and Simoncelli 2016)."""

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) to (N, C, ceil(H / 2), ceil(W / 2))."""
        taps = x.new_tensor([0.25, 0.5, 0.25])
        kernel = (taps[:, None] * taps[None, :]).expand(x.shape[1], 1, 3, 3)
        energy = functional.conv2d(x * x, kernel, stride=2, padding=1, groups=x.shape[1])
        return (energy + 1e-12).sqrt()


class Backbone(nn.Module):
    """The feature layers of one network, with random weights until some are loaded.

    Args:
        network: "squeeze", "alex" or "vgg".
        l2_pool: DISTS's pooling in the place of the max pooling.

    Raises:
        OptionError: no such network.
    """

    def __init__(self, network: str, *, l2_pool: bool = False) -> None:
        super().__init__()
        self.network, self.spec = network, backbone_spec(network)
        layers = {"squeeze": _squeezenet, "alex": _alexnet, "vgg": _vgg16}[network]()
        if l2_pool:
            layers = [L2Pool() if isinstance(layer, nn.MaxPool2d) else layer for layer in layers]
        self.features = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> list[Tensor]:
        """The compared feature maps of (N, 3, H, W), all of them after a ReLU."""
        found: list[Tensor] = []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in self.spec.taps:
                found.append(x)
        return found


def _squeezenet() -> list[nn.Module]:
    def pool() -> nn.Module:
        return nn.MaxPool2d(3, stride=2, ceil_mode=True)

    return [
        *(nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), pool()),
        *(Fire(64, 16, 64), Fire(128, 16, 64), pool()),
        *(Fire(128, 32, 128), Fire(256, 32, 128), pool()),
        *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
    ]


def _alexnet() -> list[nn.Module]:
    return [
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, stride=2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, stride=2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    ]


def _vgg16() -> list[nn.Module]:
    layers: list[nn.Module] = []
    channels = 3
    for width, convolutions in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        if layers:
            layers.append(nn.MaxPool2d(2, stride=2))
        for _ in range(convolutions):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
    return layers
