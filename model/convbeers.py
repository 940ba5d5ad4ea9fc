"""Define ConvBEERS: a residual network without batch normalisation that undoes blur and noise
(paper, section 3.1).

    image -> head -> [conv, ReLU, conv, +] x blocks -> body end, + head
    -> tail -> correction, + image

A variant of scale S rearranges S x S pixels of the image into channels before its head, and the
correction back after its tail (pixel unshuffle and shuffle; Shi et al., CVPR 2016). The host does
both, and the layers in between run at 1 / S of the resolution.

Every convolution is 3 x 3 with stride 1 and zero padding 1. 16 blocks of 64 features make 1.2 M
parameters.

Behind the bank of its sensor (`model.bank`) the same body is one network for every sensor in range:

    restored = x + g (w + body([x - 1/2, u])),   w = (W_1 - 1) x / g

A sensor changes the filters for u and w and the unit g, which are known in closed form, and the
bias of the head, which is linear in the sensor vector.

A larger network can start from a smaller one (`grow`): wider, deeper or coarser, with the same
outputs. If the last part of the training rounds the maps as the INT8 file does (`Rounding`), a
network loses less in INT8.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx
from torch.nn.functional import conv2d, pad, pixel_shuffle, pixel_unshuffle

from beers_deploy.model.bank import FILTERS, LARGEST, SIDE_PX, WIDE, Bank, bank_of_vector
from beers_deploy.model.family import RANGES, sensor_vector
from beers_deploy.model.io.tensors import BANKED, Weights, read_weights, write_tensors
from beers_deploy.model.variants import BANK_PLANES, SENSOR_VALUES, Kernels, Variant
from beers_deploy.profiles.instrument import Instrument


class ResidualBlock(nn.Module):
    """A residual block, x + conv(relu(conv(x))), of maps (N, F, H, W) of any size."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(features, features, kernel_size=3, padding=1)
        self.second = nn.Conv2d(features, features, kernel_size=3, padding=1)

    def forward(
        self, x: Tensor, step: Tensor | None = None, inner_step: Tensor | None = None
    ) -> Tensor:
        """Add the block's correction to x (N, F, H, W); the shape does not change.

        Given step sizes, the maps are rounded.
        """
        inner = torch.relu(self.first(x))
        if step is not None and inner_step is not None:
            rounded = in_steps(self.second(in_steps(inner, inner_step)), step)
            return in_steps(x + rounded, step)
        correction: Tensor = self.second(inner)
        return x + correction


class Layers(nn.Module):
    """The layers that `ConvBEERS` and `BankedConvBEERS` share.

    `planes` is the number of planes that the head reads for each pixel: 1 for the image, and more
    behind a filter bank.
    """

    def __init__(self, variant: Variant, planes: int) -> None:
        super().__init__()
        self.variant = variant
        self.head = nn.Conv2d(planes * variant.pixels, variant.features, kernel_size=3, padding=1)
        self.body = nn.Sequential(*(ResidualBlock(variant.features) for _ in range(variant.blocks)))
        self.body_end = nn.Conv2d(variant.features, variant.features, kernel_size=3, padding=1)
        self.tail = nn.Conv2d(variant.features, variant.pixels, kernel_size=3, padding=1)

    def corrected(self, shallow: Tensor, bfloat16: bool, steps: Sequence[Tensor] = ()) -> Tensor:
        """Compute the correction (N, 1, H, W) from the output of the head, (N, F, H / S, W / S).

        Given `steps` (see `Rounding.steps`), the maps between head and tail are rounded. With
        `bfloat16` the layers between head and tail compute in it, their sums stay in float32.
        """
        with torch.autocast(shallow.device.type, dtype=torch.bfloat16, enabled=bfloat16):
            if steps:
                # Every map between head and tail is rounded.
                step, *inner_steps = steps
                skip = stream = in_steps(shallow, step)
                for block, inner_step in zip(self.body, inner_steps, strict=True):
                    stream = block(stream, step, inner_step)
                deep = in_steps(skip + in_steps(self.body_end(stream), step), step)
            else:
                deep = shallow + self.body_end(self.body(shallow)).float()
        return pixel_shuffle(self.tail(deep), self.variant.scale)


def in_steps(maps: Tensor, step: Tensor) -> Tensor:
    """Clip maps (N, F, H, W) to int8 and round them to multiples of `step`, in float32.

    Gradients pass the rounding unchanged (straight-through estimator), and not where a map is
    clipped.
    """
    rounded: Tensor = _InSteps.apply(maps, step)  # type: ignore[no-untyped-call]
    return rounded


