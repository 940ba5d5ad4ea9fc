"""`beers-deploy quantize`: float ONNX to static INT8 under the DPU's rules, or free of them."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "quantize float.onnx --target vck190 --sensor pleiades-degraded --out int8.onnx"
HELD_OUT_PATCHES = 32


class Regime(StrEnum):
    """Whose arithmetic."""

    legal = "legal"
    free = "free"


def quantize(
    model: Annotated[Path, typer.Argument(help="Float ONNX written by 'export'.")],
    out: Annotated[Path, typer.Option(help="INT8 ONNX for the host, runs on stock onnxruntime.")],
    target: Annotated[str, typer.Option(help="Whose rules to obey.")] = "vck190",
    sensor: Annotated[
        str, typer.Option(help="Profile that calibration patches are drawn from.")
    ] = "pleiades-variable",
    regime: Annotated[
        Regime, typer.Option(help="legal: the DPU's rules; free: float scales, a channel's own for weights.")
    ] = Regime.legal,
    board: Annotated[Path | None, typer.Option(help="Also write the DPU's core in the board's spelling.")] = None,
    images: Annotated[Path | None, typer.Option(help="Folder of scenes for calibration; drawn ones if none.")] = None,
    patches: Annotated[int, typer.Option(min=1, help="Calibration patches.")] = 64,
    patch: Annotated[int, typer.Option(min=32, help="Side of a calibration patch in pixels.")] = 128,
    ablate: Annotated[bool, typer.Option("--ablate", help="Show what each pass buys, on other patches.")] = False,
    report: Annotated[
        Path | None,
        typer.Option(help="Folder for report.html and report.json: which layers and patches err, and how."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the patches.")] = 0,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Quantise to int8 with power-of-two positions: the correction on the DPU, the 12-bit add on the host.

    Prints each integer layer: bits of its accumulator, seen and proven, and the share of saturated results.
    """
    from deploy.blame import blame_report
    from deploy.defaults import HELD_OUT_SEED, load_scenes
    from deploy.progress import steps
    from deploy.quant_report import LAYER_PATCHES, ablation_rows, ablations, layer_rows, rounding_row
    from deploy.report.page import write_report
    from deploy.results import Document
    from deploy.tables import print_rows
    from deploy.verdict import gate_row
    from model.files import require_writable
    from profiles import load_sensor, load_target
    from profiles.errors import OptionError
    from quant.calibration import REFERENCE, Patches, draw_patches
    from quant.free import free_ticks, quantise_free
    from quant.gate import compare
    from quant.onnx_file import load_onnx, save_onnx
    from quant.quantise import quantise_model, ticks
    from quant.session import open_session

    if regime is Regime.free and (board or ablate or report):
        remedy = "leave it out, or take --regime legal"
        raise OptionError("--regime free", expected="no --board, --ablate or --report", got="one", remedy=remedy)
    page, figures = (report / "report.html", report / "report.json") if report else (None, None)
    require_writable(out, board, json, page, figures)
    board_target = load_target(target)
    float_model = load_onnx(model)
    degraded, reference = load_sensor(sensor), load_sensor(REFERENCE)
    scenes = load_scenes(images, reference.nominal(), seed)
    drawn = draw_patches(scenes, degraded, reference, patches, seed, patch)
    about = {"calibration_sensor": degraded.name, "calibration_seed": str(seed)}
    arguments = {"target": target, "sensor": sensor, "images": images, "patches": patches, "patch": patch}
    arguments |= {"regime": regime.value, "seed": seed}

    def unseen() -> Patches:
        """Patches of the same scenes, or of other drawn ones, that calibration does not see."""
        other = seed + HELD_OUT_SEED
        ground = scenes if images else load_scenes(None, reference.nominal(), other)
        return draw_patches(ground, degraded, reference, HELD_OUT_PATCHES, other)

    if regime is Regime.free:
        with steps("calibrating", free_ticks(float_model, patches)) as bar:
            made = quantise_free(float_model, drawn, about, bar.advance)
        save_onnx(made, out)
        typer.echo(f"wrote {out}: float scales, for boards that are not the DPU")
        row = gate_row(compare(open_session(float_model), open_session(made), unseen().pairs))
        print_rows("float against INT8, on patches that calibration did not see", [row])
        Document("quantize", arguments, (model, out), (row,)).write(json)
        return
    about["target"] = board_target.name
    with steps("calibrating", ticks(float_model, patches)) as bar:
        result = quantise_model(float_model, drawn, about, bar.advance)
    save_onnx(result.host, out)
    typer.echo(f"wrote {out}: {len(result.core.ops)} integer operations, {result.relus} ReLUs kept")
    if board is not None:
        save_onnx(result.board, board)
        typer.echo(f"wrote {board}: the same numbers in the board's spelling")
    layers, rounding = layer_rows(result.core, drawn.degraded), rounding_row(result.core, drawn.degraded)
    print_rows("integer layers", layers)
    print_rows("the rule for halves", [rounding])
    rows = [*layers, rounding]
    if ablate:
        with steps("ablating", len(ablations())) as bar:
            found = ablation_rows(float_model, drawn, unseen(), bar.advance)
        print_rows("what each pass buys, on patches that calibration did not see", found)
        rows += found
    if page:
        with steps("blaming", LAYER_PATCHES) as bar:
            found, written = blame_report(float_model, result, unseen(), rows, bar.advance)
        rows = [*found, *rows]
        write_report(written, page)
        typer.echo(f"wrote {page}: {written.headline}")
    document = Document("quantize", arguments, (model, out), tuple(rows))
    for path in (figures, json):
        document.write(path)
