"""What quantisation did: layer by layer in whole numbers, and what each pass buys on patches it has not seen."""

from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from itertools import islice

import numpy as np
import onnx

from deploy.results import Row, measured, predicted
from deploy.verdict import gate_row
from quant.calibration import Patches
from quant.core import IntCore
from quant.gate import compare
from quant.graph import CORRECTION
from quant.integer import LayerReport, run_core
from quant.pieces import crops
from quant.planes import split
from quant.quantise import ALL, Passes, quantise_model
from quant.session import open_any_size

LAYER_PATCHES = 4
BITS_SOURCE = "128 times the sum of the weights' sizes, plus the bias: no input exceeds it"


def layer_rows(core: IntCore, images: Iterable[np.ndarray]) -> list[Row]:
    """Accumulators, saturation and ties of each integer operation on a crop of a few images (1, 1, H, W)."""
    seen = [run_core(core, split(crop))[1] for crop in few_crops(images)]
    source = f"the integer reference on {len(seen)} calibration patches"
    return [_layer_row(list(reports), source) for reports in zip(*seen, strict=True)]


def _layer_row(reports: list[LayerReport], source: str) -> Row:
    proven = reports[0].proven_bits
    figures = {
        "accumulator, seen": measured(max(r.peak_bits for r in reports), "bits", source),
        "accumulator, proven": predicted(proven, "bits", (proven, proven), BITS_SOURCE),
        "saturated": measured(100 * float(np.mean([r.saturated for r in reports])), "%", source),
        "halves": measured(100 * float(np.mean([r.ties for r in reports])), "%", source),
    }
    return Row("integer layers", reports[0].name, figures)


def few_crops(images: Iterable[np.ndarray]) -> list[np.ndarray]:
    """One crop of each of the first few images: what is looked at layer by layer."""
    return [crops(image)[0] for image in islice(images, LAYER_PATCHES)]


def rounding_row(core: IntCore, images: Iterable[np.ndarray]) -> Row:
    """How far the DPU's rounding of halves, up, leads away from the runtime's, to even."""
    scale = core.scale(CORRECTION)
    differences = []
    for crop in few_crops(images):
        up, even = (run_core(core, split(crop), half_even=rule)[0][CORRECTION][:, :1] for rule in (False, True))
        differences.append(np.abs(up - even) * scale)
    difference = np.concatenate([d.ravel() for d in differences])
    source = f"the integer reference on {len(differences)} calibration patches, both ways"
    figures = {
        "pixels that differ": measured(100 * float((difference > 0).mean()), "%", source),
        "MAE": measured(float(difference.mean()), "of full scale", source),
    }
    return Row("rounding", "halves up (DPU) against halves to even (onnxruntime)", figures)


def ablation_rows(
    model: onnx.ModelProto, calibration: Patches, held_out: Patches, tick: Callable[[], None]
) -> list[Row]:
    """The gate's figures with all passes, with each one left out, and with none."""
    session, rows = open_any_size(model), []
    for name, passes in ablations().items():
        made = quantise_model(model, calibration, {}, lambda: None, passes)
        row = gate_row(compare(session, open_any_size(made.host), held_out.pairs))
        rows.append(Row("ablation", name, row.figures))
        tick()
    return rows


def ablations() -> dict[str, Passes]:
    """All passes, all but one, none; without a steady stream there is nothing to equalise."""
    names = [field.name for field in fields(Passes)]
    found = {"all passes": ALL}
    for name in names:
        left_out = {name: False, "equalise": False} if name == "steady_stream" else {name: False}
        found[f"without {name.replace('_', ' ')}"] = replace(ALL, **left_out)
    return {**found, "none": Passes(**dict.fromkeys(names, False))}
