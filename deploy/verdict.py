"""The verdict on an INT8 network: every limit of a gate as a check, and JUnit XML of the checks.

Checked, in this order:

1. The differences that `comparison` measured: MAE, percentile, PSNRs (`quant.gate`), and the MAE of
   an earlier gate on the same patches, where there is a baseline.
2. The results inside the INT8 network that saturate (`quant.structure`).
3. The INT8 file: the DPU's rules, its ReLUs, its encoding, the same bits with onnxruntime's
   optimisations as without.

A baseline is the document of an earlier gate. It is checked before anything is compared with it.
"""

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import onnx
from jsonschema import Draft202012Validator

from beers_deploy.comparison import Comparison
from beers_deploy.dpu.board import device_of
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.table import legality
from beers_deploy.dpu.reading import sized_graph, usual_tile_px
from beers_deploy.network import Network
from beers_deploy.profiles.errors import OptionError, encodable, printable, reason_of
from beers_deploy.profiles.figures import Check
from beers_deploy.profiles.target import TargetProfile
from beers_deploy.profiles.user_files.json_text import read_json
from beers_deploy.quant.encodings import as_on_board
from beers_deploy.quant.float_parts import float_note
from beers_deploy.quant.gate import unfit_reference
from beers_deploy.quant.limits import Limits, judge, not_judged
from beers_deploy.quant.onnx_file import faults_named
from beers_deploy.quant.samples.own import OwnSamples
from beers_deploy.quant.structure import ENCODING, structure_checks
from beers_deploy.results import SCHEMA_PATH, Input, Table

JUNIT_CHARACTERS = 2000
"""The largest number of characters of a message in JUnit XML."""

LITTLE_CHANGE = 0.02
"""The largest mean absolute change of the input, over full scale, for which the default limit of
the MAE suits a network. ConvBEERS changes it by 0.008.
"""

LEAST_CONTRAST = 0.0014
"""Mean absolute deviation of the results from the mean of their sample, over full scale: twice the
default limit of the MAE.
"""


PATCHES = ("sensor", "images", "patches", "seed", "samples", "output")
"""The arguments that define the data and the output by which INT8 and float are compared."""

SAME_DB = 0.01
"""The largest difference of the PSNRs of one float network on two processors. Most differ by less
than a thousandth.
"""

REMAKE = "Make it again with 'gate --json' and these arguments."


def read_document(path: Path) -> dict[str, object]:
    """Read the JSON document that a command wrote with `--json`, and check it against the schema.

    Args:
        path: the path of the document.

    Returns:
        The document, with the keys that `Table.to_dict` writes.

    Raises:
        OptionError: the file cannot be read, is not JSON, or does not follow the schema.
    """
    try:
        document = read_json(path)
        schema = Draft202012Validator(json.loads(SCHEMA_PATH.read_text(encoding="utf-8")))
        error = next(schema.iter_errors(document), None)
        fault = "" if error is None else f"{error.json_path.lstrip('$.')} {error.message}".strip()
    except FileNotFoundError:
        fault = "there is no such file"
    except (OSError, ValueError) as error:
        fault = reason_of(error)
    if fault:
        raise OptionError(
            f"{path} is not a results document: {fault[:100].removesuffix('.')}. Give what a "
            "command wrote with '--json'."
        )
    return document  # type: ignore[return-value]


@dataclass(frozen=True)
class Baseline:
    """The figures of an earlier gate that passed, which the differences now may not exceed.

    Attributes:
        path: the path of the earlier gate's results document.
        mae: its mean absolute difference of INT8 from float, as a share of full scale.
        psnr_float_db: the PSNR of the float network against the references in dB; NaN if the
            samples have no references.
        digests: the SHA-256 of its inputs, by name; two networks may have one file name.
        checks: the names of the checks that it made.
    """

    path: Path
    mae: float
    psnr_float_db: float
    digests: Mapping[str, Set[str]]
    checks: Set[str] = frozenset()

    def require_same(
        self, float_sha256: str, psnr_float_db: float, inputs: Iterable[Input]
    ) -> None:
        """Raise OptionError if the baseline's float network, sensor, images or samples were others.

        Args:
            float_sha256: SHA-256 of the float network that is compared now.
            psnr_float_db: PSNR of this network against the references in dB. The network is
                recognised by it if it was saved again as another file.
            inputs: all inputs of the comparison now, except the two networks.
        """
        # A network that was saved again has another digest, but the same PSNR.
        same_psnr = abs(psnr_float_db - self.psnr_float_db) < SAME_DB
        if not same_psnr and not any(float_sha256 in digests for digests in self.digests.values()):
            raise OptionError(f"{self.path} is the baseline of another float network. {REMAKE}")
        for item in inputs:
            before = self.digests.get(encodable(item.name))
            if before is None:
                raise OptionError(
                    f"{self.path} is the baseline of a gate without {item.name}. {REMAKE}"
                )
            if before != {item.sha256}:
                raise OptionError(
                    f"{self.path} is the baseline of a gate in which {item.name} had other "
                    f"content. {REMAKE}"
                )


