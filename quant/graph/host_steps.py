"""Describe the host's steps around the DPU's part of a network, which its INT8 network keeps."""

from dataclasses import dataclass

from beers_deploy.quant.graph.base import THE_IMAGE, Base
from beers_deploy.quant.graph.operations import Shuffle


@dataclass(frozen=True, kw_only=True)
class HostSteps:
    """The steps of the host before and after the DPU's part, the same in float and in INT8.

    Attributes:
        front: pixel unshuffles of the image, which come first.
        back: pixel shuffles of the result of the DPU's part.
        crop_px: the number of pixels that are cut off at each side of the result, before the image
            is added. The DPU computes them for the mirrored border.
        activation: "Sigmoid" or "Tanh" of the result, in front of the add; empty for none.
        adds_image: True if the image is added to the result (the global add).
        base: the part of the image that is added.
        last: pixel shuffles after the image was added. If the image has one channel and the sum
            several, it is added to each of them.
        limits: the low and the high end to which the result is clipped; empty for none. The sum of
            an image in [0, 1] is clipped to that range in any case.
    """

    front: tuple[Shuffle, ...] = ()
    back: tuple[Shuffle, ...] = ()
    crop_px: int = 0
    activation: str = ""
    adds_image: bool = True
    base: Base = THE_IMAGE
    last: tuple[Shuffle, ...] = ()
    limits: tuple[float, ...] = ()