class _InSteps(Function):
    """The rounding of `in_steps`, which keeps one flag a value for its gradient.

    Maps of a batch are larger than the caches, so a step takes as long as its passes over them.
    Operations on the same memory, instead of one new map each, train 1.8 times as fast on a CPU.
    """

    @staticmethod
    def forward(context: FunctionCtx, maps: Tensor, step: Tensor) -> Tensor:
        """Return the rounded maps."""
        levels = maps / step
        unclipped = levels.ge(-128)
        unclipped &= levels.le(127)
        context.save_for_backward(unclipped)
        return levels.round_().clamp_(-128, 127).mul_(step)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """Return the gradient of the maps; the step size is not trained."""
        (unclipped,) = context.saved_tensors
        return gradient * unclipped, None


@dataclass(frozen=True)
class Rounding:
    """The quantisation steps to which an INT8 file rounds the maps of a network behind a bank.

    Attributes:
        stream: the quantisation step of the F maps between head and tail, (F, 1, 1), for a bank
            whose `gain` is 1.
        inner: the quantisation step of the map within each block, for the same bank.
    """

    stream: Tensor
    inner: tuple[Tensor, ...]

    def steps(self, gains: Tensor) -> list[Tensor]:
        """Compute the quantisation steps for N images, each with the filter bank of its own sensor.

        Returns:
            The steps (N, F, 1, 1) of the maps between head and tail, then those of each block.
        """
        return [step.to(gains) / gains[:, None, None, None] for step in (self.stream, *self.inner)]


class ConvBEERS(Layers):
    """The plain network, made for one sensor.

    It restores images (N, 1, H, W) in [0, 1] of full scale, and does not clip the result. H and W
    must be multiples of the scale of its variant.
    """

    def __init__(self, variant: Variant) -> None:
        super().__init__(variant, planes=1)

    def forward(self, image: Tensor, bfloat16: bool = False) -> Tensor:
        """Return the image plus its correction, (N, 1, H, W); `bfloat16` applies to the blocks
        only.
        """
        return image + self.corrected(
            self.head(pixel_unshuffle(image, self.variant.scale)), bfloat16
        )


class Condition(NamedTuple):
    """The description of the sensors of N images on which a network behind a bank is conditioned,
    float32.

    Attributes:
        vectors: the sensor vectors (N, 4).
        filters: the kernels (N, 5, 7, 7) that `Bank.filters` returns for each sensor.
        units: the share of full scale that is 1 in the network's correction, (N,).
        gains: the factor by which quantisation steps are finer, (N,), see `Bank.gain`.
    """

    vectors: Tensor
    filters: Tensor
    units: Tensor
    gains: Tensor

    @classmethod
    def of(cls, vectors: Tensor, banks: Sequence[Bank]) -> "Condition":
        """Build the description from sensor vectors (N, 4) and N banks."""
        filters = torch.from_numpy(np.stack([bank.filters for bank in banks])).to(vectors)
        units = vectors.new_tensor([bank.unit for bank in banks])
        gains = vectors.new_tensor([bank.gain for bank in banks])
        return cls(vectors, filters, units, gains)

    def to(self, device: torch.device) -> "Condition":
        """Return the same description on a device."""
        return Condition(*(part.to(device, non_blocking=True) for part in self))

    def repeated(self, count: int) -> "Condition":
        """Repeat the description of one image `count` times."""
        return Condition(*(part.expand(count, *part.shape[1:]) for part in self))

    def some(self, which: slice | Tensor) -> "Condition":
        """Return the descriptions of the images that `which` selects."""
        return Condition(*(part[which] for part in self))


