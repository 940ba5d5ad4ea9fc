"""A network written down layer by layer: shapes and bytes of weights, no values.

Every method appends one operation and returns its result. Batch norms and activations right behind a convolution are
fused into it by the DPU's compiler, so they are not written down.
"""

from collections.abc import Callable
from dataclasses import dataclass

from deploy.dpu.graph import Kind, Network, Operation, Shape, Window

Size = int | tuple[int, int]
"""One number for both sides, or (height, width)."""


@dataclass(frozen=True)
class Tensor:
    """A result: its name and its shape (C, H, W)."""

    name: str
    shape: Shape

    @property
    def channels(self) -> int:
        """The C of its shape."""
        return self.shape[0]


class Builder:
    """A network under construction; `padding` is that of layers which do not state one."""

    def __init__(self, height: int, width: int, channels: int = 3) -> None:
        self.image = Tensor("image", (channels, height, width))
        self._operations: list[Operation] = []

    def conv(
        self,
        x: Tensor,
        channels: int,
        kernel: Size = 3,
        stride: int = 1,
        *,
        padding: str = "same",
        dilation: int = 1,
    ) -> Tensor:
        """A convolution; `padding` is "same" (size / stride, rounded up) or "valid"."""
        window = _window(kernel, stride, padding, dilation)
        weights = channels * x.channels * window.kernel[0] * window.kernel[1]
        return self._append("Conv", "conv", (x,), (channels, *_slide(x.shape, window, padding)), window, weights)

    def depthwise(self, x: Tensor, kernel: Size = 3, stride: int = 1, *, multiplier: int = 1) -> Tensor:
        """Each channel by itself, or into `multiplier` channels."""
        window = _window(kernel, stride, "same", 1)
        channels = x.channels * multiplier
        weights = channels * window.kernel[0] * window.kernel[1]
        shape = (channels, *_slide(x.shape, window, "same"))
        return self._append("Conv", "depthwise", (x,), shape, window, weights)

    def scale(self, x: Tensor) -> Tensor:
        """A batch norm that no convolution before it can take in: a 1 x 1 depthwise convolution."""
        return self.depthwise(x, 1)

    def transposed(self, x: Tensor, channels: int, kernel: int, stride: int) -> Tensor:
        """A transposed convolution that enlarges by its stride."""
        window = _window(kernel, stride, "same", 1)
        shape = (channels, x.shape[1] * stride, x.shape[2] * stride)
        return self._append("ConvTranspose", "transposed", (x,), shape, window, channels * x.channels * kernel**2)

    def pool(self, x: Tensor, kernel: int, stride: int, *, padding: str = "same", average: bool = False) -> Tensor:
        """The largest of a window, or its mean."""
        window = _window(kernel, stride, padding, 1)
        shape = (x.channels, *_slide(x.shape, window, padding))
        return self._append("AveragePool" if average else "MaxPool", "pool", (x,), shape, window)

    def global_pool(self, x: Tensor) -> Tensor:
        """The mean of each channel."""
        window = Window(kernel=x.shape[1:])
        return self._append("GlobalAveragePool", "pool", (x,), (x.channels, 1, 1), window)

    def add(self, x: Tensor, other: Tensor) -> Tensor:
        """The sum of two results of one shape."""
        return self._append("Add", "add", (x, other), x.shape)

    def concat(self, *parts: Tensor) -> Tensor:
        """Channels of several results one behind the other."""
        channels = sum(part.channels for part in parts)
        return self._append("Concat", "concat", parts, (channels, *parts[0].shape[1:]))

    def upsample(self, x: Tensor, factor: int = 2) -> Tensor:
        """Nearest neighbour."""
        shape = (x.channels, x.shape[1] * factor, x.shape[2] * factor)
        return self._append("Resize", "resize", (x,), shape)

    def unshuffle(self, x: Tensor, block: int = 2) -> Tensor:
        """Blocks of pixels become channels (the `reorg` of YOLOv2, the Focus of YOLOX)."""
        shape = (x.channels * block**2, x.shape[1] // block, x.shape[2] // block)
        return self._append("SpaceToDepth", "other", (x,), shape)

    def repeat(self, x: Tensor, times: int, block: Callable[[Tensor], Tensor]) -> Tensor:
        """The same block several times over."""
        for _ in range(times):
            x = block(x)
        return x

    def network(self, *outputs: Tensor) -> Network:
        """What was written down."""
        names = tuple(tensor.name for tensor in outputs)
        return Network(tuple(self._operations), {self.image.name: self.image.shape}, names, quantised=False)

    def _append(
        self,
        op_type: str,
        kind: Kind,
        inputs: tuple[Tensor, ...],
        shape: Shape,
        window: Window = Window(),  # noqa: B008 - frozen
        weights: int = 0,
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
                window=window,
                channels=(inputs[0].channels, shape[0]),
                weight_bytes=weights,
            )
        )
        return result


def _window(kernel: Size, stride: int, padding: str, dilation: int) -> Window:
    height, width = kernel if isinstance(kernel, tuple) else (kernel, kernel)
    rows, columns = ((height - 1) * dilation // 2, (width - 1) * dilation // 2) if padding == "same" else (0, 0)
    pads = (rows, columns, rows, columns)
    return Window((height, width), (stride, stride), pads, (dilation, dilation))


def _slide(shape: Shape, window: Window, padding: str) -> tuple[int, int]:
    """Size / stride rounded up, of the whole input or of the positions where a window fits into it."""
    lost = [(k - 1) * d if padding == "valid" else 0 for k, d in zip(window.kernel, window.dilation, strict=True)]
    height, width = (-(-(s - n) // t) for s, n, t in zip(shape[1:], lost, window.stride, strict=True))
    return height, width
