"""`beers-deploy export`: weights to a float ONNX file, and proof that both compute the same."""

from pathlib import Path
from typing import Annotated

import typer

from deploy.commands.shared import refuse, say
from model.shipped import VARIANT

EXAMPLE = "export --variant convbeers-s --out float.onnx"


def export(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="ONNX file to write.")],
    variant: Annotated[str, typer.Option(help="Shipped weights of this name.")] = VARIANT,
    checkpoint: Annotated[
        Path | None, typer.Option(help="Your own weights instead (.safetensors), or a shipped network's name.")
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(help="Specialise weights that can be told their sensor: a profile's name, or your .toml file."),
    ] = None,
    tile: Annotated[
        int | None, typer.Option(min=16, max=8192, help="Fix the input to one tile of this side, 640 for a board.")
    ] = None,
) -> None:
    """Write the network as ONNX, any height and width unless --tile fixes them, and check it against torch.

    Weights of 'train --told' become the network for one --sensor, at no cost when it runs; of a profile with ranges,
    for the middle of each. What lies outside the range that they were trained for is told as the nearest end of it,
    with a warning.
    """
    from deploy.export import about, network_for, require_parity, to_onnx
    from model.io.files import require_writable
    from model.shipped import float_file, shipped_weights
    from quant.onnx_file import save_onnx

    if checkpoint is not None:
        refuse(context, ["variant"], expected="no --checkpoint beside it", got="both", remedy="leave one out")
    path = float_file(checkpoint) if checkpoint else shipped_weights(variant)
    require_writable(out, inputs=(path, Path(sensor) if sensor else None))
    network, recipe, warnings = network_for(path, sensor)
    for warning in warnings:
        say(f"warning: {warning}", err=True)
    model = to_onnx(network, about(path.stem, recipe), tile)
    difference = require_parity(network, model, tile or 97)
    save_onnx(model, out)
    say(f"wrote {out}: largest difference from torch {difference:.2g} of full scale (measured)")
