"""The verdict on an INT8 network: every limit of a gate as a check, and JUnit XML of the checks.

Checked, in this order:

1. The differences that `comparison` found: MAE, percentile, PSNRs (`quant.gate`), and the results
  inside the INT8 network that saturate (`quant.structure`).
2. The MAE that an earlier gate found on the same patches, where there is a baseline.
3. The INT8 file: the DPU's rules, its ReLUs, its encoding, the same bits with onnxruntime's
  optimisations as without.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import onnx

from beers_deploy.baseline import Baseline, read_baseline
from beers_deploy.comparison import Comparison
from beers_deploy.dpu.board import ruled
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.table import legality
from beers_deploy.dpu.reading import network_of
from beers_deploy.network import Network
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Check
from beers_deploy.profiles.shipped import TILE_PX
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.quant.float_parts import float_note
from beers_deploy.quant.gate import GateResult, judge, judge_saturation, unfit_reference
from beers_deploy.quant.limits import Limits
from beers_deploy.quant.onnx_file import faults_named, fixed_tile_px
from beers_deploy.quant.samples import OwnSamples, samples_of
from beers_deploy.quant.structure import ENCODING, structure_checks
from beers_deploy.results import Table

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
class Verdict(Table):
    """A comparison, and every check of a gate. It is true if all of them passed."""

    comparison: Comparison

    def raise_if_failed(self) -> None:
        """Raise GateFailedError if a limit is broken: for a test."""
        if not self:
            raise GateFailedError(self.verdict)

    def to_junit(self) -> str:
        """Return the verdict as JUnit XML: a test case for each check."""
        return junit_text(f"INT8 gate of {self.comparison.int8.name}", self.checks)

    @property
    def verdict(self) -> str:
        """The verdict in one sentence, with the MAE and the PSNR drop."""
        if self.failed:
            return super().verdict
        mae = self.comparison.result.mae
        drop_db = self.comparison.result.drop_db
        drop = "" if math.isnan(drop_db) else f", PSNR drop {drop_db:.2f} dB"
        return f"gate passed, all {len(self.checks)} checks: MAE {mae:.3g} of full scale{drop}"

    def __repr__(self) -> str:
        return f"Verdict({self.verdict})"


class GateFailedError(AssertionError):
    """An INT8 network breaks a limit. That is no bad input, and so no `BeersError`."""


def baseline_for(
    path: Any, arguments: Mapping[str, object], limits: Limits, metric: str | None
) -> Baseline | None:
    """Return the baseline of a gate, if there is one.

    Raises:
        OptionError: a limit that needs a baseline or a metric, and none is given; a baseline of
            other patches.
    """
    before = None if path is None else read_baseline(Path(path), arguments)
    if before is None and limits.mae_growth is not None:
        raise OptionError(
            "The limit 'mae_growth' needs a `baseline`, but none is given. Give what an earlier "
            "'gate --json' wrote, or leave that limit out."
        )
    if limits.metric_loss is not None and metric is None:
        raise OptionError(
            "The limit 'metric_loss' needs a `metric`, but none is given. Name the metric, or "
            "leave that limit out."
        )
    return before


def references_for(
    floating: Network, samples: object, limits: Limits, metric: str | None
) -> OwnSamples | None:
    """Return a user's own samples if a metric or a limit needs their references.

    Raises:
        OptionError: the samples have no references.
    """
    purpose = "`metric`" if metric else ""
    if limits.psnr_drop_db is not None:
        purpose = "the limit 'psnr_drop_db'"
    if not purpose or samples is None:
        return None
    own = samples_of(floating.model, samples)
    if own is not None and not any(reference.size for _, reference in own.all.pairs):
        raise OptionError(
            f"`samples` must have references for {purpose}, but it has images alone. Give images "
            f"and references, or leave {purpose} out."
        )
    return own


def judged(
    comparison: Comparison,
    limits: Limits,
    baseline: Baseline | None,
    target: TargetProfile,
    own: OwnSamples | None,
) -> Verdict:
    """Return the verdict on a comparison.

    Args:
        comparison: of the float and the INT8 network.
        limits: that the differences may not exceed.
        baseline: of an earlier gate, or None.
        target: whose rules the INT8 file must obey.
        own: the user's samples, if a limit needs their references.

    Raises:
        OptionError: samples with too little contrast for the limits, a baseline of other networks
            or samples.
    """
    result = comparison.result
    _require_contrast(result)
    psnr_missing = math.isnan(result.psnr_float_db) and not math.isnan(result.mae)
    if own is not None and limits.psnr_drop_db is not None and psnr_missing:
        shape = own.all.pairs[0][1].shape
        raise unfit_reference(own.all.names[0], shape, "the limit 'psnr_drop_db'")
    # Only the comparison has the PSNR by which a float network that was saved again is recognised.
    if baseline is not None:
        sha256 = comparison.floating.sha256
        baseline.require_same(sha256, result.psnr_float_db, comparison.rests_on)
    checks = judge(result, limits, baseline.mae if baseline else None)
    checks += judge_saturation(comparison.shares, limits)
    # Without this, the file that is judged would decide itself whether its encoding is checked.
    must_describe = baseline is not None and ENCODING in baseline.checks
    checks += file_checks(comparison.floating.model, comparison.int8, target, must_describe)
    notes = (
        *comparison.notes,
        *_mae_note(result, limits, checks),
        *float_note(comparison.int8.model),
        *_unchecked(checks),
    )
    return Verdict(
        title=comparison.title,
        command="gate",
        arguments={**comparison.arguments, "target": target.name, "max_mae": limits.mae},
        inputs=comparison.inputs,
        rows=comparison.rows,
        checks=tuple(checks),
        notes=notes,
        headings=comparison.headings,
        comparison=comparison,
    )


def _require_contrast(result: GateResult) -> None:
    """Raise OptionError if a network that returned the mean of each sample would nearly keep the
    default limit.
    """
    if result.contrast < LEAST_CONTRAST:
        raise OptionError(
            "The results on `samples` must have a mean absolute deviation of at least "
            f"{LEAST_CONTRAST:g} of full scale, but it is {result.contrast:.3g}, so a network that "
            "returned the mean of each sample would hardly differ. Give samples with more contrast."
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
    note = (
        f"the MAE limit of {limits.mae:g} suits networks that change their input little "
        f"(ConvBEERS by 0.008); here the {what}: choose `max_mae` for this network, and look at "
        "the PSNR drop"
    )
    return [note]


def _unchecked(checks: Sequence[Check]) -> list[str]:
    """Return a note if the encoding was not checked: the judged file itself decides whether it
    describes integers.
    """
    if any(check.name == ENCODING for check in checks):
        return []
    reason = "the INT8 file does not describe its integers, as a file that 'quantize' wrote does"
    return [f"not checked: {ENCODING}, because {reason}"]


def file_checks(
    float_model: onnx.ModelProto, int8: Network, target: TargetProfile, must_describe: bool = False
) -> list[Check]:
    """Check the INT8 file itself: the rules of the target's DPU or NPU, then its structure."""
    checks = structure_checks(float_model, int8.model, must_describe)
    if not (target.configurations or target.npu):
        return checks
    with faults_named(int8.label):
        graph = network_of(int8.model, fixed_tile_px(int8.model) or TILE_PX, int8.name)
    return [legality(place(graph, ruled(target)), npu=bool(target.npu)), *checks]


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
    """Return the verdict as JUnit XML: a test case for each check."""
    failures = sum(not check.passed for check in checks)
    counts = {"tests": str(len(checks)), "failures": str(failures), "errors": "0"}
    suite = ET.Element("testsuite", name=printable(title), attrib=counts)
    for check in checks:
        case = ET.SubElement(suite, "testcase", classname=printable(title), name=check.name)
        if not check.passed:
            text = f"found {check.found}, allowed {check.allowed}"
            ET.SubElement(case, "failure", message=text).text = text
    return ET.tostring(suite, encoding="unicode") + "\n"
