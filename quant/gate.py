"""The float/INT8 gate: what INT8 changes, and the limits, by name, that say whether that is too much."""

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnxruntime as ort

from beers_deploy.model.metrics.fidelity import psnr_db, ssim
from beers_deploy.profiles.errors import ModelError, OptionError
from beers_deploy.profiles.figures import Check, Figure, Row, measured, unavailable
from beers_deploy.profiles.toml import read_toml_text, unreadable
from beers_deploy.quant.session import result_of
from beers_deploy.quant.untrusted import times

if TYPE_CHECKING:
    from beers_deploy.quant.samples import Pair


Parts = tuple[np.ndarray, np.ndarray]
"""Numerators and denominators of one sample, for each class or for one: both are added up over the samples."""


@dataclass(frozen=True)
class Metric:
    """What a user measures results by.

    Attributes:
        unit: of the figure.
        larger_is_better: whether it is.
        of_classes: whether references are numbers of classes, for every result or for every pixel.
        parts: of a result and its reference.
    """

    unit: str
    larger_is_better: bool
    of_classes: bool
    parts: Callable[[np.ndarray, np.ndarray], Parts]


def _alone(value: float) -> Parts:
    return np.array([value]), np.ones(1)


def _similarity(result: np.ndarray, reference: np.ndarray) -> Parts:
    return _alone(float(np.mean([ssim(*pair, 1.0) for pair in zip(result[0], reference[0], strict=True)])))


def _hits(result: np.ndarray, reference: np.ndarray) -> Parts:
    right = result.argmax(1).ravel() == reference.ravel()
    return np.array([right.sum()]), np.array([right.size])


def _overlap(result: np.ndarray, reference: np.ndarray) -> Parts:
    """Of every class, the pixels that both say and those that one of them says."""
    said, meant = (np.arange(result.shape[1])[:, None] == each.ravel() for each in (result.argmax(1), reference))
    return (said & meant).sum(1), (said | meant).sum(1)


METRICS: Mapping[str, Metric] = {
    "psnr": Metric("dB", True, False, lambda result, reference: _alone(psnr_db(result, reference, 1.0))),
    "ssim": Metric("ratio", True, False, _similarity),
    "mae": Metric("of full scale", False, False, lambda result, reference: _alone(np.abs(result - reference).mean())),
    "top1": Metric("ratio", True, True, _hits),
    "iou": Metric("ratio", True, True, _overlap),
}
"""By name. iou is the mean over the classes of intersection over union."""


def parts_of(name: str, result: np.ndarray, reference: np.ndarray) -> Parts:
    """What one result (1, C, ...) adds to a metric, by its name."""
    metric = METRICS[name]
    wanted = (len(result), *result.shape[2:]) if metric.of_classes else result.shape
    if reference.size != math.prod(wanted) or (metric.of_classes and result.shape[1] < 2):
        kind = "numbers of classes" if metric.of_classes else "references"
        expected, got = f"{kind} of {times(wanted)}", f"{times(reference.shape)} for results of {times(result.shape)}"
        raise OptionError("metric", expected=expected, got=got, remedy="give these, or another metric")
    return metric.parts(result, reference)


def value_of(parts: Sequence[Parts]) -> float:
    """The metric over all samples of one network; NaN of none."""
    if not parts:
        return math.nan
    above, below = (np.sum(each, 0) for each in zip(*parts, strict=True))
    return float((above[below > 0] / below[below > 0]).mean())


@dataclass(frozen=True)
class GateResult:
    """Differences in [0, 1] of full scale over all pixels; PSNRs over full scale, in dB, NaN without references.

    `same_class` is the share of results whose largest channel is the same: of networks that tell classes, else NaN.
    `metric` is what the user measures results by, `metric_float` and `metric_int8` what was found of the two.
    `worst_drop_db` is what the patch loses that loses most.
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
    same_class: float = math.nan
    simulated: bool = True
    worst_drop_db: float = math.nan
    metric: str = ""
    metric_float: float = math.nan
    metric_int8: float = math.nan

    @property
    def metric_loss(self) -> float:
        """What INT8 loses by the user's metric: above 0 it is worse than float."""
        lost = self.metric_float - self.metric_int8
        return lost if METRICS[self.metric].larger_is_better else -lost

    @property
    def source(self) -> str:
        """Where the figures come from."""
        return f"{self.patches} simulated patches of 128 x 128" if self.simulated else f"{self.patches} samples"

    @property
    def drop_db(self) -> float:
        """PSNR lost against the reference."""
        return self.psnr_float_db - self.psnr_int8_db

    @property
    def std_over_mae(self) -> float:
        """1.25 for rounding, which is Gaussian in the end; clipping drives it up. 0 where nothing differs."""
        return 0.0 if self.mae == 0 else self.std / self.mae


