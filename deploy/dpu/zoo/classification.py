"""Residual, plain and mobile classifiers; each function names the paper or code that its layers come from."""

import math

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder, Tensor

CLASSES = 1000
RESNET_WIDTHS = (64, 128, 256, 512)
RESNET_DEPTHS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3), 152: (3, 8, 36, 3)}


def classify(b: Builder, x: Tensor, classes: int = CLASSES) -> Network:
    """Mean over all pixels, then a fully connected layer."""
    return b.network(b.conv(b.global_pool(x), classes, 1))


def resnet18(height: int = 224, width: int = 224) -> Network:
    """ResNet-18 (He et al. 2015, arXiv:1512.03385, table 1)."""
    b = Builder(height, width)
    return classify(b, resnet_basic(b, RESNET_DEPTHS[18])[-1])


def resnet_basic(b: Builder, depths: tuple[int, ...]) -> list[Tensor]:
    """The four stages of a ResNet of basic blocks."""
    x = b.pool(b.conv(b.image, 64, 7, 2), 3, 2)
    stages = []
    for stage, (width, depth) in enumerate(zip(RESNET_WIDTHS, depths, strict=True)):
        for block in range(depth):
            x = basic(b, x, width, 2 if stage and not block else 1)
        stages.append(x)
    return stages


def basic(b: Builder, x: Tensor, channels: int, stride: int) -> Tensor:
    """Two 3 x 3 convolutions and a shortcut."""
    y = b.conv(b.conv(x, channels, 3, stride), channels)
    shortcut = x if stride == 1 and x.channels == channels else b.conv(x, channels, 1, stride)
    return b.add(y, shortcut)


def resnet_bottleneck(depth: int, stride_at: str, height: int = 224, width: int = 224) -> Network:
    """ResNet-50, 101 or 152.

    Args:
        depth: the number in the name.
        stride_at: which convolution of a stage strides: "first" (1 x 1 of its first block, the paper), "middle"
            (3 x 3 of its first block, torchvision and MLPerf), or "last block" (3 x 3 of the block before: the
            TensorFlow slim code).
        height: of the image, in pixels.
        width: of the image, in pixels.
    """
    b = Builder(height, width)
    x = b.pool(b.conv(b.image, 64, 7, 2), 3, 2)
    for stage, (channels, blocks) in enumerate(zip(RESNET_WIDTHS, RESNET_DEPTHS[depth], strict=True)):
        for block in range(blocks):
            x = bottleneck(b, x, channels, _stride(stage, block, blocks, stride_at), stride_at == "first")
    return classify(b, x)


def _stride(stage: int, block: int, blocks: int, stride_at: str) -> int:
    if stride_at == "last block":
        return 2 if block == blocks - 1 and stage < 3 else 1
    return 2 if stage and not block else 1


def bottleneck(b: Builder, x: Tensor, channels: int, stride: int, early: bool) -> Tensor:
    """1 x 1, 3 x 3, 1 x 1 and a shortcut; `early` strides in the first of them."""
    y = b.conv(x, channels, 1, stride if early else 1)
    y = b.conv(b.conv(y, channels, 3, 1 if early else stride), 4 * channels, 1)
    return b.add(y, shortcut(b, x, 4 * channels, stride))


def shortcut(b: Builder, x: Tensor, channels: int, stride: int) -> Tensor:
    """The input itself where shapes agree, else subsampled (same channels) or projected."""
    if x.channels != channels:
        return b.conv(x, channels, 1, stride)
    return b.pool(x, 1, stride) if stride > 1 else x


def resnet_v2(depth: int, side: int = 299) -> Network:
    """Pre-activation ResNet (He et al. 2016, arXiv:1603.05027), strides as in the TensorFlow slim code.

    Batch norm and ReLU stand behind an add: no convolution can take them in.
    """
    b = Builder(side, side)
    x = b.pool(b.conv(b.image, 64, 7, 2), 3, 2)
    for stage, (channels, blocks) in enumerate(zip(RESNET_WIDTHS, RESNET_DEPTHS[depth], strict=True)):
        for block in range(blocks):
            stride = _stride(stage, block, blocks, "last block")
            ready = b.scale(x)
            y = b.conv(b.conv(b.conv(ready, channels, 1), channels, 3, stride), 4 * channels, 1)
            projected = x.channels != 4 * channels
            x = b.add(y, shortcut(b, ready if projected else x, 4 * channels, stride))
    return classify(b, b.scale(x))


def vgg(depth: int, side: int = 224) -> Network:
    """VGG-16 or 19 (Simonyan and Zisserman 2014, arXiv:1409.1556, columns D and E)."""
    b = Builder(side, side)
    x = b.image
    convs = {16: (2, 2, 3, 3, 3), 19: (2, 2, 4, 4, 4)}[depth]
    for channels, count in zip((64, 128, 256, 512, 512), convs, strict=True):
        for _ in range(count):
            x = b.conv(x, channels)
        x = b.pool(x, 2, 2)
    x = b.conv(x, 4096, x.shape[1], padding="valid")
    return b.network(b.conv(b.conv(x, 4096, 1), CLASSES, 1))


def squeezenet(side: int = 224) -> Network:
    """SqueezeNet 1.1 (Iandola et al. 2016, arXiv:1602.07360, and its repository)."""
    b = Builder(side, side)
    x = b.pool(b.conv(b.image, 64, 3, 2, padding="valid"), 3, 2, padding="valid")
    for index, (squeeze, expand) in enumerate([(16, 64), (16, 64), (32, 128), (32, 128)]):
        x = fire(b, x, squeeze, expand)
        x = b.pool(x, 3, 2, padding="valid") if index % 2 else x
    for squeeze, expand in [(48, 192), (48, 192), (64, 256), (64, 256)]:
        x = fire(b, x, squeeze, expand)
    return b.network(b.global_pool(b.conv(x, CLASSES, 1)))