class BankedConvBEERS(Layers):
    """A network for every sensor, which reads the image through the filter bank of its sensor.

    It maps images (N, 1, H, W) in [0, 1] of full scale and the description of their sensors to (N,
    1, H, W), without clipping. `kernels` names the kind of banks that it was trained behind.
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
        """Restore each image with the filters of its own sensor.

        Args:
            image: the raw images (N, 1, H, W) in [0, 1] of full scale.
            condition: description of the sensor of each image.
            bfloat16: whether the blocks compute in bfloat16.
            steps: step sizes to which the maps are rounded, see `Rounding.steps`; without steps
                they are not rounded.
        """
        # Image n, mirrored at its borders, is filtered with the kernels of its own sensor.
        padded = pad(image, [SIDE_PX // 2] * 4, mode="reflect").transpose(0, 1)
        kernels = condition.filters.flatten(0, 1)[:, None]
        filtered = conv2d(padded, kernels, groups=len(image))
        filtered = filtered.view(len(image), -1, *image.shape[-2:])
        # Both are clipped to `Bank.reach`, where int8 ends, so that a network trains with the input
        # that INT8 gives it.
        planes = filtered[:, :FILTERS]
        analytic = filtered[:, FILTERS:]
        if self.kernels == "cut":
            planes = planes.clamp(-LARGEST, LARGEST)
            analytic = analytic.clamp(-LARGEST, LARGEST)
        else:
            reach = LARGEST / condition.gains[:, None, None, None]
            planes = planes.clamp(-reach, reach)
            analytic = analytic.clamp(-WIDE * reach, WIDE * reach)
        inputs = pixel_unshuffle(torch.cat([image - 0.5, planes], 1), self.variant.scale)
        shallow = (self.head(inputs) + self.bias(condition.vectors)[:, :, None, None]).contiguous(
            memory_format=torch.channels_last
        )
        correction = self.corrected(shallow, bfloat16, steps)
        restored: Tensor = image + condition.units[:, None, None, None] * (analytic + correction)
        return restored


class OfOneSensor(nn.Module):
    """A network for every sensor, conditioned on one of them.

    It maps (N, 1, H, W) in [0, 1] of full scale to the same shape, and shares the weights of the
    given network.

    Args:
        network: the network for every sensor.
        condition: the description of the sensor.
    """

    def __init__(self, network: BankedConvBEERS, condition: Condition) -> None:
        super().__init__()
        self.network = network
        self.condition = condition
        self.variant = network.variant

    def forward(self, image: Tensor) -> Tensor:
        """Restore images (N, 1, H, W) in [0, 1] of full scale."""
        restored: Tensor = self.network(image, self.condition.repeated(len(image)))
        return restored


TrainableNetwork = ConvBEERS | BankedConvBEERS
"""A network that can be trained and saved: a plain one, or one for every sensor in range."""


def for_sensor(
    network: TrainableNetwork, vector: Tensor, bank: Bank | None = None
) -> ConvBEERS | OfOneSensor:
    """Return a network that accepts images only.

    Args:
        network: a network behind a bank is conditioned on the sensor; a plain one is returned
            unchanged.
        vector: the sensor vector (4,): MTF across and along the track and noise at two
            brightnesses, each scaled to [-1, 1].
        bank: the bank of the sensor; None builds that of the vector's MTF and noise.
    """
    if isinstance(network, ConvBEERS):
        return network
    bank = bank or bank_of_vector(tuple(vector.tolist()), network.kernels)
    return OfOneSensor(network, Condition.of(vector[None], [bank]))


def initialise(network: TrainableNetwork, generator: torch.Generator) -> None:
    """Draw the first weights of a network, so that it changes images hardly at all.

    Weights are He-normal. The last convolution of each residual branch and the tail are scaled
    down, the tail once more if it writes several pixels.
    """
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d):
            fan_in = module.in_channels * 9
            # Without batch normalisation the stream's variance would double at each block.
            scale = 0.1 if name.endswith(("second", "body_end", "tail")) else 1.0
            # An offset of one channel would be a pattern of the pixels of one place.
            scale /= network.variant.scale if name == "tail" else 1
            with torch.no_grad():
                module.weight.normal_(0.0, scale * (2 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()


def vector_tensor(sensor: Instrument) -> Tensor:
    """Return the sensor vector as a tensor (4,) float32: MTF across and along the track, noise of
    dark and of bright ground.

    Values outside the ranges of the training are clamped to them.
    """
    return torch.tensor(sensor_vector(sensor).values)


def arrays(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Convert tensors of any shape to NumPy arrays."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()}


def network_of(weights: Weights) -> TrainableNetwork:
    """Build the torch network that has the given weights, in evaluation mode on the CPU.

    It is a `ConvBEERS` for weights of a plain network, else a `BankedConvBEERS`.
    """
    network: TrainableNetwork = ConvBEERS(weights.variant)
    if weights.conditioned:
        network = BankedConvBEERS(weights.variant, weights.kernels)
    network.load_state_dict(
        {name: torch.from_numpy(np.array(value)) for name, value in weights.tensors.items()}
    )
    return network.eval()


def save_network(path: Path, network: TrainableNetwork, recipe: Mapping[str, object]) -> None:
    """Write a network's weights, its variant and the recipe that made them; for a network behind a
    bank also its sensor ranges. `read_weights` reads them.
    """
    header: dict[str, object] = {"variant": asdict(network.variant), "recipe": dict(recipe)}
    if isinstance(network, BankedConvBEERS):
        header |= {"kind": BANKED, "ranges": dict(RANGES), "kernels": network.kernels}
    # No interval is written, because other weights make other errors.
    write_tensors(path, arrays(network.state_dict()), header)


def load_network(path: Path) -> tuple[TrainableNetwork, dict[str, object]]:
    """Read a network in evaluation mode, plain or behind a bank, and its recipe."""
    weights = read_weights(path)
    return network_of(weights), weights.recipe
