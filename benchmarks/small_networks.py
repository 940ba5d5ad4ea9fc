"""Thirteen small networks, trained briefly, which `benchmarks.int8_peers` and `benchmarks.ablation`
quantise.

`examples.samples` defines the task that each one learns.
"""

import argparse
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from beers_deploy.quant.session import open_session, result_of
from examples.networks import DPU_SLOPE, ESPCN, DnCNN
from examples.samples import batches_of

SIDE_PX = 64
SEPARABLE = 32
DENSE = 16
"""The number of features of networks with depthwise convolutions (SEPARABLE) and of those without
(DENSE)."""
BATCH = 4
RATE = 2e-3
FAST = 5e-3
"""Samples per step (BATCH), and the learning rates of most networks (RATE) and of those without a
global add (FAST)."""


def conv(
    inputs: int, outputs: int, act: nn.Module, kernel: int = 3, dilation: int = 1, groups: int = 1
) -> nn.Module:
    """Return a convolution that preserves the size, followed by an activation."""
    padding = dilation * (kernel // 2)
    inner = nn.Conv2d(inputs, outputs, kernel, padding=padding, dilation=dilation, groups=groups)
    return nn.Sequential(inner, act)


def depthwise(act: nn.Module, dilation: int = 1) -> nn.Module:
    """Return a network with a depthwise and a 1 x 1 convolution, without a global add."""
    separable = (
        conv(SEPARABLE, SEPARABLE, act, dilation=dilation, groups=SEPARABLE),
        conv(SEPARABLE, SEPARABLE, act, 1),
    )
    return nn.Sequential(conv(1, SEPARABLE, act), *separable, nn.Conv2d(SEPARABLE, 1, 3, padding=1))


def plain(layers: int, dilation: int = 1) -> nn.Module:
    """Return a stack of convolutions with ReLU, without a global add."""
    middle = [conv(DENSE, DENSE, nn.ReLU(), dilation=dilation) for _ in range(layers - 2)]
    return nn.Sequential(conv(1, DENSE, nn.ReLU()), *middle, nn.Conv2d(DENSE, 1, 3, padding=1))


class Added(nn.Module):
    """A module that adds the output of its layers to their input."""

    def __init__(self, *inner: nn.Module) -> None:
        super().__init__()
        self.inner = nn.Sequential(*inner)

    def forward(self, x: Tensor) -> Tensor:
        """Return the sum, of the shape of `x`."""
        output: Tensor = self.inner(x)
        return x + output


def inverted(inputs: int, outputs: int) -> nn.Module:
    """Return MobileNetV2's block: a 1 x 1 convolution to twice the channels, a depthwise one, and a
    1 x 1 projection without an activation.
    """
    wide = 2 * inputs
    block = [
        conv(inputs, wide, nn.ReLU6(), kernel=1),
        conv(wide, wide, nn.ReLU6(), groups=wide),
        conv(wide, outputs, nn.Identity(), kernel=1),
    ]
    return Added(*block) if inputs == outputs else nn.Sequential(*block)


class MobileUNet(nn.Module):
    """A U-Net with two levels of inverted residuals: max pooling, upsampling, a concatenated skip
    connection and a global add.
    """

    def __init__(self, features: int = 8) -> None:
        super().__init__()
        self.head = conv(1, features, nn.ReLU6())
        self.fine = inverted(features, features)
        self.down = inverted(features, 2 * features)
        self.deep = nn.Sequential(*(inverted(2 * features, 2 * features) for _ in range(2)))
        self.join = inverted(3 * features, features)
        self.tail = nn.Conv2d(features, 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) of even sides to the same shape."""
        fine = self.fine(self.head(image))
        deep = self.deep(self.down(functional.max_pool2d(fine, 2)))
        up = functional.interpolate(deep, scale_factor=2.0, mode="nearest")
        correction: Tensor = self.tail(self.join(torch.cat([up, fine], 1)))
        return image + correction


def transposed() -> nn.Module:
    """Return a network that downsamples by a stride and upsamples by a transposed convolution, with
    a global add.
    """
    down = nn.Sequential(nn.Conv2d(1, DENSE, 4, stride=2, padding=1), nn.ReLU())
    up = nn.ConvTranspose2d(DENSE, DENSE, 4, stride=2, padding=1)
    inner = [conv(DENSE, DENSE, nn.ReLU()) for _ in range(2)]
    return Added(down, *inner, up, nn.ReLU(), nn.Conv2d(DENSE, 1, 3, padding=1))


def residual() -> nn.Module:
    """Return a network of four residual blocks with a global add."""
    blocks = [
        Added(conv(DENSE, DENSE, nn.ReLU()), conv(DENSE, DENSE, nn.Identity())) for _ in range(4)
    ]
    return Added(nn.Conv2d(1, DENSE, 3, padding=1), *blocks, nn.Conv2d(DENSE, 1, 3, padding=1))


class Distillation(nn.Module):
    """RFDN's block: three times a part of the features is distilled, and all parts are joined (Liu
    et al., 2020). It has no attention, and its slope is the one that the DPU supports.
    """

    def __init__(self, features: int = DENSE) -> None:
        super().__init__()
        act = nn.LeakyReLU(DPU_SLOPE)
        half = features // 2
        self.aside = nn.ModuleList(conv(features, half, act, 1) for _ in range(3))
        self.refine = nn.ModuleList(nn.Conv2d(features, features, 3, padding=1) for _ in range(3))
        self.last = conv(features, half, act)
        self.join = nn.Conv2d(4 * half, features, 1)
        self.act = act

    def forward(self, x: Tensor) -> Tensor:
        """Return a tensor of the shape of `x`."""
        parts = []
        for aside, refine in zip(self.aside, self.refine, strict=True):
            parts.append(aside(x))
            x = self.act(refine(x) + x)
        joined: Tensor = self.join(torch.cat([*parts, self.last(x)], 1))
        return joined


class RFDN(nn.Module):
    """A network of two distillation blocks whose results are joined, with a long residual and a
    global add.
    """

    def __init__(self, features: int = DENSE) -> None:
        super().__init__()
        self.head = nn.Conv2d(1, features, 3, padding=1)
        self.blocks = nn.ModuleList(Distillation(features) for _ in range(2))
        self.join = conv(2 * features, features, nn.LeakyReLU(DPU_SLOPE), 1)
        self.smooth = nn.Conv2d(features, features, 3, padding=1)
        self.tail = nn.Conv2d(features, 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        head = self.head(image)
        x = head
        results = []
        for block in self.blocks:
            x = block(x)
            results.append(x)
        correction: Tensor = self.tail(self.smooth(self.join(torch.cat(results, 1))) + head)
        return image + correction


class Gated(nn.Module):
    """NAFNet's block without layer normalisation and attention: one half of the features is
    multiplied by the other (Chen et al., 2022).
    """

    def __init__(self, features: int = DENSE) -> None:
        super().__init__()
        wide = 2 * features
        self.spread = nn.Conv2d(features, wide, 1)
        self.filter = nn.Conv2d(wide, wide, 3, padding=1, groups=wide)
        self.narrow = nn.Conv2d(features, features, 1)
        self.mix = nn.Conv2d(features, wide, 1)
        self.end = nn.Conv2d(features, features, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return a tensor of the shape of `x`."""
        first, second = self.filter(self.spread(x)).chunk(2, 1)
        x = x + self.narrow(first * second)
        first, second = self.mix(x).chunk(2, 1)
        result: Tensor = x + self.end(first * second)
        return result


