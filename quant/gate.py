"""Measure the effect of INT8: run both networks once on all patches, and compare them with each
other and with the references.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import onnxruntime as ort

from beers_deploy.model.metrics.fidelity import psnr_db
from beers_deploy.profiles.errors import ImageError, ModelError, counted
from beers_deploy.profiles.figures import Figure, Row, measured, unavailable
from beers_deploy.profiles.instrument import MAX_DN
from beers_deploy.quant.input_range import (
    LARGEST,
    MOST,
    Ranges,
    ranges_of_result,
    share_within,
    to_shares,
)
from beers_deploy.quant.metrics import METRICS, SCALE, metric_value
from beers_deploy.quant.samples.coverage import BINS, SampleRange, histogram, range_from
from beers_deploy.quant.samples.patches import Patches
from beers_deploy.quant.session import result_of
from beers_deploy.quant.untrusted import times


@dataclass(frozen=True)
class Spread:
    """Differences of INT8 from float over the patches that both networks were run on.

    Attributes:
        counts: (2 * 4095 + 1,) the number of pixels for each difference INT8 - float, rounded to
            integer digital numbers (DN, 4095 at full scale), from -4095 on.
        mae: (K,) mean absolute difference of each of the K patches, as a share of full scale.
        largest: (K,) largest absolute difference of each patch, as a share of full scale.
    """

    counts: np.ndarray
    mae: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, differences: Sequence[np.ndarray]) -> "Spread":
        """Summarise the differences (P,) of each of K patches, as shares of full scale."""
        counts = np.zeros(2 * MAX_DN + 1, np.int64)
        for difference in differences:
            dn = np.rint(np.nan_to_num(difference).clip(-1, 1) * MAX_DN).astype(np.int64)
            # Shifted by the largest digital number, because `bincount` counts from 0 on.
            counts += np.bincount(dn + MAX_DN, minlength=len(counts))
        sizes = [np.abs(difference) for difference in differences]
        mae = np.array([float(size.mean()) for size in sizes])
        largest = np.array([float(size.max()) for size in sizes])
        return cls(counts, mae, largest)

    @property
    def std_dn(self) -> float:
        """The standard deviation of the differences in DN, from the histogram of rounded
        differences.
        """
        dn = np.arange(-MAX_DN, MAX_DN + 1)
        mean = np.average(dn, weights=self.counts)
        return float(np.sqrt(np.average((dn - mean) ** 2, weights=self.counts)))

    def share_beyond(self, dn: int) -> float:
        """Return the share of the pixels, in [0, 1], whose rounded difference exceeds `dn` digital
        numbers.
        """
        return 1 - float(self.counts[MAX_DN - dn : MAX_DN + dn + 1].sum() / self.counts.sum())

    def worst(self, count: int) -> list[int]:
        """Return the places of the `count` patches with the largest MAE, the worst first."""
        # Stable, so that patches of equal error keep their order.
        return [int(k) for k in np.argsort(-self.mae, kind="stable")[:count]]


@dataclass(frozen=True)
class GateResult:
    """The measured differences between the INT8 and the float network, over all pixels of all
    patches.

    Differences are INT8 minus float, in shares of full scale. PSNRs are in dB over full scale, as
    means over the patches, and NaN without references.

    Attributes:
        mae: mean absolute difference.
        std: standard deviation of the difference.
        max_abs: largest absolute difference.
        p999: 99.9th percentile of the absolute difference.
        psnr_between_db: PSNR of the INT8 results against the float results, over all pixels.
        psnr_degraded_db: PSNR of the inputs against the references.
        psnr_float_db: PSNR of the float results against the references.
        psnr_int8_db: PSNR of the INT8 results against the references.
        patches: the number of patches.
        sample_range: the part of the brightness range that the patches cover.
        spread: the differences patch by patch.
        simulated: True for simulated patches, False for a user's own samples.
        worst_drop_db: the largest PSNR drop from float to INT8 of one patch, in dB.
        metric: the name of the user's metric; empty for none.
        metric_float: the metric's mean value of the float results.
        metric_int8: the metric's mean value of the INT8 results.
        input_change: mean absolute difference of the float results from their inputs; NaN if they
            differ in shape.
        contrast: mean absolute deviation of the float results from the mean of their patch.
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
    sample_range: SampleRange
    spread: Spread
    simulated: bool = True
    worst_drop_db: float = math.nan
    metric: str = ""
    metric_float: float = math.nan
    metric_int8: float = math.nan
    input_change: float = math.nan
    contrast: float = math.nan

    @property
    def metric_unit(self) -> str:
        """The unit of the user's metric."""
        return METRICS[self.metric].unit

    @property
    def metric_loss(self) -> float:
        """The amount by which INT8 is worse than float in the metric's unit; negative if it is
        better.
        """
        drop = self.metric_float - self.metric_int8
        return drop if METRICS[self.metric].larger_is_better else -drop

    @property
    def source(self) -> str:
        """A description of the samples that the figures come from, such as "64 samples"."""
        if self.simulated:
            return f"{self.patches} simulated patches of 128 x 128"
        return counted(self.patches, "sample")

    @property
    def drop_db(self) -> float:
        """The PSNR in dB that INT8 loses against the reference: that of float less that of INT8."""
        return self.psnr_float_db - self.psnr_int8_db

    @property
    def gain_db(self) -> float:
        """The PSNR in dB against the reference that the float network gains over its input."""
        return self.psnr_float_db - self.psnr_degraded_db

    @property
    def std_over_mae(self) -> float:
        """The standard deviation of the difference over the MAE, which shows whether values were
        clipped.

        Rounding, whose errors are nearly Gaussian, makes it 1.25; clipping makes it larger. It is 0
        if there is no difference.
        """
        return 0.0 if self.mae == 0 else self.std / self.mae


