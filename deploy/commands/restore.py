"""`beers-deploy restore`: a raw 12-bit image in, the restored one out."""

from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "restore raw.tif restored.tif"


def restore(
    image: Annotated[Path, typer.Argument(metavar="IN", help="Mono image of at most 12 bits (TIFF or PNG).")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="16-bit TIFF to write, values 0 to 4095.")],
    model: Annotated[
        Path | None, typer.Option(help="ONNX network, float or INT8; the shipped INT8 one if none.")
    ] = None,
    tile: Annotated[int, typer.Option(min=16, help="Tile side in pixels.")] = 640,
    halo: Annotated[str, typer.Option(help="Context around a tile: 'exact' (no seams) or pixels.")] = "exact",
    threads: Annotated[int, typer.Option(min=0, help="Threads; 0 takes every core.")] = 0,
) -> None:
    """Restore an image tile by tile; with the exact halo the result is the whole image's, bit for bit."""
    from deploy.defaults import default_int8
    from deploy.progress import steps
    from deploy.restore import check_fixed_tile, parse_halo, read_acquisition, restore_image, write_tiff
    from deploy.tiling import plan_tiles
    from model.files import require_writable
    from quant.onnx_file import load_onnx
    from quant.radius import receptive_radius_px
    from quant.session import open_session

    require_writable(out)
    network = load_onnx(model or default_int8())
    halo_px = parse_halo(halo, receptive_radius_px(network))
    dn = read_acquisition(image)
    check_fixed_tile(network, tile, dn.shape)
    height, width = dn.shape
    with steps("restoring", len(plan_tiles(height, width, tile, halo_px))) as bar:
        restored = restore_image(dn, open_session(network, threads), tile, halo_px, bar.advance)
    write_tiff(out, restored)
    typer.echo(f"wrote {out}: {height} x {width} pixels, tile {tile}, halo {halo_px}")
