"""Combine the copies that the integer core writes of each channel to one value.

int8 has 256 steps. A copy that is finer by `GAIN` has smaller rounding errors but a smaller range,
so a coarse copy is used where it is clipped. The channels of a result are ordered by copy.
"""

from dataclasses import dataclass

import numpy as np

from beers_deploy.model.bank import UNIT_STEPS, WIDE
from beers_deploy.quant.host_part.writer import HostWriter

GAIN = 8
"""The ratio of a coarse copy's step to that of a fine copy."""
FINE_MAX = 126
"""The largest valid integer of a fine copy, because 127 may be a clipped value."""
ANALYTIC_COPIES = 4
"""The number of copies of the analytic restoration in the result of a network behind a bank."""
DECODED = "host_back.correction"
"""The name of the tensor of decoded values."""

Offsets = tuple[tuple[float, ...], ...]
Constants = dict[str, object]


@dataclass(frozen=True)
class Plain:
    """Decodes a result that the core writes once. The decodings of several copies derive from this
    class.

    Attributes:
        offsets: (windows, C) the numbers that the host adds to each of the last copies, in the
            result's unit; empty if it adds none.
        finer_bits: the number of fractional bits that a fine copy has in addition to those of a
            single copy.
    """

    offsets: Offsets = ()
    finer_bits = 0

    @property
    def gains(self) -> tuple[int, ...]:
        """The factor by which the host multiplies each copy that the last convolution writes, in
        order.
        """
        return (1,)

    @property
    def copies(self) -> int:
        """The number of times that the core writes each channel of the result."""
        return len(self.gains)

    def never_replaced(self, outputs: int) -> slice:  # noqa: ARG002 - other decodings use it
        """Return the channels of the core's result that no other copy replaces where they are
        clipped.

        A clipped value there is lost, so that the check for saturation counts it.

        Args:
            outputs: the number of decoded channels.

        Returns:
            A slice of the channels.
        """
        return slice(None)

    def with_bias_errors(self, errors: np.ndarray) -> "Plain":  # noqa: ARG002 - as above
        """Return a decoding that adds the rounding errors of the last biases to its offsets, if it
        has offsets.

        Args:
            errors: (copies C,) the float bias less the int8 bias of each channel that the core
                writes, in the result's unit.
        """
        return self

    def decode(self, result: np.ndarray, scale: float) -> np.ndarray:  # noqa: ARG002 - as above
        """Return the result unchanged, because the core writes each channel once.

        Decodings of several copies combine the copies of each channel to one value here.

        Args:
            result: (N, copies C, H, W) float32, multiples of `scale`.
            scale: the real value of the integer 1 of the result.

        Returns:
            The decoded values, (N, C, H, W) float32.
        """
        return result

    def write(self, w: HostWriter, feeds: list[str], outputs: int, scale: float) -> None:  # noqa: ARG002 - as above
        """Write the ONNX nodes that decode a result as the tensor DECODED.

        Args:
            w: the writer that receives the nodes.
            feeds: the names of three tensors: the result in uint8, its scale and its zero point.
            outputs: the number of decoded channels.
            scale: the number in the second tensor. Decodings of several copies compute their limits
                from it.
        """
        w.node("DequantizeLinear", DECODED, feeds)

    def constants(self, scale: float) -> Constants:  # noqa: ARG002 - as above
        """Return the constants that a kit's `host.py` needs to decode a result, by their names
        there.

        Args:
            scale: the real value of the integer 1 of the result.
        """
        return {"decoding": "plain"}


OutputDecoding = Plain