def compare(
    float_session: ort.InferenceSession,
    int8_session: ort.InferenceSession,
    patches: Patches,
    metric: str = "",
) -> GateResult:
    """Run the float and the INT8 network on patches, and measure how their results differ.

    Results that are images are clipped to [0, 1], as a file would store them. If images have other
    ranges than [0, 1], shares of these ranges are compared. The ranges are those of the patches and
    not those that the INT8 file states, because a wide stated range would make its errors look
    small.

    Args:
        float_session: an onnxruntime session of the float network.
        int8_session: an onnxruntime session of the INT8 network.
        patches: the images that both are run on, with their references.
        metric: one of `METRICS`, by which both results are also compared with the references; empty
            for none.

    Returns:
        The differences over all patches. PSNRs against the references are NaN if there are no
        references, or if they differ in size from the results.

    Raises:
        ModelError: the results of the networks differ in shape, or are no images (N, C, H, W).
        ImageError: a reference of the results' size is outside [0, 1], or a sample has none of this
            size while others do.
        OptionError: the metric needs references of the size of the results.
    """
    brightness = np.zeros(BINS, np.int64)
    differences = []
    changes = []
    contrasts = []
    psnrs_db = []
    metric_values = []
    unfit = []
    for number, (degraded, reference) in enumerate(patches.pairs):
        in_float, in_int8, ranges = _results(float_session, int8_session, degraded, patches.ranges)
        degraded = to_shares(degraded, patches.ranges)
        brightness += histogram(degraded)
        differences.append((in_int8 - in_float).ravel())
        same_shape = in_float.shape == degraded.shape
        changes.append(float(np.abs(in_float - degraded).mean()) if same_shape else math.nan)
        contrasts.append(float(np.abs(in_float - in_float.mean()).mean()))
        if reference.shape != in_float.shape:
            unfit.append(number)
        elif ranges or patches.ranges:
            reference = to_shares(reference, ranges)
        elif not (reference.min() >= 0 and reference.max() <= LARGEST):
            raise ImageError(
                f"The reference of {_name(patches, number)} must have values in [0, 1], but they "
                f"are {reference.min():.4g} to {reference.max():.4g}. Divide it by full scale."
            )
        psnrs_db.append(
            [
                psnr_db(image, reference, 1.0) if image.shape == reference.shape else math.nan
                for image in (degraded, in_float, in_int8)
            ]
        )
        if metric:
            metric_values.append([metric_value(metric, r, reference) for r in (in_float, in_int8)])
    if unfit and len(unfit) < len(differences):
        # A mean over some of them would be NaN, and its check left out.
        raise unfit_reference(patches, unfit[0], "the mean PSNR")
    everything = np.concatenate(differences).astype(np.float64)
    degraded_db, float_db, int8_db = np.mean(psnrs_db, axis=0).tolist()
    metric_float, metric_int8 = np.mean(metric_values or [[math.nan] * 2], axis=0).tolist()
    return GateResult(
        mae=float(np.abs(everything).mean()),
        std=float(everything.std()),
        max_abs=float(np.abs(everything).max()),
        p999=float(np.quantile(np.abs(everything), 0.999)),
        psnr_between_db=psnr_db(everything, np.zeros_like(everything), 1.0),
        psnr_degraded_db=degraded_db,
        psnr_float_db=float_db,
        psnr_int8_db=int8_db,
        patches=len(differences),
        simulated=bool(patches.views),
        metric=metric,
        metric_float=metric_float,
        metric_int8=metric_int8,
        worst_drop_db=float(np.max([in_float - in_int8 for _, in_float, in_int8 in psnrs_db])),
        input_change=float(np.mean(changes)),
        contrast=float(np.mean(contrasts)),
        sample_range=range_from(brightness),
        spread=Spread.of(differences),
    )


