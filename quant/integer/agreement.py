"""Compare the integer reference with onnxruntime, layer by layer, and report the comparison."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

import numpy as np
from onnx import ModelProto, TensorProto

from beers_deploy.profiles.errors import ModelError
from beers_deploy.profiles.figures import Figure, Row, measured, predicted
from beers_deploy.quant.core import IntCore
from beers_deploy.quant.host_part import ZERO
from beers_deploy.quant.input_range import to_shares
from beers_deploy.quant.integer.reference import (
    BITS_SOURCE,
    NARROW_BITS,
    LayerReport,
    merged_correction,
    run_core,
)
from beers_deploy.quant.onnx.image_input import any_size
from beers_deploy.quant.session import (
    TILE_PX,
    open_any_size,
    open_session,
    result_of,
    with_outputs,
)
from beers_deploy.quant.tiling.receptive_field import tiling_of

LAYER_PATCHES = 4


@dataclass(frozen=True)
class LayerAgreement:
    """A comparison of one operation's results: the DPU's rule for ties, ties to even, and
    onnxruntime.

    Attributes:
        report: the report of the integer reference, which rounds ties up, as the DPU does.
        unequal: the share of onnxruntime's results that differ from the reference when that rounds
            ties to even. It should be 0.
        moved: the share of the results that differ between both rules, because of this operation or
            of those before it.
        moved_by: the largest of these differences, as a number of steps of the tensor's scale.
    """

    report: LayerReport
    unequal: float
    moved: float
    moved_by: int


@dataclass(frozen=True)
class Agreement:
    """A comparison of a core's results by both rules for ties, and with onnxruntime.

    Attributes:
        layers: the comparison for each operation, in order.
        up: the decoded result (N, C, H, W) with ties rounded up, as on the DPU.
        even: the decoded result with ties rounded to even, as in onnxruntime.
    """

    layers: list[LayerAgreement]
    up: np.ndarray
    even: np.ndarray


def agreement(core: IntCore, host: ModelProto, image: np.ndarray) -> Agreement:
    """Run a core by both rules for ties and in onnxruntime, and compare the results of each
    operation.

    Args:
        core: the integer core.
        host: the host's ONNX file of this core.
        image: (N, C, H, W) float32 as the network reads it.
    """
    names = [op.output for op in core.ops]
    session = open_session(with_outputs(any_size(host), dict.fromkeys(names, TensorProto.UINT8)))
    stored = session.run(names, {session.get_inputs()[0].name: image})
    planes = core.host_part.encode(image)
    up, reports = run_core(core, planes)
    even, _ = run_core(core, planes, half_even=True)
    layers = []
    for name, report, runtime in zip(names, reports, stored, strict=True):
        difference = np.abs(up[name] - even[name])
        # The host's file stores int8 as uint8 around 128.
        unequal = float((runtime.astype(np.int16) - ZERO != even[name]).mean())
        share = float((difference > 0).mean())
        layers.append(LayerAgreement(report, unequal, share, int(difference.max())))
    return Agreement(layers, merged_correction(core, up), merged_correction(core, even))


def few_crops(images: Iterable[np.ndarray], model: ModelProto) -> list[np.ndarray]:
    """Return one crop of each of the first LAYER_PATCHES images, on which figures of each layer are
    measured.

    Args:
        images: (1, C, H, W).
        model: the network. If it is fixed to one size, or reads the whole image, whole images are
            returned; otherwise sides that it accepts, of about TILE_PX.

    Returns:
        Crops (1, C, h, w).
    """
    try:
        tiling = tiling_of(model)
    except ModelError:
        side_px = None
    else:
        side_px = tiling.fixed_px or tiling.whole_px(TILE_PX)
    return [image[..., :side_px, :side_px] for image in islice(images, LAYER_PATCHES)]


def integer_rows(
    model: ModelProto, core: IntCore, host: ModelProto, images: Iterable[np.ndarray]
) -> tuple[Row, ...]:
    """Compare a core with the integer reference on a few crops, as table rows.

    Args:
        model: the float network.
        core: the integer core.
        host: the host's ONNX file of this core.
        images: calibration images (1, C, H, W), a crop of the first few of which is run.

    Returns:
        A row for each integer operation, then one for the effect of the DPU's tie rounding.
    """
    patches = few_crops(images, host)
    agreements = [agreement(core, host, crop) for crop in patches]
    source = f"the integer reference on {len(agreements)} calibration patches"
    by_layer = zip(*(one.layers for one in agreements), strict=True)
    layers = [_layer_row(list(same), source) for same in by_layer]
    session = open_any_size(model)
    part = core.host_part
    results = []
    for crop, one in zip(patches, agreements, strict=True):
        in_float = part.clip(result_of(session, crop))
        images_of = (part.finish(crop, one.up), part.finish(crop, one.even), in_float)
        results.append([to_shares(image, part.input_ranges).ravel() for image in images_of])
    up, even, floats = map(np.concatenate, zip(*results, strict=True))

    def mae(one: np.ndarray, other: np.ndarray) -> Figure:
        return measured(float(np.abs(one - other).mean(dtype=np.float64)), "of full scale", source)

    # How far the results differ, and the error of each against the float network.
    figures = {
        "pixels that differ": measured(100 * float((up != even).mean()), "%", source),
        "MAE between them": mae(up, even),
        "MAE of half up": mae(up, floats),
        "MAE of half to even": mae(even, floats),
    }
    return (
        *layers,
        Row("rounding", "half up (DPU) against half to even (onnxruntime)", figures),
    )


def _layer_row(layers: list[LayerAgreement], source: str) -> Row:
    proven = layers[0].report.proven_bits
    # AMD states no width of the accumulator; the bound on shift_bias hints at 24 bits.
    margin = NARROW_BITS - proven

    def percent(shares: Iterable[float], of: str = source) -> Figure:
        return measured(100 * float(np.mean(list(shares))), "%", of)

    figures = {
        "accumulator, seen": measured(max(a.report.peak_bits for a in layers), "bits", source),
        "accumulator, proven": predicted(proven, "bits", (proven, proven), BITS_SOURCE),
        "left of 24 bits": predicted(
            margin, "bits", (margin, margin), f"23 bits and a sign, less {BITS_SOURCE}"
        ),
        "saturated": percent(a.report.saturated for a in layers),
        "ties": percent(a.report.ties for a in layers),
        "as onnxruntime": percent(
            (1 - a.unequal for a in layers), f"{source}, half to even as there"
        ),
        "moved by half up": percent((a.moved for a in layers), f"{source}, half up"),
        "at most by": measured(max(a.moved_by for a in layers), "units", f"{source}, half up"),
    }
    return Row("integer layers", layers[0].report.name, figures)
