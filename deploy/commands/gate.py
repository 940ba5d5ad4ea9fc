"""`beers-deploy gate`: does INT8 stay close enough to float? Exit code 1 when it does not."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "gate float.onnx int8.onnx --max-mae 0.0007"


def gate(
    float_model: Annotated[
        Path | None, typer.Argument(metavar="[FLOAT]", help="Float ONNX or weights; a shipped pair if none.")
    ] = None,
    int8_model: Annotated[Path | None, typer.Argument(metavar="[INT8]", help="Its INT8 ONNX.")] = None,
    variant: Annotated[
        str | None, typer.Option(help="Shipped pair of this name, without files; convbeers-s if none.")
    ] = None,
    max_mae: Annotated[
        float | None, typer.Option(min=0, help="Largest mean absolute difference, of full scale; 0.0007 if none.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="TOML file of limits; see docs/gate.md.")] = None,
    baseline: Annotated[Path | None, typer.Option(help="What 'gate --json' wrote before: MAE may not grow.")] = None,
    target: Annotated[str, typer.Option(help="Board whose rules the INT8 file must keep.")] = "vck190",
    sensor: Annotated[str, typer.Option(help="Profile of the test patches.")] = "pleiades-degraded",
    images: Annotated[Path | None, typer.Option(help="Folder of scenes; drawn ones if none.")] = None,
    patches: Annotated[int, typer.Option(min=1, help="Test patches of 128 x 128.")] = 32,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the patches.")] = 0,
    summary: Annotated[Path | None, typer.Option(help="Write the verdict here as Markdown.")] = None,
    junit: Annotated[Path | None, typer.Option(help="Write the verdict here as JUnit XML.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Compare a float and an INT8 network on simulated pairs neither was calibrated on.

    Also checked: what saturates inside, the DPU's rules, that no ReLU was lost, and that onnxruntime's optimisations
    change no bit.
    """
    from deploy.counterpart import require_quantised
    from deploy.defaults import HELD_OUT_SEED, load_scenes
    from deploy.defaults import float_model as read_float
    from deploy.gate import files_or_shipped, structure_checks
    from deploy.gate_baseline import baseline_mae
    from deploy.gate_report import write_summaries
    from deploy.results import Document
    from deploy.tables import print_rows
    from deploy.verdict import gate_row, saturation_figure
    from model.files import require_writable
    from profiles import load_sensor
    from quant.calibration import REFERENCE, draw_patches
    from quant.gate import compare
    from quant.limits import judge, judge_saturation, read_limits
    from quant.onnx_file import load_onnx
    from quant.saturation import saturated_shares
    from quant.session import open_any_size

    require_writable(json, summary, junit)
    limits = read_limits(config, max_mae)
    arguments = {"max_mae": limits.mae, "config": config, "baseline": baseline, "target": target, "sensor": sensor}
    arguments |= {"patches": patches, "seed": seed, "images": images}
    before = None if baseline is None else baseline_mae(baseline, arguments)
    float_path, int8_path = files_or_shipped(float_model, int8_model, variant)
    models = read_float(float_path), load_onnx(int8_path)
    require_quantised(models[0], float_path, wanted=False)
    require_quantised(models[1], int8_path, wanted=True)
    sessions = open_any_size(models[0]), open_any_size(models[1])
    degraded, reference = load_sensor(sensor), load_sensor(REFERENCE)
    held_out = seed + HELD_OUT_SEED
    scenes = load_scenes(images, reference.nominal(), held_out)
    drawn = draw_patches(scenes, degraded, reference, patches, held_out)
    result, shares = compare(*sessions, drawn.pairs), saturated_shares(models[1], drawn.degraded)
    checks = [*judge(result, limits, before), *judge_saturation(shares, limits)]
    checks += structure_checks(models[0], int8_path, models[1], target)
    row = gate_row(result)
    row = replace(row, figures={**row.figures, "saturated results": saturation_figure(shares, patches)})
    print_rows("float against INT8", [row])
    for check in checks:
        typer.echo(f"{'ok    ' if check.passed else 'FAILED'} {check.name}: {check.found} (allowed: {check.allowed})")
    Document("gate", arguments, (float_path, int8_path), (row,)).write(json)
    write_summaries(f"INT8 gate of {int8_path.name}", checks, summary, junit)
    passed = all(check.passed for check in checks)
    typer.echo(f"gate {'passed' if passed else 'FAILED'}: MAE {result.mae:.3g}, PSNR drop {result.drop_db:.2f} dB")
    if not passed:
        raise typer.Exit(1)
