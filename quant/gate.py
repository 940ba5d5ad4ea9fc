"""The float/INT8 gate: measure what INT8 changes, and compare it with the limits."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
import onnxruntime as ort

from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.profiles.errors import ImageError, ModelError, OptionError
from beers_deploy.profiles.figures import Check, Figure, Row, measured, unavailable
from beers_deploy.quant.limits import MAE_GROWTH, Limits
from beers_deploy.quant.sample_range import RangeCounts, SampleRange
from beers_deploy.quant.samples import LARGEST
from beers_deploy.quant.session import result_of
from beers_deploy.quant.untrusted import times

if TYPE_CHECKING:
    from beers_deploy.quant.samples import Pair


@dataclass(frozen=True)
class Metric:
    """What a user measures results by.

    Attributes:
        unit: of the figure.
        larger_is_better: whether it is.
        value: of a result (1, C, H, W) and its reference of the same shape.
    """

    unit: str
    larger_is_better: bool
    value: Callable[[np.ndarray, np.ndarray], float]


def _similarity(result: np.ndarray, reference: np.ndarray) -> float:
    # SSIM is that of one band, so it is the mean over the bands.
    return float(np.mean([ssim(*pair, 1.0) for pair in zip(result[0], reference[0], strict=True)]))


METRICS: Mapping[str, Metric] = {
    "psnr": Metric("dB", True, lambda result, reference: psnr_db(result, reference, 1.0)),
    "ssim": Metric("ratio", True, _similarity),
    "mae": Metric(
        "of full scale",
        False,
        lambda result, reference: float(np.abs(result - reference).mean()),
    ),
}


def metric_value(name: str, result: np.ndarray, reference: np.ndarray) -> float:
    """Return the value of a metric, by its name, for one result (1, C, H, W)."""
    if reference.size != result.size:
        raise OptionError(
            f"The `metric` {name!r} needs references of {times(result.shape)} for results of that "
            f"size, got {times(reference.shape)}. Give these, or leave the metric out."
        )
    return METRICS[name].value(result, reference)


@dataclass(frozen=True)
class GateResult:
    """Differences in [0, 1] of full scale over all pixels; PSNRs over full scale, in dB, NaN
    without references.

    `metric` is what the user measures results by, `metric_float` and
    `metric_int8` what was found of the two. `worst_drop_db` is what the patch loses that loses
    most. `input_change` is the mean absolute difference of the float results from their inputs, NaN
    where these have another shape. `contrast` is the mean absolute deviation of the float results
    from their own means. `sample_range` says which part of the range the samples cover.
    """

    mae: float
    std: float
    max_abs: float
    p999: float
    psnr_between_db: float
    psnr_degraded_db: float
    psnr_float_db: float
    psnr_int8_db: float
    patches: int
    simulated: bool = True
    worst_drop_db: float = math.nan
    metric: str = ""
    metric_float: float = math.nan
    metric_int8: float = math.nan
    input_change: float = math.nan
    contrast: float = math.nan
    sample_range: SampleRange | None = None

    @property
    def metric_loss(self) -> float:
        """What INT8 loses by the user's metric: above 0 it is worse than float."""
        lost = self.metric_float - self.metric_int8
        return lost if METRICS[self.metric].larger_is_better else -lost

    @property
    def source(self) -> str:
        """Where the figures come from."""
        return (
            f"{self.patches} simulated patches of 128 x 128"
            if self.simulated
            else f"{self.patches} samples"
        )

    @property
    def drop_db(self) -> float:
        """PSNR lost against the reference."""
        return self.psnr_float_db - self.psnr_int8_db

    @property
    def gain_db(self) -> float:
        """PSNR that the float network gains over its input."""
        return self.psnr_float_db - self.psnr_degraded_db

    @property
    def drop_share(self) -> float:
        """PSNR lost over PSNR gained by the float network; NaN where that gains nothing, or without
        references.
        """
        return self.drop_db / self.gain_db if self.gain_db > 0 else math.nan

    @property
    def std_over_mae(self) -> float:
        """1.25 for rounding, which is Gaussian in the end; clipping drives it up.

        0 where nothing differs.
        """
        return 0.0 if self.mae == 0 else self.std / self.mae


