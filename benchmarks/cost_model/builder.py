"""Build a network layer by layer: shapes and bytes of weights, without values.

Every method appends one operation and returns its result. The DPU's compiler fuses batch norms and
activations into the convolution before them, so they are left out.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from beers_deploy.dpu.graph import Kind, Operation, Shape, SizedGraph
from beers_deploy.quant.onnx.window import Window

Size = int | tuple[int, int]
"""One number for both sides, or (height, width)."""

NOTHING: Mapping[str, object] = MappingProxyType({})


@dataclass(frozen=True)
class Tensor:
    """A result: its name and its shape (C, H, W)."""

    name: str
    shape: Shape

    @property
    def channels(self) -> int:
        """The number of channels."""
        return self.shape[0]


@dataclass(frozen=True)
class Written:
    """A network, and the number of bytes of each result that the host reads for one image."""

    network: SizedGraph
    read_bytes: Mapping[str, int]


class Builder:
    """A builder that appends operations to a network."""

    def __init__(self, height: int, width: int, channels: int = 3) -> None:
        self.image = Tensor("image", (channels, height, width))
        self._operations: list[Operation] = []
        self._read_bytes: dict[str, int] = {}

    def conv(
        self,
        x: Tensor,
        channels: int,
        kernel: Size = 3,
        stride: Size = 1,
        *,
        d: int = 1,
        valid: int = 0,
    ) -> Tensor:
        """Append a convolution.

        Args:
            x: the input.
            channels: of its result.
            kernel: its size in pixels.
            stride: in pixels.
            d: dilation.
            valid: pads nothing if 1; otherwise the result has size / stride, rounded up.
        """
        sides, window, size = _slide(x.shape, kernel, stride, valid, d)
        weights = channels * x.channels * math.prod(sides)
        return self._append("Conv", "conv", (x,), (channels, *size), sides, window, weights)

    def depthwise(
        self, x: Tensor, kernel: Size = 3, stride: Size = 1, *, d: int = 1, m: int = 1
    ) -> Tensor:
        """Append a depthwise convolution into `m` times the channels; `d` is the dilation."""
        sides, window, size = _slide(x.shape, kernel, stride, 0, d)
        channels = x.channels * m
        weights = channels * math.prod(sides)
        return self._append("Conv", "depthwise", (x,), (channels, *size), sides, window, weights)

    def transposed(self, x: Tensor, channels: int, kernel: int, stride: int) -> Tensor:
        """Append a transposed convolution that enlarges by its stride."""
        cut = max(kernel - stride, 0)
        pads = (cut // 2, cut // 2, cut - cut // 2, cut - cut // 2)
        window = Window((stride, stride), pads)
        shape = (channels, x.shape[1] * stride, x.shape[2] * stride)
        weights = channels * x.channels * kernel**2
        return self._append(
            "ConvTranspose", "transposed", (x,), shape, (kernel, kernel), window, weights
        )

    def pool(
        self,
        x: Tensor,
        kernel: Size,
        stride: Size,
        *,
        valid: int = 0,
        ceil: int = 0,
        op_type: str = "MaxPool",
    ) -> Tensor:
        """Append a pooling by maximum or mean. With `ceil`, windows that only begin inside the
        image count too.
        """
        # Pad behind the image by as much as a stride may lose.
        behind = [(side - 1) * ceil for side in _pair(stride)]
        padded = (x.channels, x.shape[1] + behind[0], x.shape[2] + behind[1])
        sides, window, size = _slide(padded, kernel, stride, valid or ceil, 1)
        if ceil:
            window = replace(window, pads=(0, 0, behind[0], behind[1]))
        return self._append(op_type, "pool", (x,), (x.channels, *size), sides, window)

    def global_mean(self, x: Tensor) -> Tensor:
        """Append the mean of each channel."""
        shape = (x.channels, 1, 1)
        return self._append("GlobalAveragePool", "pool", (x,), shape, x.shape[1:])

    def add(self, x: Tensor, *others: Tensor) -> Tensor:
        """Append sums of results of one shape."""
        for other in others:
            _require_same(x.shape, other.shape)
            x = self._append("Add", "add", (x, other), x.shape)
        return x

    def concat(self, x: Tensor, *others: Tensor) -> Tensor:
        """Append a concatenation of channels."""
        for other in others:
            _require_same(x.shape[1:], other.shape[1:])
        channels = x.channels + sum(other.channels for other in others)
        return self._append("Concat", "concat", (x, *others), (channels, *x.shape[1:]))

    def resize(self, x: Tensor, to: int | Tensor = 2, *, linear: bool = False) -> Tensor:
        """Append a resize by an integer factor, or to the size of another result: nearest
        neighbour, or bilinear.
        """
        height, width = (
            to.shape[1:] if isinstance(to, Tensor) else (x.shape[1] * to, x.shape[2] * to)
        )
        corners = {"mode": "linear", "coordinate_transformation_mode": "asymmetric"}
        attributes = corners if linear else {"mode": "nearest"}
        return self._append(
            "Resize", "resize", (x,), (x.channels, height, width), attributes=attributes
        )

    def shuffle(self, x: Tensor, block: int = 2) -> Tensor:
        """Append a pixel shuffle: channels become blocks of pixels."""
        shape = (x.channels // block**2, x.shape[1] * block, x.shape[2] * block)
        return self._append("DepthToSpace", "pixel shuffle", (x,), shape)

    def unshuffle(self, x: Tensor, block: int = 2) -> Tensor:
        """Append the inverse of a pixel shuffle (`reorg` of YOLOv2, Focus of YOLOX)."""
        shape = (x.channels * block**2, x.shape[1] // block, x.shape[2] // block)
        return self._append("SpaceToDepth", "pixel shuffle", (x,), shape)

    def out(self, x: Tensor, channels: int | None = None) -> Tensor:
        """Make a result one of the network's; the host reads `channels` of it,
        all if not stated.
        """
        channels_read = x.channels if channels is None else channels
        self._read_bytes[x.name] = channels_read * x.shape[1] * x.shape[2]
        return x

    def written(self, last: Tensor) -> Written:
        """Return the network; `last` is its output if `out` was never called."""
        if not self._read_bytes:
            self.out(last)
        names = tuple(self._read_bytes)
        net = SizedGraph(
            tuple(self._operations), {self.image.name: self.image.shape}, names, quantized=False
        )
        return Written(net, self._read_bytes)

    def _append(
        self,
        op_type: str,
        kind: Kind,
        inputs: tuple[Tensor, ...],
        shape: Shape,
        kernel: tuple[int, int] = (1, 1),
        window: Window = Window(),  # noqa: B008 - frozen
        weights: int = 0,
        attributes: Mapping[str, object] = NOTHING,
    ) -> Tensor:
        result = Tensor(f"{op_type.lower()}{len(self._operations)}", shape)
        self._operations.append(
            Operation(
                name=result.name,
                op_type=op_type,
                kind=kind,
                inputs=tuple(tensor.name for tensor in inputs),
                outputs=(result.name,),
                in_shapes=tuple(tensor.shape for tensor in inputs),
                out_shape=shape,
                kernel=kernel,
                window=window,
                channels=(inputs[0].channels, shape[0]),
                weight_bytes=weights,
                attributes=attributes,
                follows=next(
                    (op.kind for op in reversed(self._operations) if inputs[0].name in op.outputs),
                    None,
                ),
            )
        )
        return result


def _require_same(one: tuple[int, ...], other: tuple[int, ...]) -> None:
    if one != other:
        raise ValueError(f"shapes differ: {one} and {other}")


def _pair(size: Size) -> tuple[int, int]:
    return size if isinstance(size, tuple) else (size, size)


def _slide(
    shape: Shape, kernel: Size, stride: Size, valid: int, dilation: int
) -> tuple[tuple[int, int], Window, tuple[int, int]]:
    """Return the sides of a kernel, its window, and the size of the result: size / stride rounded
    up, of the whole input or of the positions where a window fits into it.
    """
    sides = _pair(kernel)
    strides = _pair(stride)
    reach = [(side - 1) * dilation for side in sides]
    rows, columns = (0 if valid else px // 2 for px in reach)
    window = Window(strides, (rows, columns, rows, columns), (dilation, dilation))
    height, width = (
        -(-(side - px * valid) // step)
        for side, px, step in zip(shape[1:], reach, strides, strict=True)
    )
    return sides, window, (height, width)
