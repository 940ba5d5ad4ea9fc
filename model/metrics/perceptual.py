"""LPIPS and DISTS, differentiable, over a backbone that the user brings.

Both follow the arithmetic of their authors' packages, `lpips` 0.1.4 with the v0.1 weights and `DISTS-pytorch` 0.1,
whose published channel weights lie in `weights/`. The paper this project reproduces does not say which LPIPS it used,
so no figure from here compares with its own.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import torch
from torch import Tensor, nn

from beers_deploy.model.metrics.backbones import Backbone, load_backbone, read_tensors
from beers_deploy.profiles.errors import ImageError

PUBLISHED = Path(__file__).parent / "weights"
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MIN_NORM = 1e-3


class Lpips(nn.Module):
    """Learned perceptual image patch similarity (Zhang et al. 2018, v0.1): 0 for identical images, no upper bound.

    Name it with its network, "LPIPS-squeeze" (`label`): the networks' figures do not compare with each other.

    Args:
        backbone: the network whose features are compared.
        heads: for each compared layer (C,), how much each channel counts.
    """

    heads: Tensor

    def __init__(self, backbone: Backbone, heads: Sequence[Tensor]) -> None:
        super().__init__()
        self.backbone, self.label = backbone, f"LPIPS-{backbone.network}"
        self.register_buffer("heads", torch.cat(list(heads)))
        self.requires_grad_(False).eval()

    @classmethod
    def load(cls, network: str, path: Path) -> Self:
        """The metric with its published heads, over the backbone in a file (see `find_backbone`).

        Args:
            network: "squeeze", "alex" or "vgg".
            path: .safetensors or .npz, parameters named as in torchvision.
        """
        backbone = load_backbone(network, path)
        names = [f"lin{layer}" for layer in range(len(backbone.spec.taps))]
        heads = read_tensors(PUBLISHED / f"lpips-{network}.safetensors", names)
        return cls(backbone, [heads[name] for name in names])

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """The distance of each pair, (N,); its gradient is finite everywhere.

        Args:
            image: (N, 1, H, W), 0 to 1 of full scale; at least 17 px a side for squeeze, 31 for alex, 16 for vgg.
            reference: the same shape.
        """
        _check_pair(self.label, self.backbone, image, reference)
        with torch.autocast(image.device.type, enabled=False):
            pairs = zip(_features(self.backbone, image), _features(self.backbone, reference), strict=True)
            errors = [(_unit(a) - _unit(b)).square().mean(dim=(2, 3)) for a, b in pairs]
            return torch.cat(errors, dim=1) @ self.heads


class Dists(nn.Module):
    """Deep image structure and texture similarity (Ding et al. 2020) over VGG16: 0 for identical images, at most 1.

    Args:
        backbone: VGG16 with L2 pooling.
        alpha: (1475,), how much the mean (texture) of the image and of each of its channels counts.
        beta: (1475,), how much their covariance (structure) counts.
    """

    label = "DISTS"
    alpha: Tensor
    beta: Tensor

    def __init__(self, backbone: Backbone, alpha: Tensor, beta: Tensor) -> None:
        super().__init__()
        self.backbone = backbone
        total = alpha.sum() + beta.sum()
        self.register_buffer("alpha", alpha / total)
        self.register_buffer("beta", beta / total)
        self.requires_grad_(False).eval()

    @classmethod
    def load(cls, path: Path) -> Self:
        """The metric with its published weights, over the VGG16 in a file (`find_backbone("vgg")`)."""
        backbone = load_backbone("vgg", path, l2_pool=True)
        weights = read_tensors(PUBLISHED / "dists.safetensors", ["alpha", "beta"])
        return cls(backbone, weights["alpha"], weights["beta"])

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """The distance of each pair, (N,); its gradient is finite everywhere.

        Args:
            image: (N, 1, H, W), 0 to 1 of full scale, at least 16 px a side.
            reference: the same shape.
        """
        _check_pair(self.label, self.backbone, image, reference)
        with torch.autocast(image.device.type, enabled=False):
            stages = zip(self._stages(image), self._stages(reference), strict=True)
            apart = [_texture_and_structure(a, b) for a, b in stages]
            texture, structure = (torch.cat(parts, dim=1) for parts in zip(*apart, strict=True))
            return texture @ self.alpha + structure @ self.beta

    def _stages(self, image: Tensor) -> list[Tensor]:
        return [_as_colour(self.backbone, image), *_features(self.backbone, image)]


def _unit(features: Tensor) -> Tensor:
    """Each pixel's features at length 1.

    The package divides by sqrt(sum) + 1e-10, whose gradient is NaN where all features are zero and unbounded near it.
    With a floor under the sum the value is the same and the gradient at most 1 / MIN_NORM.
    """
    return features / features.square().sum(dim=1, keepdim=True).clamp(min=MIN_NORM**2).sqrt()


def _texture_and_structure(a: Tensor, b: Tensor, small: float = 1e-6) -> tuple[Tensor, Tensor]:
    """1 minus the similarity of the means, and of the covariances, of each channel: two (N, C).

    Written as differences, not as 1 - (2 x y + c) / (x^2 + y^2 + c): identical images then give 0 to the last digit.
    """
    mean_a, mean_b = a.mean(dim=(2, 3), keepdim=True), b.mean(dim=(2, 3), keepdim=True)
    a, b = a - mean_a, b - mean_b
    texture = (mean_a - mean_b).square() / (mean_a.square() + mean_b.square() + small)
    variances = a.square().mean(dim=(2, 3)) + b.square().mean(dim=(2, 3))
    return texture.flatten(1), (a - b).square().mean(dim=(2, 3)) / (variances + small)


def _as_colour(backbone: Backbone, image: Tensor) -> Tensor:
    """Grey as three equal channels, in the backbone's own precision: float32, whatever the caller's autocast."""
    return image.to(next(backbone.parameters()).dtype).expand(-1, 3, -1, -1)


def _features(backbone: Backbone, image: Tensor) -> list[Tensor]:
    """The compared features of a grey image; the scaling layer of `lpips` is ImageNet's figures after [-1, 1]."""
    colour = _as_colour(backbone, image)
    mean, std = (colour.new_tensor(x)[:, None, None] for x in (IMAGENET_MEAN, IMAGENET_STD))
    features: list[Tensor] = backbone((colour - mean) / std)
    return features


def _check_pair(label: str, backbone: Backbone, image: Tensor, reference: Tensor) -> None:
    smallest = backbone.spec.min_side_px
    grey = image.ndim == 4 and image.shape[1] == 1 and image.shape == reference.shape
    if not grey or min(image.shape[2:]) < smallest:
        expected = f"two images (N, 1, H, W) of at least {smallest} pixels a side"
        got = f"{tuple(image.shape)} and {tuple(reference.shape)}"
        raise ImageError(label, expected=expected, got=got, remedy="give larger images, grey and of one shape")
