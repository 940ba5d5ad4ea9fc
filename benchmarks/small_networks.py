"""What INT8 costs eleven small networks that are trained briefly, next to AMD Quark.

    python -m benchmarks.small_networks --images aerial-train/ --held-out aerial-test/ \
        --quark-python quark/bin/python

Prints a Markdown table: what PSNR is lost on samples that neither training nor calibration saw, in
the mean and on the worst sample. With --tuned, also once our integers are fine-tuned on more
samples, and Quark's weights are rounded by AdaRound. The samples are those of `examples.samples`,
the environment of Quark that of `int8_peers.py`. Trained networks stay in the folder of --keep,
where a later run finds them.
"""

import argparse
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from beers_deploy import quantize
from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.quant.graph import read_network
from beers_deploy.quant.host_part import HostPart, Plain
from beers_deploy.quant.onnx_file import load_onnx, save_onnx
from benchmarks.int8_peers import OURS, QUARK, Peered, Restore, Way, print_lines, quantize_in_child
from examples.networks import ESPCN, DnCNN
from examples.samples import batches_of

SIDE_PX = {"dncnn": 64, "espcn": 64}
SEPARABLE = 32
DENSE = 16
"""Features of networks with depthwise convolutions, and of those without."""
BATCH = 4
RATE = 2e-3
FAST = 5e-3
"""Samples of a step, and learning rates: of all networks, and of those that the image itself passes
through.
"""
TUNED = Way("beers-deploy, fine-tuned", False, OURS)
MORE = 8
"""Quantised and fine-tuned, in this process, on so many times the samples."""
ADAROUND_STEPS = "1000"
"""A layer's, Quark's own default."""


