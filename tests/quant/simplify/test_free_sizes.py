"""Tests that arithmetic on the image size is removed without changing the results."""

import io
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from beers_deploy.quant.graph import refusal
from beers_deploy.quant.simplify.simplify import simplify
from tests.quant.quick import assert_same, run_model, uniform
from tests.quant.simplify.networks import network_from

FEATURES = 4
IMAGE = np.random.default_rng(2).uniform(0, 1, (1, 1, 22, 38)).astype(np.float32)


class PaddedUNet(nn.Module):
    """A U-Net that pads enlarged features to the size of the skip, as the most copied one does."""

    def __init__(self) -> None:
        super().__init__()
        self.fine = nn.Conv2d(1, FEATURES, 3, padding=1)
        self.pool: nn.Module = nn.MaxPool2d(2)
        self.deep = nn.Conv2d(FEATURES, FEATURES, 3, padding=1)
        self.up = nn.ConvTranspose2d(FEATURES, FEATURES, 2, stride=2)
        self.tail = nn.Conv2d(2 * FEATURES, 1, 1)

    def enlarged(self, deep: Tensor, fine: Tensor) -> Tensor:
        """Return deep features at the size of fine ones, (1, F, H, W)."""
        up: Tensor = self.up(deep)
        rows = fine.size(2) - up.size(2)
        columns = fine.size(3) - up.size(3)
        sides = [columns // 2, columns - columns // 2, rows // 2, rows - rows // 2]
        return functional.pad(up, sides)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        fine = torch.relu(self.fine(image))
        deep = torch.relu(self.deep(self.pool(fine)))
        result: Tensor = self.tail(torch.cat([self.enlarged(deep, fine), fine], 1))
        return result


class ResizedUNet(PaddedUNet):
    """A U-Net that pools an incomplete pair of rows too, as U2-Net does, resizes features to the
    size of the skip, and the result to that of the image, and clips it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.pool = nn.AvgPool2d(2, ceil_mode=True, count_include_pad=False)

    def enlarged(self, deep: Tensor, fine: Tensor) -> Tensor:
        """Return deep features at the size of fine ones, (1, F, H, W)."""
        return functional.interpolate(deep, size=fine.shape[2:], mode="bilinear")

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        result = functional.interpolate(
            super().forward(image), size=image.shape[2:], mode="bilinear"
        )
        return torch.clamp(image + result, 0, 1)


class DeepUNet(nn.Module):
    """A U-Net of eight levels, as pix2pix has, that resizes features to the size of the skip."""

    def __init__(self) -> None:
        super().__init__()
        self.halve = nn.Conv2d(1, 1, 3, stride=2, padding=1)
        self.join = nn.Conv2d(2, 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        levels = [image]
        for _ in range(8):
            levels.append(self.halve(levels[-1]))
        result = levels.pop()
        for fine in reversed(levels):
            large = functional.interpolate(result, size=fine.shape[2:])
            result = self.join(torch.cat([large, fine], 1))
        return result


class Gated(nn.Module):
    """A network with NAFNet's gate: half of the channels times the other half."""

    def __init__(self) -> None:
        super().__init__()
        self.wide = nn.Conv2d(1, 2 * FEATURES, 1)
        self.deep = nn.Conv2d(2 * FEATURES, 2 * FEATURES, 3, padding=1, groups=2 * FEATURES)
        self.tail = nn.Conv2d(FEATURES, 1, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        first, second = self.deep(self.wide(image)).chunk(2, 1)
        correction: Tensor = self.tail(first * second)
        return image + correction


class Shuffled(Gated):
    """A network with ShuffleNet's channel shuffle, a pixel unshuffle, and an expanded gate."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = nn.Conv2d(2 * FEATURES, 1, 1)
        self.tail = nn.Conv2d(8 * FEATURES, 4, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        wide: Tensor = self.wide(image)
        count, channels, rows, columns = wide.shape
        pairs = wide.reshape(count, 2, channels // 2, rows, columns).transpose(1, 2)
        deep = self.deep(pairs.reshape(count, channels, rows, columns))
        gated = deep * functional.hardsigmoid(self.gate(deep)).expand_as(deep)
        correction = self.tail(functional.pixel_unshuffle(gated, 2))
        return image + functional.pixel_shuffle(correction, 2)


class Repeated(Shuffled):
    """A network that repeats channels and pixels, resizes, and unshuffles in another order."""

    def __init__(self) -> None:
        super().__init__()
        self.tail = nn.Conv2d(2 * FEATURES * 7, 1, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        wide: Tensor = self.wide(image)
        count, channels, rows, columns = wide.shape
        sides = (rows // 2, columns // 2)
        blocks = wide.reshape(count, channels, sides[0], 2, sides[1], 2).permute(0, 3, 5, 1, 2, 4)
        parts = [
            functional.interpolate(wide, size=sides, mode="bilinear"),
            functional.interpolate(wide * 2, scale_factor=0.5),
            wide.repeat_interleave(2, 1)[:, :channels, ::2, ::2],
            blocks.reshape(count, 4 * channels, *sides),
        ]
        correction: Tensor = self.tail(torch.cat(parts, 1))
        return image + correction.repeat_interleave(2, 2).repeat_interleave(2, 3)


class NoiseLevel(nn.Module):
    """A network with FFDNet's map of one constant noise level."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Conv2d(2, FEATURES, 3, padding=1)
        self.tail = nn.Conv2d(FEATURES, 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        level = torch.full((1, 1, 1, 1), 0.1)
        level = level.expand(1, 1, image.shape[2], image.shape[3])
        result: Tensor = self.tail(torch.relu(self.head(torch.cat([image, level], 1))))
        return result


class UnshuffledNoiseLevel(NoiseLevel):
    """All of FFDNet: it reads unshuffled pixels, and a noise level that is repeated over them."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Conv2d(5, FEATURES, 3, padding=1)
        self.tail = nn.Conv2d(FEATURES, 4, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to the same shape."""
        blocks = functional.pixel_unshuffle(image, 2)
        level = torch.full((1, 1, 1, 1), 0.1).repeat(1, 1, blocks.shape[2], blocks.shape[3])
        result = self.tail(torch.relu(self.head(torch.cat([blocks, level], 1))))
        return functional.pixel_shuffle(result, 2)


class Blocks(nn.Module):
    """A network that enlarges maps by rearranging them, as einops does, in both orders."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Conv2d(1, 4 * FEATURES, 3, padding=1)
        self.shrink = nn.Conv2d(FEATURES, 4, 3, padding=1, stride=2)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to (N, 1, 2 H, 2 W)."""
        batch, _, height, width = image.shape
        wide = self.head(image).reshape(batch, FEATURES, 2, 2, height, width)
        large = wide.permute(0, 1, 4, 2, 5, 3).reshape(batch, FEATURES, 2 * height, 2 * width)
        blocks = self.shrink(large).reshape(batch, 2, 2, 1, height, width)
        result: Tensor = blocks.permute(0, 3, 4, 1, 5, 2).reshape(batch, 1, 2 * height, 2 * width)
        return result


class Unshuffled(nn.Module):
    """A network that unshuffles the pixels of a colour image, as Real-ESRGAN does for twice the
    sampling, and adds the mean of its channels, as of several frames.
    """

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Conv2d(12, 12, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 3, H, W) to the same shape."""
        batch, channels, height, width = image.shape
        blocks = image.reshape(batch, channels, height // 2, 2, width // 2, 2)
        wide = blocks.permute(0, 1, 3, 5, 2, 4).reshape(batch, -1, height // 2, width // 2)
        mean = image.reshape(batch, channels, 1, height, width).mean(1)
        return mean + functional.pixel_shuffle(self.body(wide), 2)


def exported(module: nn.Module, channels: int = 1) -> onnx.ModelProto:
    """Export a module with random weights, for any height and width."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for numbers in module.parameters():
            numbers.uniform_(-0.5, 0.5, generator=generator)
    file = io.BytesIO()
    axes = {"input": {2: "height", 3: "width"}, "output": {2: "h", 3: "w"}}
    how: dict[str, Any] = {"input_names": ["input"], "output_names": ["output"]}
    how |= {"dynamic_axes": axes, "opset_version": 17, "dynamo": False}
    image = torch.zeros(1, channels, 256, 256)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(module.eval(), (image,), file, **how)  # type: ignore[arg-type]
    return onnx.load_model_from_string(file.getvalue())


@pytest.mark.parametrize(
    ("make", "image"),
    [
        (PaddedUNet, IMAGE),
        (ResizedUNet, IMAGE),
        (DeepUNet, uniform(1, 1, 256, 512)),
        (Gated, IMAGE),
        (Shuffled, IMAGE),
        (Repeated, IMAGE),
        (NoiseLevel, IMAGE),
        (UnshuffledNoiseLevel, IMAGE),
        (Blocks, IMAGE),
        (Unshuffled, uniform(1, 3, 22, 38)),
    ],
)
def test_sizes_are_gone_and_results_are_the_same(
    make: Callable[[], nn.Module], image: np.ndarray
) -> None:
    """Sides need not be multiples of 64, if the network halves them evenly."""
    model = exported(make(), image.shape[1])
    short = simplify(model, "a.onnx")
    left = Counter(node.op_type for node in short.graph.node)
    assert not left.keys() & {"Shape", "Slice", "Split", "Pad", "Expand", "Gather"}
    assert refusal(short) == ""
    assert_same(model, short, image, atol=1e-6)


class Enlarged(nn.Module):
    """A network that expands two factors and its result, the last without an effect."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Conv2d(1, 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to (N, 3, H, W)."""
        wide = self.body(image).expand(-1, 3, -1, -1)
        result: Tensor = wide * (1 - self.body(wide[:, :1])).expand_as(wide)
        return result.expand(image.shape[0], 3, image.shape[2], image.shape[3])


class Selected(nn.Module):
    """A network that reorders channels, and scales them by their mean over the image and by one of
    them. Its maps lie in memory with the channels last.
    """

    def __init__(self) -> None:
        super().__init__()
        self.wide = nn.Conv2d(1, FEATURES, 3, padding=1)
        self.tail = nn.Conv2d(FEATURES, 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Map images (1, 1, H, W) to the same shape."""
        wide = self.wide(image).contiguous(memory_format=torch.channels_last)
        ordered: Tensor = wide[:, [3, 1, 0, 2]]
        mean = functional.interpolate(functional.adaptive_avg_pool2d(wide, 1), wide.shape[2:])
        result: Tensor = self.tail(ordered * mean * wide[:, 2].unsqueeze(1) * wide[:, [1]])
        return result


@pytest.mark.parametrize("nodes", ["g = Gather<axis=2>(c, twins)", "g = Gather<axis=3>(c, twins)"])
def test_a_chain_that_only_looks_like_an_enlargement_stays(nodes: str) -> None:
    """It repeats 8 rows as 16, or makes them of channels."""
    twins = np.arange(16).reshape(2, 8) % 8
    ends = "float[1,4,8,8] x => float[1,1,16,32] y"
    shuffled = f"c = Conv<pads=[1,1,1,1]>(x, w) {nodes} y = Reshape(g, large)"
    model = network_from(shuffled, ends=ends, twins=twins, large=[1, 1, 16, 32])
    assert_same(model, simplify(model, "a.onnx"), uniform(1, 4, 8, 8))


@pytest.mark.slow
def test_torchs_newer_exporter_selects_channels_in_another_way(tmp_path: Path) -> None:
    """It writes GatherND between two Transposes, a mean that onnx converts incompletely, and a
    Gather of the flat mean.
    """
    image = torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Selected().eval(), (image,), tmp_path / "a.onnx", dynamo=True, verbose=False
        )
    model = onnx.load_model(tmp_path / "a.onnx")
    short = simplify(model, "a.onnx")
    assert refusal(short) == ""
    assert_same(model, short, image.numpy(), atol=1e-5)


def test_an_expand_that_has_an_effect_keeps_it() -> None:
    model = exported(Enlarged())
    assert_same(model, simplify(model, "a.onnx"), IMAGE, atol=1e-6)


class Cropped(nn.Module):
    """A network that appends the first tenth of its rows again, whatever their number."""

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to (N, 1, H + H // 10, W)."""
        rows = image.shape[2] // 10
        return torch.cat([image, image[:, :, :rows]], 2)


def test_a_pool_that_rounds_up_with_an_effect_stays() -> None:
    """Of eight pixels, windows of three with a stride of two leave one over."""
    pool = "y = MaxPool<kernel_shape=[3,3], strides=[2,2], ceil_mode=1>(c)"
    model = network_from(f"c = Conv<pads=[1,1,1,1]>(x, w) {pool}")
    short = simplify(model, "a.onnx")
    assert "ceil_mode 0" in refusal(short)
    assert_same(model, short, uniform(1, 4, 8, 8))


class Lengthened(nn.Module):
    """A network that appends a tenth of its rows as zeros, whatever their number."""

    def forward(self, image: Tensor) -> Tensor:
        """Map images (N, 1, H, W) to (N, 1, H + H // 10, W)."""
        return functional.pad(image, (0, 0, 0, image.shape[2] // 10))


@pytest.mark.parametrize(
    ("module", "remedy"),
    [(Cropped(), "Compute maps whole"), (Lengthened(), "Export it with fixed height and width")],
)
def test_arithmetic_that_depends_on_the_size_stays_and_is_refused(
    module: nn.Module, remedy: str
) -> None:
    """The refusal says what to do. No fixed size would allow parts of maps."""
    model = simplify(exported(module), "a.onnx")
    assert any(node.op_type == "Shape" for node in model.graph.node)
    assert remedy in refusal(model)


@pytest.mark.parametrize(
    ("nodes", "is_freed"),
    [
        ('c = Conv<pads=[1,1,1,1]>(x, w) r = Resize<mode="linear">(c, , twice) y = Tanh(r)', True),
        ("c = Conv<pads=[1,1,1,1]>(x, w) g = GlobalAveragePool(c) y = Mul(c, g)", False),
    ],
)
def test_a_rectangle_is_freed_where_it_has_no_effect(nodes: str, is_freed: bool) -> None:
    """The free network gives the results of the rectangle, and results of other sizes."""
    model = network_from(nodes, ends="float[1,4,8,12] x => float[1,4,H,W] y")
    freed = simplify(model, "a.onnx")
    assert (freed.graph.input[0].type.tensor_type.shape.dim[2].dim_value == 0) is is_freed
    image = np.random.default_rng(0).random((1, 4, 8, 12), np.float32)
    assert_same(model, freed, image)
    if is_freed:
        assert run_model(freed, image[..., :9]).shape[2:] == (16, 18)
