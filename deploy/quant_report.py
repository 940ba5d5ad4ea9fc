"""What quantisation did: layer by layer in whole numbers, and what each pass buys on patches it has not seen."""

from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from itertools import islice

import numpy as np
import onnx

from deploy.gate import gate_row
from deploy.results import Figure, Row, measured, predicted
from quant.agreement import LayerAgreement, agreement
from quant.calibration import Patches
from quant.core import IntCore
from quant.gate import compare
from quant.pieces import crops
from quant.positions import SHIFTS, Shifts
from quant.quantise import ALL, Passes, quantise_model
from quant.session import open_any_size, run

LAYER_PATCHES = 4
NARROW_BITS = 23
"""Of a 24-bit accumulator, without the sign: the documents hint at one (facts on the DPU's rules), int32 has 31."""
BITS_SOURCE = "128 times the sum of the weights' sizes, plus the bias: no input exceeds it"


def integer_rows(
    model: onnx.ModelProto, core: IntCore, host: onnx.ModelProto, images: Iterable[np.ndarray]
) -> tuple[list[Row], Row]:
    """Each integer operation on a crop of a few images (1, 1, H, W), and what the DPU's rule for halves changes."""
    seen = few_crops(images)
    found = [agreement(core, host, crop) for crop in seen]
    source = f"the integer reference on {len(found)} calibration patches"
    layers = [_layer_row(list(same), source) for same in zip(*(one.layers for one in found), strict=True)]
    session = open_any_size(model)
    both = [
        [np.clip(crop + result, 0, 1) for result in (one.up, one.even)] for crop, one in zip(seen, found, strict=True)
    ]
    in_float = [np.clip(run(session, crop), 0, 1) for crop in seen]
    return layers, _rounding_row(in_float, both, source)


def _layer_row(layers: list[LayerAgreement], source: str) -> Row:
    proven = layers[0].report.proven_bits
    left = NARROW_BITS - proven

    def percent(shares: Iterable[float], of: str = source) -> Figure:
        return measured(100 * float(np.mean(list(shares))), "%", of)

    figures = {
        "accumulator, seen": measured(max(a.report.peak_bits for a in layers), "bits", source),
        "accumulator, proven": predicted(proven, "bits", (proven, proven), BITS_SOURCE),
        "left of 24 bits": predicted(left, "bits", (left, left), f"23 bits and a sign, less {BITS_SOURCE}"),
        "saturated": percent(a.report.saturated for a in layers),
        "halves": percent(a.report.ties for a in layers),
        "as onnxruntime": percent((1 - a.unequal for a in layers), f"{source}, halves to even as there"),
        "moved by halves up": percent((a.moved for a in layers), f"{source}, halves up"),
        "at most by": measured(max(a.moved_by for a in layers), "units", f"{source}, halves up"),
    }
    return Row("integer layers", layers[0].report.name, figures)


def _rounding_row(in_float: list[np.ndarray], both: list[list[np.ndarray]], source: str) -> Row:
    """How far the DPU's rounding of halves, up, leads away from the runtime's, to even; which is nearer to float."""
    up, even = (np.concatenate([results[k].ravel() for results in both]) for k in (0, 1))
    whole = np.concatenate([result.ravel() for result in in_float])

    def mae(one: np.ndarray, other: np.ndarray) -> Figure:
        return measured(float(np.abs(one - other).mean(dtype=np.float64)), "of full scale", source)

    figures = {
        "pixels that differ": measured(100 * float((up != even).mean()), "%", source),
        "MAE between them": mae(up, even),
        "MAE of halves up": mae(up, whole),
        "MAE of halves to even": mae(even, whole),
    }
    return Row("rounding", "halves up (DPU) against halves to even (onnxruntime)", figures)


def few_crops(images: Iterable[np.ndarray]) -> list[np.ndarray]:
    """One crop of each of the first few images: what is looked at layer by layer."""
    return [crops(image)[0] for image in islice(images, LAYER_PATCHES)]


def ablation_rows(
    model: onnx.ModelProto, calibration: Patches, held_out: Patches, tick: Callable[[], None], shifts: Shifts = SHIFTS
) -> list[Row]:
    """The gate's figures with all passes, with each one left out, and with none."""
    session, rows = open_any_size(model), []
    for name, passes in ablations().items():
        made = quantise_model(model, calibration, {}, lambda: None, passes, shifts)
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
