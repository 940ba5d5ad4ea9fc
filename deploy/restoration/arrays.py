"""One window through a network, and the sizes that a network takes."""

from collections.abc import Callable

import numpy as np
import onnx

from model.io.images import MAX_DN
from profiles.errors import ImageError, OptionError
from quant.onnx_file import fixed_tile_px

TILE_PX = 640

Infer = Callable[[np.ndarray], np.ndarray]
"""A network ready to run: (1, 1, h, w) float32 in [0, 1] to the same shape."""


def restore_window(dn: np.ndarray, infer: Infer, full_scale: float = MAX_DN) -> np.ndarray:
    """One (h, w) window of digital numbers through the network, (h, w) float32 in 0..full_scale, not rounded.

    Raises:
        ImageError: the network gives NaN or infinity.
    """
    image = np.ascontiguousarray(dn, dtype=np.float32)[None, None] / np.float32(full_scale)
    with np.errstate(over="ignore"):  # what overflows is refused
        restored = infer(image)[0, 0] * np.float32(full_scale)
    if not np.isfinite(restored).all():
        raise ImageError("restored tile", expected="finite pixels", got="NaN", remedy="check the model with 'gate'")
    return np.asarray(np.clip(restored, 0, np.float32(full_scale)))


def parse_halo(text: str, radius_px: int) -> int:
    """'exact' is the receptive radius; anything else is a number of pixels.

    Raises:
        OptionError: neither.
    """
    if text == "exact":
        return radius_px
    if text.isdecimal():
        return int(text)
    remedy = f"{radius_px} is exact for this network"
    raise OptionError("--halo", expected="'exact' or a number of pixels", got=repr(text), remedy=remedy)


def check_fixed_tile(model: onnx.ModelProto, tile_px: int, shape: tuple[int, ...]) -> None:
    """A model of one fixed size takes only windows of that size.

    Raises:
        OptionError: another tile size, or an image smaller than the tile.
    """
    fixed = fixed_tile_px(model)
    if fixed is not None and (fixed != tile_px or min(shape) < fixed):
        raise OptionError(
            "--tile",
            expected=f"{fixed}, the size the model is fixed to, and an image at least as large",
            got=f"tile {tile_px}, image {shape[1]} x {shape[0]}",
            remedy="use a model exported without --tile",
        )