def gated() -> nn.Module:
    """Return a network of NAFNet's blocks at one size, with a global add."""
    tail = nn.Conv2d(DENSE, 1, 3, padding=1)
    return Added(nn.Conv2d(1, DENSE, 3, padding=1), Gated(), Gated(), tail)


NETWORKS: dict[str, tuple[str, Callable[[], nn.Module]]] = {
    "depthwise, ReLU6": ("dncnn", lambda: depthwise(nn.ReLU6())),
    "depthwise, ReLU": ("dncnn", lambda: depthwise(nn.ReLU())),
    "depthwise, HardSwish": ("dncnn", lambda: depthwise(nn.Hardswish())),
    "depthwise, dilated": ("dncnn", lambda: depthwise(nn.ReLU(), 2)),
    "U-Net of inverted residuals": ("dncnn", MobileUNet),
    "plain": ("dncnn", lambda: plain(5)),
    "plain, dilated": ("dncnn", lambda: plain(5, 2)),
    "transposed": ("dncnn", transposed),
    "residual": ("dncnn", residual),
    "DnCNN": ("dncnn", lambda: DnCNN(6)),
    "ESPCN": ("espcn", ESPCN),
    "RFDN": ("dncnn", RFDN),
    "NAF-like": ("dncnn", gated),
}
"""The task that each network learns (`examples.samples`) and the function that builds it."""


