"""`beers-deploy export`: weights to a float ONNX file, and proof that both compute the same."""

from pathlib import Path
from typing import Annotated

import typer

from deploy.commands.shared import refuse, say
from model.shipped import SENSOR, VARIANT

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
        typer.Option(help=f"Specialise to this: a profile's name, your .toml file, or blind; {SENSOR} if none."),
    ] = None,
    tile: Annotated[
        int | None, typer.Option(min=16, max=8192, help="Fix the input to one tile of this side, 640 for a board.")
    ] = None,
) -> None:
    """Write the network as ONNX, any height and width unless --tile fixes them, and check it against torch.

    Weights that are conditioned on their sensor, as all shipped ones are, become the network for one, at no cost when
    it runs: of a profile with ranges, for the middle of each. A value outside the range that was trained is taken as
    the nearest end of it, with a warning.
    """
    from deploy.export import about, require_parity, to_onnx, weights_for
    from deploy.networks import weights_file
    from model.convbeers import plain_network
    from model.io.files import require_writable
    from model.io.tensors import is_conditioned, read_plain
    from model.shipped import shipped_weights
    from profiles import load_sensor
    from profiles.errors import ModelError
    from quant.onnx_file import save_onnx

    if checkpoint is not None:
        refuse(context, ["variant"], expected="no --checkpoint beside it", got="both", remedy="leave one out")
    path = weights_file(checkpoint) if checkpoint else shipped_weights(variant)
    require_writable(out, inputs=(path, Path(sensor) if sensor else None))
    if is_conditioned(path):
        known = load_sensor(sensor or SENSOR)
        weights, outside = weights_for(path, known.nominal())
        for sentence in outside:
            say(f"warning: {sentence}", err=True)
        said = about(path.stem, weights.recipe, known.name)
    elif sensor is not None:
        expected, remedy = "weights of 'train --conditioned'", "leave --sensor out, or give such weights"
        raise ModelError(str(path), expected=expected, got="those of a plain network", remedy=remedy)
    else:
        weights = read_plain(path)
        said = about(path.stem, weights.recipe)
    model = to_onnx(weights, said, tile)
    difference = require_parity(plain_network(weights.tensors, weights.variant), model, tile or 97)
    save_onnx(model, out)
    say(f"wrote {out}: largest difference from torch {difference:.2g} of full scale (measured)")
