"""Define the host's part of an INT8 network: both sides of the integer core, in NumPy and as ONNX
nodes.

image -> pixel unshuffle -> encoding -> core -> decoding -> activation -> pixel shuffle -> + image

The encoding reads an image over its full scale.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np
from onnx import TensorProto

from beers_deploy.profiles.rounding import up_to_multiple
from beers_deploy.quant.graph import (
    CORRECTION,
    IMAGE,
    PLANES,
    SplitNetwork,
    channels_of,
)
from beers_deploy.quant.graph.host_steps import HostSteps
from beers_deploy.quant.graph.writer import write_base, write_shuffle
from beers_deploy.quant.host_part.input_encoding import ENCODED, IMAGE_SLICES, InputEncoding
from beers_deploy.quant.host_part.output_decoding import DECODED, OutputDecoding, Plain
from beers_deploy.quant.host_part.writer import ZERO, HostWriter
from beers_deploy.quant.input_range import UNIT, Ranges, largest_size

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "Sigmoid": lambda values: 0.5 + 0.5 * np.tanh(0.5 * values),
    "Tanh": np.tanh,
}


@dataclass(frozen=True)
class HostPart(HostSteps):
    """The computations on the host's processor before and after the integer core of an INT8
    network.

    Attributes:
        channels: the number of channels that the encoding reads: those of the image after the pixel
            unshuffles of `front`.
        outputs: the number of channels of the decoded result.
        unit: the share of full scale that a decoded value of 1 stands for.
        encoding: turns the image into the int8 planes that the core reads.
        decoding: combines the copies of each channel that the core writes.
        input_ranges: the range (low, high) of each channel of the image; empty if all are in [0,
            1].
    """

    channels: int = 1
    outputs: int = 1
    unit: float = 1.0
    encoding: InputEncoding = IMAGE_SLICES
    decoding: OutputDecoding = field(default_factory=Plain)
    input_ranges: Ranges = ()

    @classmethod
    def of(
        cls, network: SplitNetwork, decoding: OutputDecoding, input_ranges: Ranges = ()
    ) -> "HostPart":
        """Build the host's part of a float network that reads the image itself.

        Args:
            network: the float network, split into host and DPU part.
            decoding: combines the copies of each channel that the core writes.
            input_ranges: the range (low, high) of each channel of the image; empty if all are in
                [0, 1].
        """
        channels = network.core_channels
        steps = {step.name: getattr(network, step.name) for step in fields(HostSteps)}
        # An image in [0, 1] is clipped when it is stored.
        if network.limits == UNIT and not input_ranges:
            steps["limits"] = ()
        return cls(
            channels,
            channels_of(network.graph, {IMAGE: channels})[CORRECTION],
            encoding=image_encoding(network.border_px, input_ranges),
            decoding=decoding,
            input_ranges=input_ranges,
            **steps,
        )

    @property
    def full_scale(self) -> np.ndarray | None:
        """The factor (C,) float32 by which each channel that the encoding reads is divided.

        It maps the largest absolute value of the channel's range to 1. None if all channels are in
        [0, 1] already. C counts the channels after the pixel unshuffles in `front`.

        There is no offset: zero stays zero, so that the zero padding of the float network equals
        that of the int8 planes. An offset could not be folded into a bias, because a padded border
        has none.
        """
        if not self.input_ranges:
            return None
        sizes = np.array([largest_size(*ends) for ends in self.input_ranges], np.float32)
        image = np.tile(sizes[None, :, None, None], (1, 1, self.place_px, self.place_px))
        for shuffle in self.front:
            image = shuffle(image)
        return image.ravel()

    @property
    def planes(self) -> int:
        """The number of int8 planes that the core reads, of all channels together."""
        return self.encoding.planes * self.channels

    @property
    def border_px(self) -> int:
        """The number of pixels by which the image is mirrored beyond its borders."""
        # Rounded up, so that pixel unshuffling divides the image into the same places as before.
        return up_to_multiple(self.encoding.margin_px, self.place_px)

    @property
    def image_channels(self) -> int:
        """The number of channels of the image, before the pixel unshuffles of `front`."""
        return self.channels // self.place_px**2

    @property
    def place_px(self) -> int:
        """The side in pixels of the square of the image that becomes one pixel of the core's
        planes.
        """
        return math.prod(shuffle.block for shuffle in self.front)

    def encode(self, image: np.ndarray) -> np.ndarray:
        """Encode an image as the int8 planes that the core reads.

        Args:
            image: (N, C, H, W) in the network's units. Sides are multiples of `place_px`.

        Returns:
            Planes (N, P, H', W') int8, with P as in `planes`. H' and W' are H and W with the
            mirrored border, divided by `place_px`.
        """
        if self.border_px:
            image = np.pad(image, ((0, 0), (0, 0), *[(self.border_px,) * 2] * 2), "reflect")
        for shuffle in self.front:
            image = shuffle(image)
        full_scale = self.full_scale
        if full_scale is not None:
            image = image * (1 / full_scale)[:, None, None]
        return self.encoding.encode(image)

    def decode(self, result: np.ndarray, scale: float) -> np.ndarray:
        """Combine the copies in the core's result to one value per channel.

        Args:
            result: (N, copies C, H, W) float32, multiples of `scale`.
            scale: the real value of the integer 1 of the result.

        Returns:
            The decoded result (N, C, H, W), in the unit of the image: shares of full scale if that
            is in [0, 1].
        """
        return np.asarray(self.decoding.decode(result, scale) * np.float32(self.unit))

    def unrounded(self, result: np.ndarray) -> np.ndarray:
        """Return the decoded value of a result in float, where no copy is rounded or clipped.

        The first copy of each channel then has the exact value, so the others are not needed.

        Args:
            result: (N, copies C, H, W) of a float network that writes the copies.

        Returns:
            (N, C, H, W): `decode` returns it times `unit`.
        """
        return result[:, : self.outputs] * np.float32(self.decoding.gains[0])

    def restore(self, image: np.ndarray, result: np.ndarray, scale: float) -> np.ndarray:
        """Compute the restored image from an image and the core's result for it.

        Args:
            image: (N, C, H, W) in the network's units.
            result: the core's result (N, copies C', H', W') float32, multiples of `scale`.
            scale: the real value of the integer 1 of the result.

        Returns:
            The restored image (N, C'', H'', W'') in the network's units, clipped if the host clips.
        """
        return self.finish(image, self.decode(result, scale))

    def finish(self, image: np.ndarray, decoded: np.ndarray) -> np.ndarray:
        """Compute the restored image from an image and a decoded result: activate, shuffle, crop,
        add the image, and clip.

        Args:
            image: (N, C, H, W) in the network's units.
            decoded: (N, C', H', W') as `decode` returns it, before the pixel shuffles of `back`.

        Returns:
            The restored image (N, C'', H'', W'') in the network's units.
        """
        result = self.activated(decoded)
        for shuffle in self.back:
            result = shuffle(result)
        if self.crop_px:
            result = result[..., self.crop_px : -self.crop_px, self.crop_px : -self.crop_px]
        result = self.clip(self.base(image) + result if self.adds_image else result)
        for shuffle in self.last:
            result = shuffle(result)
        return result

    def correction_of(self, image: np.ndarray, restored: np.ndarray) -> np.ndarray:
        """Return the activated result for which `finish` returns a given restored image, unless it
        clips.

        This is the inverse of `finish` behind `activated`. Fine-tuning computes its targets with
        it.

        Args:
            image: (N, C, H, W) in the network's units.
            restored: the restored image, of the size that `finish` returns.
        """
        result = restored
        for shuffle in reversed(self.last):
            result = shuffle.inverse(result)
        result = result - self.base(image) if self.adds_image else result
        # Fine-tuning judges no pixels at the border.
        result = np.pad(result, [(0, 0), (0, 0), *[(self.crop_px,) * 2] * 2], "edge")
        for shuffle in reversed(self.back):
            result = shuffle.inverse(result)
        return np.ascontiguousarray(result)

    def activated(self, decoded: np.ndarray) -> np.ndarray:
        """Return the activation of a decoded result; the result itself if there is none."""
        if not self.activation:
            return decoded
        # In float64, so that NumPy and onnxruntime round to the same float32.
        return ACTIVATIONS[self.activation](decoded.astype(np.float64)).astype(np.float32)

    def clip(self, result: np.ndarray) -> np.ndarray:
        """Clip a result to `clip_limits`, as the host does; return it unchanged if there are no
        limits.
        """
        if not self.clip_limits:
            return result
        low, high = self.clip_limits
        return np.asarray(np.clip(result, low, high))

    @property
    def clip_limits(self) -> tuple[float, ...]:
        """The low and the high end to which the host clips the result; empty if it does not."""
        adds_unit = self.adds_image and not self.input_ranges
        return self.limits or (UNIT if adds_unit else ())

    def write_front(self, w: HostWriter) -> None:
        """Write the ONNX nodes before the core, from the image to its planes in uint8.

        Args:
            w: the writer that receives the nodes.
        """
        image = IMAGE
        channels = self.image_channels
        if self.border_px:
            around = w.constant("border_px", np.array([0, 0, self.border_px, self.border_px] * 2))
            image = w.node("Pad", "host_front.widened", [image, around], mode="reflect")
        for k, shuffle in enumerate(self.front):
            write_shuffle(w, shuffle, image, f"host_front.shuffled_{k}", channels)
            image = f"host_front.shuffled_{k}"
            channels = channels * shuffle.block**2
        full_scale = self.full_scale
        if full_scale is not None:
            factors = w.constant("input_factors", (1 / full_scale)[None, :, None, None])
            image = w.node("Mul", "host_front.shares", [image, factors])
        self.encoding.write(w, image)
        # The planes are int8 values stored as uint8 with the zero point ZERO.
        w.node("Add", "host_front.offset", [ENCODED, w.scalar("offset", ZERO)])
        w.node("Cast", PLANES, ["host_front.offset"], to=TensorProto.UINT8)

    def write_back(self, w: HostWriter, feeds: list[str], scale: float) -> None:
        """Write the ONNX nodes after the core, from its result to the restored image, the tensor
        `restored`.

        Args:
            w: the writer that receives the nodes.
            feeds: the names of three tensors: the result in uint8, its scale and its zero point.
            scale: the number in the second tensor.
        """
        self.decoding.write(w, feeds, self.outputs, scale)
        result = DECODED
        if self.activation:
            wide = w.node("Cast", "host_back.float64", [result], to=TensorProto.DOUBLE)
            wide = w.node(self.activation, "host_back.activated_float64", [wide])
            result = w.node("Cast", "host_back.activated", [wide], to=TensorProto.FLOAT)
        for k, shuffle in enumerate(self.back):
            write_shuffle(w, shuffle, result, f"host_back.shuffled_{k}")
            result = f"host_back.shuffled_{k}"
        if self.unit != 1:
            result = w.node("Mul", "host_back.in_units", [result, w.scalar("unit", self.unit)])
        if self.crop_px:
            crop = [self.crop_px] * 2, [-self.crop_px] * 2, [2, 3]
            places = [w.constant(f"crop_{k}", np.array(side)) for k, side in enumerate(crop)]
            result = w.node("Slice", "host_back.cropped", [result, *places])
        if self.adds_image:
            base = write_base(w, self.base, IMAGE)
            result = w.node("Add", "host_back.add", [base, result])
        name = "host_back.clipped" if self.last else "restored"
        if self.clip_limits:
            low, high = self.clip_limits
            ends = [w.scalar("zero" if low == 0 else "low", low)]
            ends.append(w.scalar("one" if high == 1 else "high", high))
            w.node("Clip", name, [result, *ends], name="host_back.clip")
        else:
            # The file's output is named `restored`, whatever the node in front of it.
            w.node("Identity", name, [result], name="host_back.result")
        for k, shuffle in enumerate(self.last):
            result = name
            name = "restored" if k + 1 == len(self.last) else f"host_back.last_{k}"
            write_shuffle(w, shuffle, result, name)


def image_encoding(margin_px: int, input_ranges: Ranges) -> InputEncoding:
    """Return the encoding for a network that reads the image itself, not the results of a sensor's
    filters.

    Args:
        margin_px: the number of pixels by which the image must at least be mirrored beyond its
            borders.
        input_ranges: the range (low, high) of each channel of the image. If one has values below 0,
            the encoding is signed.
    """
    signed = any(low < 0 for low, _ in input_ranges)
    return replace(IMAGE_SLICES, margin_px=margin_px, signed=signed)


ONE_CHANNEL = HostPart()
"""The host's part for an image of one channel, to which the core's plain result is added."""
