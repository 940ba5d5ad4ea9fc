"""Define the sizes of ConvBEERS by name, and the tensors of each, without loading anything.

The paper's family works at full resolution. A variant of scale 2 treats each square of 2 x 2 pixels
as one place of four channels, and so works at half resolution: its maps have a quarter of the
places.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Literal

from beers_deploy.profiles.errors import OptionError

Kernels = Literal["cut", "fitted"]
"""The way in which the filters in front of a network become kernels of 7 x 7: cut from the whole
filter, or fitted to it.

Networks behind fitted kernels were trained on many curves of the MTF (`model.curves`).
"""

BANK_PLANES = 5
SENSOR_VALUES = 4
"""The inputs of a head behind a bank: the image and four planes of each pixel, and the values of a
sensor vector.
"""


@dataclass(frozen=True)
class Variant:
    """The size of a network, by which the shipped ones are named.

    Attributes:
        blocks: the number of residual blocks.
        features: the number of channels of the maps between head and tail.
        scale: side in pixels of the square that is one place of the maps; images have multiples of
            it as sides.
    """

    blocks: int
    features: int
    scale: int = 1

    @property
    def pixels(self) -> int:
        """The number of pixels of one place of the maps, which are the channels of the network's
        input and output.
        """
        return self.scale**2

    @property
    def convolutions(self) -> Mapping[str, tuple[int, int]]:
        """The numbers of output and input channels of each 3 x 3 convolution, by name and in the
        order of computation.
        """
        places = product(range(self.blocks), ("first", "second"))
        body = [f"body.{block}.{place}" for block, place in places]
        square = (self.features, self.features)
        return {
            "head": (self.features, self.pixels),
            **dict.fromkeys([*body, "body_end"], square),
            "tail": (self.pixels, self.features),
        }

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each weight and bias by name."""
        shapes: dict[str, tuple[int, ...]] = {}
        for name, (outputs, inputs) in self.convolutions.items():
            shapes |= {f"{name}.weight": (outputs, inputs, 3, 3), f"{name}.bias": (outputs,)}
        return shapes

    @property
    def banked_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each weight and bias of a network behind a filter bank, by name. Its head
        reads the planes of four filters and the sensor vector in place of the image.
        """
        head = self.features, BANK_PLANES * self.pixels, 3, 3
        return {**self.shapes, "head.weight": head, "bias.weight": (self.features, SENSOR_VALUES)}


VARIANTS = {
    "convbeers": Variant(blocks=16, features=64),  # This is the paper's network.
    "convbeers-s": Variant(blocks=8, features=32),
    "convbeers-xs": Variant(blocks=4, features=16),
    "convbeers-half": Variant(blocks=4, features=64, scale=2),
    "convbeers-half-xs": Variant(blocks=2, features=32, scale=2),
}


def variant_named(name: str) -> Variant:
    """Return the variant of that name, or raise OptionError if there is none."""
    if name not in VARIANTS:
        raise OptionError(f"`variant` must be one of {', '.join(VARIANTS)}, got {name!r}.")
    return VARIANTS[name]