def compare(
    float_session: ort.InferenceSession,
    int8_session: ort.InferenceSession,
    pairs: "Iterable[Pair]",
    simulated: bool = True,
    metric: str | None = None,
    names: Sequence[str] = (),
) -> GateResult:
    """Run both networks on (degraded, reference) pairs of (1, C, H, W) in [0, 1]; images clipped as
    a file would.

    Without references, or where they have another size than what is compared, the PSNRs to them are
    NaN.

    Args:
        float_session: the float network's.
        int8_session: the INT8 network's.
        pairs: what both are run on.
        simulated: whether these are simulated patches.
        metric: one of `METRICS`, by which results are compared with the references too.
        names: of the samples, for messages.

    Raises:
        ModelError: results of different shapes.
        ImageError: a reference of the results' size outside [0, 1], or a sample without one where
            others have it.
        OptionError: references that the metric does not take.
    """
    differences = []
    errors = []
    changes = []
    contrasts = []
    counts = RangeCounts()
    metric_values = list[list[float]]()
    unfit_shapes = dict[str, tuple[int, ...]]()
    for number, (degraded, reference) in enumerate(pairs):
        counts.add(degraded)
        results = [result_of(s, degraded) for s in (float_session, int8_session)]
        if results[0].shape != results[1].shape:
            float_size, int8_size = (times(result.shape) for result in results)
            raise ModelError(
                f"The results of the INT8 network are {int8_size}, but those of the float network "
                f"are {float_size}. Give the INT8 file that was made from this float network."
            )
        if results[0].ndim != 4:
            raise ModelError(
                f"The results of the networks must be images (N, C, H, W), but they are "
                f"{times(results[0].shape)}. The gate is for networks that make an image of an "
                "image; 'check' and 'bench' read any network."
            )
        # The float result alone decides, so that both are clipped or neither is.
        inside = ((results[0] >= 0) & (results[0] <= 1)).mean()
        is_image = results[0].shape[1] == degraded.shape[1] and bool(inside >= MOST)
        in_float, in_int8 = (_as_in_a_file(result, is_image) for result in results)
        differences.append((in_int8 - in_float).ravel())
        same_shape = in_float.shape == degraded.shape
        changes.append(float(np.abs(in_float - degraded).mean()) if same_shape else math.nan)
        contrasts.append(float(np.abs(in_float - in_float.mean()).mean()))
        name = names[number] if names else f"sample {number}"
        if reference.shape != in_float.shape:
            unfit_shapes[name] = reference.shape
        else:
            _require_full_scale(name, reference)
        errors.append([_psnr_db(image, reference) for image in (degraded, in_float, in_int8)])
        if metric is not None:
            metric_values.append(
                [metric_value(metric, result, reference) for result in (in_float, in_int8)]
            )
    some_fit = not np.isnan([in_float for _, in_float, _ in errors]).all()
    if unfit_shapes and some_fit:
        # A mean over some of them would be NaN, and its check left out.
        name, shape = next(iter(unfit_shapes.items()))
        raise unfit_reference(name, shape, "the PSNRs, because other samples have one")
    difference = np.concatenate(differences).astype(np.float64)
    degraded_db, float_db, int8_db = np.mean(errors, axis=0)
    metric_float = metric_int8 = math.nan
    if metric is not None:
        metric_float, metric_int8 = np.mean(metric_values, axis=0).tolist()
    return GateResult(
        mae=float(np.abs(difference).mean()),
        std=float(difference.std()),
        max_abs=float(np.abs(difference).max()),
        p999=float(np.quantile(np.abs(difference), 0.999)),
        psnr_between_db=psnr_db(difference, np.zeros_like(difference), 1.0),
        psnr_degraded_db=float(degraded_db),
        psnr_float_db=float(float_db),
        psnr_int8_db=float(int8_db),
        patches=len(errors),
        simulated=simulated,
        metric=metric or "",
        metric_float=metric_float,
        metric_int8=metric_int8,
        worst_drop_db=float(np.max([in_float - in_int8 for _, in_float, in_int8 in errors])),
        input_change=float(np.mean(changes)),
        contrast=float(np.mean(contrasts)),
        sample_range=counts.range,
    )


def _require_full_scale(name: str, reference: np.ndarray) -> None:
    low = float(reference.min())
    high = float(reference.max())
    if not (low >= 0 and high <= LARGEST):
        raise ImageError(
            f"The reference of {name} must have values in [0, 1], but they are {low:.4g} to "
            f"{high:.4g}. Divide it by full scale."
        )


def unfit_reference(name: str, shape: Sequence[int], wanted: str) -> ImageError:
    """Return the error of a reference of another size than the network's results, which `wanted`
    needs.
    """
    fault = f"its reference has {times(shape[1:])}" if math.prod(shape) else "it has none"
    return ImageError(
        f"{name} must have a reference of the size of the network's results for {wanted}, but "
        f"{fault}. Give references of that size for all samples, or none."
    )


MOST = 0.5
"""Of a float network's results lie in [0, 1] where they are an image, and not of another scale."""


def _as_in_a_file(result: np.ndarray, is_image: bool) -> np.ndarray:
    """An image clipped to [0, 1], anything else as it is; NaN where infinite, which no clipping
    makes a pixel.
    """
    return np.where(np.isinf(result), np.nan, np.clip(result, 0, 1) if is_image else result)


