"""Random networks of operators that can be tiled, on small integers, whose sums are exact."""

from fractions import Fraction
from typing import Any

import onnx
from hypothesis import strategies as st

from tests.quant.tiling.small_networks import Row, taps


class Builder(Row):
    """A random network, whose last tensor has `at` pixels for each pixel of the image."""

    def __init__(self, draw: Any) -> None:
        super().__init__()
        self.draw = draw
        self.channels = 1
        self.at = Fraction(1)
        self.skips: dict[Fraction, tuple[str, int]] = {}

    def number(self, least: int, most: int) -> int:
        return int(self.draw(st.integers(least, most)))

    def pads(self, total: int) -> list[int]:
        before = [self.number(0, total) for _ in range(2)]
        return [*before, *(total - pad for pad in before)]

    def convolve(self, kernel: int, channels: int = 2, **window: Any) -> None:
        self.add(
            "Conv", taps(f"{len(self.nodes)}", channels, self.channels, kernel, kernel), **window
        )
        self.channels = channels

    def conv(self, stride: int = 1) -> None:
        kernel = self.number(1, 4)
        dilation = self.number(1, 2)
        extent = (kernel - 1) * dilation + 1
        pads = self.pads(self.number(max(extent - stride, 0), extent - 1))
        self.convolve(kernel, strides=[stride] * 2, dilations=[dilation] * 2, pads=pads)
        self.at /= stride

    def strided(self) -> None:
        self.conv(self.number(2, 3))

    def pool(self) -> None:
        extent = self.number(2, 4)
        kind = self.draw(st.sampled_from(["MaxPool", "AveragePool"]))
        counted = {"count_include_pad": 1} if kind == "AveragePool" else {}
        self.add(
            kind, kernel_shape=[extent] * 2, strides=[2, 2], pads=self.pads(extent - 2), **counted
        )
        self.at /= 2

    def padded(self) -> None:
        """Append a pad, then a convolution that uses it up, or a slice that leaves a shifted map.

        The slice cuts as much as was added, but from the opposite sides.
        """
        mode = self.draw(st.sampled_from(["constant", "edge", "reflect"]))
        before, behind = self.pads(2)[::2]
        self.add("Pad", [0, 0, before, before, 0, 0, behind, behind], mode=mode)
        if before == behind or self.draw(st.booleans()):
            self.convolve(3)
        else:
            self.add(
                "Slice",
                [behind, behind],
                [-before or 1 << 62] * 2,
                [2, 3],
            )

    def transposed(self) -> None:
        kernel = self.number(1, 4)
        window = {"pads": self.pads(max(kernel - 2, 0)), "output_padding": [max(2 - kernel, 0)] * 2}
        weight = taps(f"{len(self.nodes)}", self.channels, 2, kernel, kernel)
        self.add("ConvTranspose", weight, strides=[2, 2], **window)
        self.channels = 2
        self.at *= 2

    def shuffle(self) -> None:
        self.convolve(1, 4)
        self.add("DepthToSpace", blocksize=2, mode="CRD")
        self.channels = 1
        self.at *= 2

    def unshuffle(self) -> None:
        self.add("SpaceToDepth", blocksize=2)
        self.channels *= 4
        self.at /= 2

    def resize(self) -> None:
        mode = self.draw(st.sampled_from(["nearest", "linear"]))
        where = self.draw(st.sampled_from(["asymmetric", "half_pixel", "pytorch_half_pixel"]))
        self.add(
            "Resize",
            "",
            [1.0, 1.0, 2.0, 2.0],
            mode=mode,
            coordinate_transformation_mode=where,
        )
        self.at *= 2

    def join(self) -> None:
        """Concatenate an earlier tensor of the same size, if there is one."""
        if self.at in self.skips:
            name, channels = self.skips[self.at]
            self.add("Concat", name, axis=1)
            self.channels += channels
        self.skips[self.at] = self.tensor, self.channels

    def small(self) -> None:
        """Round and clip to small integers.

        Their sums are exact in any order, and a runtime chooses the order by the size.
        """
        self.add("Mul", 0.125).add("Floor").add("Clip", -255.0, 255.0)


@st.composite
def networks(draw: Any) -> onnx.ModelProto:
    """Draw a small network of operators that can be tiled, on integers."""
    builder = Builder(draw)
    parts = (
        Builder.conv,
        Builder.strided,
        Builder.pool,
        Builder.padded,
        Builder.transposed,
        Builder.shuffle,
        Builder.unshuffle,
        Builder.resize,
        Builder.join,
    )
    for part in draw(st.lists(st.sampled_from(parts), min_size=2, max_size=7)):
        grows = part in (Builder.transposed, Builder.shuffle, Builder.resize)
        if builder.channels <= 16 and not (grows and builder.at >= 2):
            part(builder)
            builder.small()
    return builder.model((1, builder.channels))