def fire(b: Builder, x: Tensor, squeeze: int, expand: int) -> Tensor:
    """A fire module."""
    y = b.conv(x, squeeze, 1)
    return b.concat(b.conv(y, expand, 1), b.conv(y, expand, 3))


def sphereface20() -> Network:
    """SphereFace-20 (Liu et al. 2017, arXiv:1704.08063, table 2), 112 x 96."""
    b = Builder(112, 96)
    x = b.image
    for channels, count in zip(RESNET_WIDTHS, (1, 2, 4, 1), strict=True):
        x = b.repeat(b.conv(x, channels, 3, 2), count, lambda t: b.add(t, b.conv(b.conv(t, t.channels), t.channels)))
    height, width = x.shape[1:]
    return b.network(b.conv(x, 512, (height, width), padding="valid"))


def reid(depth: int, height: int, width: int) -> Network:
    """A ResNet-18 or 50 that describes persons: no classes (Luo et al. 2019, arXiv:1903.07071)."""
    if depth == 18:
        return resnet18(height, width)
    return resnet_bottleneck(50, "middle", height, width)


V2_STAGES = (
    (1, 16, 1, 1),
    (6, 24, 2, 2),
    (6, 32, 3, 2),
    (6, 64, 4, 2),
    (6, 96, 3, 1),
    (6, 160, 3, 2),
    (6, 320, 1, 1),
)
"""Expansion, channels, blocks, stride."""

EDGETPU = (
    (1, 3, 1, 4, 24),
    (2, 3, 2, 8, 32),
    (4, 3, 2, 8, 48),
    (5, 5, 2, 8, 96),
    (4, 5, 1, 8, 144),
    (2, 5, 2, 8, 192),
)
FUSED_STAGES = 3
"""Blocks, kernel, stride, expansion, channels; in the first three stages the expansion is a full convolution."""

LITE = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
"""Blocks, kernel, stride, expansion, channels."""


def rounded(channels: float) -> int:
    """The multiple of 8 next to it, no more than a tenth smaller."""
    result = max(8, int(channels + 4) // 8 * 8)
    return result + 8 if result < 0.9 * channels else result


def mobilenet_v1(side: int = 224, width: float = 1.0) -> Network:
    """MobileNet (Howard et al. 2017, arXiv:1704.04861, table 1)."""
    b = Builder(side, side)
    x = b.conv(b.image, int(32 * width), 3, 2)
    plan = [(64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2), *[(512, 1)] * 5, (1024, 2), (1024, 1)]
    for channels, stride in plan:
        x = b.conv(b.depthwise(x, 3, stride), int(channels * width), 1)
    return classify(b, x)


def inverted(b: Builder, x: Tensor, wide: int, channels: int, kernel: int, stride: int) -> Tensor:
    """Widen, filter each channel, narrow; the input is added where shapes agree."""
    y = b.conv(x, wide, 1) if wide != x.channels else x
    y = b.conv(b.depthwise(y, kernel, stride), channels, 1)
    return b.add(y, x) if y.shape == x.shape else y


def mobilenet_v2(side: int = 224, width: float = 1.0) -> Network:
    """MobileNetV2 (Sandler et al. 2018, arXiv:1801.04381, table 2)."""
    b = Builder(side, side)
    x = b.conv(b.image, rounded(32 * width), 3, 2)
    for expansion, channels, blocks, stride in V2_STAGES:
        for block in range(blocks):
            x = inverted(b, x, expansion * x.channels, rounded(channels * width), 3, 1 if block else stride)
    return classify(b, b.conv(x, rounded(1280 * max(width, 1.0)), 1))


def efficientnet_edgetpu(side: int, width: float, depth: float) -> Network:
    """EfficientNet-EdgeTPU S, M or L (Google's TPU repository, efficientnet/edgetpu).

    Its first three stages widen by a full 3 x 3 convolution, and stride in the 1 x 1 behind it.
    """
    b = Builder(side, side)
    x = b.conv(b.image, rounded(32 * width), 3, 2)
    for stage, (blocks, kernel, stride, expansion, channels) in enumerate(EDGETPU):
        for block in range(math.ceil(blocks * depth)):
            entry = rounded(24 * width) if not stage else x.channels  # the code widens as if 24 channels came in
            make = fused if stage < FUSED_STAGES else inverted
            x = make(b, x, expansion * entry, rounded(channels * width), kernel, 1 if block else stride)
    return classify(b, b.conv(x, rounded(1280 * width), 1))


def fused(b: Builder, x: Tensor, wide: int, channels: int, kernel: int, stride: int) -> Tensor:
    """An inverted block whose expansion filters too."""
    y = b.conv(b.conv(x, wide, kernel), channels, 1, stride)
    return b.add(y, x) if y.shape == x.shape else y


def efficientnet_lite0(side: int = 224) -> Network:
    """EfficientNet-Lite0 (Google's TPU repository, efficientnet/lite)."""
    b = Builder(side, side)
    x = b.conv(b.image, 32, 3, 2)
    for blocks, kernel, stride, expansion, channels in LITE:
        for block in range(blocks):
            x = inverted(b, x, expansion * x.channels, channels, kernel, 1 if block else stride)
    return classify(b, b.conv(x, 1280, 1))
