"""What the host does around the integer core, in numpy and as ONNX: planes in front, the result
made behind.

image -> pixel unshuffle -> planes -> core -> one correction of its gains or windows -> pixel
shuffle -> + image
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from onnx import TensorProto, helper

from beers_deploy.model.bank import SIDE_PX, UNIT_STEPS, WIDE
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.banked.filters import (
    ANALYTIC_COPIES,
    BITS,
    MIDDLE_DN,
    PART,
    STEP_DN,
    split_planes,
)
from beers_deploy.quant.graph import (
    COARSE_MAX,
    CORRECTION,
    COUNT,
    IMAGE,
    PLANES,
    QUARTER,
    STEP,
    Network,
    Shuffle,
    channels_of,
    split,
)
from beers_deploy.quant.graph.writer import write_shuffle
from beers_deploy.quant.onnx_file import GraphWriter

ZERO = 128
"""Around which uint8 stands for int8 in the host's file."""
GAIN = 8
BORDER_PX = SIDE_PX // 2
FINE_MAX = 126
"""The largest size at which the fine channel is believed: one below int8's end."""


@dataclass(frozen=True)
class Ends:
    """The host's part of an INT8 network.

    What does not stand here is as in `quant.graph.Network`; a sum with the image is clipped to [0,
    1].

    Attributes:
        channels: of the core's image, behind `front`.
        planes: of int8 that each channel becomes.
        banked: whether the core begins with the bank of a sensor (`quant.banked`): the image's
            borders are mirrored, the planes are the bank's, and the analytic restoration comes in
            copies behind the correction's gains.
        unit: the share of full scale that is 1 in the core's result.
        wide: whether the last copy of the analytic restoration is coarse by `WIDE`, for what the
            others clip.
        direct: whether the image is planes already, whole multiples of 1/128: what follows a bank
            by itself.
        gains: 2 where the correction's channels come twice, fine and coarse by `GAIN`.
        outputs: channels of the correction, gains and windows not counted.
        offsets: what each window has taken off each channel, (windows, outputs): the channels come
            coarse by `GAIN` first, then once for each window.
    """

    channels: int = 1
    planes: int = COUNT
    front: tuple[Shuffle, ...] = ()
    back: tuple[Shuffle, ...] = ()
    adds_image: bool = True
    last: tuple[Shuffle, ...] = ()
    gains: int = 1
    outputs: int = 1
    offsets: tuple[tuple[float, ...], ...] = ()
    banked: bool = False
    unit: float = 1.0
    direct: bool = False
    wide: bool = False

    @property
    def border_px(self) -> int:
        """Pixels by which the image's borders are mirrored in front of the planes."""
        # Rounded up, so that pixel unshuffling divides the image into the same places as before.
        return -(-BORDER_PX // self.place_px) * self.place_px if self.banked else 0

    @property
    def image_channels(self) -> int:
        """Of the image as it comes."""
        return self.channels // self.place_px**2

    @property
    def place_px(self) -> int:
        """Side in pixels of the square of the image that is one place of the core's planes."""
        return math.prod(shuffle.block for shuffle in self.front)

    @property
    def correction_px(self) -> int:
        """As `place_px`, of the core's result where the image is added to it."""
        return math.prod(shuffle.block for shuffle in self.back)

    def split(self, image: np.ndarray) -> np.ndarray:
        """An image (N, C, H, W) in [0, 1] to the core's planes, int8."""
        # These are multiples of 1/128 already: rounding takes off float error alone.
        if self.direct:
            return np.clip(np.rint(image * 2.0**BITS), -128, 127).astype(np.int8)
        # Zeros around the image would look like a black edge to the bank's filters.
        if self.border_px:
            image = np.pad(image, ((0, 0), (0, 0), *[(self.border_px,) * 2] * 2), "reflect")
        for shuffle in self.front:
            image = shuffle(image)
        return split_planes(image) if self.banked else split(image, self.planes)

    def merge(self, correction: np.ndarray, scale: float) -> np.ndarray:
        """One correction (N, C, H, W) of full scale from its gains or windows: (N, copies C, H, W)
        of `scale`.
        """
        if self.offsets:
            return self._of_windows(correction, scale)
        if self.gains == 1:
            return correction
        fine, coarse, *analytic = np.split(correction, self.copies, axis=1)
        # At int8's end the fine copy may have saturated, so the coarse one is taken there.
        limit = np.float32((FINE_MAX + 0.5) * scale)
        value = np.where(np.abs(fine) <= limit, fine, coarse * np.float32(GAIN))
        if not analytic:
            return value
        added = np.sum(analytic[: self.fine_copies], 0) * np.float32(self.analytic_gain(scale))
        # The fine copies lie within one step of each other, so one of them tells where they end.
        if self.wide:
            coarse = analytic[-1] * np.float32(self.coarse_gain(scale))
            added = np.where(np.abs(analytic[0]) <= limit, added, coarse)
        return np.asarray((value + added) * np.float32(self.unit))

    @property
    def fine_copies(self) -> int:
        """Of the analytic restoration."""
        return ANALYTIC_COPIES - self.wide

    def analytic_gain(self, scale: float) -> float:
        """What the sum of the fine analytic copies is multiplied with, where one step is said to be
        `scale`.
        """
        return 1 / (UNIT_STEPS * self.fine_copies * scale)

    def coarse_gain(self, scale: float) -> float:
        """Likewise the coarse copy; 0 if there is none."""
        return WIDE / (UNIT_STEPS * scale) if self.wide else 0.0

    def whole(self, correction: np.ndarray) -> np.ndarray:
        """One correction from all its copies in float, which rounding has not touched: (N, C, H,
        W).
        """
        first = correction[:, : self.outputs]
        return first * np.float32(GAIN) if self.offsets else first

    def _of_windows(self, correction: np.ndarray, scale: float) -> np.ndarray:
        coarse, *windows = np.split(correction, self.copies, axis=1)
        # The coarse copy stays where no window holds the value.
        value = coarse * np.float32(GAIN)
        for window, offset in zip(windows, np.array(self.offsets, np.float32), strict=True):
            inside = np.abs(window) <= np.float32((FINE_MAX + 0.5) * scale)
            value = np.where(inside, window + offset[:, None, None], value)
        return value

    def moved(self, left: np.ndarray) -> "Ends":
        """With what rounding left of the biases of all channels, (copies outputs,), put into the
        windows' offsets.
        """
        # The coarse copy comes first, and the host adds no offset to it.
        windows = np.asarray(left[self.outputs :]).reshape(-1, self.outputs)
        sums = np.array(self.offsets) + windows
        offsets = tuple(tuple(float(offset) for offset in window) for window in sums)
        return replace(self, offsets=offsets)

    @property
    def copies(self) -> int:
        """How often the core writes each channel of its result."""
        return 1 + len(self.offsets) if self.offsets else self.gains + ANALYTIC_COPIES * self.banked

    def restored(self, image: np.ndarray, correction: np.ndarray, scale: float) -> np.ndarray:
        """What the host makes of an image (N, C, H, W) and the core's result."""
        return self.finished(image, self.merge(correction, scale))

    def finished(self, image: np.ndarray, result: np.ndarray) -> np.ndarray:
        """As `restored`, of a correction that is one already."""
        for shuffle in self.back:
            result = shuffle(result)
        result = self.clipped(image + result) if self.adds_image else result
        for shuffle in self.last:
            result = shuffle(result)
        return result

    def correction_of(self, image: np.ndarray, result: np.ndarray) -> np.ndarray:
        """The correction from which `finished` makes that result (N, C, H, W), in [0, 1] where the
        image is added.
        """
        # The inverse of `finished`, from its last step to its first.
        for shuffle in reversed(self.last):
            result = shuffle.inverse(result)
        result = result - image if self.adds_image else result
        for shuffle in reversed(self.back):
            result = shuffle.inverse(result)
        return np.ascontiguousarray(result)

    def clipped(self, result: np.ndarray) -> np.ndarray:
        """A float network's result as the host would clip its own: to [0, 1] where the image is
        added.
        """
        return np.clip(result, 0, 1) if self.adds_image else result


ONE_CHANNEL = Ends()
"""An image of one channel, and a correction of it that is added."""


def ends_of(network: Network, gains: int = 1) -> Ends:
    """The ends of a network whose correction comes in so many gains."""
    steps = network.front, network.back, network.adds_image, network.last
    outputs = channels_of(network.graph, {IMAGE: network.core_channels})[CORRECTION]
    return Ends(network.core_channels, COUNT, *steps, gains, outputs)


class HostWriter(GraphWriter):
    """Writes the host's operators, each with its domain, and uint8 around 128."""

    domain = ""

    def scalar(self, name: str, value: float) -> str:
        """A float32 constant."""
        return self.constant(name, np.array(value, np.float32))

    def zero_point(self) -> str:
        """The constant 128, around which uint8 stands for int8."""
        return self.constant("zero_point", np.array(ZERO, np.uint8))


def write_front(w: HostWriter, ends: Ends) -> None:
    """Write the host's nodes in front of the core, image to uint8 planes: `Ends.split` as
    operators.
    """
    if ends.direct:
        w.node("Mul", "host_front.scale", [IMAGE, w.scalar("units", 2.0**BITS)])
        w.node("Round", "host_front.planes", ["host_front.scale"])
        _write_uint8(w)
        return
    image = IMAGE
    channels = ends.image_channels
    if ends.border_px:
        around = w.constant("border_px", np.array([0, 0, ends.border_px, ends.border_px] * 2))
        image = w.node("Pad", "host_front.widened", [image, around], mode="reflect")
    for k, shuffle in enumerate(ends.front):
        write_shuffle(w, shuffle, image, f"host_front.shuffled_{k}", channels)
        image = f"host_front.shuffled_{k}"
        channels = channels * shuffle.block**2
    # A digital number is a coarse step and a remainder, so that int8 planes hold its 12 bits.
    step, part = (STEP_DN, PART) if ends.banked else (STEP, QUARTER)
    w.node("Mul", "host_front.scale", [image, w.scalar("max_dn", MAX_DN)])
    w.node("Round", "host_front.round", ["host_front.scale"])
    dn = w.node(
        "Clip",
        "host_front.dn",
        ["host_front.round", w.scalar("zero", 0), w.scalar("max_dn", MAX_DN)],
    )
    if ends.banked:
        dn = w.node("Sub", "host_front.centred", [dn, w.scalar("middle", MIDDLE_DN)])
    w.node("Mul", "host_front.steps", [dn, w.scalar("one_step", 1 / step)])
    w.node("Round", "host_front.whole_steps", ["host_front.steps"])
    # At full scale the coarse plane is at int8's end, and the remainder holds more.
    w.node(
        "Min", "host_front.coarse", ["host_front.whole_steps", w.scalar("coarse_max", COARSE_MAX)]
    )
    w.node("Mul", "host_front.coarse_dn", ["host_front.coarse", w.scalar("step", step)])
    w.node("Sub", "host_front.remainder", [dn, "host_front.coarse_dn"])
    w.node(
        "Mul", "host_front.quarters", ["host_front.remainder", w.scalar("one_quarter", 1 / part)]
    )
    w.node("Round", "host_front.quarter", ["host_front.quarters"])
    # A bank shares the weights of its coarse plane between two, and so has twice int8's range.
    coarse = ["host_front.coarse"] * (2 if ends.banked else 1)
    planes = [*coarse, "host_front.remainder", "host_front.quarter"]
    w.node("Concat", "host_front.planes", planes, axis=1)
    _write_uint8(w)


def _write_uint8(w: HostWriter) -> None:
    w.node("Add", "host_front.offset", ["host_front.planes", w.scalar("offset", ZERO)])
    w.node("Cast", PLANES, ["host_front.offset"], to=TensorProto.UINT8)


def write_back(w: HostWriter, ends: Ends, feeds: list[str], scale: float) -> None:
    """Write the host's nodes behind the core: `Ends.restored` as operators.

    Args:
        w: gets the nodes.
        ends: of the network.
        feeds: the core's result with its scale and its zero point, as names.
        scale: the value of one unit of it.
    """
    result = _write_one(w, ends, feeds, scale)
    for k, shuffle in enumerate(ends.back):
        write_shuffle(w, shuffle, result, f"host_back.shuffled_{k}")
        result = f"host_back.shuffled_{k}"
    if ends.unit != 1:
        result = w.node("Mul", "host_back.in_units", [result, w.scalar("unit", ends.unit)])
    if ends.adds_image:
        w.node("Add", "host_back.add", [IMAGE, result])
        limits = [w.scalar("zero", 0), w.scalar("one", 1)]
        name = "host_back.clipped" if ends.last else "restored"
        w.node("Clip", name, ["host_back.add", *limits], name="host_back.clip")
        for k, shuffle in enumerate(ends.last):
            result = name
            name = "restored" if k + 1 == len(ends.last) else f"host_back.last_{k}"
            write_shuffle(w, shuffle, result, name)
    else:
        # The file's output is named `restored`, whatever the node in front of it.
        w.node("Identity", "restored", [result], name="host_back.result")


def _write_one(w: HostWriter, ends: Ends, feeds: list[str], scale: float) -> str:
    """Write the nodes that make one correction of the core's result; its name."""
    if ends.copies == 1:
        w.node("DequantizeLinear", "host_back.correction", feeds)
    elif ends.offsets:
        w.node("DequantizeLinear", "host_back.all", feeds)
        _write_windows(w, ends, scale)
    else:
        w.node("DequantizeLinear", "host_back.both", feeds)
        _write_merge(w, ends, scale)
    return "host_back.correction"


def _write_windows(w: HostWriter, ends: Ends, scale: float) -> None:
    """Write the nodes that find each value in the window that holds it."""
    names = [f"host_back.window_{k}" for k in range(ends.copies)]
    sizes = w.constant("channels_each", np.full(ends.copies, ends.outputs))
    w.nodes.append(
        helper.make_node("Split", ["host_back.all", sizes], names, axis=1, name="host_back.split")
    )
    value = w.node("Mul", "host_back.wide", [names[0], w.scalar("gain", GAIN)])
    limit = w.scalar("fine_max", (FINE_MAX + 0.5) * scale)
    for k, (name, offset) in enumerate(zip(names[1:], ends.offsets, strict=True)):
        added = w.constant(f"offset_{k}", np.array(offset, np.float32)[None, :, None, None])
        w.node("Abs", f"{name}.size", [name])
        w.node("LessOrEqual", f"{name}.inside", [f"{name}.size", limit])
        w.node("Add", f"{name}.value", [name, added])
        result = "host_back.correction" if k + 1 == len(ends.offsets) else f"{name}.chosen"
        value = w.node("Where", result, [f"{name}.inside", f"{name}.value", value])


def _write_merge(w: HostWriter, ends: Ends, scale: float) -> None:
    """Write the nodes that make one correction of two gains: `Ends.merge` as operators."""
    name = "one_each" if ends.outputs == 1 else "channels_each"
    sizes = w.constant(name, np.full(ends.copies, ends.outputs))
    analytic = [f"host_back.analytic_{k}" for k in range(ends.copies - 2)]
    names = ["host_back.fine", "host_back.coarse", *analytic]
    w.nodes.append(helper.make_node("Split", ["host_back.both", sizes], names, axis=1))
    w.nodes[-1].name = "host_back.split"
    w.node("Mul", "host_back.wide", ["host_back.coarse", w.scalar("gain", GAIN)])
    w.node("Abs", "host_back.size", ["host_back.fine"])
    limit = w.scalar("fine_max", (FINE_MAX + 0.5) * scale)
    w.node("LessOrEqual", "host_back.fits", ["host_back.size", limit])
    merged = "host_back.chosen" if analytic else "host_back.correction"
    w.node("Where", merged, ["host_back.fits", "host_back.fine", "host_back.wide"])
    if analytic:
        w.node("Sum", "host_back.analytic", analytic[: ends.fine_copies])
        gain = w.scalar("analytic_gain", ends.analytic_gain(scale))
        w.node("Mul", "host_back.added", ["host_back.analytic", gain])
        added = _write_wide(w, ends, analytic, scale) if ends.wide else "host_back.added"
        w.node("Add", "host_back.correction", [merged, added])


def _write_wide(w: HostWriter, ends: Ends, analytic: list[str], scale: float) -> str:
    """Write the nodes that take the coarse analytic copy where the fine ones are at their end."""
    w.node("Abs", "host_back.analytic_size", [analytic[0]])
    limit = w.scalar("analytic_max", (FINE_MAX + 0.5) * scale)
    w.node("LessOrEqual", "host_back.analytic_fits", ["host_back.analytic_size", limit])
    w.node("Mul", "host_back.far", [analytic[-1], w.scalar("coarse_gain", ends.coarse_gain(scale))])
    return w.node(
        "Where",
        "host_back.reached",
        ["host_back.analytic_fits", "host_back.added", "host_back.far"],
    )
