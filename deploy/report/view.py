"""A view of a run: raw and restored image in one HTML file, to swipe, zoom and compare.

The page needs no server and no network access. It contains OpenSeadragon with its licence, which
draws tiles that are data: addresses. A browser therefore decodes only the visible tiles.

Its layers are images of 8 bits, made from the files of a run. Each file is read once, by rows. An
image of more than SIDE_PX pixels a side is reduced by an integer factor, so that the memory does
not grow with the image. A map of blocks is coloured as it is.
"""

import base64
import io
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

from beers_deploy import __version__
from beers_deploy.model.io.files import write_text
from beers_deploy.model.io.pictures import GAMMA, Stretch
from beers_deploy.model.raster.facts import BandInfo, Raster
from beers_deploy.model.raster.reader import open_raster
from beers_deploy.model.raster.source import Source, strips
from beers_deploy.model.self_check import BLOCK_PX, OUTSIDE, SMOOTH, WITHIN
from beers_deploy.report.page import template

SIDE_PX = 4096
"""The longest side of a layer in pixels."""

STRIP_PX = 1 << 20
"""The number of pixels that are read at a time, but at least a row of blocks."""

SAMPLE_PX = 1024
"""The longest side of the sample from which a stretch is computed."""

STRETCH = (2.0, 98.0)
"""Percentiles of the raw image that are shown black and white."""

MOST_CHANGE = 99.0
"""The percentile of the absolute difference that is shown black or white."""

SELF_CHECK = "self-check"
"""The name of the layer that is a map of blocks."""

STATES = {
    WITHIN: ("#2b7bd6", "agrees with the raw image"),
    OUTSIDE: ("#f0562b", "contradicts it"),
    SMOOTH: ("#9aa4b0", "too smooth to decide"),
}
"""Colour and meaning of each state in a map of the self-check. Colour-blind people can distinguish
the colours.
"""

BLOCK_ALPHA = 96
"""Opacity of a block's colour over the image, out of 255."""

SHARP_PX = 4
"""The largest number of image pixels per pixel of a block's colour. A larger one would be
smoothed.
"""

Pixels = NDArray[np.uint8]
Planes = NDArray[np.float32]


@dataclass(frozen=True)
class Layer:
    """One picture of the page that compares a raw and a restored image.

    Attributes:
        name: the name of the layer on the page.
        pixels: uint8, (H, W) grey, (H, W, 3) colour, or (H, W, 4) colour with opacity.
        pixel_px: the number of columns of the raw image that one column of `pixels` covers.
        legend: colours (CSS) and what they mean.
    """

    name: str
    pixels: Pixels
    pixel_px: float
    legend: Sequence[tuple[str, str]]


def layers_of(
    image: Path, restored: Path, maps: Mapping[str, Path], trusted: bool
) -> tuple[list[Layer], str]:
    """Read the pictures that a page shows of a restoration, reduced to SIDE_PX a side.

    Args:
        image: the file of the raw image.
        restored: the file of the restored image.
        maps: files of further rasters of the same place, by the name of the layer. SELF_CHECK is
            the map of the self-check, a state for each block of the image; others are images.
        trusted: True if `image` may be an index (such as a VRT) of files outside its folder.

    Returns:
        The raw image, the restored image, their difference if they have one size, and the maps;
        and sentences on how they are shown.
    """
    with ExitStack() as stack:
        raw = stack.enter_context(open_raster(image, trusted))
        result = stack.enter_context(open_raster(restored))
        facts = raw.raster
        bands = range(3 if min(facts.bands, result.raster.bands) >= 3 else 1)
        before = read_planes(raw, bands, reduction(facts))
        after = read_planes(result, bands, reduction(result.raster))
        others = []
        for name, path in maps.items():
            source = stack.enter_context(open_raster(path))
            others.append(_map_layer(name, source, facts))
        notes = _notes(facts, result.raster, len(bands))
        made_px = _pixel_px(result.raster, facts)
    stretches = [Stretch(*np.percentile(_sample(plane), STRETCH).tolist()) for plane in before]
    legend = _ends(stretches, _unit(facts))
    layers = [
        Layer("raw image", _stretched(before, stretches), reduction(facts), legend),
        Layer("restored image", _stretched(after, stretches), made_px, legend),
    ]
    # A network that enlarges the image leaves no pixels to compare.
    if before.shape == after.shape:
        layers.append(_difference(before, after, _unit(facts), reduction(facts)))
    return [*layers, *others], notes