@dataclass(frozen=True)
class DualRange(Plain):
    """A decoding of two copies of each channel: a fine one for nearly all pixels, and a coarse one
    for the strongest edges, where the fine one is clipped.
    """

    finer_bits = 1
    _chosen = DECODED

    @property
    def gains(self) -> tuple[int, ...]:
        """The factors by which the host multiplies the fine and the coarse copy: 1 and GAIN."""
        return (1, GAIN)

    def never_replaced(self, outputs: int) -> slice:
        """Return all channels behind the fine copy, which is the only one that another copy
        replaces.
        """
        return slice(outputs, None)

    def decode(self, result: np.ndarray, scale: float) -> np.ndarray:
        """Return the fine copy where it is not clipped, else the coarse one.

        Args:
            result: (N, 2 C, H, W) float32, multiples of `scale`: all fine copies, then all coarse
                ones.
            scale: the real value of the integer 1 of the result.

        Returns:
            The decoded values, (N, C, H, W) float32.
        """
        fine, coarse = np.split(result, self.copies, axis=1)
        return _in_dual_range(fine, coarse, scale)

    def write(self, w: HostWriter, feeds: list[str], outputs: int, scale: float) -> None:
        """Write the nodes that choose the fine or the coarse copy; for the arguments see
        `Plain.write`.
        """
        both = w.node("DequantizeLinear", "host_back.both", feeds)
        name = "one_each" if outputs == 1 else "channels_each"
        analytic = [f"host_back.analytic_{k}" for k in range(self.copies - 2)]
        names = ["host_back.fine", "host_back.coarse", *analytic]
        w.split(both, w.constant(name, np.full(self.copies, outputs)), names)
        wide = w.node("Mul", "host_back.wide", [names[1], w.scalar("gain", GAIN)])
        size = w.node("Abs", "host_back.size", names[:1])
        limit = w.scalar("fine_max", _fine_limit(scale))
        fits = w.node("LessOrEqual", "host_back.fits", [size, limit])
        w.node("Where", self._chosen, [fits, names[0], wide])

    def constants(self, scale: float) -> Constants:
        """Return the constants of a kit's `host.py`: the largest valid value of the fine copy, and
        GAIN.

        Args:
            scale: the real value of the integer 1 of the result.
        """
        return {"decoding": "dual range", "fine_max": _fine_limit(scale), "gain": GAIN}


@dataclass(frozen=True)
class OffsetWindows(Plain):
    """A decoding of one coarse copy and several fine ones, each of which covers a part of the
    result's range.

    Such a part is called a window. The core writes a fine copy less the middle of its window, and
    the host adds the middle again: the copy's offset.
    """

    finer_bits = GAIN.bit_length() - 1

    @property
    def gains(self) -> tuple[int, ...]:
        """The factors by which the host multiplies each copy: GAIN for the coarse one, which comes
        first, then 1.
        """
        return (GAIN, *[1] * len(self.offsets))

    def never_replaced(self, outputs: int) -> slice:
        """Return the channels of the coarse copy, which come first."""
        return slice(outputs)

    def with_bias_errors(self, errors: np.ndarray) -> "OffsetWindows":
        """Return a decoding whose offsets include the rounding errors of the fine copies' biases.

        Args:
            errors: (copies C,) the float bias less the int8 bias of each channel that the core
                writes, in the result's unit.
        """
        # The coarse copy comes first, and the host adds no offset to it.
        fine = errors.reshape(self.copies, -1)[1:]
        return OffsetWindows(tuple(map(tuple, (np.array(self.offsets) + fine).tolist())))

    def decode(self, result: np.ndarray, scale: float) -> np.ndarray:
        """Combine the copies of each channel to one value.

        A value comes from the last window whose copy is not clipped, plus the window's offset. If
        all are clipped, it comes from the coarse copy.

        Args:
            result: (N, copies C, H, W) float32, multiples of `scale`: the coarse copy of all
                channels, then the windows.
            scale: the real value of the integer 1 of the result.

        Returns:
            The decoded values, (N, C, H, W) float32.
        """
        coarse, *windows = np.split(result, self.copies, axis=1)
        value = coarse * np.float32(GAIN)
        for window, offset in zip(windows, np.array(self.offsets, np.float32), strict=True):
            value = np.where(_is_fine(window, scale), window + offset[:, None, None], value)
        return value

    def write(self, w: HostWriter, feeds: list[str], outputs: int, scale: float) -> None:
        """Write the nodes that choose the last window which holds a value; for the arguments see
        `Plain.write`.
        """
        every = w.node("DequantizeLinear", "host_back.all", feeds)
        names = [f"host_back.window_{k}" for k in range(self.copies)]
        sizes = w.constant("channels_each", np.full(self.copies, outputs))
        w.split(every, sizes, names)
        value = w.node("Mul", "host_back.wide", [names[0], w.scalar("gain", GAIN)])
        limit = w.scalar("fine_max", _fine_limit(scale))
        for k, (name, offset) in enumerate(zip(names[1:], self.offsets, strict=True)):
            added = w.constant(f"offset_{k}", np.array(offset, np.float32)[None, :, None, None])
            size = w.node("Abs", f"{name}.size", [name])
            inside = w.node("LessOrEqual", f"{name}.inside", [size, limit])
            moved = w.node("Add", f"{name}.value", [name, added])
            result = DECODED if k + 1 == len(self.offsets) else f"{name}.chosen"
            value = w.node("Where", result, [inside, moved, value])

    def constants(self, scale: float) -> Constants:
        """Return the constants of a kit's `host.py`: the largest valid value of a fine copy, GAIN
        and the offsets.

        Args:
            scale: the real value of the integer 1 of the result.
        """
        return {
            "decoding": "offset windows",
            "fine_max": _fine_limit(scale),
            "gain": GAIN,
            "offsets": self.offsets,
        }


