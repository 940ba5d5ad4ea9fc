"""The paper's own network: never fitted, only predicted."""

from deploy.dpu.graph import Network
from deploy.dpu.zoo.builder import Builder


def convbeers(side: int = 640, blocks: int = 16, features: int = 64) -> Network:
    """ConvBEERS as the paper describes it: head, residual blocks, body's end, tail, global add."""
    b = Builder(side, side, 1)
    stream = head = b.conv(b.image, features)
    stream = b.repeat(stream, blocks, lambda x: b.add(b.conv(b.conv(x, features), features), x))
    deep = b.add(b.conv(stream, features), head)
    return b.network(b.add(b.conv(deep, 1), b.image))
