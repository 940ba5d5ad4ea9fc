"""A view of a run: raw and restored image in one HTML file, to swipe, zoom and compare.

The page needs no server and no network access. It contains OpenSeadragon with its licence, which
draws tiles that are data: addresses. A browser therefore decodes only the visible tiles.
"""

import base64
import io
from collections.abc import Mapping
from pathlib import Path

from markupsafe import Markup
from PIL import Image

from beers_deploy import __version__
from beers_deploy.model.io.files import write_text
from beers_deploy.report.page import template
from beers_deploy.report.view_layers import SELF_CHECK, layers_of

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
    for level in levels:
        width, height = level.size
        rows = []
        for top in range(0, height, TILE_PX):
            bottom = min(top + TILE_PX, height)
            row = []
            for left in range(0, width, TILE_PX):
                right = min(left + TILE_PX, width)
                buffer = io.BytesIO()
                # JPEG has no opacity.
                kind = "png" if level.mode == "RGBA" else "jpeg"
                tile = level.crop((left, top, right, bottom))
                tile.save(buffer, kind, quality=QUALITY, subsampling=0)
                content = base64.b64encode(buffer.getvalue()).decode()
                row.append(f"data:image/{kind};base64,{content}")
            rows.append(row)
        tiles.append(rows)
    return tiles
