"""`beers-deploy quantize`: float ONNX to static INT8 under the DPU's rules."""

from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "quantize float.onnx --target vck190 --sensor pleiades-degraded --out int8.onnx"


def quantize(
    model: Annotated[Path, typer.Argument(help="Float ONNX written by 'export'.")],
    out: Annotated[Path, typer.Option(help="INT8 ONNX for the host, runs on stock onnxruntime.")],
    target: Annotated[str, typer.Option(help="Whose rules to obey.")] = "vck190",
    sensor: Annotated[
        str, typer.Option(help="Profile that calibration patches are drawn from.")
    ] = "pleiades-variable",
    board: Annotated[Path | None, typer.Option(help="Also write the DPU's core in the board's spelling.")] = None,
    images: Annotated[Path | None, typer.Option(help="Folder of scenes for calibration; drawn ones if none.")] = None,
    patches: Annotated[int, typer.Option(min=1, help="Calibration patches of 128 x 128.")] = 64,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the patches.")] = 0,
) -> None:
    """Quantise to int8 with power-of-two positions: the correction on the DPU, the 12-bit add on the host."""
    from deploy.defaults import load_scenes
    from deploy.progress import steps
    from model.files import require_writable
    from profiles import load_sensor, load_target
    from quant.calibration import REFERENCE, draw_patches
    from quant.onnx_file import load_onnx, save_onnx
    from quant.quantise import quantise_model, ticks

    require_writable(out, board)
    board_target = load_target(target)
    float_model = load_onnx(model)
    degraded, reference = load_sensor(sensor), load_sensor(REFERENCE)
    drawn = draw_patches(load_scenes(images, reference.nominal(), seed), degraded, reference, patches, seed)
    about = {"calibration_sensor": degraded.name, "calibration_seed": str(seed), "target": board_target.name}
    with steps("calibrating", ticks(float_model, patches)) as bar:
        result = quantise_model(float_model, drawn, about, bar.advance)
    save_onnx(result.host, out)
    typer.echo(f"wrote {out}: {len(result.core.ops)} integer operations, {result.relus} ReLUs kept")
    if board is not None:
        save_onnx(result.board, board)
        typer.echo(f"wrote {board}: the same numbers in the board's spelling")
