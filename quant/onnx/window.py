"""Define how a window moves over an image, and compute the size of its result along each axis."""

from dataclasses import dataclass, replace

Sides = tuple[int, int]
"""Rows and columns."""


@dataclass(frozen=True)
class Window:
    """The motion of a convolution or a pool over the image, in ONNX's terms.

    Axis 0 means the rows, axis 1 the columns. The size of the window itself is the `kernel` of the
    operation, because a convolution's weights have it.

    Attributes:
        strides: the strides of rows and columns.
        pads: top, left, bottom, right.
        dilations: the dilations of rows and columns.
    """

    strides: Sides = (1, 1)
    pads: tuple[int, int, int, int] = (0, 0, 0, 0)
    dilations: Sides = (1, 1)

    def extent(self, axis: int, kernel: int) -> int:
        """Return the number of pixels from the first to the last that the window reads along an
        axis.

        Args:
            axis: 0 for the rows, 1 for the columns.
            kernel: the number of pixels that the window reads along the axis.
        """
        return (kernel - 1) * self.dilations[axis] + 1

    def output_size(self, axis: int, kernel: int, size: int, ceil: bool = False) -> int:
        """Return the number of positions of the window along an axis, which is the size of the
        result.

        Args:
            axis: 0 for the rows, 1 for the columns.
            kernel: the number of pixels that the window reads along the axis.
            size: the number of pixels of the map along the axis.
            ceil: True if the last window may reach beyond the padding (ONNX's `ceil_mode`).
        """
        stride = self.strides[axis]
        before = self.pads[axis]
        room = size + before + self.pads[axis + 2] - self.extent(axis, kernel)
        if not ceil:
            return room // stride + 1
        # ONNX lets the last window reach beyond the padding, but it must begin on the map or on the
        # padding before it.
        return min(-(-room // stride), (size + before - 1) // stride) + 1

    def transposed_size(self, axis: int, kernel: int, size: int) -> int:
        """Return the size of a transposed convolution's result along an axis, without ONNX's
        `output_padding`.

        Args:
            axis: 0 for the rows, 1 for the columns.
            kernel: the number of weights along the axis.
            size: the number of pixels of the map that is read.
        """
        beyond = self.extent(axis, kernel) - self.pads[axis] - self.pads[axis + 2]
        return self.strides[axis] * (size - 1) + beyond

    def padded(self, auto_pad: str, kernel: Sides, size: Sides) -> "Window":
        """Return the window with the pads that ONNX's attribute `auto_pad` means for a map of one
        size.

        With SAME_UPPER and SAME_LOWER the window has size / stride positions, rounded up. With
        VALID nothing is padded.

        Args:
            auto_pad: "SAME_UPPER", "SAME_LOWER" or "VALID".
            kernel: rows and columns of the kernel.
            size: rows and columns of the map.
        """
        total = [0, 0]
        if auto_pad != "VALID":
            for axis, stride in enumerate(self.strides):
                beyond = self.extent(axis, kernel[axis]) - stride
                total[axis] = max(beyond + -size[axis] % stride, 0)
        less = [t // 2 for t in total]
        more = [t - t // 2 for t in total]
        # If the number is odd, SAME_LOWER puts the extra pixel before the map, SAME_UPPER behind
        # it.
        begin, end = (more, less) if auto_pad == "SAME_LOWER" else (less, more)
        return replace(self, pads=(begin[0], begin[1], end[0], end[1]))