def conv(
    inputs: int, outputs: int, act: nn.Module, kernel: int = 3, dilation: int = 1, groups: int = 1
) -> nn.Module:
    """A convolution that keeps the size, and an activation."""
    padding = dilation * (kernel // 2)
    inner = nn.Conv2d(inputs, outputs, kernel, padding=padding, dilation=dilation, groups=groups)
    return nn.Sequential(inner, act)


def depthwise(act: nn.Module, dilation: int = 1) -> nn.Module:
    """A depthwise convolution with one of 1 x 1 behind it, without a global add."""
    separable = (
        conv(SEPARABLE, SEPARABLE, act, dilation=dilation, groups=SEPARABLE),
        conv(SEPARABLE, SEPARABLE, act, 1),
    )
    return nn.Sequential(conv(1, SEPARABLE, act), *separable, nn.Conv2d(SEPARABLE, 1, 3, padding=1))


def plain(layers: int, dilation: int = 1) -> nn.Module:
    """Convolutions with ReLU, without a global add."""
    middle = [conv(DENSE, DENSE, nn.ReLU(), dilation=dilation) for _ in range(layers - 2)]
    return nn.Sequential(conv(1, DENSE, nn.ReLU()), *middle, nn.Conv2d(DENSE, 1, 3, padding=1))


class Added(nn.Module):
    """What a network gives, added to what it gets."""

    def __init__(self, *inner: nn.Module) -> None:
        super().__init__()
        self.inner = nn.Sequential(*inner)

    def forward(self, x: Tensor) -> Tensor:
        """The same shape."""
        output: Tensor = self.inner(x)
        return x + output


def inverted(inputs: int, outputs: int) -> nn.Module:
    """MobileNetV2's block: widened twofold, filtered channel by channel, narrowed without an
    activation.
    """
    wide = 2 * inputs
    block = [
        conv(inputs, wide, nn.ReLU6(), kernel=1),
        conv(wide, wide, nn.ReLU6(), groups=wide),
        conv(wide, outputs, nn.Identity(), kernel=1),
    ]
    return Added(*block) if inputs == outputs else nn.Sequential(*block)


class MobileUNet(nn.Module):
    """Two levels of inverted residuals, pooled down, enlarged up, the skip concatenated; a global
    add.
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
        """Images (N, 1, H, W) of even sides to the same."""
        fine = self.fine(self.head(image))
        deep = self.deep(self.down(functional.max_pool2d(fine, 2)))
        up = functional.interpolate(deep, scale_factor=2.0, mode="nearest")
        correction: Tensor = self.tail(self.join(torch.cat([up, fine], 1)))
        return image + correction


def transposed() -> nn.Module:
    """Down by a stride, up by a transposed convolution, with a global add."""
    down = nn.Sequential(nn.Conv2d(1, DENSE, 4, stride=2, padding=1), nn.ReLU())
    up = nn.ConvTranspose2d(DENSE, DENSE, 4, stride=2, padding=1)
    inner = [conv(DENSE, DENSE, nn.ReLU()) for _ in range(2)]
    return Added(down, *inner, up, nn.ReLU(), nn.Conv2d(DENSE, 1, 3, padding=1))


def residual() -> nn.Module:
    """Four residual blocks, with a global add."""
    blocks = [
        Added(conv(DENSE, DENSE, nn.ReLU()), conv(DENSE, DENSE, nn.Identity())) for _ in range(4)
    ]
    return Added(nn.Conv2d(1, DENSE, 3, padding=1), *blocks, nn.Conv2d(DENSE, 1, 3, padding=1))


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
}
"""By name, what each learns from (`examples.samples`) and how it is made."""


@dataclass(frozen=True)
class Drawn:
    """Samples: images (K, C, H, W) in [0, 1], and their references."""

    images: np.ndarray
    wanted: np.ndarray

    @classmethod
    def of(cls, kind: str, folder: Path | None, seed: int, batches: int) -> "Drawn":
        """So many batches of what the examples learn from."""
        samples = list(islice(batches_of(kind, folder, seed), batches))
        images, references = (torch.cat(tensors).numpy() for tensors in zip(*samples, strict=True))
        return cls(images, references)


@torch.no_grad()
def drawn(network: nn.Module, generator: torch.Generator) -> nn.Module:
    """The network with weights and biases drawn as torch draws them, from a generator."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            bound = module.weight[0].numel() ** -0.5
            for numbers in module.parameters():
                numbers.uniform_(-bound, bound, generator=generator)
    return network


def trained(name: str, folder: Path | None, count: int) -> nn.Module:
    """The network of that name after so many steps of Adam."""
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
    """Export as users do, for one size of image, and fold."""
    names: dict[str, Any] = {"input_names": ["input"], "output_names": ["output"]}
    names["dynamic_axes"] = {"input": {0: "batch"}}
    image = torch.zeros(1, 1, side_px, side_px)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(network, (image,), str(path), opset_version=17, dynamo=False, **names)
    save_onnx(load_onnx(path), path)


def losses(in_float: Restore, in_int8: Restore, held_out: Drawn) -> np.ndarray:
    """Return what each sample loses, (K,): dB of PSNR."""
    values = []
    for image, reference in zip(held_out.images, held_out.wanted, strict=True):
        results = [run(image[None]) for run in (in_float, in_int8)]
        scores = [psnr_db(np.clip(result, 0, 1), reference[None], 1.0) for result in results]
        values.append(scores[0] - scores[1])
    return np.array(values)


def cells(
    name: str, way: Way, python: str, folder: Path, samples: dict[bool, Drawn], held_out: Drawn
) -> str:
    """What a way loses: the mean, and the worst sample's.

    `samples[True]` is what it tunes on.
    """
    path = folder / f"{slug(name)}.onnx"
    model = load_onnx(path)
    network = Peered(model, HostPart.of(read_network(model), Plain()))
    patches = path.with_suffix(".npy")
    out = path.with_suffix(f".{slug(way.name)}.onnx")
    if way is TUNED:
        seconds = fine_tune(path, samples[True], out)
    else:
        np.save(patches, samples[False].images)
        seconds, _ = quantize_in_child(way, {False: (path, patches)}, out, python)
    sample_losses = losses(network.runner(path), network.runner(out), held_out)
    print(name, way.name, f"{seconds:.0f} s", file=sys.stderr)
    return f"{sample_losses.mean():.2f}, {sample_losses.max():.2f}"


def fine_tune(path: Path, tuning: Drawn, out: Path) -> float:
    """Quantise and fine-tune a network; return the processor time in seconds."""
    begun = time.process_time()
    samples = tuning.images, tuning.wanted
    save_onnx(quantize(path, samples=samples, finetune="auto", progress=False).model, out)
    return time.process_time() - begun


def slug(name: str) -> str:
    """For the name of a file."""
    return name.lower().replace(",", "").replace(" ", "-")


def table(arguments: argparse.Namespace, folder: Path) -> Iterator[str]:
    """Line by line, as each network is judged."""
    ours = [Way("beers-deploy", False, OURS, ("ours",))]
    quark = [Way("Quark XINT8", False, QUARK, (), ("0",))]
    if arguments.tuned:
        ours.append(TUNED)
        quark.append(Way("Quark XINT8, AdaRound", False, QUARK, (), (ADAROUND_STEPS,)))
    ways = [(way, sys.executable) for way in ours]
    if arguments.quark_python:
        ways += [(way, arguments.quark_python) for way in quark]
    yield f"| network | {' | '.join(way.name for way, _ in ways)} |"
    yield "|---" * (len(ways) + 1) + "|"
    for name, (kind, _) in NETWORKS.items():
        if not re.search(arguments.only, name):
            continue
        path = folder / f"{slug(name)}.onnx"
        # ESPCN doubles the size, so its images have half the side of its references.
        if not path.exists():
            save(
                trained(name, arguments.images, arguments.steps),
                SIDE_PX[kind] // (2 if kind == "espcn" else 1),
                path,
            )
        samples = {False: Drawn.of(kind, arguments.images, 5, arguments.batches)}
        if arguments.tuned:
            samples[True] = Drawn.of(kind, arguments.images, 5, MORE * arguments.batches)
        held_out = Drawn.of(kind, arguments.held_out, 6, arguments.batches)
        columns = [cells(name, way, python, folder, samples, held_out) for way, python in ways]
        yield f"| {name} | {' | '.join(columns)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--images", type=Path, help="folder of scenes to train and calibrate on; drawn ones if none"
    )
    parser.add_argument(
        "--held-out", type=Path, help="folder of scenes to judge on; drawn ones if none"
    )
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument(
        "--batches", type=int, default=8, help="of eight samples: to calibrate on, and to judge on"
    )
    parser.add_argument("--tuned", action="store_true", help="fine-tune as well; minutes a network")
    parser.add_argument(
        "--quark-python", help="interpreter of the environment that AMD Quark is installed in"
    )
    parser.add_argument(
        "--only", default="", help="networks whose names this regular expression finds"
    )
    parser.add_argument("--keep", type=Path, help="folder for the networks")
    print_lines(table, parser.parse_args())


if __name__ == "__main__":
    main()
