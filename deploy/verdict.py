"""The gate: what INT8 changes, what the file itself shows, and which limits that keeps.

Looked at, in this order:

1. Patches that calibration did not see, through both networks: MAE, percentile, PSNRs
  (`quant.gate`), and the results inside the INT8 network that saturate (`quant.structure`).
2. The MAE that an earlier gate found on the same patches, where a baseline is given.
3. The INT8 file: the DPU's rules, its ReLUs, its encoding, the same bits with onnxruntime's
  optimisations as without.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import onnx

from beers_deploy.baseline import data_inputs, read_baseline, sensor_input
from beers_deploy.dpu.board import BoardLike, ruled
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.table import legality
from beers_deploy.dpu.reading import network_of
from beers_deploy.model.progress import Progress, reporting
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike, SensorLike
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Check, Row
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import DEFAULT_TARGET, TILE_PX, TargetProfile
from beers_deploy.quant.float_parts import float_note
from beers_deploy.quant.gate import (
    METRICS,
    GateResult,
    judge,
    judge_saturation,
    unfit_reference,
    verdict_row,
)
from beers_deploy.quant.gate import compare as differences_of
from beers_deploy.quant.limits import Limits, limits_of
from beers_deploy.quant.onnx_file import faults_named, fixed_tile_px, metadata, require_quantised
from beers_deploy.quant.sample_range import range_row, recorded_range, uncovered
from beers_deploy.quant.samples import CALIBRATED_ON, OwnSamples, digest_of, samples_of
from beers_deploy.quant.session import open_any_size
from beers_deploy.quant.structure import ENCODING, saturated_shares, structure_checks
from beers_deploy.results import Input, Table

if TYPE_CHECKING:
    from beers_deploy.quant.samples import Patches

JUNIT_CHARACTERS = 2000
"""Of a message in JUnit XML, at most."""

LITTLE_CHANGE = 0.02
"""Mean absolute change of the input, over full scale, up to which the default limit of the MAE
suits a network. ConvBEERS changes it by 0.008.
"""

LEAST_CONTRAST = 0.0014
"""Mean absolute deviation of the results from the mean of their sample, over full scale: twice the
default limit of the MAE.
"""


@dataclass(frozen=True, repr=False, kw_only=True)
class Comparison(Table):
    """What INT8 changes, and how many results inside the INT8 network saturate.

    Attributes:
        result: the differences.
        shares: of each layer's results the share at the ends of 8 bits.
        floating: the float network.
        int8: the INT8 network.
        sensor: of the simulated patches, and of shipped networks.
        rests_on: what the figures rest on besides the networks.
    """

    result: GateResult
    shares: Mapping[str, float]
    floating: Network
    int8: Network
    sensor: Sensor
    rests_on: tuple[Input, ...]


@dataclass(frozen=True, repr=False, kw_only=True)
class Verdict(Table):
    """What a gate found: a comparison, and every check. It is true where all of them passed."""

    comparison: Comparison

    @property
    def passed(self) -> bool:
        """Whether every check did."""
        return bool(self)

    @property
    def failed(self) -> tuple[Check, ...]:
        """The checks that did not pass."""
        return tuple(check for check in self.checks if not check.passed)

    def raise_if_failed(self) -> None:
        """Fail a test where a limit is broken."""
        if not self:
            raise GateFailedError(str(self))

    def to_junit(self) -> str:
        """The verdict as JUnit XML: a test case a check."""
        return junit_text(f"INT8 gate of {self.comparison.arguments['int8']}", self.checks)

    def __repr__(self) -> str:
        return f"Verdict({self})"

    def __str__(self) -> str:
        mae = self.comparison.result.mae
        drop_db = self.comparison.result.drop_db
        drop = "" if math.isnan(drop_db) else f", PSNR drop {drop_db:.2f} dB"
        return f"gate {sentence(self.checks, f'MAE {mae:.3g} of full scale{drop}')}"


class GateFailedError(AssertionError):
    """An INT8 network does not keep its limits; no bad input, and so no `BeersError`."""


def compare(
    int8: NetworkLike,
    against: NetworkLike | None = None,
    samples: object = None,
    *,
    sensor: SensorLike = SENSOR,
    images: str | os.PathLike[str] | None = None,
    patches: int = 32,
    seed: int = 0,
    metric: str | None = None,
    progress: Progress = None,
) -> Comparison:
    """Compare an INT8 network with its float network, on patches that calibration did not see or on
    given samples.

    Args:
        int8: the INT8 network.
        against: the float one; where it is None, the one that `int8` was quantised from here.
        samples: a path, arrays or whatever `quantize` takes, none of which calibration should have
            seen; None for simulated patches.
        sensor: of the simulated patches and of shipped networks.
        images: folder of scenes for them; None for drawn ones.
        patches: how many of 128 x 128 are simulated.
        seed: of the patches.
        metric: psnr, ssim, mae, top1 or iou, by which results are held against the samples'
            references too.
        progress: a function that is told each step, False for silence, None for a bar or lines on
            standard error.

    Raises:
        ModelError: a file that is not what it should be.
        OptionError: no float network, or a metric that is none.
        ImageError: samples that the networks do not take.

    Examples:
        >>> found = bd.compare("convbeers-xs-int8", "convbeers-xs", patches=2)
        >>> bool(found.rows[0].figures["MAE"].value < 0.001)  # of full scale
        True
    """
    profile = Sensor.load(sensor)
    if samples is not None and images is not None:
        remedy = "leave one of them out: images are for simulated patches"
        raise OptionError(
            "images", expected="none together with samples", got=str(images), remedy=remedy
        )
    _require_metric(metric)
    ours, theirs = _pair(int8, against, profile)
    scenes = None if images is None else Path(images)
    with reporting(progress), faults_named(theirs.label):
        judged, simulated, notes = _samples(ours, theirs, profile, samples, scenes, patches, seed)
        sessions = open_any_size(theirs.model), open_any_size(ours.model)
        result = differences_of(*sessions, judged.pairs, simulated, metric, judged.names)
        shares = saturated_shares(ours.model, judged.degraded)
    arguments: dict[str, object] = {
        "float": theirs.name,
        "int8": ours.name,
        "sensor": profile.name,
        "images": images,
    }
    arguments |= {"patches": patches, "seed": seed, "samples": _named(samples)}
    path = Path(samples) if isinstance(samples, str | os.PathLike) else None
    rests_on = [sensor_input(profile), *data_inputs(scenes, path)]
    # Samples in memory are no file, so the digest is that of their values.
    if samples is not None and path is None:
        rests_on.append(Input(f"samples {IN_MEMORY}", judged.digest))
    rows, range_notes = _range_rows(ours, result)
    return Comparison(
        "compare",
        arguments,
        (theirs.input, ours.input, *rests_on),
        (verdict_row(result, shares), *rows),
        notes=(*notes, *range_notes),
        result=result,
        shares=shares,
        floating=theirs,
        int8=ours,
        sensor=profile,
        rests_on=tuple(rests_on),
    )


IN_MEMORY = "in memory"
"""What arguments and inputs call samples that are no file."""


def _named(samples: object) -> str | None:
    """Return what a document calls samples; None of simulated patches."""
    if isinstance(samples, str | os.PathLike):
        return os.fspath(samples)
    return None if samples is None else IN_MEMORY


def _range_rows(int8: Network, result: GateResult) -> tuple[list[Row], list[str]]:
    """Return the range of the samples, the one that the INT8 file records, and a note if bright
    ground is missing.
    """
    judged = result.sample_range
    assert judged is not None  # noqa: S101 - `quant.gate.compare` measures it
    rows = [range_row(judged, "judged on", result.source)]
    recorded = recorded_range(metadata(int8.model))
    if recorded is not None:
        rows.append(
            range_row(
                recorded, "calibrated on", "recorded in the INT8 file, which nothing verifies"
            )
        )
    note = uncovered(judged, recorded)
    return rows, [note] if note else []


def gate(
    int8: NetworkLike,
    against: NetworkLike | None = None,
    samples: object = None,
    *,
    board: BoardLike = DEFAULT_TARGET,
    limits: Limits | Mapping[str, float] | str | os.PathLike[str] | None = None,
    baseline: str | os.PathLike[str] | None = None,
    sensor: SensorLike = SENSOR,
    images: str | os.PathLike[str] | None = None,
    patches: int = 32,
    seed: int = 0,
    metric: str | None = None,
    progress: Progress = None,
) -> Verdict:
    """Judge an INT8 network beside its float one; the verdict is true where every check passed.

    Args:
        int8: as in `compare`, like all that follow but for these three.
        against: the float network.
        samples: what both are compared on.
        board: whose rules the INT8 file must keep.
        limits: names and numbers, such as {"mae": 0.001}, or a TOML file; what they leave out has
            its default.
        baseline: what an earlier gate that passed wrote as JSON: the MAE may not grow.
        sensor: of the simulated patches.
        images: folder of scenes for them.
        patches: how many.
        seed: of the patches.
        metric: beside the references; its limit is metric_loss.
        progress: how it is told.

    Raises:
        ModelError: a file that is not what it should be.
        OptionError: as in `compare`, limits or a baseline that do not fit, or too little contrast
            for the limits.
        ImageError: samples that the networks do not take.
        ProfileError: no such board or sensor.

    Examples:
        >>> verdict = bd.gate("convbeers-xs-int8", "convbeers-xs", limits={"mae": 0.001}, patches=2)
        >>> verdict.raise_if_failed()
        >>> bool(verdict)
        True
    """
    _require_metric(metric)
    allowed = limits_of(limits)
    target = TargetProfile.load(board)
    profile = Sensor.load(sensor)
    ours, theirs = _pair(int8, against, profile)
    config = limits if isinstance(limits, str | os.PathLike) else None
    sensor_name = sensor if isinstance(sensor, str) else profile.name
    arguments: dict[str, object] = {"max_mae": allowed.mae, "limits": config, "baseline": baseline}
    arguments |= {
        "target": target.name,
        "sensor": sensor_name,
        "images": images,
        "patches": patches,
        "seed": seed,
    }
    arguments |= {"samples": _named(samples)} | ({"metric": metric} if metric else {})
    before = None if baseline is None else read_baseline(Path(baseline), arguments)
    if before is None and allowed.mae_growth is not None:
        remedy = "give what an earlier 'gate --json' wrote, or leave that limit out"
        raise OptionError(
            "baseline", expected="one beside the limit mae_growth", got="none", remedy=remedy
        )
    if (allowed.metric_loss is None) < (metric is None):
        remedy = "name the metric, or leave that limit out"
        raise OptionError(
            "metric", expected="one beside the limit metric_loss", got="none", remedy=remedy
        )
    # Missing references are refused before the networks run.
    purpose = "a metric" if metric else ""
    if allowed.psnr_drop_db is not None:
        purpose = "psnr_drop_db"
    own = samples_of(theirs.model, samples) if purpose and samples is not None else None
    _require_references(own, purpose)
    how: dict[str, Any] = {
        "sensor": profile,
        "images": images,
        "patches": patches,
        "seed": seed,
        "metric": metric,
    }
    comparison = compare(ours, theirs, samples, **how, progress=progress)
    _require_contrast(comparison.result)
    psnr_missing = math.isnan(comparison.result.psnr_float_db) and not math.isnan(
        comparison.result.mae
    )
    if own is not None and allowed.psnr_drop_db is not None and psnr_missing:
        raise unfit_reference(own.all.names[0], own.all.pairs[0][1].shape, "psnr_drop_db")
    # Only the comparison has the PSNR by which a float network that was saved again is recognised.
    if before is not None:
        before.require_same(theirs.sha256, comparison.result.psnr_float_db, comparison.rests_on)
    checks = judge(comparison.result, allowed, before.mae if before else None)
    checks += judge_saturation(comparison.shares, allowed)
    # Without this, the file that is judged would decide itself whether its encoding is checked.
    must_describe = before is not None and ENCODING in before.checks
    checks += file_checks(theirs.model, ours, target, must_describe)
    notes = (
        *comparison.notes,
        *_mae_note(comparison.result, allowed, checks),
        *float_note(ours.model),
        *_unchecked(checks),
    )
    return Verdict(
        "gate",
        arguments,
        comparison.inputs,
        comparison.rows,
        tuple(checks),
        notes=notes,
        comparison=comparison,
    )


def _require_contrast(result: GateResult) -> None:
    """Raise OptionError if a network that returned the mean of each sample would nearly keep the
    default limit.
    """
    if not result.contrast < LEAST_CONTRAST:
        return
    expected = (
        f"results with a mean absolute deviation of at least {LEAST_CONTRAST:g} of full scale"
    )
    got = (
        f"{result.contrast:.3g}: a network that returned the mean of each sample would hardly "
        "differ"
    )
    raise OptionError(
        "samples", expected=expected, got=got, remedy="give samples with more contrast"
    )


def _mae_note(result: GateResult, limits: Limits, checks: Sequence[Check]) -> list[str]:
    """Return a note if the MAE broke its default limit and that does not suit the network."""
    broken = any(check.name == "MAE" and not check.passed for check in checks)
    if not broken or limits.mae != Limits().mae or result.input_change <= LITTLE_CHANGE:
        return []
    what = "results have another size than the input"
    if not math.isnan(result.input_change):
        what = (
            f"float results differ from the input by {result.input_change:.3g} of full scale "
            "in the mean"
        )
    suits = (
        f"the MAE limit of {limits.mae:g} suits networks that change their input little "
        "(ConvBEERS by 0.008)"
    )
    return [
        f"{suits}; here the {what}: choose --max-mae for this network, and look at the PSNR drop"
    ]


def _pair(
    int8: NetworkLike, against: NetworkLike | None, sensor: Sensor
) -> tuple[Network, Network]:
    """The INT8 network and the float one, each of its precision."""
    theirs = None if against is None else Network.load(against, sensor=sensor)
    ours = Network.load(int8, sensor=sensor)
    # A network that was quantised in this process knows its float network.
    theirs = theirs or ours.origin
    if theirs is None:
        remedy = "give it, or quantise it here"
        raise OptionError(
            "against", expected=f"the float network of {ours.name}", got="none", remedy=remedy
        )
    require_quantised(theirs.model, theirs.label, wanted=False)
    require_quantised(ours.model, ours.label, wanted=True)
    return ours, theirs


def _samples(
    int8: Network,
    floating: Network,
    sensor: Sensor,
    samples: object,
    images: Path | None,
    patches: int,
    seed: int,
) -> "tuple[Patches, bool, tuple[str, ...]]":
    """Return what the two are compared on, whether it is simulated, and notes for the reader.

    All samples that were given are judged. The INT8 file says which of them it was calibrated on,
    but it may not choose its judges: that is a note.
    """
    own = samples_of(floating.model, samples)
    if own is None:
        # This loads SciPy, which samples of one's own do without.
        from beers_deploy.quant.calibration import unseen_patches

        return unseen_patches(sensor, images, patches, seed), True, ()
    calibrated = set(metadata(int8.model).get(CALIBRATED_ON, "").split())
    count = sum(digest_of(degraded) in calibrated for degraded in own.all.degraded)
    if count == 0:
        return own.all, False, ()
    # The file may not choose its judges: samples that it was calibrated on are judged, and noted.
    note = (
        f"by the INT8 file's own record, {count} of the {len(own.all.pairs)} samples were "
        "its calibration"
    )
    return own.all, False, (f"{note}: on those INT8 loses less than on others",)


def _require_metric(metric: str | None) -> None:
    if metric not in (None, *METRICS):
        raise OptionError(
            "metric", expected=f"one of {', '.join(METRICS)}", got=repr(metric), remedy="choose one"
        )


def _require_references(own: OwnSamples | None, purpose: str) -> None:
    if own is not None and not any(reference.size for _, reference in own.all.pairs):
        expected = f"references for {purpose}"
        remedy = "give images and references, or leave it out"
        raise OptionError("samples", expected=expected, got="images alone", remedy=remedy)


def _unchecked(checks: Sequence[Check]) -> list[str]:
    """Return a note if the encoding was not checked: the judged file itself decides whether it
    describes integers.
    """
    reason = "the INT8 file does not describe its integers, as a file that 'quantize' wrote does"
    checked = any(check.name == ENCODING for check in checks)
    return [] if checked else [f"not checked: {ENCODING}, because {reason}"]


def file_checks(
    float_model: onnx.ModelProto, int8: Network, target: TargetProfile, must_describe: bool = False
) -> list[Check]:
    """Check the INT8 file itself: the rules of the target's DPU or NPU, then what
    `structure_checks` looks at.
    """
    checks = structure_checks(float_model, int8.model, must_describe)
    if not (target.configurations or target.npu):
        return checks
    with faults_named(int8.label):
        graph = network_of(int8.model, fixed_tile_px(int8.model) or TILE_PX, int8.name)
    return [legality(place(graph, ruled(target)), npu=bool(target.npu)), *checks]


def sentence(checks: Sequence[Check], passed: str) -> str:
    """The line that ends a command: all checks that failed, with value and limit; or their number
    and `passed`.
    """
    failed = [str(check) for check in checks if not check.passed]
    if not failed:
        return f"passed, all {len(checks)} checks: {passed}"
    return f"FAILED, {len(failed)} of {len(checks)} checks: {'; '.join(failed)}"


def junit_error(title: str, message: str) -> str:
    """Return JUnit XML that says that nothing could be judged, and why."""
    suite = ET.Element(
        "testsuite", name=printable(title), attrib={"tests": "1", "failures": "0", "errors": "1"}
    )
    case = ET.SubElement(suite, "testcase", classname=printable(title), name="gate")
    text = printable(message, JUNIT_CHARACTERS)
    ET.SubElement(case, "error", message=text).text = text
    return ET.tostring(suite, encoding="unicode") + "\n"


def junit_text(title: str, checks: Sequence[Check]) -> str:
    """The verdict as JUnit XML: a test case a check."""
    failures = sum(not check.passed for check in checks)
    counts = {"tests": str(len(checks)), "failures": str(failures), "errors": "0"}
    suite = ET.Element("testsuite", name=printable(title), attrib=counts)
    for check in checks:
        case = ET.SubElement(suite, "testcase", classname=printable(title), name=check.name)
        if not check.passed:
            text = f"found {check.found}, allowed {check.allowed}"
            ET.SubElement(case, "failure", message=text).text = text
    return ET.tostring(suite, encoding="unicode") + "\n"