@dataclass(frozen=True)
class BankSum(DualRange):
    """A decoding for a network behind a sensor's filters: its correction plus the analytic
    restoration.

    The analytic restoration is the one that the filters compute in closed form (`model.bank`). The
    core writes it in ANALYTIC_COPIES copies, behind a fine and a coarse copy of the correction.

    Attributes:
        coarse_copies: 1 if the last analytic copy is coarser by `WIDE`, for values at which the
            others are clipped, else 0.
    """

    coarse_copies: int = 0
    _chosen = "host_back.chosen"

    @property
    def copies(self) -> int:
        """The number of copies of each channel that the core writes: two of the correction, then
        the analytic ones.
        """
        return len(self.gains) + ANALYTIC_COPIES

    @property
    def fine_copies(self) -> int:
        """The number of fine copies of the analytic restoration."""
        return ANALYTIC_COPIES - self.coarse_copies

    def _fine_gain(self, scale: float) -> float:
        """Return the factor of the sum of the fine analytic copies."""
        # The copies have steps of their own, whatever scale the core states for its result.
        return 1 / (UNIT_STEPS * self.fine_copies * scale)

    def _coarse_gain(self, scale: float) -> float:
        """Return the factor of the coarse analytic copy; 0 if there is none."""
        return self.coarse_copies * WIDE / (UNIT_STEPS * scale)

    def decode(self, result: np.ndarray, scale: float) -> np.ndarray:
        """Return the sum of the correction and the analytic restoration.

        The correction comes from its fine copy, or from the coarse one where that is clipped. The
        analytic restoration is the sum of its fine copies, or the coarse copy where these are
        clipped.

        Args:
            result: (N, copies C, H, W) float32, multiples of `scale`: fine and coarse correction,
                then the analytic copies.
            scale: the real value of the integer 1 of the result.

        Returns:
            The sum, (N, C, H, W) float32.
        """
        fine, coarse, *analytic = np.split(result, self.copies, axis=1)
        fine_sum = np.sum(analytic[: self.fine_copies], 0) * np.float32(self._fine_gain(scale))
        if self.coarse_copies:
            # The fine copies differ by at most one step, so checking one of them suffices.
            coarse_value = analytic[-1] * np.float32(self._coarse_gain(scale))
            fine_sum = np.where(_is_fine(analytic[0], scale), fine_sum, coarse_value)
        return np.asarray(_in_dual_range(fine, coarse, scale) + fine_sum)

    def write(self, w: HostWriter, feeds: list[str], outputs: int, scale: float) -> None:
        """Write the nodes that decode correction and analytic restoration, and add both; for the
        arguments see `Plain.write`.
        """
        super().write(w, feeds, outputs, scale)
        analytic = [f"host_back.analytic_{k}" for k in range(ANALYTIC_COPIES)]
        fine_sum = w.node("Sum", "host_back.analytic", analytic[: self.fine_copies])
        gain = w.scalar("analytic_gain", self._fine_gain(scale))
        added = w.node("Mul", "host_back.added", [fine_sum, gain])
        if self.coarse_copies:
            size = w.node("Abs", "host_back.analytic_size", [analytic[0]])
            limit = w.scalar("analytic_max", _fine_limit(scale))
            fits = w.node("LessOrEqual", "host_back.analytic_fits", [size, limit])
            coarse_gain = w.scalar("coarse_gain", self._coarse_gain(scale))
            far = w.node("Mul", "host_back.far", [analytic[-1], coarse_gain])
            added = w.node("Where", "host_back.reached", [fits, added, far])
        w.node("Add", DECODED, [self._chosen, added])

    def constants(self, scale: float) -> Constants:
        """Return the constants of a kit's `host.py`: those of `DualRange`, and the factors of the
        analytic copies.

        Args:
            scale: the real value of the integer 1 of the result.
        """
        return {
            **super().constants(scale),
            "decoding": "bank sum",
            "fine_copies": self.fine_copies,
            "fine_gain": self._fine_gain(scale),
            "coarse_gain": self._coarse_gain(scale),
        }


def _fine_limit(scale: float) -> float:
    """Return the largest valid value of a fine copy, plus half a unit to tolerate float errors."""
    return (FINE_MAX + 0.5) * scale


def _is_fine(copy: np.ndarray, scale: float) -> np.ndarray:
    """Return where a fine copy is not clipped."""
    return np.asarray(np.abs(copy) <= np.float32(_fine_limit(scale)))


def _in_dual_range(fine: np.ndarray, coarse: np.ndarray, scale: float) -> np.ndarray:
    """Choose the fine copy where it is not clipped, else the coarse one."""
    return np.where(_is_fine(fine, scale), fine, coarse * np.float32(GAIN))
