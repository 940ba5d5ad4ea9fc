"""LPIPS, differentiable, over SqueezeNet 1.1, which the user brings.

It follows the arithmetic of its authors' package, `lpips` 0.1.4 with the v0.1 weights, whose channel weights lie in
`weights/`. The paper this project reproduces does not say which LPIPS it used, so no figure from here compares
with its own.

The feature layers are named as in torchvision, and written here because that does not import beside the CPU build of
torch. Their weights come from a user's file (`find_backbone`): ImageNet weights are never shipped or fetched.
"""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.lib.npyio import NpzFile
from safetensors import safe_open
from torch import Tensor, nn
from torch.nn import functional

from beers_deploy.profiles.errors import ImageError, ModelError
from beers_deploy.profiles.toml import unreadable

LABEL = "LPIPS-squeeze"
FILE_STEM = "squeezenet1_1"
"""What torchvision calls it, and the start of its file's name."""
TAPS = 1, 4, 7, 9, 10, 11, 12
"""The feature layers that are compared."""
MIN_SIDE_PX = 17
"""A smaller image leaves nothing for the last pooling."""


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


class Backbone(nn.Module):
    """The feature layers of SqueezeNet 1.1, with random weights until some are loaded."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            *(nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), _pool()),
            *(Fire(64, 16, 64), Fire(128, 16, 64), _pool()),
            *(Fire(128, 32, 128), Fire(256, 32, 128), _pool()),
            *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """The compared feature maps of (N, 3, H, W), all of them after a ReLU."""
        found: list[Tensor] = []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in TAPS:
                found.append(x)
        return found


def _pool() -> nn.Module:
    return nn.MaxPool2d(3, stride=2, ceil_mode=True)


WEIGHTS_VARIABLE = "BEERS_LPIPS_WEIGHTS"
SUFFIXES = (".safetensors", ".npz")
CONVERT = (
    "convert it where you trust it: safetensors.torch.save_file(torch.load(FILE, weights_only=True), "
    "'NAME.safetensors')"
)
NAMED = "give the feature layers named as in torchvision (features.0.weight ...)"


def find_backbone(place: Path | None = None) -> Path | None:
    """The weights file of SqueezeNet, or None: then NOT_FOUND is the reason to show.

    Args:
        place: a file, which is taken at its word, or a folder. Without it the environment variable
            BEERS_LPIPS_WEIGHTS is asked; it may name a file or a folder, and a file counts only if its name begins
            with the network's.
    """
    if place is not None and not place.is_dir():
        return place
    named = place or os.environ.get(WEIGHTS_VARIABLE)
    if not named:
        return None
    files = [Path(named)] if Path(named).is_file() else sorted(Path(named).glob("*"))
    return next((file for file in files if file.name.startswith(FILE_STEM) and file.suffix in SUFFIXES), None)


NOT_FOUND = (
    f"weights not found: no {' or '.join(f'{FILE_STEM}*{suffix}' for suffix in SUFFIXES)}; "
    f"set {WEIGHTS_VARIABLE} to the file or its folder"
)


def load_backbone(path: Path) -> Backbone:
    """A backbone with its parameters from a .safetensors or .npz file; whatever else that holds is left aside."""
    backbone = Backbone()
    wanted = backbone.state_dict()
    tensors = read_tensors(path, wanted)
    for name, tensor in tensors.items():
        if tensor.shape != wanted[name].shape:
            raise _error(path, f"{name} of shape {tuple(wanted[name].shape)}", f"{tuple(tensor.shape)}", NAMED)
        if not bool(torch.isfinite(tensor).all()):
            raise _error(path, f"finite values in {name}", "NaN or infinity", NAMED)
    backbone.load_state_dict(tensors)
    return backbone


def read_tensors(path: Path, names: Iterable[str]) -> dict[str, Tensor]:
    """The named tensors, of any shape, of a .safetensors or .npz file, as float32."""
    if path.suffix not in SUFFIXES:
        raise _error(path, "a .safetensors or .npz file", f"'{path.suffix}', which is not read", CONVERT)
    got = unreadable(path)
    if got is not None:
        raise _error(path, "a weights file", got, "check the path")
    try:
        found = _read(path, names)
        for tensor in found.values():
            if not tensor.is_floating_point():
                raise TypeError(f"an array of {tensor.dtype}")
    except Exception as error:  # whatever the bytes of a damaged archive lead to
        got = " ".join(str(error).split())[:120]
        raise _error(path, "arrays of floating-point numbers, none pickled", got, CONVERT) from error
    for name in names:
        if name not in found:
            raise _error(path, f"a tensor named {name}", "none of that name", NAMED)
    return {name: tensor.float() for name, tensor in found.items()}


def _read(path: Path, names: Iterable[str]) -> dict[str, Tensor]:
    """Those of the named tensors that a file holds."""
    if path.suffix == ".npz":
        with path.open("rb") as raw:  # np.load leaves a file open that turns out to be broken
            file = np.load(raw, allow_pickle=False)
            if not isinstance(file, NpzFile):
                raise TypeError("a single array")
            return {name: torch.from_numpy(file[name]) for name in names if name in file}
    with safe_open(path, framework="pt") as file:
        held = set(file.keys())
        return {
            name: file.get_tensor(name).clone() for name in names if name in held
        }  # the library's lie in the file


def _error(path: Path, expected: str, got: str, remedy: str) -> ModelError:
    return ModelError(str(path), expected=expected, got=got, remedy=remedy)


PUBLISHED = Path(__file__).parent / "weights"
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MIN_NORM = 1e-3


class Lpips(nn.Module):
    """Learned perceptual image patch similarity (Zhang et al. 2018, v0.1): 0 for identical images, no upper bound.

    Args:
        backbone: whose features are compared.
        heads: for each compared layer (C,), how much each channel counts.
    """

    heads: Tensor

    def __init__(self, backbone: Backbone, heads: Sequence[Tensor]) -> None:
        super().__init__()
        self.backbone = backbone
        self.register_buffer("heads", torch.cat(list(heads)))
        self.requires_grad_(False).eval()

    @classmethod
    def load(cls, path: Path) -> Self:
        """The metric with its published heads, over the backbone in a file (see `find_backbone`)."""
        names = [f"lin{layer}" for layer in range(len(TAPS))]
        heads = read_tensors(PUBLISHED / "lpips-squeeze.safetensors", names)
        return cls(load_backbone(path), [heads[name] for name in names])

    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        """The distance of each pair, (N,); its gradient is finite everywhere.

        Args:
            image: (N, 1, H, W), 0 to 1 of full scale; at least 17 px a side.
            reference: the same shape.
        """
        _check_pair(image, reference)
        with torch.autocast(image.device.type, enabled=False):
            pairs = zip(self._features(image), self._features(reference), strict=True)
            errors = [(_unit(a) - _unit(b)).square().mean(dim=(2, 3)) for a, b in pairs]
            return torch.cat(errors, dim=1) @ self.heads

    def _features(self, image: Tensor) -> list[Tensor]:
        """Of a grey image, as three equal channels in the backbone's own precision, whatever the caller's autocast.

        The scaling layer of `lpips` is ImageNet's figures after [-1, 1].
        """
        colour = image.to(next(self.backbone.parameters()).dtype).expand(-1, 3, -1, -1)
        mean, std = (colour.new_tensor(x)[:, None, None] for x in (IMAGENET_MEAN, IMAGENET_STD))
        features: list[Tensor] = self.backbone((colour - mean) / std)
        return features


def _unit(features: Tensor) -> Tensor:
    """Each pixel's features at length 1.

    The package divides by sqrt(sum) + 1e-10, whose gradient is NaN where all features are zero and unbounded near it.
    With a floor under the sum the value is the same and the gradient at most 1 / MIN_NORM.
    """
    return features / features.square().sum(dim=1, keepdim=True).clamp(min=MIN_NORM**2).sqrt()


def _check_pair(image: Tensor, reference: Tensor) -> None:
    grey = image.ndim == 4 and image.shape[1] == 1 and image.shape == reference.shape
    if not grey or min(image.shape[2:]) < MIN_SIDE_PX:
        expected = f"two images (N, 1, H, W) of at least {MIN_SIDE_PX} pixels a side"
        got = f"{tuple(image.shape)} and {tuple(reference.shape)}"
        raise ImageError(LABEL, expected=expected, got=got, remedy="give larger images, grey and of one shape")