def reduction(raster: Raster) -> int:
    """Return the integer factor by which an image is reduced, so that no side exceeds SIDE_PX."""
    return -(-max(raster.height_px, raster.width_px) // SIDE_PX)


def read_planes(source: Source, bands: Sequence[int], factor: int) -> Planes:
    """Read bands of an image, reduced by an integer factor.

    Each pixel is the mean of a block of `factor` x `factor` pixels, without those that the file
    marks as missing.

    Args:
        source: an open image.
        bands: the numbers of the bands, from 0.
        factor: the factor of the reduction; 1 for none.

    Returns:
        float32 (bands, H, W); NaN where all pixels of a block are missing.
    """
    raster = source.raster
    rows_px = factor * max(1, STRIP_PX // (raster.width_px * raster.bands * factor))
    parts = []
    for start, stop in strips(raster.height_px, rows_px):
        stored = source.read(start, stop)[list(bands)]
        # Blocks at the right and at the bottom may have fewer pixels.
        beyond = ((0, 0), (0, (start - stop) % factor), (0, -raster.width_px % factor))
        missing = raster.missing(stored)
        pixels = np.ma.array(
            np.pad(np.where(missing, 0, stored), beyond),
            np.float32,
            mask=np.pad(missing, beyond, constant_values=True),
        )
        blocks = pixels.reshape(len(bands), pixels.shape[1] // factor, factor, -1, factor)
        parts.append(blocks.mean(axis=(2, 4)).filled(np.nan).astype(np.float32))
    return np.concatenate(parts, axis=1)


def _sample(plane: Planes) -> Planes:
    """Return the known pixels of a plane on a coarse grid, or one zero if there are none."""
    step = -(-max(plane.shape) // SAMPLE_PX)
    sample = plane[::step, ::step]
    values = sample[np.isfinite(sample)]
    return values if values.size else np.zeros(1, np.float32)


def _stretched(planes: Planes, stretches: Sequence[Stretch]) -> Pixels:
    """Return planes as grey or colour. Missing pixels are black."""
    shown = [
        stretch.to_bytes(np.nan_to_num(plane, nan=stretch.black))
        for plane, stretch in zip(planes, stretches, strict=True)
    ]
    return _picture(shown)


def _picture(shown: Sequence[Pixels] | Pixels) -> Pixels:
    return shown[0] if len(shown) == 1 else np.stack(list(shown), axis=-1)


def _difference(before: Planes, after: Planes, unit: str, pixel_px: float) -> Layer:
    """Return restored minus raw: mid-grey is no change, and black and white are equal changes."""
    sample = np.concatenate([_sample(plane) for plane in after - before])
    most = float(np.percentile(np.abs(sample), MOST_CHANGE))
    share = np.nan_to_num((after - before) / max(most, 1e-6))
    shown = np.rint(127.5 + 127.5 * np.clip(share, -1, 1)).astype(np.uint8)
    legend = (
        ("#000", f"restored is darker by {most:.3g} {unit} or more"),
        ("#808080", "no change"),
        ("#fff", f"brighter by {most:.3g} {unit} or more"),
    )
    return Layer("difference", _picture(shown), pixel_px, legend)


def _map_layer(name: str, source: Source, raw: Raster) -> Layer:
    """Return a raster over the same place as a layer."""
    raster = source.raster
    if name == SELF_CHECK:
        # The planes are chi2 and state of each band that was checked.
        states = read_planes(source, range(1, raster.bands, 2), 1)
        times = max(1, BLOCK_PX // (SHARP_PX * reduction(raw)))
        picture = np.zeros((*states.shape[1:], 4), np.uint8)
        # The worst state of all bands counts. A block that no band has a state for stays clear.
        legend = (*STATES.values(), ("transparent", "too few pixels to check"))
        for state in (SMOOTH, WITHIN, OUTSIDE):
            colour = bytes.fromhex(STATES[state][0].removeprefix("#"))
            picture[(states == state).any(axis=0)] = (*colour, BLOCK_ALPHA)
        shown = picture.repeat(times, axis=0).repeat(times, axis=1)
        return Layer(name, shown, BLOCK_PX / times, legend)
    (plane,) = read_planes(source, range(1), reduction(raster))
    stretch = Stretch(0, float(np.percentile(_sample(plane), STRETCH[1])))
    shown = _stretched(plane[None], [stretch])
    return Layer(name, shown, _pixel_px(raster, raw), _ends([stretch], _unit(raster)))


def _pixel_px(raster: Raster, raw: Raster) -> float:
    """Return the number of columns of the raw image that one displayed column of another image
    covers.
    """
    return reduction(raster) * raw.width_px / raster.width_px


def _unit(raster: Raster) -> str:
    """Return the unit of the stored pixels as the file states it, else digital numbers."""
    band = raster.band_info[0] if raster.band_info else BandInfo()
    scaled = (band.scale, band.offset) != (1, 0)
    return "DN" if scaled or not band.unit else band.unit


def _ends(stretches: Sequence[Stretch], unit: str) -> tuple[tuple[str, str], ...]:
    """Return the legend of stretched bands."""
    blacks = ", ".join(f"{stretch.black:.4g}" for stretch in stretches)
    whites = ", ".join(f"{stretch.white:.4g}" for stretch in stretches)
    return (("#000", f"{blacks} {unit} or less"), ("#fff", f"{whites} {unit} or more"))


def _notes(raw: Raster, result: Raster, bands: int) -> str:
    """Return sentences on what is shown and how."""
    low, high = STRETCH
    stretch = (
        f"Raw and restored have one stretch: black and white are the percentiles {low:g} and "
        f"{high:g} of the raw image, with a gamma of {1 / GAMMA:g}."
    )
    sentences = [f"{raw.width_px} x {raw.height_px} pixels.", stretch]
    if bands == 3:
        sentences.append("Bands 1, 2 and 3 are shown red, green and blue.")
    elif raw.bands > 1:
        sentences.append(f"Band 1 of {raw.bands} is shown.")
    factor = reduction(raw)
    if factor > 1:
        sentences.append(
            f"The image is reduced by {factor}: a pixel here is the mean of {factor} x {factor}, "
            "which hides noise and sharpness. Restore a crop to see them."
        )
    if result.width_px != raw.width_px:
        sentences.append(
            f"The restored image is {result.width_px // raw.width_px} times as large, so there is "
            "no difference."
        )
    return " ".join(sentences)


TILE_PX = 512
QUALITY = 90
"""Quality of the JPEG tiles, with which 8-bit levels are off by about one."""

VIEWER = Path(__file__).parent / "openseadragon"


def write_view(
    path: Path, image: Path, restored: Path, maps: Mapping[str, Path], trusted: bool
) -> None:
    """Write an HTML page that compares a raw image with its restoration, atomically.

    Args:
        path: the HTML file to write.
        image: the file of the raw image.
        restored: the file of the restored image.
        maps: files of further rasters of the same place by the name of their layer, such as the map
            of the self-check; see `layers_of`.
        trusted: True if `image` may be an index (such as a VRT) of files outside its folder.
    """
    layers, notes = layers_of(image, restored, maps, trusted)
    raw = layers[0]
    described = []
    for layer in layers:
        height, width = layer.pixels.shape[:2]
        facts = {
            "name": layer.name,
            "width": width,
            "height": height,
            # In widths of the raw image as it is shown.
            "across": width * layer.pixel_px / (raw.pixels.shape[1] * raw.pixel_px),
            "legend": layer.legend,
            "tiles": pyramid(Image.fromarray(layer.pixels)),
        }
        described.append(facts)
    page = template("view.html").render(
        title=f"{image.name}, raw and restored",
        notes=notes,
        layers=described,
        overlay=SELF_CHECK,
        quality=QUALITY,
        version=__version__,
        licence=(VIEWER / "LICENSE.txt").read_text(encoding="utf-8"),
        viewer=Markup((VIEWER / "openseadragon.min.js").read_text(encoding="utf-8")),  # noqa: S704
    )
    write_text(path, page)


def pyramid(picture: Image.Image) -> list[list[list[str]]]:
    """Cut a picture into tiles at several sizes, so that a viewer loads only what is visible.

    Args:
        picture: the picture at full size.

    Returns:
        The tiles as data: addresses, indexed by level, row and column. Each level has half the size
        of the next. The first level is a single tile, the last the picture at full size.
    """
    levels = [picture]
    while max(levels[0].size) > TILE_PX:
        levels.insert(0, levels[0].reduce(2))
    tiles = []
    # JPEG has no opacity.
    kind = "png" if picture.mode == "RGBA" else "jpeg"
    for level in levels:
        width, height = level.size
        rows = []
        for top in range(0, height, TILE_PX):
            row = []
            for left in range(0, width, TILE_PX):
                box = (left, top, min(left + TILE_PX, width), min(top + TILE_PX, height))
                buffer = io.BytesIO()
                level.crop(box).save(buffer, kind, quality=QUALITY, subsampling=0)
                content = base64.b64encode(buffer.getvalue()).decode()
                row.append(f"data:image/{kind};base64,{content}")
            rows.append(row)
        tiles.append(rows)
    return tiles
