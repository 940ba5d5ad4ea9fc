"""The Inception family: branches beside each other, joined by concats."""

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder, Size, Tensor
from deploy.dpu.zoo.classification import classify

GOOGLENET = (
    (64, 96, 128, 16, 32, 32),
    (128, 128, 192, 32, 96, 64),
    (192, 96, 208, 16, 48, 64),
    (160, 112, 224, 24, 64, 64),
    (128, 128, 256, 24, 64, 64),
    (112, 144, 288, 32, 64, 64),
    (256, 160, 320, 32, 128, 128),
    (256, 160, 320, 32, 128, 128),
    (384, 192, 384, 48, 128, 128),
)
"""1x1; reduced, 3x3; reduced, 5x5; behind the pool."""

BN_INCEPTION = (
    (64, 64, 64, 64, 96, 32),
    (64, 64, 96, 64, 96, 64),
    (0, 128, 160, 64, 96, 0),
    (224, 64, 96, 96, 128, 128),
    (192, 96, 128, 96, 128, 128),
    (160, 128, 160, 128, 160, 128),
    (96, 128, 192, 160, 192, 128),
    (0, 128, 192, 192, 256, 0),
    (352, 192, 320, 160, 224, 128),
    (352, 192, 320, 192, 224, 128),
)
"""1x1; reduced, 3x3; reduced, 3x3 twice; behind the pool. Zeros: the module halves the size."""

Step = tuple[int, Size]
"""Channels and kernel of one convolution of a branch."""


def chain(b: Builder, x: Tensor, *steps: Step) -> Tensor:
    """One convolution behind the other."""
    for channels, kernel in steps:
        x = b.conv(x, channels, kernel)
    return x


def halve(b: Builder, x: Tensor, *branches: tuple[tuple[Step, ...], int]) -> Tensor:
    """Branches that end in a 3 x 3 convolution of stride 2 without padding, and a pool."""
    ends = [b.conv(chain(b, x, *steps), channels, 3, 2, padding="valid") for steps, channels in branches]
    return b.concat(*ends, b.pool(x, 3, 2, padding="valid"))


def inception_v1(large: int = 5) -> Network:
    """GoogLeNet (Szegedy et al. 2014, arXiv:1409.4842, table 1).

    Args:
        large: kernel of the large branch: 5 in the paper, 3 in the TensorFlow slim code.
    """
    b = Builder(224, 224)
    x = b.pool(b.conv(b.image, 64, 7, 2), 3, 2)
    x = b.pool(b.conv(b.conv(x, 64, 1), 192), 3, 2)
    for index, (one, reduced, three, narrow, five, behind) in enumerate(GOOGLENET):
        x = b.pool(x, 3 if index == 2 else 2, 2) if index in (2, 7) else x
        x = b.concat(
            b.conv(x, one, 1),
            chain(b, x, (reduced, 1), (three, 3)),
            chain(b, x, (narrow, 1), (five, large)),
            b.conv(b.pool(x, 3, 1), behind, 1),
        )
    return classify(b, x)


def inception_v2(*, separable_stem: bool = False) -> Network:
    """BN-Inception (Ioffe and Szegedy 2015, arXiv:1502.03167, figure 5).

    Args:
        separable_stem: the first layer as the TensorFlow slim code has it: depthwise by 8, then 1 x 1.
    """
    b = Builder(224, 224)
    x = b.conv(b.depthwise(b.image, 7, 2, multiplier=8), 64, 1) if separable_stem else b.conv(b.image, 64, 7, 2)
    return classify(b, inception_v2_body(b, x)[-1])