def _results(
    float_session: ort.InferenceSession,
    int8_session: ort.InferenceSession,
    degraded: np.ndarray,
    ranges: Ranges,
) -> tuple[np.ndarray, np.ndarray, Ranges]:
    """Return the float result, the INT8 result and their ranges; both results are shares of these.

    If the network makes images, results are clipped to [0, 1]. Infinite values become NaN, because
    clipping must not make pixels of them.
    """
    results = [result_of(session, degraded) for session in (float_session, int8_session)]
    if results[0].shape != results[1].shape:
        float_size, int8_size = (times(result.shape) for result in results)
        raise ModelError(
            f"The results of the INT8 network are {int8_size}, but those of the float network "
            f"are {float_size}. Give the INT8 file that was made from this float network."
        )
    if results[0].ndim != 4:
        raise ModelError(
            f"The results of the networks must be images (N, C, H, W), but they are "
            f"{times(results[0].shape)}. The gate compares image-to-image networks only. 'check' "
            "and 'bench' read any network."
        )
    # Only the float result decides, so that both are treated alike.
    ranges = ranges_of_result(results[0], degraded, ranges)
    results = [to_shares(result, ranges) for result in results]
    is_image = results[0].shape[1] == degraded.shape[1] and share_within(results[0], 0, 1) >= MOST
    in_float, in_int8 = (
        np.where(np.isinf(result), np.nan, np.clip(result, 0, 1) if is_image else result)
        for result in results
    )
    return in_float, in_int8, ranges


def _name(patches: Patches, number: int) -> str:
    return patches.names[number] if patches.names else f"sample {number}"


def unfit_reference(patches: Patches, number: int, purpose: str) -> ImageError:
    """Build the error for a sample whose reference is missing or differs in size from the network's
    result.

    Args:
        patches: the samples.
        number: the place of the sample among them.
        purpose: the figure that needs the reference, for the message, such as "the mean PSNR".
    """
    shape = patches.pairs[number][1].shape
    fault = f"its reference has {times(shape[1:])}" if math.prod(shape) else "it has none"
    return ImageError(
        f"{_name(patches, number)} must have a reference of the size of the network's results, "
        f"because {purpose} needs one for every sample, but {fault}. Give such references for all "
        "samples, or for none."
    )


def gate_row(result: GateResult, shares: Mapping[str, float] | None = None) -> Row:
    """Return the effect of INT8 as the one row of the table "gate".

    Args:
        result: the measured differences.
        shares: for each layer, by name, the share of its results at the ends of 8 bits. If given,
            the row also states the largest of them and the PSNR drop.
    """
    entries = {
        "MAE": (result.mae, SCALE),
        "std": (result.std, SCALE),
        "std / MAE": (result.std_over_mae, "ratio"),
        "99.9th percentile": (result.p999, SCALE),
        "max": (result.max_abs, SCALE),
        "PSNR float-INT8": (result.psnr_between_db, "dB"),
        "PSNR degraded": (result.psnr_degraded_db, "dB"),
        "PSNR float": (result.psnr_float_db, "dB"),
        "PSNR INT8": (result.psnr_int8_db, "dB"),
    }
    if result.metric:
        unit = result.metric_unit
        entries[f"{result.metric} float"] = (result.metric_float, unit)
        entries[f"{result.metric} INT8"] = (result.metric_int8, unit)
        entries[f"{result.metric} lost"] = (result.metric_loss, unit)
    if shares is not None:
        entries["PSNR drop"] = (result.drop_db, "dB")
    missing = "a network gave NaN" if math.isnan(result.mae) else "no reference, or of another size"
    figures = {
        name: figure_of(value, unit, result.source, missing)
        for name, (value, unit) in entries.items()
    }
    if shares is not None:
        # The largest share of a layer's results at the ends of 8 bits, with the layer.
        saturation = unavailable("%", "no result in the file is rounded to 8 bits")
        if shares:
            layer = max(shares, key=lambda name: shares[name])
            source = f"{layer}, the worst of {len(shares)}; {result.source}"
            saturation = measured(100 * shares[layer], "%", source)
        figures["saturated results"] = saturation
    return Row("gate", "INT8 against float", figures)


def figure_of(value: float, unit: str, source: str, missing: str) -> Figure:
    """Return a measured value as a figure for a table.

    An infinite value and NaN become unavailable figures, each with its reason.

    Args:
        value: the value in the unit. Infinity is taken for the PSNR of identical images.
        unit: the unit of the figure.
        source: how the value was measured.
        missing: the reason that the figure states if the value is NaN.
    """
    if math.isinf(value):
        return unavailable(unit, "infinite: the two images are identical")
    if math.isnan(value):
        return unavailable(unit, missing)
    return measured(value, unit, source)
