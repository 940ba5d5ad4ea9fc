"""Encode an image in [0, 1] as the int8 planes that the integer core reads."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from beers_deploy.model.bank import SIDE_PX
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.graph import COARSE_MAX, PLANES_FRAC_BITS, QUARTER, STEP
from beers_deploy.quant.host_part.writer import HostWriter

ENCODED = "host_front.planes"
"""The tensor of the planes in float, before they are stored as uint8."""


@dataclass(frozen=True)
class BitSlices:
    """Encodes a digital number (DN) of 12 bits as several int8 planes.

    DN - middle = step * coarse + remainder. The first planes hold the coarse number, the next one
    the remainder, and the last one remainder / part, rounded. With the last plane the weights of a
    convolution have finer steps.

    Attributes:
        step: the number of DN of one coarse step.
        part: the divisor of the remainder in the last plane.
        middle: the DN that is encoded as 0.
        coarse_planes: the number of copies of the coarse plane. Two of them share the weights of a
            filter, which can then be twice as large as int8.
        margin_px: the number of pixels by which the image must at least be mirrored beyond its
            borders.
        signed: if True, the image is in [-1, 1] instead of [0, 1].
    """

    step: int = STEP
    part: int = QUARTER
    middle: int = 0
    coarse_planes: int = 1
    margin_px: int = 0
    signed: bool = False

    @property
    def lowest_dn(self) -> int:
        """The smallest digital number that can be encoded: 0, or -MAX_DN if signed."""
        return -MAX_DN if self.signed else 0

    @property
    def planes(self) -> int:
        """The number of int8 planes that each channel of the image becomes."""
        return self.coarse_planes + 2

    @property
    def limits(self) -> tuple[list[int], list[int]]:
        """The smallest and the largest integer of each plane of one channel, over all DN."""
        every_dn = np.arange(self.lowest_dn, MAX_DN + 1, dtype=np.float32)[None, None, None]
        planes = self.encode(every_dn / np.float32(MAX_DN))[0, :, 0]
        return planes.min(1).tolist(), planes.max(1).tolist()

    def encode(self, image: np.ndarray) -> np.ndarray:
        """Encode an image as planes.

        Args:
            image: (N, C, H, W) in shares of full scale. Values outside [0, 1], or outside [-1, 1]
                if `signed`, are clipped.

        Returns:
            Planes (N, planes C, H, W) int8. All channels of a plane come before the next plane.
        """
        dn = np.clip(np.rint(image * np.float32(MAX_DN)), self.lowest_dn, MAX_DN) - self.middle
        # Full scale rounds to 128 steps, one more than int8 holds, so the remainder holds more.
        coarse = np.minimum(np.rint(dn / self.step), COARSE_MAX)
        # dn = step coarse + remainder holds exactly, because all three are small integers.
        remainder = dn - self.step * coarse
        planes = [*[coarse] * self.coarse_planes, remainder, np.rint(remainder / self.part)]
        return np.concatenate(planes, axis=1).astype(np.int8)

    def write(self, w: HostWriter, image: str) -> None:
        """Write the ONNX nodes that encode an image, with the planes as the tensor ENCODED.

        Args:
            w: the writer that receives the nodes.
            image: the name of the image, a tensor (N, C, H, W) in shares of full scale.
        """
        max_dn = w.scalar("max_dn", MAX_DN)
        scaled = w.node("Mul", "host_front.scale", [image, max_dn])
        # ONNX's Round rounds ties to even as np.rint does, so the file agrees with `encode`.
        whole = w.node("Round", "host_front.round", [scaled])
        lowest = w.scalar("lowest_dn" if self.signed else "zero", self.lowest_dn)
        dn = w.node("Clip", "host_front.dn", [whole, lowest, max_dn])
        if self.middle:
            dn = w.node("Sub", "host_front.centred", [dn, w.scalar("middle", self.middle)])
        # Step and part are powers of two, so multiplying by the inverse is as exact as dividing.
        steps = w.node("Mul", "host_front.steps", [dn, w.scalar("one_step", 1 / self.step)])
        rounded = w.node("Round", "host_front.whole_steps", [steps])
        most = w.scalar("coarse_max", COARSE_MAX)
        coarse = w.node("Min", "host_front.coarse", [rounded, most])
        step = w.scalar("step", self.step)
        coarse_dn = w.node("Mul", "host_front.coarse_dn", [coarse, step])
        remainder = w.node("Sub", "host_front.remainder", [dn, coarse_dn])
        one_part = w.scalar("one_quarter", 1 / self.part)
        parts = w.node("Mul", "host_front.quarters", [remainder, one_part])
        part = w.node("Round", "host_front.quarter", [parts])
        w.node("Concat", ENCODED, [*[coarse] * self.coarse_planes, remainder, part], axis=1)

    def constants(self) -> dict[str, int]:
        """Return the constants that a kit's `host.py` needs to encode an image, by their names
        there.
        """
        return {
            "step": self.step,
            "part": self.part,
            "middle": self.middle,
            "coarse_planes": self.coarse_planes,
            "lowest_dn": self.lowest_dn,
        }


IMAGE_SLICES = BitSlices()
"""The encoding for a network that reads the image itself: 0 is encoded as 0, as its zero padding
is.
"""
BANK_SLICES = BitSlices(16, 2, 2048, 2, SIDE_PX // 2)
"""The encoding for a sensor's bank, whose filters sum to 0: around the middle of the range, the
steps are half as large. Zeros around the image would look like a black edge to the filters, so it
is mirrored.
"""


@dataclass(frozen=True)
class Direct:
    """Stores values that are int8 planes already: multiples of 1/128, such as the results of a
    sensor's filters.
    """

    planes: ClassVar[int] = 1
    margin_px: ClassVar[int] = 0
    limits: ClassVar[tuple[list[int], list[int]]] = [-128], [127]

    def encode(self, image: np.ndarray) -> np.ndarray:
        """Return the integers 128 v, int8, of values v (N, C, H, W) that are multiples of 1/128."""
        # These are multiples of 1/128 already: rounding removes float error only.
        return np.clip(np.rint(image * 2.0**PLANES_FRAC_BITS), -128, 127).astype(np.int8)

    def write(self, w: HostWriter, image: str) -> None:
        """Write the ONNX nodes that turn multiples of 1/128 into integers, as the tensor ENCODED.

        Args:
            w: the writer that receives the nodes.
            image: the name of the tensor of multiples of 1/128.
        """
        scaled = w.node(
            "Mul", "host_front.scale", [image, w.scalar("units", 2.0**PLANES_FRAC_BITS)]
        )
        w.node("Round", ENCODED, [scaled])

    def constants(self) -> None:
        """Return None, because no kit has a core without a sensor's filters in front of it."""
        return


InputEncoding = BitSlices | Direct
