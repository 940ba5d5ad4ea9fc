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
    ablate: Annotated[bool, typer.Option("--ablate", help="Show what each pass buys, on other patches.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the patches.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Quantise to int8 with power-of-two positions: the correction on the DPU, the 12-bit add on the host.

    Prints each integer layer: bits of its accumulator, seen and proven, and the share of saturated results.
    """
    from deploy.defaults import HELD_OUT_SEED, load_scenes
    from deploy.progress import steps
    from deploy.quant_report import ablation_rows, ablations, layer_rows, rounding_row
    from deploy.results import Document
    from deploy.tables import print_rows
    from model.files import require_writable
    from profiles import load_sensor, load_target
    from quant.calibration import REFERENCE, draw_patches
    from quant.onnx_file import load_onnx, save_onnx
    from quant.quantise import quantise_model, ticks

    require_writable(out, board, json)
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
    degraded_images = [image for image, _ in drawn.pairs]
    layers, rounding = layer_rows(result.core, degraded_images), rounding_row(result.core, degraded_images)
    print_rows("integer layers", layers)
    print_rows("the rule for halves", [rounding])
    rows = [*layers, rounding]
    if ablate:
        unseen = seed + HELD_OUT_SEED
        held_out = draw_patches(load_scenes(images, reference.nominal(), unseen), degraded, reference, 32, unseen)
        with steps("ablating", len(ablations())) as bar:
            found = ablation_rows(float_model, drawn, held_out, bar.advance)
        print_rows("what each pass buys, on patches that calibration did not see", found)
        rows += found
    arguments = {"target": target, "sensor": sensor, "images": images, "patches": patches, "seed": seed}
    Document("quantize", arguments, (model, out), tuple(rows)).write(json)
