"""The atmosphere between scene and sensor."""

from torch import Tensor

from profiles.effects import Veil


def add_veil(radiance: Tensor, veil: Veil) -> Tensor:
    """L' = transmittance * L + path radiance, in W/m2/sr/um.

    Limits: (1, 0) changes nothing; transmittance 0 leaves the path radiance alone. It is the same before and after
    the blur, whose gain at zero frequency is 1: so it is applied on the small target grid.
    """
    return radiance * veil.transmittance + veil.path_radiance