def inception_v2_body(b: Builder, x: Tensor) -> list[Tensor]:
    """Everything between the first layer and the classifier: the results of strides 16 and 32."""
    x = b.pool(x, 3, 2)
    x = b.pool(b.conv(b.conv(x, 64, 1), 192), 3, 2)
    ends = []
    for index, (one, reduced, three, narrow, double, behind) in enumerate(BN_INCEPTION):
        if not one:
            ends.append(x)
            y = b.conv(b.conv(x, reduced, 1), three, 3, 2)
            z = b.conv(chain(b, x, (narrow, 1), (double, 3)), double, 3, 2)
            x = b.concat(y, z, b.pool(x, 3, 2))
            continue
        last = index == len(BN_INCEPTION) - 1
        x = b.concat(
            b.conv(x, one, 1),
            chain(b, x, (reduced, 1), (three, 3)),
            chain(b, x, (narrow, 1), (double, 3), (double, 3)),
            b.conv(b.pool(x, 3, 1, average=not last), behind, 1),
        )
    return [ends[-1], x]


def stem(b: Builder) -> Tensor:
    """The first layers of Inception-v3 and Inception-ResNet-v2: 192 channels of 35 x 35."""
    x = b.conv(b.conv(b.image, 32, 3, 2, padding="valid"), 32, 3, padding="valid")
    x = b.pool(b.conv(x, 64), 3, 2, padding="valid")
    return b.pool(b.conv(b.conv(x, 80, 1), 192, 3, padding="valid"), 3, 2, padding="valid")


def inception_v3(side: int = 299) -> Network:
    """Inception-v3 (Szegedy et al. 2015, arXiv:1512.00567, and the TensorFlow slim code)."""
    b = Builder(side, side)
    x = stem(b)
    for behind in (32, 64, 64):
        five, double = chain(b, x, (48, 1), (64, 5)), chain(b, x, (64, 1), (96, 3), (96, 3))
        x = b.concat(b.conv(x, 64, 1), five, double, b.conv(b.pool(x, 3, 1, average=True), behind, 1))
    x = halve(b, x, ((), 384), (((64, 1), (96, 3)), 96))
    for n in (128, 160, 160, 192):
        seven = chain(b, x, (n, 1), (n, (1, 7)), (192, (7, 1)))
        double = chain(b, x, (n, 1), (n, (7, 1)), (n, (1, 7)), (n, (7, 1)), (192, (1, 7)))
        x = b.concat(b.conv(x, 192, 1), seven, double, b.conv(b.pool(x, 3, 1, average=True), 192, 1))
    x = halve(b, x, (((192, 1),), 320), (((192, 1), (192, (1, 7)), (192, (7, 1))), 192))
    for _ in range(2):
        one, double = b.conv(x, 384, 1), chain(b, x, (448, 1), (384, 3))
        forks = [b.conv(y, 384, kernel) for y in (one, double) for kernel in ((1, 3), (3, 1))]
        x = b.concat(b.conv(x, 320, 1), *forks, b.conv(b.pool(x, 3, 1, average=True), 192, 1))
    return classify(b, x)


def inception_resnet_v2(side: int = 299) -> Network:
    """Inception-ResNet-v2 (Szegedy et al. 2016, arXiv:1602.07261, and the TensorFlow slim code)."""
    b = Builder(side, side)
    x = stem(b)
    five, double = chain(b, x, (48, 1), (64, 5)), chain(b, x, (64, 1), (96, 3), (96, 3))
    x = b.concat(b.conv(x, 96, 1), five, double, b.conv(b.pool(x, 3, 1, average=True), 64, 1))
    for _ in range(10):
        x = _residual(b, x, ((32, 1),), ((32, 1), (32, 3)), ((32, 1), (48, 3), (64, 3)))
    x = halve(b, x, ((), 384), (((256, 1), (256, 3)), 384))
    for _ in range(20):
        x = _residual(b, x, ((192, 1),), ((128, 1), (160, (1, 7)), (192, (7, 1))))
    x = halve(b, x, (((256, 1),), 384), (((256, 1),), 288), (((256, 1), (288, 3)), 320))
    for _ in range(10):
        x = _residual(b, x, ((192, 1),), ((192, 1), (224, (1, 3)), (256, (3, 1))))
    return classify(b, b.conv(x, 1536, 1))


def _residual(b: Builder, x: Tensor, *branches: tuple[Step, ...]) -> Tensor:
    joined = b.concat(*(chain(b, x, *steps) for steps in branches))
    return b.add(b.conv(joined, x.channels, 1), x)
