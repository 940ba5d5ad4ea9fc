"""Restore a whole image tile by tile."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import tifffile

from deploy.tiling import Tile, plan_tiles
from model.files import whole_file
from model.images import read_pixels
from profiles.errors import ImageError, OptionError
from quant.onnx_file import fixed_tile_px
from quant.session import run

MAX_DN = 4095
TILE_PX = 640


def read_acquisition(path: Path) -> np.ndarray:
    """Digital numbers (H, W) float32 of a mono image of at most 12 bits.

    Raises:
        ImageError: several bands, or values that no 12-bit sensor gives.
    """
    pixels = read_pixels(path)
    if pixels.ndim != 2:
        raise ImageError(
            str(path), expected="one band", got=f"{pixels.shape[2]} bands", remedy="extract the panchromatic band"
        )
    low, high = float(pixels.min()), float(pixels.max())
    if low < 0 or high > MAX_DN:
        raise ImageError(
            str(path),
            expected=f"12-bit digital numbers, 0 to {MAX_DN}",
            got=f"values from {low:g} to {high:g}",
            remedy="rescale it to the sensor's digital numbers",
        )
    return np.asarray(pixels, dtype=np.float32)


def restore_image(
    dn: np.ndarray,
    session: ort.InferenceSession,
    tile_px: int,
    halo_px: int,
    tick: Callable[[], None] = lambda: None,
) -> np.ndarray:
    """Restore (H, W) digital numbers to (H, W) uint16 in 0..4095; `tick` is called once a tile."""
    result = np.empty(dn.shape, np.uint16)
    height, width = dn.shape
    for tile in plan_tiles(height, width, tile_px, halo_px):
        tile.write(restore_tile(dn, tile, session), result)
        tick()
    return result


def restore_tile(dn: np.ndarray, tile: Tile, session: ort.InferenceSession) -> np.ndarray:
    """One window through the network, (h, w) uint16."""
    image = np.ascontiguousarray(tile.read(dn), dtype=np.float32)[None, None] / np.float32(MAX_DN)
    restored = run(session, image)[0, 0] * np.float32(MAX_DN)
    if not np.isfinite(restored).all():
        raise ImageError("restored tile", expected="finite pixels", got="NaN", remedy="check the model with 'gate'")
    return np.asarray(np.clip(np.rint(restored), 0, MAX_DN).astype(np.uint16))


def write_tiff(path: Path, dn: np.ndarray) -> None:
    """Write (H, W) uint16 as a tiled, losslessly compressed TIFF, whole or not at all."""
    with whole_file(path) as temporary:
        tifffile.imwrite(temporary, dn, tile=(256, 256), compression="zlib", software="beers-deploy")


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
            got=f"tile {tile_px}, image {shape[0]} x {shape[1]}",
            remedy="use a model exported without --tile",
        )
