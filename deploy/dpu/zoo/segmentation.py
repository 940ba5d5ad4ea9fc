"""Networks with a result for every pixel, or for every block of 8 x 8."""

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder, Tensor


def superpoint(height: int = 480, width: int = 640) -> Network:
    """SuperPoint (DeTone et al. 2017, arXiv:1712.07629, section 3)."""
    b = Builder(height, width, 1)
    x = b.image
    for index, channels in enumerate((64, 64, 128, 128)):
        x = b.pool(x, 2, 2) if index else x
        x = b.conv(b.conv(x, channels), channels)
    return b.network(b.conv(b.conv(x, 256), 65, 1), b.conv(b.conv(x, 256), 256, 1))


def erfnet(height: int = 512, width: int = 1024, classes: int = 20) -> Network:
    """ERFNet (Romera et al. 2018, IEEE T-ITS 19(1), table I)."""
    b = Builder(height, width)

    def down(x: Tensor, channels: int) -> Tensor:
        return b.concat(b.conv(x, channels - x.channels, 3, 2), b.pool(x, 2, 2))

    def factored(x: Tensor, dilation: int = 1) -> Tensor:
        y = b.conv(b.conv(x, x.channels, (3, 1)), x.channels, (1, 3))
        y = b.conv(b.conv(y, x.channels, (3, 1), dilation=dilation), x.channels, (1, 3), dilation=dilation)
        return b.add(y, x)

    x = down(down(b.image, 16), 64)
    x = down(b.repeat(x, 5, factored), 128)
    for dilation in (2, 4, 8, 16) * 2:
        x = factored(x, dilation)
    x = b.repeat(b.transposed(x, 64, 3, 2), 2, factored)
    x = b.repeat(b.transposed(x, 16, 3, 2), 2, factored)
    return b.network(b.transposed(x, classes, 2, 2))


def enet(height: int = 512, width: int = 1024, classes: int = 19) -> Network:
    """ENet (Paszke et al. 2016, arXiv:1606.02147, table 1), its unpooling replaced by nearest neighbour."""
    b = Builder(height, width)
    x = b.concat(b.conv(b.image, 13, 3, 2), b.pool(b.image, 2, 2))
    x = b.repeat(_enet_down(b, x, 64), 4, lambda t: _enet_block(b, t))
    x = _enet_down(b, x, 128)
    for dilation in (1, 2, 0, 4, 1, 8, 0, 16) * 2:  # 0: asymmetric
        x = _enet_block(b, x, dilation)
    x = b.repeat(_enet_up(b, x, 64), 2, lambda t: _enet_block(b, t))
    x = _enet_block(b, _enet_up(b, x, 16))
    return b.network(b.transposed(x, classes, 3, 2))


def _enet_block(b: Builder, x: Tensor, dilation: int = 1) -> Tensor:
    narrow = x.channels // 4
    y = b.conv(x, narrow, 1)
    middle = (
        b.conv(y, narrow, 3, dilation=dilation) if dilation else b.conv(b.conv(y, narrow, (5, 1)), narrow, (1, 5))
    )
    return b.add(b.conv(middle, x.channels, 1), x)


def _enet_down(b: Builder, x: Tensor, channels: int) -> Tensor:
    narrow = channels // 4
    y = b.conv(b.conv(b.conv(x, narrow, 2, 2), narrow), channels, 1)
    return b.add(y, b.conv(b.pool(x, 2, 2), channels, 1))


def _enet_up(b: Builder, x: Tensor, channels: int) -> Tensor:
    narrow = x.channels // 4
    y = b.conv(b.transposed(b.conv(x, narrow, 1), narrow, 3, 2), channels, 1)
    return b.add(y, b.upsample(b.conv(x, channels, 1)))