def compare(
    float_session: ort.InferenceSession,
    int8_session: ort.InferenceSession,
    pairs: "Iterable[Pair]",
    simulated: bool = True,
    metric: str | None = None,
) -> GateResult:
    """Run both networks on (degraded, reference) pairs of (1, C, H, W) in [0, 1]; images clipped as a file would.

    Without references, or where they have another size than what is compared, the PSNRs to them are NaN.

    Args:
        float_session: the float network's.
        int8_session: the INT8 network's.
        pairs: what both are run on.
        simulated: whether these are simulated patches.
        metric: one of `METRICS`, by which results are held against the references too.

    Raises:
        ModelError: results of different shapes.
        OptionError: references that the metric does not take.
    """
    differences, errors, agreeing, measured_by = [], [], [], list[list[Parts]]()
    for degraded, reference in pairs:
        results = [result_of(s, degraded) for s in (float_session, int8_session)]
        if results[0].shape != results[1].shape:
            expected, got = (times(result.shape) for result in results)
            remedy = "give the INT8 file that was made of this float network"
            raise ModelError("INT8 network", expected=f"results of {expected}, as in float", got=got, remedy=remedy)
        classes = [result.argmax(1) for result in results]
        agreeing.append((classes[0] == classes[1]).mean() if results[0].shape[1] > degraded.shape[1] else math.nan)
        inside = ((results[0] >= 0) & (results[0] <= 1)).mean()
        is_image = results[0].ndim == 4 and results[0].shape[1] == degraded.shape[1] and bool(inside >= MOST)
        in_float, in_int8 = (_as_in_a_file(result, is_image) for result in results)
        differences.append((in_int8 - in_float).ravel())
        errors.append([_psnr_db(image, reference) for image in (degraded, in_float, in_int8)])
        if metric is not None:
            measured_by.append([parts_of(metric, result, reference) for result in (in_float, in_int8)])
    difference = np.concatenate(differences).astype(np.float64)
    degraded_db, float_db, int8_db = np.mean(errors, axis=0)
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
        same_class=float(np.mean(agreeing)),
        simulated=simulated,
        metric=metric or "",
        metric_float=value_of([parts for parts, _ in measured_by]),
        metric_int8=value_of([parts for _, parts in measured_by]),
        worst_drop_db=float(np.max([in_float - in_int8 for _, in_float, in_int8 in errors])),
    )


MOST = 0.5
"""Of a float network's results lie in [0, 1] where they are an image, and not of another scale."""


def _as_in_a_file(result: np.ndarray, is_image: bool) -> np.ndarray:
    """An image clipped to [0, 1], anything else as it is; NaN where infinite, which no clipping makes a pixel."""
    return np.where(np.isinf(result), np.nan, np.clip(result, 0, 1) if is_image else result)


def _psnr_db(image: np.ndarray, reference: np.ndarray) -> float:
    return psnr_db(image, reference, 1.0) if reference.shape == image.shape else math.nan


@dataclass(frozen=True)
class Limits:
    """The largest values allowed; None for no limit. Differences and shares in [0, 1], PSNRs in dB.

    Attributes:
        mae: mean absolute difference of INT8 from float.
        p999: 99.9th percentile of its size.
        std_over_mae: 1.25 is rounding alone; clipping drives it up.
        psnr_drop_db: PSNR lost against the reference.
        min_psnr_float_int8_db: smallest PSNR of INT8 against float.
        metric_loss: what INT8 loses by the metric that is chosen.
        saturated: share of a layer's results at the ends of 8 bits, of the layer with most.
        mae_growth: how many times a stored baseline's MAE; 1.05 where there is a baseline and no such limit.

    Examples:
        >>> bd.Limits(psnr_drop_db=0.2).mae
        0.0007
    """

    mae: float | None = 0.0007
    p999: float | None = None
    std_over_mae: float | None = None
    psnr_drop_db: float | None = None
    min_psnr_float_int8_db: float | None = None
    metric_loss: float | None = None
    saturated: float | None = None
    mae_growth: float | None = None


MAE_GROWTH = 1.05
BREAKABLE = {
    "mae": (0.0, 0.5),
    "p999": (0.0, 0.9),
    "std_over_mae": (0.0, 1000.0),
    "psnr_drop_db": (0.0, 100.0),
    "min_psnr_float_int8_db": (10.0, 1000.0),
    "metric_loss": (0.0, 100.0),
    "saturated": (0.0, 0.9),
    "mae_growth": (0.0, 100.0),
}
"""What limits may be: images in [0, 1] differ by no more, no layer saturates more, and no network is so far off."""


def limits_of(
    given: "Limits | Mapping[str, float] | str | os.PathLike[str] | None", max_mae: float | None = None
) -> Limits:
    """Limits by their names, of a TOML file such as `mae = 0.0007`, or the defaults for None; `max_mae` overrides.

    Raises:
        OptionError: no limits, unknown ones, or some that no network breaks.
    """
    if isinstance(given, str | os.PathLike):
        limits = _parse(Path(given))
    else:
        limits = _named("limits", given) if isinstance(given, Mapping) else _breakable("limits", given or Limits())
    return limits if max_mae is None else _breakable("max_mae", replace(limits, mae=max_mae))


