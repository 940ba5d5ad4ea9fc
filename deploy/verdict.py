"""The gate: what INT8 changes, what the file itself shows, and which limits that keeps.

Looked at, in this order:

1. Patches that calibration did not see, through both networks: MAE, percentile, PSNRs (`quant.gate`), and the results
   inside the INT8 network that saturate (`quant.structure`).
2. The MAE that an earlier gate found on the same patches, where a baseline is given.
3. The INT8 file: the DPU's rules, its ReLUs, its encoding, the same bits with onnxruntime's optimisations as without.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import onnx

from beers_deploy.dpu.board import BoardLike, ruled
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.table import legality
from beers_deploy.dpu.reading import network_of
from beers_deploy.model.progress import Progress, reporting
from beers_deploy.model.shipped import SENSOR
from beers_deploy.network import Network, NetworkLike, SensorLike
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Check
from beers_deploy.profiles.sensor import Sensor
from beers_deploy.profiles.target import DEFAULT_TARGET, TILE_PX, TargetProfile
from beers_deploy.profiles.toml import read_json, unreadable
from beers_deploy.quant.gate import METRICS, GateResult, Limits, judge, judge_saturation, limits_of, verdict_row
from beers_deploy.quant.gate import compare as differences
from beers_deploy.quant.onnx_file import faults_named, fixed_tile_px, metadata, require_quantised
from beers_deploy.quant.samples import CALIBRATED_ON, OwnSamples, samples_of, without
from beers_deploy.quant.session import open_any_size
from beers_deploy.quant.structure import saturated_shares, structure_checks
from beers_deploy.results import Input, Table, input_of

if TYPE_CHECKING:
    from beers_deploy.quant.samples import Patches

PATCHES = ("sensor", "images", "patches", "seed", "samples")
"""The arguments that say what INT8 and float are compared on."""


ALL_SEEN = "calibration saw all of these samples"


@dataclass(frozen=True, repr=False, kw_only=True)
class Comparison(Table):
    """What INT8 changes, and how many results inside the INT8 network saturate.

    Attributes:
        result: the differences.
        shares: of each layer's results the share at the ends of 8 bits.
        float_sha256: of the float network.
    """

    result: GateResult
    shares: Mapping[str, float]
    float_sha256: str


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
        mae, drop_db = self.comparison.result.mae, self.comparison.result.drop_db
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
    """Compare an INT8 network with its float network, on patches or samples that calibration did not see.

    Args:
        int8: the INT8 network.
        against: the float one; where it is None, the one that `int8` was quantised from here.
        samples: a path, arrays or whatever `quantize` takes; None for simulated patches. Of samples that include
            those of its calibration only the others are used.
        sensor: of the simulated patches, and what shipped networks are told.
        images: folder of scenes for them; None for drawn ones.
        patches: how many of 128 x 128 are simulated.
        seed: of the patches.
        metric: psnr, ssim, mae, top1 or iou, by which results are held against the samples' references too.
        progress: a function that is told each step, False for silence, None for a bar or lines on standard error.

    Raises:
        ModelError: a file that is not what it should be.
        OptionError: no float network, or samples that were all calibrated on.
        ImageError: samples that the networks do not take.

    Examples:
        >>> found = bd.compare("convbeers-xs-int8", "convbeers-xs", patches=2)
        >>> bool(found.rows[0].figures["MAE"].value < 0.001)  # of full scale
        True
    """
    known = Sensor.load(sensor)
    if metric not in (None, *METRICS):
        raise OptionError("metric", expected=f"one of {', '.join(METRICS)}", got=repr(metric), remedy="choose one")
    ours, theirs = _pair(int8, against, known)
    scenes = None if images is None else Path(images)
    with reporting(progress), faults_named(theirs.label):
        unseen, simulated, notes = _unseen(ours, theirs, known, samples, scenes, patches, seed)
        sessions = open_any_size(theirs.model), open_any_size(ours.model)
        result = differences(*sessions, unseen.pairs, simulated, metric)
        shares = saturated_shares(ours.model, unseen.degraded)
    arguments: dict[str, object] = {"float": theirs.name, "int8": ours.name, "sensor": known.name, "images": images}
    arguments |= {"patches": patches, "seed": seed, "samples": samples if isinstance(samples, str | Path) else None}
    own = [Path(samples)] if isinstance(samples, str | Path) and Path(samples).is_file() else []
    inputs = theirs.input, ours.input, *map(input_of, own)
    table = "compare", arguments, inputs, (verdict_row(result, shares),)
    return Comparison(*table, notes=notes, result=result, shares=shares, float_sha256=theirs.sha256)


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
        limits: names and numbers, such as {"mae": 0.001}, or a TOML file; None for the default of the MAE.
        baseline: what an earlier gate wrote as JSON: the MAE may not grow.
        sensor: of the simulated patches.
        images: folder of scenes for them.
        patches: how many.
        seed: of the patches.
        metric: beside the references; its limit is metric_loss.
        progress: how it is told.

    Raises:
        ModelError: a file that is not what it should be.
        OptionError: as in `compare`, or limits or a baseline that do not fit.
        ImageError: samples that the networks do not take.
        ProfileError: no such board or sensor.

    Examples:
        >>> verdict = bd.gate("convbeers-xs-int8", "convbeers-xs", limits={"mae": 0.001}, patches=2)
        >>> verdict.raise_if_failed()
        >>> bool(verdict)
        True
    """
    allowed, target, known = limits_of(limits), TargetProfile.load(board), Sensor.load(sensor)
    ours, theirs = _pair(int8, against, known)
    config, data = (each if isinstance(each, str | os.PathLike) else None for each in (limits, samples))
    told = sensor if isinstance(sensor, str) else known.name
    arguments: dict[str, object] = {"max_mae": allowed.mae, "limits": config, "baseline": baseline}
    arguments |= {"target": target.name, "sensor": told, "images": images, "patches": patches, "seed": seed}
    arguments |= {"samples": data} | ({"metric": metric} if metric else {})
    before = None if baseline is None else baseline_mae(Path(baseline), arguments)
    if before is None and allowed.mae_growth is not None:
        remedy = "give what an earlier 'gate --json' wrote, or leave that limit out"
        raise OptionError("baseline", expected="one beside the limit mae_growth", got="none", remedy=remedy)
    if (allowed.metric_loss is None) < (metric is None):
        remedy = "name the metric, or leave that limit out"
        raise OptionError("metric", expected="one beside the limit metric_loss", got="none", remedy=remedy)
    wanted = "psnr_drop_db" if allowed.psnr_drop_db is not None else "a metric" if metric else ""
    if wanted and samples is not None:
        _require_references(samples_of(theirs.model, samples), wanted)
    how: dict[str, Any] = {"sensor": known, "images": images, "patches": patches, "seed": seed, "metric": metric}
    found = compare(ours, theirs, samples, **how, progress=progress)
    if ALL_SEEN in found.notes:
        expected, remedy = "samples that calibration did not see", "give others, or quantise with four or more"
        raise OptionError("samples", expected=expected, got="those of the calibration", remedy=remedy)
    if baseline is not None:
        require_same_float(Path(baseline), found)
    checks = judge(found.result, allowed, before) + judge_saturation(found.shares, allowed)
    checks += file_checks(theirs.model, ours, target)
    return Verdict("gate", arguments, found.inputs, found.rows, tuple(checks), notes=found.notes, comparison=found)


