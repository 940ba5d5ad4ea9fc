"""Compute LPIPS and DISTS, differentiable, over a backbone that the user provides: SqueezeNet 1.1
or VGG16.

Both follow the arithmetic of their authors' packages, `lpips` 0.1.4 with the v0.1 weights and
`DISTS-pytorch` 0.1. Their published channel weights are stored in `weights/`. The paper that this
project reproduces does not state which LPIPS it used, so no figure from here can be compared with
its own.

The feature layers of the backbones have torchvision's names. They are defined here because
torchvision cannot be imported together with the CPU build of torch. Their weights come from a
user's file (`find_backbone`): ImageNet weights are never shipped or downloaded.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.lib.npyio import NpzFile
from safetensors import safe_open
from torch import Tensor, nn
from torch.nn import functional

from beers_deploy.profiles.errors import ImageError, ModelError, reason_of
from beers_deploy.profiles.user_files.whole import unreadable


@dataclass(frozen=True)
class BackboneSpec:
    """The architecture of a backbone, the image network whose features LPIPS and DISTS compare.

    Attributes:
        file_stem: torchvision's name of the network, with which the name of its weights file
            begins.
        taps: the indices of the feature layers that are compared.
        min_side_px: the smallest side of an image; a smaller one leaves nothing for the last
            pooling.
    """

    file_stem: str
    taps: tuple[int, ...]
    min_side_px: int


BACKBONES: Mapping[str, BackboneSpec] = {
    "squeeze": BackboneSpec("squeezenet1_1", (1, 4, 7, 9, 10, 11, 12), min_side_px=17),
    "vgg": BackboneSpec("vgg16", (3, 8, 15, 22, 29), min_side_px=16),
}
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class Fire(nn.Module):
    """A block of SqueezeNet: a narrow 1x1 convolution, then 1x1 and 3x3 convolutions side by side.

    Its arguments are the channels of the input, of the first and of each of the other convolutions.
    """

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Compute the block's output: (N, inputs, H, W) to (N, 2 expanded, H, W)."""
        x = functional.relu(self.squeeze(x))
        return functional.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1))


class L2Pool(nn.Module):
    """DISTS's pooling: root of the Hanning-weighted mean of squares, stride 2 (Hénaff and
    Simoncelli 2016).
    """

    def forward(self, x: Tensor) -> Tensor:
        """Pool each channel by 2: (N, C, H, W) to (N, C, ceil(H / 2), ceil(W / 2))."""
        taps = x.new_tensor([0.25, 0.5, 0.25])
        kernel = (taps[:, None] * taps[None, :]).expand(x.shape[1], 1, 3, 3)
        energy = functional.conv2d(x * x, kernel, stride=2, padding=1, groups=x.shape[1])
        return (energy + 1e-12).sqrt()


class Backbone(nn.Module):
    """The feature layers of a network that LPIPS or DISTS uses, with random weights until weights
    are loaded.

    `network` is "squeeze" (SqueezeNet 1.1) or "vgg" (VGG16). `l2_pool` replaces max pooling by
    DISTS's pooling.
    """

    def __init__(self, network: str, *, l2_pool: bool = False) -> None:
        super().__init__()
        self.network = network
        self.spec = BACKBONES[network]
        layers = {"squeeze": _squeezenet, "vgg": _vgg16}[network]()
        if l2_pool:
            layers = [L2Pool() if isinstance(layer, nn.MaxPool2d) else layer for layer in layers]
        self.features = nn.Sequential(*layers)

    def forward(self, image: Tensor) -> list[Tensor]:
        """Compute the feature maps that LPIPS and DISTS compare.

        Each map is taken after a ReLU. The scaling layer of `lpips` equals ImageNet's mean and
        deviation after scaling to [-1, 1].

        Args:
            image: grey images (N, 1, H, W) from 0 to 1. They are converted to the data type of the
                parameters.

        Returns:
            The image repeated in three channels (N, 3, H, W), then the feature maps (N, C, h, w),
            from the first tapped layer to the last. Without autocast they have the data type of the
            parameters.
        """
        colour = image.to(next(self.parameters()).dtype).expand(-1, 3, -1, -1)
        mean, std = (colour.new_tensor(x)[:, None, None] for x in (IMAGENET_MEAN, IMAGENET_STD))
        x = (colour - mean) / std
        maps = [colour]
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in self.spec.taps:
                maps.append(x)
        return maps


def _squeezenet() -> list[nn.Module]:
    def pool() -> nn.Module:
        return nn.MaxPool2d(3, stride=2, ceil_mode=True)

    return [
        *(nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), pool()),
        *(Fire(64, 16, 64), Fire(128, 16, 64), pool()),
        *(Fire(128, 32, 128), Fire(256, 32, 128), pool()),
        *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
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