def _breakable(where: str, limits: Limits) -> Limits:
    """Limits that a network can break: a gate that cannot fail is none."""
    for name, (low, high) in BREAKABLE.items():
        value = getattr(limits, name)
        if value is not None and not low <= value <= high:
            expected, remedy = f"{name} of {low:g} to {high:g}", "set one that a broken network would not keep"
            raise OptionError(where, expected=expected, got=f"{value:g}", remedy=remedy)
    return limits


def _parse(path: Path) -> Limits:
    try:
        raw = read_toml_text(path)
    except (OSError, ValueError) as error:
        got, expected = unreadable(path) or str(error), "a TOML file of limits"
        raise OptionError(str(path), expected=expected, got=got, remedy="write mae = 0.0007") from error
    return _named(str(path), raw)


def _named(where: str, raw: Mapping[str, object]) -> Limits:
    names = [field.name for field in fields(Limits)]
    if not raw:
        expected = f"at least one of {', '.join(names)}"
        raise OptionError(where, expected=expected, got="no limit", remedy="write mae = 0.0007")
    for name, value in raw.items():
        if name not in names or not _is_limit(value):
            expected = f"numbers above 0 named {', '.join(names)}"
            raise OptionError(where, expected=expected, got=f"{name} = {value!r}", remedy="correct that line")
    given: dict[str, Any] = {**dict.fromkeys(names), **raw}
    return _breakable(where, Limits(**given))


def _is_limit(value: object) -> bool:
    """A number above 0, of no more digits than are compared with others."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return value > 0 and (isinstance(value, float) or value < 1 << 64)


def judge(result: GateResult, limits: Limits, baseline_mae: float | None = None) -> list[Check]:
    """Every limit that is set, against what was found."""
    scale = "of full scale"
    checks = [
        _at_most("MAE", result.mae, limits.mae, scale),
        _at_most("99.9th percentile", result.p999, limits.p999, scale),
        _at_most("std / MAE", result.std_over_mae, limits.std_over_mae, "ratio"),
        _at_most("PSNR drop", result.drop_db, limits.psnr_drop_db, "dB"),
    ]
    if limits.metric_loss is not None and result.metric:
        unit = METRICS[result.metric].unit
        checks.append(_at_most(f"{result.metric} lost", result.metric_loss, limits.metric_loss, unit))
    if limits.min_psnr_float_int8_db is not None:
        least = limits.min_psnr_float_int8_db
        checks.append([Check("PSNR float-INT8", result.psnr_between_db, least, "dB", "at least")])
    if baseline_mae is not None:
        growth = MAE_GROWTH if limits.mae_growth is None else limits.mae_growth
        allowed, detail = growth * baseline_mae, f"the baseline has {baseline_mae:.4g}"
        checks.append(_at_most("MAE against the baseline", result.mae, allowed, scale, detail))
    return [check for found in checks for check in found]


def judge_saturation(shares: Mapping[str, float], limits: Limits) -> list[Check]:
    """The layer that saturates most, against the limit if there is one; where nothing is 8-bit none is kept."""
    layer, share = max(shares.items(), key=lambda item: item[1], default=("any layer: none is 8-bit", math.nan))
    return _at_most("saturated results", share, limits.saturated, "of a layer's", f"in {layer}")


def _at_most(name: str, value: float, limit: float | None, unit: str, detail: str = "") -> list[Check]:
    return [] if limit is None else [Check(name, value, limit, unit, detail=detail)]


def gate_row(result: GateResult) -> Row:
    """What INT8 changes, on patches that calibration did not see."""
    found = {
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
    figures = {name: _figure(value, unit, result) for name, (value, unit) in found.items()}
    if not math.isnan(result.same_class):
        figures["same class"] = _figure(100 * result.same_class, "%", result)
    if result.metric:
        values = {"float": result.metric_float, "INT8": result.metric_int8, "lost": result.metric_loss}
        unit = METRICS[result.metric].unit
        figures |= {f"{result.metric} {name}": _figure(value, unit, result) for name, value in values.items()}
    return Row("gate", "INT8 against float", figures)


def verdict_row(result: GateResult, shares: Mapping[str, float]) -> Row:
    """The figures of a gate: those of `gate_row`, the PSNR lost to the reference, the worst layer's saturation."""
    row, drop = gate_row(result), _figure(result.drop_db, "dB", result)
    worst = saturation_figure(shares, result.source)
    return replace(row, figures={**row.figures, "PSNR drop": drop, "saturated results": worst})


def _figure(value: float, unit: str, result: GateResult) -> Figure:
    if math.isinf(value):
        return unavailable(unit, "infinite: the two images are identical")
    if math.isnan(value):
        return unavailable(unit, "a network gave NaN" if math.isnan(result.mae) else "no reference of that size")
    return measured(value, unit, result.source)


def saturation_figure(shares: Mapping[str, float], source: str) -> Figure:
    """What share of its results comes to the ends of 8 bits, in the layer where most do."""
    if not shares:
        return unavailable("%", "no result in the file is rounded to 8 bits")
    layer = max(shares, key=lambda name: shares[name])
    return measured(100 * shares[layer], "%", f"{layer}, the worst of {len(shares)}; {source}")
