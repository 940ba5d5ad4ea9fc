"""`beers-deploy export`: weights to a float ONNX file, and proof that both compute the same."""

from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "export --variant convbeers-s --out float.onnx"

MAX_DIFFERENCE = 1e-5
"""Of full scale: a twentieth of a digital number, above what float32 summation order explains."""


def export(
    out: Annotated[Path, typer.Option(help="ONNX file to write.")],
    variant: Annotated[str, typer.Option(help="Shipped weights of this name.")] = "convbeers-s",
    checkpoint: Annotated[Path | None, typer.Option(help="Your own weights instead (.safetensors).")] = None,
    tile: Annotated[
        int | None, typer.Option(min=16, help="Fix the input to one tile of this side, 640 for a board.")
    ] = None,
) -> None:
    """Write the network as ONNX, any height and width unless --tile fixes them, and check it against torch."""
    from deploy.defaults import about
    from deploy.export import parity, to_onnx
    from model.shipped import shipped_weights
    from model.weights_file import load_network
    from profiles.errors import ModelError
    from quant.onnx_file import save_onnx

    path = checkpoint or shipped_weights(variant)
    network, recipe = load_network(path)
    save_onnx(to_onnx(network, about(path.stem, recipe), tile), out)
    difference = parity(network, out, tile or 97)
    typer.echo(f"wrote {out}: largest difference from torch {difference:.2g} of full scale (measured)")
    if difference > MAX_DIFFERENCE:
        remedy = "report it: the export is wrong"
        raise ModelError(
            str(out), expected=f"at most {MAX_DIFFERENCE:g} from torch", got=f"{difference:g}", remedy=remedy
        )