def _pair(int8: NetworkLike, against: NetworkLike | None, sensor: Sensor) -> tuple[Network, Network]:
    """The INT8 network and the float one, each of its precision."""
    theirs = None if against is None else Network.load(against, sensor=sensor)
    ours = Network.load(int8, sensor=sensor)
    theirs = theirs or ours.origin
    if theirs is None:
        remedy = "give it, or quantise it here"
        raise OptionError("against", expected=f"the float network of {ours.name}", got="none", remedy=remedy)
    require_quantised(theirs.model, theirs.label, wanted=False)
    require_quantised(ours.model, ours.label, wanted=True)
    return ours, theirs


def _unseen(
    int8: Network, floating: Network, sensor: Sensor, samples: object, images: Path | None, patches: int, seed: int
) -> "tuple[Patches, bool, tuple[str, ...]]":
    """What the two are compared on, whether it is simulated, and what a reader must know of it."""
    own = samples_of(floating.model, samples)
    if own is None:
        from beers_deploy.quant.calibration import unseen_patches  # SciPy, which samples of one's own do without

        return unseen_patches(sensor, images, patches, seed), True, ()
    calibrated = set(metadata(int8.model).get(CALIBRATED_ON, "").split())
    found, count = without(own.all, calibrated), len(own.all.pairs)
    if len(found.pairs) == count:
        return found, False, ()
    if not found.pairs:
        return own.all, False, (ALL_SEEN,)
    return found, False, (f"{len(found.pairs)} of {count} samples: the others were calibrated on",)