def read_baseline(path: Path, arguments: Mapping[str, Any]) -> Baseline:
    """Read the document of an earlier gate that passed on the same patches.

    Args:
        path: the path of the document.
        arguments: the arguments of the gate that runs now, by name. Those that define the patches
            must be equal in the document.

    Raises:
        OptionError: the file is not a results document, or is one of another command, of a gate
            that failed or of a gate on other patches, or has no MAE.
    """
    document: Any = read_document(path)
    if document["command"] != "gate":
        command = printable(repr(document["command"]))
        raise OptionError(f"{path} is a document of {command}, not of 'gate'. {REMAKE}")
    if document["verdict"] != "passed":
        raise OptionError(
            f"{path} is the document of a gate that failed. Give the document of a version that "
            "passed."
        )
    before = document["arguments"]
    for name in PATCHES:
        then = _plain(name, before.get(name))
        now = _plain(name, arguments.get(name))
        if then != now:
            raise OptionError(
                f"{path} is the baseline of other patches: its `{name}` is {printable(then)}, but "
                f"here it is {printable(now)}. {REMAKE}"
            )
    rows = (row["figures"] for row in document["rows"] if row["table"] == "gate")
    figures: dict[str, Any] = next(rows, {})
    mae = figures.get("MAE", {})
    if mae.get("value") is None:
        raise OptionError(f"{path} has no MAE that a gate measured. {REMAKE}")
    psnr_db = figures.get("PSNR float", {}).get("value")
    digests = defaultdict[str, set[str]](set)
    for entry in document["inputs"]:
        digests[entry["name"]].add(entry["sha256"])
    checks = {check["name"] for check in document["checks"]}
    return Baseline(
        path, float(mae["value"]), math.nan if psnr_db is None else float(psnr_db), digests, checks
    )


def _plain(name: str, value: object) -> str:
    """Return an argument as text. A path is reduced to its name, because the files may be
    elsewhere now.
    """
    return encodable(
        Path(str(value)).name if name in ("images", "samples", "sensor") else str(value)
    )


@dataclass(frozen=True, repr=False, kw_only=True)
class Verdict(Table):
    """The result of `gate`: the figures of `comparison`, and a check for each limit. It is true if
    all checks passed.
    """

    comparison: Comparison

    def raise_if_failed(self) -> None:
        """Raise GateFailedError if a check failed. Call this in a test of your own."""
        if not self:
            raise GateFailedError(self.verdict)

    def to_junit(self) -> str:
        """Return the verdict as JUnit XML, which CI servers read: a test case for each check."""
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
    """The error of `Verdict.raise_if_failed`. It is not bad input, so it is no `BeersError`."""


def baseline_for(
    path: Any, arguments: Mapping[str, object], limits: Limits, metric: str | None
) -> Baseline | None:
    """Read the baseline of a gate, if one is given, and check that its limits have what they need.

    Args:
        path: the path of the document of an earlier `gate --json`; None for no baseline.
        arguments: the arguments of the gate that runs now, by name.
        limits: the limits of this gate. Its `mae_growth` needs a baseline, its `metric_loss` a
            metric.
        metric: the metric by which results are compared with references; None for no metric.

    Returns:
        The baseline; None if no path is given.

    Raises:
        OptionError: a limit needs a baseline or a metric and none is given, or the baseline is of
            other patches.
    """
    if path is None and limits.mae_growth is not None:
        raise OptionError(
            "The limit 'mae_growth' needs a `baseline`, but none is given. Give what an earlier "
            "'gate --json' wrote, or leave that limit out."
        )
    if limits.metric_loss is not None and metric is None:
        raise OptionError(
            "The limit 'metric_loss' needs a `metric`, but none is given. Name the metric, or "
            "leave that limit out."
        )
    return None if path is None else read_baseline(Path(path), arguments)


def require_references(own: OwnSamples | None, limits: Limits, metric: str | None) -> None:
    """Raise OptionError if the metric or the limit `psnr_drop_db` needs references, and the user's
    samples have none. Simulated patches (`own` is None) have references.
    """
    purpose = "`metric`" if metric else ""
    if limits.psnr_drop_db is not None:
        purpose = "the limit 'psnr_drop_db'"
    if own and purpose and not any(reference.size for _, reference in own.all.pairs):
        raise OptionError(
            f"`samples` must have references for {purpose}, but it has images alone. Give images "
            f"and references, or leave {purpose} out."
        )


