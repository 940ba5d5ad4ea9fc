"""What a step of fine-tuning costs against a plain float step of the same network on the same
patches, in one run.

    python -m benchmarks.finetune

Three networks with drawn weights, four patches of 128 x 128 a step. The float step is forward,
loss, backward and Adam in torch, in whichever of its two memory layouts is faster. Both are
interleaved, so that what else the machine does falls on each of them.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from beers_deploy import quantize
from beers_deploy.model.processor import processor_name
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.encodings import read_core
from beers_deploy.quant.integer.trainable import TrainableCore
from beers_deploy.quant.passes.finetune import Sample, Tuning, descend
from examples.networks import UNet

PATCHES = 4
SIDE_PX = 128


class Added(nn.Sequential):
    """The image plus what a network makes of it."""

    def forward(self, image: Tensor) -> Tensor:
        """(N, 1, H, W) to the same."""
        corrected: Tensor = image + super().forward(image)  # type: ignore[no-untyped-call]
        return corrected


def depthwise(features: int = 32) -> nn.Module:
    """A depthwise and a pointwise convolution between two others, ReLU6 behind each, without a
    global add.
    """
    filters = nn.Conv2d(features, features, 3, padding=1, groups=features)
    middle = (filters, nn.ReLU6(), nn.Conv2d(features, features, 1), nn.ReLU6())
    return nn.Sequential(_conv(1, features), nn.ReLU6(), *middle, _conv(features, 1))


def dncnn(layers: int = 8, features: int = 32) -> nn.Module:
    """Convolutions with ReLU whose result is added to the image."""
    # The first convolution comes first, because each one draws its weights as it is made.
    parts: list[nn.Module] = [_conv(1, features), nn.ReLU()]
    for _ in range(layers - 2):
        parts += _conv(features, features), nn.ReLU()
    return Added(*parts, _conv(features, 1))


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1)


NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "depthwise": depthwise,
    "unet": UNet,
    "dncnn": dncnn,
}


def float_step(network: nn.Module, layout: torch.memory_format) -> Callable[[], None]:
    """What anybody would write."""
    network = network.to(memory_format=layout)  # type: ignore[call-overload]
    images = torch.rand(PATCHES, 1, SIDE_PX, SIDE_PX)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-4)
    images = images.to(memory_format=layout)

    def step() -> None:
        optimiser.zero_grad()
        (network(images) - images).square().mean().backward()
        optimiser.step()

    return step


def tuning_step(core: IntCore) -> Callable[[], None]:
    """A step of `quantize --finetune`."""
    generator = np.random.default_rng(0)
    samples = []
    for _ in range(PATCHES):
        image = generator.random((1, 1, SIDE_PX, SIDE_PX)).astype(np.float32)
        planes = torch.from_numpy(core.host_part.encode(image).astype(np.float32)).to(
            memory_format=torch.channels_last
        )
        samples.append(Sample(image, planes, torch.zeros(1, 1, SIDE_PX, SIDE_PX), None, 1.0))
    return partial(next, descend(TrainableCore(core), samples, Tuning([(image, image)]), [10**6]))


def main() -> None:
    """Print the times and the ratio of each network."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=8)
    turns = parser.parse_args().turns
    print(
        f"{processor_name()}, {torch.get_num_threads()} threads, processor time of the fastest "
        f"of {turns} steps"
    )
    for name, make in NETWORKS.items():
        core = read_core(quantize(make(), patches=2, patch=64, progress=False).model)
        layouts = torch.contiguous_format, torch.channels_last
        steps = [tuning_step(core), *(float_step(make(), layout) for layout in layouts)]
        times_s = [[_seconds(step) for step in steps] for _ in range(turns)]
        tuned, *both = 1e3 * np.min(times_s, axis=0)
        print(
            f"{name}: float {min(both):.0f} ms, tuning {tuned:.0f} ms, ratio "
            f"{tuned / min(both):.2f}",
            flush=True,
        )


def _seconds(step: Callable[[], None]) -> float:
    begun = time.process_time()
    step()
    return time.process_time() - begun


if __name__ == "__main__":
    main()