@dataclass(frozen=True)
class Drawn:
    """Samples: images (K, C, H, W) in [0, 1], and their references."""

    images: np.ndarray
    references: np.ndarray

    @classmethod
    def of(cls, kind: str, folder: Path | None, seed: int, batches: int) -> "Drawn":
        """Draw `batches` batches of samples of the kind that the examples train on."""
        samples = list(islice(batches_of(kind, folder, seed), batches))
        images, references = (torch.cat(tensors).numpy() for tensors in zip(*samples, strict=True))
        return cls(images, references)


@torch.no_grad()
def drawn(network: nn.Module, generator: torch.Generator) -> nn.Module:
    """Draw weights and biases with the generator, from torch's default distribution, and return the
    network.
    """
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            bound = module.weight[0].numel() ** -0.5
            for numbers in module.parameters():
                numbers.uniform_(-bound, bound, generator=generator)
    return network


def trained(name: str, folder: Path | None, count: int) -> nn.Module:
    """Train the named network with `count` steps of Adam."""
    kind, make = NETWORKS[name]
    network = drawn(make(), torch.Generator().manual_seed([*NETWORKS].index(name))).train()
    optimiser = torch.optim.Adam(
        network.parameters(), lr=FAST if name.startswith(("depthwise", "plain")) else RATE
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, count)
    for image, reference in islice(batches_of(kind, folder, 0), count):
        optimiser.zero_grad()
        functional.l1_loss(network(image[:BATCH]), reference[:BATCH]).backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    return network.eval()


def save(network: nn.Module, side_px: int, path: Path) -> None:
    """Export for one image size as users do, and fold the batch normalisation."""
    names: dict[str, Any] = {"input_names": ["input"], "output_names": ["output"]}
    names["dynamic_axes"] = {"input": {0: "batch"}}
    image = torch.zeros(1, 1, side_px, side_px)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(network, (image,), str(path), opset_version=17, dynamo=False, **names)
    save_onnx(load_onnx(path), path)


@dataclass(frozen=True)
class Small:
    """A trained network: its file, samples for calibration, and held-out samples."""

    path: Path
    samples: Drawn
    held_out: Drawn

    def losses_db(self, int8: Path) -> np.ndarray:
        """Return the loss of PSNR in INT8 for each held-out sample, (K,)."""
        sessions = [open_session(load_onnx(path)) for path in (self.path, int8)]
        values = []
        for image, reference in zip(self.held_out.images, self.held_out.references, strict=True):
            results = [result_of(session, image[None]) for session in sessions]
            in_float, in_int8 = (
                psnr_db(np.clip(result, 0, 1), reference[None], 1.0) for result in results
            )
            values.append(in_float - in_int8)
        return np.array(values)


def options(text: str | None) -> argparse.ArgumentParser:
    """Return the options that all scripts over these networks have."""
    parser = argparse.ArgumentParser(
        description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path, help="folder of scenes; drawn ones if none")
    parser.add_argument("--held-out", type=Path, help="folder of scenes to judge on")
    parser.add_argument("--steps", type=int, default=1500, help="of the training")
    parser.add_argument("--batches", type=int, default=8, help="of eight samples each")
    parser.add_argument("--only", default="", help="networks whose names this expression matches")
    return parser


def prepared(name: str, arguments: argparse.Namespace, folder: Path) -> Small:
    """Train a network, save it in a folder, and draw its samples."""
    kind, _ = NETWORKS[name]
    path = folder / f"{slug(name)}.onnx"
    # ESPCN doubles the size, so its images have half the side of its references.
    side_px = SIDE_PX // (2 if kind == "espcn" else 1)
    save(trained(name, arguments.images, arguments.steps), side_px, path)
    return Small(
        path,
        Drawn.of(kind, arguments.images, 5, arguments.batches),
        Drawn.of(kind, arguments.held_out, 6, arguments.batches),
    )


def names_in(arguments: argparse.Namespace, *more: str) -> list[str]:
    """Return the names of the networks, and of some more, that --only matches."""
    return [name for name in (*NETWORKS, *more) if re.search(arguments.only, name)]


def slug(name: str) -> str:
    """Return the name of a network as part of a file name."""
    return name.lower().replace(",", "").replace(" ", "-")
