"""`beers-deploy restore`: a raw image in, the restored one out, of any size."""

from pathlib import Path
from typing import Annotated

import typer

from deploy.swath.options import TILE_PX, Compression, Options, Runtime

EXAMPLE = "restore raw.tif restored.tif"


def restore(
    image: Annotated[Path, typer.Argument(metavar="IN", help="Image of at most 12 bits (TIFF of any size, or PNG).")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="TIFF to write: uint16, or float32 where IN is float.")],
    model: Annotated[
        Path | None, typer.Option(help="ONNX network, float or INT8; the shipped INT8 one if none.")
    ] = None,
    tile: Annotated[int, typer.Option(min=16, help="Longest side of a tile in pixels.")] = TILE_PX,
    halo: Annotated[str, typer.Option(help="Context around a tile: 'exact' (no seams) or pixels.")] = "exact",
    full_scale: Annotated[
        float | None,
        typer.Option(help="Pixel value that is full scale; 4095 if none, but 8-bit and 0..1 pixels need it."),
    ] = None,
    runtime: Annotated[Runtime, typer.Option(help="What runs the network.")] = Runtime.onnxruntime,
    threads: Annotated[int, typer.Option(min=0, help="Threads; 0 takes every core, or what falls to a worker.")] = 0,
    compression: Annotated[Compression, typer.Option(help="Of the output, lossless.")] = Compression.zlib,
    memory: Annotated[
        float | None,
        typer.Option(min=0, help="Budget in GB, --workers included; of a scheduler's, each. What is free if none."),
    ] = None,
    workers: Annotated[
        int, typer.Option(min=0, help="Processes of this machine that restore, by Dask; 0: none but this one.")
    ] = 0,
    scheduler: Annotated[
        str | None, typer.Option(help="Dask scheduler whose workers restore, such as tcp://host:8786.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was stopped or killed.")] = False,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Restore an image tile by tile; with the exact halo the result is the whole image's, bit for bit.

    The image is read and written by rows, so memory does not grow with its height. Bands are restored one by one.
    OUT has the scale of IN: 8-bit pixels with --full-scale 255 come out as 0..255, floats with 1 as 0..1.
    Georeference, RPCs and missing pixels (NaN, or the nodata value) are kept. Until OUT is finished its rows lie in
    .OUT.part beside it. Workers change no pixel: where they are of one processor and the same versions, the bytes are
    those of one process. Those of a scheduler must find IN under its path; only this process writes.
    """
    from deploy.results import Document
    from deploy.shipped import default_int8
    from deploy.swath.run import restore_file
    from deploy.tables import print_rows
    from model.files import require_writable

    require_writable(json)
    path = model or default_int8()
    options = Options(
        path,
        tile,
        halo,
        full_scale,
        runtime,
        threads,
        compression,
        int(memory * 1e9) if memory else None,
        resume,
        workers,
        scheduler,
    )
    row = restore_file(image, out, options, typer.echo)
    print_rows(f"wrote {out}", [row])
    arguments = {"tile": tile, "halo": halo, "full_scale": full_scale, "runtime": runtime, "threads": threads}
    arguments |= {"workers": workers, "scheduler": scheduler}
    Document("restore", arguments, (path, image), (row,)).write(json)
