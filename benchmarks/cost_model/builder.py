"""A network written down layer by layer: shapes and bytes of weights, no values.

Every method appends one operation and returns its result. Batch norms and activations right behind
a convolution are fused into it by the DPU's compiler, so they are not written down.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from beers_deploy.dpu.graph import Operation, SizedGraph
from beers_deploy.dpu.shapes import Kind, Shape
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
        """The C of its shape."""
        return self.shape[0]


@dataclass(frozen=True)
class Written:
    """A network that was written down, and how many bytes of which results the host reads for one
    image.
    """

    network: SizedGraph
    read_bytes: Mapping[str, int]


class Builder:
    """A network under construction."""

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
        g: int = 1,
        valid: int = 0,
    ) -> Tensor:
        """A convolution.

        Args:
            x: what it reads.
            channels: of its result.
            kernel: its size in pixels.
            stride: in pixels.
            d: dilation.
            g: groups of channels that do not see one another.
            valid: pads nothing if 1; otherwise the result has size / stride, rounded up.
        """
        if x.channels % g or channels % g:
            raise ValueError(f"{x.channels} to {channels} channels are no {g} equal groups")
        sides = _pair(kernel)
        window = _window(sides, stride, valid, d)
        weights = channels * (x.channels // g) * sides[0] * sides[1]
        shape = (channels, *_slide(x.shape, sides, window, valid))
        return self._append(
            "Conv", "grouped conv" if g > 1 else "conv", (x,), shape, sides, window, weights
        )

    def depthwise(
        self, x: Tensor, kernel: Size = 3, stride: Size = 1, *, d: int = 1, m: int = 1
    ) -> Tensor:
        """Each channel by itself, or into `m` channels; `d` is the dilation."""
        sides = _pair(kernel)
        window = _window(sides, stride, 0, d)
        channels = x.channels * m
        shape = (channels, *_slide(x.shape, sides, window, 0))
        weights = channels * sides[0] * sides[1]
        return self._append("Conv", "depthwise", (x,), shape, sides, window, weights)

    def transposed(self, x: Tensor, channels: int, kernel: int, stride: int) -> Tensor:
        """A transposed convolution that enlarges by its stride."""
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
        """The largest value of a window, or its mean; `ceil` counts windows that only begin inside
        a bare image.
        """
        sides = _pair(kernel)
        window = _window(sides, stride, valid or ceil, 1)
        shape = x.shape
        # Pad behind the image by as much as a stride may lose.
        if ceil:
            behind = window.strides[0] - 1, window.strides[1] - 1
            window = replace(window, pads=(0, 0, *behind))
            shape = (x.channels, x.shape[1] + behind[0], x.shape[2] + behind[1])
        result = (x.channels, *_slide(shape, sides, window, valid or ceil))
        return self._append(op_type, "pool", (x,), result, sides, window)

    def global_mean(self, x: Tensor) -> Tensor:
        """The mean of each channel."""
        shape = (x.channels, 1, 1)
        return self._append("GlobalAveragePool", "pool", (x,), shape, x.shape[1:])

    def add(self, x: Tensor, *others: Tensor) -> Tensor:
        """The sum of results of one shape."""
        for other in others:
            _require_same(x.shape, other.shape)
            x = self._append("Add", "add", (x, other), x.shape)
        return x

    def mul(self, x: Tensor, other: Tensor) -> Tensor:
        """The product of two results of one shape, or of each channel with a number of its own."""
        per_channel = other.shape[1:] == (1, 1)
        _require_same(x.shape, (other.channels, *x.shape[1:]) if per_channel else other.shape)
        return self._append("Mul", "mul", (x, other), x.shape)

    def concat(self, x: Tensor, *others: Tensor) -> Tensor:
        """Channels of several results one behind the other."""
        for other in others:
            _require_same(x.shape[1:], other.shape[1:])
        channels = x.channels + sum(other.channels for other in others)
        return self._append("Concat", "concat", (x, *others), (channels, *x.shape[1:]))

    def slice(self, x: Tensor, first: int, count: int) -> Tensor:
        """`count` channels from `first` on, counted from 0."""
        if first + count > x.channels:
            raise ValueError(f"channels {first} to {first + count - 1} of {x.channels}")
        return self._append("Slice", "other", (x,), (count, *x.shape[1:]))

    def resize(self, x: Tensor, to: int | Tensor = 2, *, linear: bool = False) -> Tensor:
        """Larger by a whole factor, or as large as another result: nearest
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
        """Channels become blocks of pixels (pixel shuffle)."""
        if x.channels % block**2:
            raise ValueError(f"{x.channels} channels are no multiple of {block**2}")
        shape = (x.channels // block**2, x.shape[1] * block, x.shape[2] * block)
        return self._append("DepthToSpace", "pixel shuffle", (x,), shape)

    def unshuffle(self, x: Tensor, block: int = 2) -> Tensor:
        """Blocks of pixels become channels (the `reorg` of YOLOv2, the Focus of YOLOX)."""
        shape = (x.channels * block**2, x.shape[1] // block, x.shape[2] // block)
        return self._append("SpaceToDepth", "pixel shuffle", (x,), shape)

    def activation(self, x: Tensor, op_type: str) -> Tensor:
        """One that no convolution takes in."""
        return self._append(op_type, "activation", (x,), x.shape)

    def out(self, x: Tensor, channels: int | None = None) -> Tensor:
        """Make a result one of the network's; the host reads `channels` of it,
        all if not stated.
        """
        channels_in = x.channels if channels is None else channels
        if channels_in > x.channels:
            raise ValueError(f"{channels_in} of {x.channels} channels read")
        self._read_bytes[x.name] = channels_in * x.shape[1] * x.shape[2]
        return x

    def written(self, last: Tensor) -> Written:
        """What was written down; `last` is the result if there was no other."""
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
        if min(shape) < 1:
            raise ValueError(f"a result without pixels: {shape}")
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


def _window(kernel: tuple[int, int], stride: Size, valid: int, dilation: int) -> Window:
    height, width = kernel
    rows, columns = (0, 0) if valid else ((height - 1) * dilation // 2, (width - 1) * dilation // 2)
    return Window(_pair(stride), (rows, columns, rows, columns), (dilation, dilation))


def _pair(size: Size) -> tuple[int, int]:
    return size if isinstance(size, tuple) else (size, size)


def _slide(shape: Shape, kernel: tuple[int, int], window: Window, valid: int) -> tuple[int, int]:
    """Size / stride rounded up, of the whole input or of the positions where a
    window fits into it.
    """
    border_px = [(k - 1) * d if valid else 0 for k, d in zip(kernel, window.dilations, strict=True)]
    height, width = (
        -(-(s - n) // t) for s, n, t in zip(shape[1:], border_px, window.strides, strict=True)
    )
    return height, width