def judged(
    comparison: Comparison,
    limits: Limits,
    baseline: Baseline | None,
    target: TargetProfile,
    own: OwnSamples | None,
) -> Verdict:
    """Check a comparison against the limits, and the INT8 file against the board's rules.

    Args:
        comparison: the comparison of the float and the INT8 network.
        limits: the limits of the differences.
        baseline: the baseline of an earlier gate, or None.
        target: the board whose rules apply to the INT8 file.
        own: the user's samples of the comparison; None for simulated patches.

    Raises:
        OptionError: the samples have too little contrast for the limits, or the baseline is of
            other networks or samples.
    """
    result = comparison.result
    if result.contrast < LEAST_CONTRAST:
        raise OptionError(
            "The results on `samples` must have a mean absolute deviation of at least "
            f"{LEAST_CONTRAST:g} of full scale, but it is {result.contrast:.3g}, so a network that "
            "returned the mean of each sample would hardly differ. Give samples with more contrast."
        )
    psnr_missing = math.isnan(result.psnr_float_db) and not math.isnan(result.mae)
    if own is not None and limits.psnr_drop_db is not None and psnr_missing:
        raise unfit_reference(own.all, 0, "the limit 'psnr_drop_db'")
    # Only the comparison has the PSNR by which a float network that was saved again is recognised.
    if baseline is not None:
        sha256 = comparison.floating.sha256
        baseline.require_same(sha256, result.psnr_float_db, comparison.rests_on)
    checks = judge(result, limits, baseline.mae if baseline else None, comparison.shares)
    # Without this, the file that is judged would decide if its encoding is checked.
    must_describe = baseline is not None and ENCODING in baseline.checks
    checks += file_checks(comparison.floating.model, comparison.int8, target, must_describe)
    notes = list(comparison.notes)
    mae_failed = any(check.name == "MAE" and not check.passed for check in checks)
    if mae_failed and limits.mae == Limits().mae and result.input_change > LITTLE_CHANGE:
        notes.append(
            f"the MAE limit of {limits.mae:g} suits networks that change their input little "
            "(ConvBEERS by 0.008 of full scale), and this one changes it more: choose `max_mae` "
            "for this network, and look at the PSNR drop"
        )
    notes += float_note(comparison.int8.model)
    notes += not_judged(result, limits)
    if not any(check.name == ENCODING for check in checks):
        notes.append(
            f"not checked: {ENCODING}, because the INT8 file does not describe its integers, as a "
            "file that 'quantize' wrote does"
        )
    return Verdict(
        title=comparison.title,
        command="gate",
        arguments={**comparison.arguments, "target": target.name, "max_mae": limits.mae},
        inputs=comparison.inputs,
        rows=comparison.rows,
        checks=tuple(checks),
        notes=tuple(notes),
        headings=comparison.headings,
        comparison=comparison,
    )


def file_checks(
    float_model: onnx.ModelProto, int8: Network, target: TargetProfile, must_describe: bool = False
) -> list[Check]:
    """Check the INT8 file itself: the rules of the board's DPU or NPU, then its structure.

    Args:
        float_model: the network that the file was quantised from, whose ReLUs the file must have.
        int8: the INT8 network.
        target: the board. The rules are not checked if it has neither a DPU nor an NPU.
        must_describe: True if a file fails whose metadata do not describe its integers.
    """
    checks = structure_checks(float_model, int8.model, must_describe)
    if not (target.configurations or target.npu):
        return checks
    with faults_named(int8.label):
        core = as_on_board(int8.model)
        graph = sized_graph(core, usual_tile_px(core), int8.name)
    dpu = device_of(target)
    return [legality(place(graph, dpu), dpu), *checks]


def junit_text(title: str, checks: Sequence[Check]) -> str:
    """Write checks as JUnit XML: a test suite named `title` with a test case for each check."""
    cases = {
        check.name: "" if check.passed else f"found {check.actual}, allowed {check.allowed}"
        for check in checks
    }
    return _junit(title, "failure", cases)


def junit_error(title: str, message: str) -> str:
    """Return the JUnit XML of a gate that stopped with an error, whose message is `message`."""
    return _junit(title, "error", {"gate": printable(message, JUNIT_CHARACTERS)})


def _junit(title: str, kind: str, cases: Mapping[str, str]) -> str:
    """Return JUnit XML of test cases, each with the text of its fault, or "" if it passed."""
    counts = {"tests": str(len(cases)), "failures": "0", "errors": "0"}
    counts[f"{kind}s"] = str(sum(map(bool, cases.values())))
    suite = ET.Element("testsuite", name=printable(title), attrib=counts)
    for name, text in cases.items():
        case = ET.SubElement(suite, "testcase", classname=printable(title), name=name)
        if text:
            ET.SubElement(case, kind, message=text).text = text
    return ET.tostring(suite, encoding="unicode") + "\n"