def _psnr_db(image: np.ndarray, reference: np.ndarray) -> float:
    return psnr_db(image, reference, 1.0) if reference.shape == image.shape else math.nan


def judge(result: GateResult, limits: Limits, baseline_mae: float | None = None) -> list[Check]:
    """Every limit that is set, against what was found."""
    scale = "of full scale"
    checks = [
        _at_most("MAE", result.mae, limits.mae, scale),
        _at_most("99.9th percentile", result.p999, limits.p999, scale),
        _at_most("std / MAE", result.std_over_mae, limits.std_over_mae, "ratio"),
        _at_most("PSNR drop", result.drop_db, limits.psnr_drop_db, "dB"),
    ]
    # Without references the gain is NaN, and where float gains nothing a share of it says nothing.
    if result.gain_db > 0:
        gained = f"the float network gains {result.gain_db:.2f} dB"
        checks.append(
            _at_most("PSNR drop over gain", result.drop_share, limits.drop_share, "ratio", gained)
        )
    if limits.metric_loss is not None and result.metric:
        unit = METRICS[result.metric].unit
        checks.append(
            _at_most(f"{result.metric} lost", result.metric_loss, limits.metric_loss, unit)
        )
    if limits.min_psnr_float_int8_db is not None:
        least = limits.min_psnr_float_int8_db
        checks.append([Check("PSNR float-INT8", result.psnr_between_db, least, "dB", "at least")])
    if baseline_mae is not None:
        growth = MAE_GROWTH if limits.mae_growth is None else limits.mae_growth
        allowed = growth * baseline_mae
        detail = f"the baseline has {baseline_mae:.4g}"
        checks.append(_at_most("MAE against the baseline", result.mae, allowed, scale, detail))
    return list(chain.from_iterable(checks))


def judge_saturation(shares: Mapping[str, float], limits: Limits) -> list[Check]:
    """The layer that saturates most, against the limit if there is one; where nothing is 8-bit none
    is kept.
    """
    none = ("any layer: none is 8-bit", math.nan)
    layer, share = max(shares.items(), key=lambda item: item[1], default=none)
    return _at_most("saturated results", share, limits.saturated, "of a layer's", f"in {layer}")


def _at_most(
    name: str, value: float, limit: float | None, unit: str, detail: str = ""
) -> list[Check]:
    return [] if limit is None else [Check(name, value, limit, unit, detail=detail)]


def gate_row(result: GateResult) -> Row:
    """What INT8 changes, on patches that calibration did not see."""
    entries = {
        "MAE": (result.mae, "of full scale"),
        "std": (result.std, "of full scale"),
        "std / MAE": (result.std_over_mae, "ratio"),
        "99.9th percentile": (result.p999, "of full scale"),
        "max": (result.max_abs, "of full scale"),
        "PSNR float-INT8": (result.psnr_between_db, "dB"),
        "PSNR degraded": (result.psnr_degraded_db, "dB"),
        "PSNR float": (result.psnr_float_db, "dB"),
        "PSNR INT8": (result.psnr_int8_db, "dB"),
    }
    figures = {name: _figure(value, unit, result) for name, (value, unit) in entries.items()}
    if result.metric:
        values = {
            "float": result.metric_float,
            "INT8": result.metric_int8,
            "lost": result.metric_loss,
        }
        unit = METRICS[result.metric].unit
        for name, value in values.items():
            figures[f"{result.metric} {name}"] = _figure(value, unit, result)
    return Row("gate", "INT8 against float", figures)


def verdict_row(result: GateResult, shares: Mapping[str, float]) -> Row:
    """The figures of a gate: those of `gate_row`, the PSNR lost to the reference, the worst layer's
    saturation.
    """
    row = gate_row(result)
    drop = _figure(result.drop_db, "dB", result)
    worst = saturation_figure(shares, result.source)
    return replace(row, figures={**row.figures, "PSNR drop": drop, "saturated results": worst})


def _figure(value: float, unit: str, result: GateResult) -> Figure:
    if math.isinf(value):
        return unavailable(unit, "infinite: the two images are identical")
    if math.isnan(value):
        return unavailable(
            unit, "a network gave NaN" if math.isnan(result.mae) else "no reference of that size"
        )
    return measured(value, unit, result.source)


def saturation_figure(shares: Mapping[str, float], source: str) -> Figure:
    """What share of its results comes to the ends of 8 bits, in the layer where most do."""
    if not shares:
        return unavailable("%", "no result in the file is rounded to 8 bits")
    layer = max(shares, key=lambda name: shares[name])
    return measured(100 * shares[layer], "%", f"{layer}, the worst of {len(shares)}; {source}")
