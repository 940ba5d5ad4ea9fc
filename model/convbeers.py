"""ConvBEERS: a residual network without batch normalisation that undoes blur and noise (paper,
section 3.1).

    image -> head -> [conv, ReLU, conv, +] x blocks -> body end, + head
    -> tail -> correction, + image

A variant of scale S rearranges the image in front of its head, S x S pixels into channels, and the
correction back behind its tail (pixel unshuffle and shuffle; Shi et al., CVPR 2016). The host does
both; what lies between runs at 1 / S of the resolution.

Every convolution is 3 x 3 with stride 1 and zero padding 1. 16 blocks of 64 features make 1.2 M
parameters.

Behind the bank of its sensor (`model.bank`) the same body is one network for every sensor in range:

    restored = x + g (w + body([x - 1/2, u])),   w = (W_1 - 1) x / g

What a sensor changes are the filters that make u and w and the unit g, known in closed form, and
the bias of the head, which is linear in the sensor vector.

A larger network can begin where a smaller one stands (`grow`): wider, deeper or coarser, with the
same outputs. Trained in the end with its maps rounded as its INT8 file rounds them (`Rounding`), a
network loses less in INT8.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad, pixel_shuffle, pixel_unshuffle

from beers_deploy.model.bank import FILTERS, LARGEST, SIDE_PX, WIDE, Bank, bank_of_vector
from beers_deploy.model.family import sensor_vector
from beers_deploy.model.io.tensors import Weights, read_weights, write_weights
from beers_deploy.model.variants import BANK_PLANES, SENSOR_VALUES, Kernels, Variant
from beers_deploy.profiles.instrument import Instrument


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(x))), (N, F, H, W) to the same shape."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(features, features, kernel_size=3, padding=1)
        self.second = nn.Conv2d(features, features, kernel_size=3, padding=1)

    def forward(
        self, x: Tensor, step: Tensor | None = None, inner_step: Tensor | None = None
    ) -> Tensor:
        """Add the block's correction to x (N, F, H, W); the shape is kept.

        Given steps, the maps are rounded.
        """
        inner = torch.relu(self.first(x))
        if step is not None and inner_step is not None:
            rounded = in_steps(self.second(in_steps(inner, inner_step)), step)
            return in_steps(x + rounded, step)
        correction: Tensor = self.second(inner)
        return x + correction


class Layers(nn.Module):
    """What both networks are made of; their heads read so many planes of each pixel."""

    def __init__(self, variant: Variant, planes: int) -> None:
        super().__init__()
        self.variant = variant
        self.head = nn.Conv2d(planes * variant.pixels, variant.features, kernel_size=3, padding=1)
        self.body = nn.Sequential(*(ResidualBlock(variant.features) for _ in range(variant.blocks)))
        self.body_end = nn.Conv2d(variant.features, variant.features, kernel_size=3, padding=1)
        self.tail = nn.Conv2d(variant.features, variant.pixels, kernel_size=3, padding=1)

    def corrected(self, shallow: Tensor, bfloat16: bool, steps: Sequence[Tensor] = ()) -> Tensor:
        """What the head gave, (N, F, H / S, W / S), to the correction (N, 1, H, W); see
        `Rounding.steps`.
        """
        with torch.autocast(shallow.device.type, dtype=torch.bfloat16, enabled=bfloat16):
            deep = (
                self._rounded(shallow, *steps)
                if steps
                else shallow + self.body_end(self.body(shallow)).float()
            )
        return pixel_shuffle(self.tail(deep), self.variant.scale)

    def _rounded(self, shallow: Tensor, step: Tensor, *inner: Tensor) -> Tensor:
        """What the tail reads, with every map between head and tail rounded."""
        skip = stream = in_steps(shallow, step)
        for block, inner_step in zip(self.body, inner, strict=True):
            stream = block(stream, step, inner_step)
        return in_steps(skip + in_steps(self.body_end(stream), step), step)


def in_steps(maps: Tensor, step: Tensor) -> Tensor:
    """Maps (N, F, H, W) in float32, held to int8 and rounded to whole steps; gradients pass the
    rounding.
    """
    clipped = maps.float().clamp(-128 * step, 127 * step)
    # The value is rounded, but the gradient is that of `clipped`: detach hides the difference.
    return clipped + (torch.round(clipped / step) * step - clipped).detach()


@dataclass(frozen=True)
class Rounding:
    """How an INT8 file rounds the maps of a network behind a bank.

    Attributes:
        stream: what a 1 stands for in the maps between head and tail, (F, 1, 1), at a gain of 1.
        inner: the same of the map within each block.
    """

    stream: Tensor
    inner: tuple[Tensor, ...]

    def steps(self, gains: Tensor) -> list[Tensor]:
        """Those of images, each with the gain of its bank (N,): (N, F, 1, 1) of the stream, then of
        each block.
        """
        return [step.to(gains) / gains[:, None, None, None] for step in (self.stream, *self.inner)]


class ConvBEERS(Layers):
    """The network: (N, 1, H, W) in [0, 1] of full scale to the same, not clipped; H and W multiples
    of its scale.
    """

    def __init__(self, variant: Variant) -> None:
        super().__init__(variant, planes=1)

    def forward(self, image: Tensor, bfloat16: bool = False) -> Tensor:
        """Image plus correction, (N, 1, H, W); `bfloat16` is for the blocks alone."""
        return image + self.corrected(
            self.head(pixel_unshuffle(image, self.variant.scale)), bfloat16
        )


@dataclass(frozen=True)
class Condition:
    """What a network behind a bank is told of the sensors of N images, float32.

    Attributes:
        vectors: the sensor vectors (N, 4).
        filters: (N, 5, 7, 7), see `Bank.filters`.
        units: (N,) what the network adds is in these shares of full scale.
        gains: (N,) see `Bank.gain`.
    """

    vectors: Tensor
    filters: Tensor
    units: Tensor
    gains: Tensor

    @classmethod
    def of(cls, vectors: Tensor, banks: Sequence[Bank]) -> "Condition":
        """Of the sensor vectors (N, 4) and as many banks."""
        filters = torch.from_numpy(np.stack([bank.filters for bank in banks])).to(vectors)
        units = vectors.new_tensor([bank.unit for bank in banks])
        gains = vectors.new_tensor([bank.gain for bank in banks])
        return cls(vectors, filters, units, gains)

    @property
    def parts(self) -> tuple[Tensor, ...]:
        """All of it, in its order."""
        return self.vectors, self.filters, self.units, self.gains

    def to(self, device: torch.device) -> "Condition":
        """The same on a device."""
        return Condition(*(part.to(device, non_blocking=True) for part in self.parts))

    def repeated(self, count: int) -> "Condition":
        """What is told of one image, for as many."""
        return Condition(*(part.expand(count, *part.shape[1:]) for part in self.parts))

    def some(self, which: slice | Tensor) -> "Condition":
        """What is told of some of the images."""
        return Condition(*(part[which] for part in self.parts))


class BankedConvBEERS(Layers):
    """Images (N, 1, H, W) in [0, 1] of full scale and what is told of their sensors to (N, 1, H,
    W), not clipped.

    `kernels` says what banks it was trained behind.
    """

    def __init__(self, variant: Variant, kernels: Kernels = "fitted") -> None:
        super().__init__(variant, BANK_PLANES)
        self.kernels = kernels
        self.bias = nn.Linear(SENSOR_VALUES, variant.features, bias=False)
        nn.init.zeros_(self.bias.weight)

    def forward(
        self,
        image: Tensor,
        condition: Condition,
        bfloat16: bool = False,
        steps: Sequence[Tensor] = (),
    ) -> Tensor:
        """Restore each image as its own sensor asks for.

        Args:
            image: (N, 1, H, W).
            condition: of the sensor of each.
            bfloat16: for the blocks alone.
            steps: that the maps are rounded to, see `Rounding.steps`; without any they stay as they
                are.
        """
        filtered = each_by_its_own(image, condition.filters)
        planes, analytic = self._held(filtered, condition.gains)
        inputs = pixel_unshuffle(torch.cat([image - 0.5, planes], 1), self.variant.scale)
        shallow = (self.head(inputs) + self.bias(condition.vectors)[:, :, None, None]).contiguous(
            memory_format=torch.channels_last
        )
        correction = self.corrected(shallow, bfloat16, steps)
        restored: Tensor = image + condition.units[:, None, None, None] * (analytic + correction)
        return restored

    def _held(self, filtered: Tensor, gains: Tensor) -> tuple[Tensor, Tensor]:
        """Planes and analytic restoration, (N, 5, H, W) in units, held as `Bank.reach` says."""
        planes = filtered[:, :FILTERS]
        analytic = filtered[:, FILTERS:]
        if self.kernels == "cut":
            return planes.clamp(-LARGEST, LARGEST), analytic.clamp(-LARGEST, LARGEST)
        # Both end where int8 does, so that a network trains with what INT8 will show it.
        reach = LARGEST / gains[:, None, None, None]
        return planes.clamp(-reach, reach), analytic.clamp(-WIDE * reach, WIDE * reach)


class OfOneSensor(nn.Module):
    """A network behind a bank, told one sensor's vector (4,): (N, 1, H, W) in [0, 1] of full scale
    to the same.

    It shares the network's weights. Without a bank the sensor's is made of the vector.
    """

    def __init__(self, network: BankedConvBEERS, vector: Tensor, bank: Bank | None = None) -> None:
        super().__init__()
        self.network = network
        self.vector = vector
        self.bank = bank
        self.variant = network.variant

    def forward(self, image: Tensor) -> Tensor:
        """Restore (N, 1, H, W)."""
        bank = self.bank or bank_of_vector(tuple(self.vector.tolist()), self.network.kernels)
        condition = Condition.of(self.vector[None], [bank])
        restored: Tensor = self.network(image, condition.repeated(len(image)))
        return restored


Network = ConvBEERS | BankedConvBEERS
"""What can be trained and kept: a plain network, or one for every sensor in range."""


def for_sensor(
    network: Network, vector: Tensor, bank: Bank | None = None
) -> ConvBEERS | OfOneSensor:
    """A network that takes images alone: one behind a bank told the sensor of a vector (4,), a
    plain one as it is.
    """
    return OfOneSensor(network, vector, bank) if isinstance(network, BankedConvBEERS) else network


def each_by_its_own(image: Tensor, kernels: Tensor) -> Tensor:
    """Image n of (N, 1, H, W), mirrored at its borders, by kernels n of (N, K,
    7, 7): (N, K, H, W).
    """
    count = len(image)
    radius = SIDE_PX // 2
    padded = pad(image, [radius] * 4, mode="reflect")
    filtered = conv2d(padded.transpose(0, 1), kernels.flatten(0, 1)[:, None], groups=count)
    return filtered.view(count, -1, *image.shape[-2:])


def initialise(network: Network, generator: torch.Generator) -> None:
    """Start as (nearly) the identity: He-normal weights, residual branches and correction scaled
    down, the tail once more where it writes several pixels.
    """
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d):
            fan_in = module.in_channels * 9
            # Without batch normalisation the stream's variance would double at each block.
            scale = 0.1 if name.endswith(("second", "body_end", "tail")) else 1.0
            # What is an offset of one channel is a pattern of the pixels of one place.
            scale /= network.variant.scale if name == "tail" else 1
            with torch.no_grad():
                module.weight.normal_(0.0, scale * (2 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()


def vector_tensor(sensor: Instrument) -> Tensor:
    """The sensor vector (4,) float32, clamped to the ranges."""
    return torch.tensor(sensor_vector(sensor).values)


def arrays(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Tensors of any shape as arrays."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


def network_of(weights: Weights) -> Network:
    """A network of those weights, plain or behind a bank, in evaluation mode, on the CPU."""
    network: Network = ConvBEERS(weights.variant)
    if weights.conditioned:
        network = BankedConvBEERS(weights.variant, weights.kernels)
    network.load_state_dict(
        {name: torch.from_numpy(np.array(value)) for name, value in weights.tensors.items()}
    )
    return network.eval()


def save_network(path: Path, network: Network, recipe: Mapping[str, object]) -> None:
    """Write a network's weights, its variant and the recipe that made them."""
    weights = Weights(arrays(network.state_dict()), network.variant, dict(recipe))
    if isinstance(network, BankedConvBEERS):
        weights = replace(weights, conditioned=True, kernels=network.kernels)
    write_weights(path, weights)


def load_network(path: Path) -> tuple[Network, dict[str, object]]:
    """Read a network in evaluation mode, plain or behind a bank, and its recipe."""
    weights = read_weights(path)
    return network_of(weights), weights.recipe