WEIGHTS_VARIABLE = "BEERS_LPIPS_WEIGHTS"
SUFFIXES = (".safetensors", ".npz")
CONVERT = (
    "If you trust it, convert it: safetensors.torch.save_file(torch.load(FILE, "
    "weights_only=True), 'NAME.safetensors')."
)
NAMED = "Give the feature layers named as in torchvision (features.0.weight ...)."


def find_backbone(network: str, place: Path | None = None) -> Path | None:
    """Find the weights file of "squeeze" or "vgg" (for DISTS), or return None.

    If it is None, `not_found(network)` is the reason to show. A file given as `place` is returned
    unchecked. Without `place`, which may also be a folder to search, the environment variable
    BEERS_LPIPS_WEIGHTS names the file or folder. A file that it names is used only for the network
    with whose file stem its name begins.
    """
    stem = BACKBONES[network].file_stem
    if place is not None and not place.is_dir():
        return place
    location = place or os.environ.get(WEIGHTS_VARIABLE)
    if not location:
        return None
    files = [Path(location)] if Path(location).is_file() else sorted(Path(location).glob("*"))
    return next(
        (file for file in files if file.name.startswith(stem) and file.suffix in SUFFIXES), None
    )


def not_found(network: str) -> str:
    """Return a sentence that says which weights file of "squeeze" or "vgg" is missing, after
    `find_backbone` returned None.
    """
    names = " or ".join(f"{BACKBONES[network].file_stem}*{suffix}" for suffix in SUFFIXES)
    return f"weights not found: no {names}; set {WEIGHTS_VARIABLE} to the file or its folder"


def load_backbone(network: str, path: Path, *, l2_pool: bool = False) -> Backbone:
    """Load a `Backbone` with its parameters from a file, by name; other tensors in it are ignored.

    Args:
        network: "squeeze" or "vgg".
        path: the weights file, .safetensors or .npz.
        l2_pool: True to use DISTS's pooling.

    Raises:
        ModelError: the file cannot be read, or lacks a finite tensor of the right shape.
    """
    backbone = Backbone(network, l2_pool=l2_pool)
    parameters = backbone.state_dict()
    tensors = read_tensors(path, parameters)
    for name, tensor in tensors.items():
        if tensor.shape != parameters[name].shape:
            raise ModelError(
                f"{path} must have {name} of the shape {tuple(parameters[name].shape)}, got "
                f"{tuple(tensor.shape)}. {NAMED}"
            )
        if not bool(torch.isfinite(tensor).all()):
            raise ModelError(f"{path} has NaN or infinity in {name}. {NAMED}")
    backbone.load_state_dict(tensors)
    return backbone


def read_tensors(path: Path, names: Iterable[str]) -> dict[str, Tensor]:
    """Read the tensors in `names` from a .safetensors or .npz file as float32, by name.

    Raises:
        ModelError: the file cannot be read, lacks a tensor, or holds no floating-point numbers.
    """
    reason = unreadable(path)
    if reason is not None:
        raise ModelError(f"The weights file {path} cannot be read: {reason}. Check the path.")
    if path.suffix not in SUFFIXES:
        raise ModelError(
            f"{path} must be a .safetensors or .npz file; '{path.suffix}' is not read. {CONVERT}"
        )
    try:
        tensors = _read(path, names)
        for tensor in tensors.values():
            if not tensor.is_floating_point():
                raise TypeError(f"an array of {tensor.dtype}")
    # The bytes of a damaged archive may lead to anything.
    except Exception as error:
        reason = reason_of(error)
        raise ModelError(
            f"{path} must contain arrays of floating-point numbers, none pickled, but reading it "
            f"failed: {reason}. {CONVERT}"
        ) from error
    for name in names:
        if name not in tensors:
            raise ModelError(f"{path} has no tensor named {name}. {NAMED}")
    return {name: tensor.float() for name, tensor in tensors.items()}


def _read(path: Path, names: Iterable[str]) -> dict[str, Tensor]:
    """Read the tensors in `names` that exist in the file."""
    if path.suffix == ".npz":
        # np.load leaves a file open that turns out to be broken.
        with path.open("rb") as raw:
            file = np.load(raw, allow_pickle=False)
            if not isinstance(file, NpzFile):
                raise TypeError("a single array")
            return {name: torch.from_numpy(file[name]) for name in names if name in file}
    with safe_open(path, framework="pt") as file:
        keys = set(file.keys())
        # Copies, because the library's own lie in the file.
        return {name: file.get_tensor(name).clone() for name in names if name in keys}


PUBLISHED = Path(__file__).parent / "weights"
MIN_NORM = 1e-3
SMALL = 1e-6
"""The constant c of DISTS, which keeps its quotients finite."""