def _require_references(own: OwnSamples | None, wanted: str) -> None:
    if own is not None and not any(reference.size for _, reference in own.all.pairs):
        expected, remedy = f"references for {wanted}", "give images and references, or leave it out"
        raise OptionError("samples", expected=expected, got="images alone", remedy=remedy)


def baseline_mae(path: Path, arguments: Mapping[str, Any]) -> float:
    """The MAE in a document that an earlier `gate --json` wrote, of the same patches as with these arguments."""
    try:
        document: Any = read_json(path)
        before = {name: _plain(name, dict(document["arguments"]).get(name)) for name in PATCHES}
        mae = float(next(row["figures"]["MAE"]["value"] for row in document["rows"] if row["table"] == "gate"))
    except (OSError, ValueError, KeyError, TypeError, StopIteration) as error:
        got = unreadable(path) or "another document"
        remedy = "give what 'gate --json' wrote"
        raise OptionError(str(path), expected="a gate's results", got=got, remedy=remedy) from error
    for name in PATCHES:
        now = _plain(name, arguments.get(name))
        if before[name] != now:
            expected, got = f"a baseline of the same patches ({name} {now})", f"{name} {before[name]}"
            raise OptionError(str(path), expected=expected, got=got, remedy="make it anew with these")
    return mae


SAME_DB = 0.01
"""Between the PSNRs of one float network on two processors: most differ by less than a thousandth."""


def require_same_float(path: Path, found: Comparison) -> None:
    """Refuse the baseline of another float network: by its file, or else by its PSNR on the same patches."""
    document: Any = read_json(path)
    before = next(row["figures"].get("PSNR float", {}) for row in document["rows"] if row["table"] == "gate")
    same_psnr = abs(found.result.psnr_float_db - float(before.get("value") or math.nan)) < SAME_DB
    digests, remedy = [each["sha256"] for each in document["inputs"]], "make it anew with 'gate --json'"
    if not same_psnr and found.float_sha256 not in digests:
        raise OptionError(str(path), expected="a baseline of this float network", got="another's", remedy=remedy)
    own = [each for each in found.inputs[2:] if isinstance(each, Input)]
    if own and len(digests) > 2 and own[0].sha256 not in digests:
        expected, got = "a baseline of the same samples", f"one of another {own[0].name}"
        raise OptionError(str(path), expected=expected, got=got, remedy=remedy)


def _plain(name: str, value: object) -> str:
    """As text; of a folder of images its name, for it may lie elsewhere."""
    return Path(str(value)).name if name == "images" else str(value)


def file_checks(float_model: onnx.ModelProto, int8: Network, target: TargetProfile) -> list[Check]:
    """What the INT8 file itself shows: the rules of the target's DPU or NPU, then what `quant.structure` looks at."""
    checks = structure_checks(float_model, int8.model)
    if not (target.configurations or target.npu):
        return checks
    read = network_of(int8.model, fixed_tile_px(int8.model) or TILE_PX, int8.name)
    return [legality(place(read, ruled(target)), npu=bool(target.npu)), *checks]


def sentence(checks: Sequence[Check], passed: str) -> str:
    """The line that ends a command: all checks that failed, with value and limit; or their number and `passed`."""
    failed = [str(check) for check in checks if not check.passed]
    if not failed:
        return f"passed, all {len(checks)} checks: {passed}"
    return f"FAILED, {len(failed)} of {len(checks)} checks: {'; '.join(failed)}"


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
