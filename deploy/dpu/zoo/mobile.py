"""Classifiers made of depthwise or narrow convolutions."""

import math

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder, Tensor
from deploy.dpu.zoo.classification import classify

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