class Lpips(nn.Module):
    """Learned perceptual image patch similarity (Zhang et al. 2018, v0.1): 0 for identical images,
    no upper bound.

    Name it with its network, "LPIPS-squeeze" (`label`), because figures of different networks
    cannot be compared. Its argument `heads` has the weights of the channels of each compared layer,
    (C,) each; its attribute `heads` joins them.
    """

    heads: Tensor

    def __init__(self, backbone: Backbone, heads: Sequence[Tensor]) -> None:
        super().__init__()
        self.backbone = backbone
        self.label = f"LPIPS-{backbone.network}"
        self.register_buffer("heads", torch.cat(list(heads)))
        self.requires_grad_(False).eval()

    @classmethod
    def load(cls, network: str, path: Path) -> Self:
        """Load the metric with its published heads, over the backbone "squeeze" or "vgg" whose
        weights are in the file `path` (see `find_backbone`).
        """
        backbone = load_backbone(network, path)
        names = [f"lin{layer}" for layer in range(len(backbone.spec.taps))]
        heads = read_tensors(PUBLISHED / f"lpips-{network}.safetensors", names)
        return cls(backbone, [heads[name] for name in names])

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """Compute the distance (N,) of each pair of grey images (N, 1, H, W), from 0 to 1 of full
        scale.

        Its gradient is finite everywhere. Images of other shapes, or too small, raise ImageError.
        """
        _check_pair(self, image, reference)
        with torch.autocast(image.device.type, enabled=False):
            pairs = zip(self.backbone(image)[1:], self.backbone(reference)[1:], strict=True)
            errors = [(_unit(a) - _unit(b)).square().mean(dim=(2, 3)) for a, b in pairs]
            return torch.cat(errors, dim=1) @ self.heads


class Dists(nn.Module):
    """Deep image structure and texture similarity (Ding et al. 2020): 0 for identical images, at
    most 1.

    It uses VGG16 with L2 pooling. `alpha` (1475,) weights the mean (texture) of the image and of
    each of its channels, `beta` (1475,) their covariance (structure).
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
        """Load the metric with its published weights, over the VGG16 whose weights are in the file
        `path` (`find_backbone("vgg")`).
        """
        backbone = load_backbone("vgg", path, l2_pool=True)
        weights = read_tensors(PUBLISHED / "dists.safetensors", ["alpha", "beta"])
        return cls(backbone, weights["alpha"], weights["beta"])

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """Compute the distance (N,) of each pair of grey images (N, 1, H, W), from 0 to 1 of full
        scale.

        Its gradient is finite everywhere. Images of other shapes, or too small, raise ImageError.
        """
        _check_pair(self, image, reference)
        with torch.autocast(image.device.type, enabled=False):
            stages = zip(self.backbone(image), self.backbone(reference), strict=True)
            textures = []
            structures = []
            # 1 minus the similarity of the means, and of the covariances, of each channel. Both are
            # computed from differences and not as 1 - (2 x y + c) / (x^2 + y^2 + c), so that
            # identical images give exactly 0.
            for a, b in stages:
                mean_a = a.mean(dim=(2, 3), keepdim=True)
                mean_b = b.mean(dim=(2, 3), keepdim=True)
                a = a - mean_a
                b = b - mean_b
                squares = mean_a.square() + mean_b.square()
                textures.append(((mean_a - mean_b).square() / (squares + SMALL)).flatten(1))
                variances = a.square().mean(dim=(2, 3)) + b.square().mean(dim=(2, 3))
                structures.append((a - b).square().mean(dim=(2, 3)) / (variances + SMALL))
            return (
                torch.cat(textures, dim=1) @ self.alpha + torch.cat(structures, dim=1) @ self.beta
            )


def _unit(features: Tensor) -> Tensor:
    """Normalise the features of each pixel to length 1.

    The package divides by sqrt(sum) + 1e-10. The gradient of that is NaN where all features are
    zero, and unbounded near it. A lower limit of the sum gives the same values and a gradient of at
    most 1 / MIN_NORM.
    """
    return features / features.square().sum(dim=1, keepdim=True).clamp(min=MIN_NORM**2).sqrt()


def _check_pair(metric: Lpips | Dists, image: Tensor, reference: Tensor) -> None:
    smallest = metric.backbone.spec.min_side_px
    grey = image.ndim == 4 and image.shape[1] == 1 and image.shape == reference.shape
    if not grey or min(image.shape[2:]) < smallest:
        raise ImageError(
            f"{metric.label} needs two grey images (N, 1, H, W) of one shape and at least "
            f"{smallest} pixels a side, got {tuple(image.shape)} and {tuple(reference.shape)}."
        )
