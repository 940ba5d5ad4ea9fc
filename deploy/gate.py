"""The gate: what INT8 changes, what the file itself shows, and which limits that keeps.

Looked at, in this order:

1. Patches that calibration did not see, through both networks: MAE, percentile, PSNRs (`quant.gate`), and the results
   inside the INT8 network that saturate (`quant.structure`).
2. The MAE that an earlier gate found on the same patches, where a baseline is given.
3. The INT8 file: the DPU's rules, its ReLUs, its encoding, the same bits with onnxruntime's optimisations as without.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import onnx

from beers_deploy.dpu.board import load_dpu
from beers_deploy.dpu.checker.placement import place
from beers_deploy.dpu.checker.table import legality
from beers_deploy.dpu.reading import read_network
from beers_deploy.export import float_model
from beers_deploy.model.progress import Log, no_log
from beers_deploy.model.shipped import SENSOR, VARIANT
from beers_deploy.networks import float_file, int8_file, shipped_pair
from beers_deploy.profiles import load_sensor, load_target
from beers_deploy.profiles.errors import OptionError, printable
from beers_deploy.profiles.figures import Row
from beers_deploy.profiles.toml import read_json, unreadable
from beers_deploy.quant.checks import Check
from beers_deploy.quant.gate import GateResult, Limits, compare, judge, judge_saturation, verdict_row
from beers_deploy.quant.onnx_file import fixed_tile_px, load_onnx, require_quantised
from beers_deploy.quant.session import open_any_size
from beers_deploy.quant.structure import saturated_shares, structure_checks
from beers_deploy.restoration.options import TILE_PX
from beers_deploy.results import Document

if TYPE_CHECKING:
    from beers_deploy.quant.calibration import Patches

PATCHES = ("sensor", "images", "patches", "seed", "data")
"""The arguments that say what INT8 and float are compared on."""


@dataclass(frozen=True)
class Request:
    """What to judge, by which limits, on which patches.

    Attributes:
        float_path: float ONNX or weights.
        int8_path: its INT8 ONNX.
        limits: what is allowed.
        baseline: what an earlier gate wrote as JSON, or None.
        target: name of the board whose rules the INT8 file must keep.
        sensor: name or file of the profile of the test patches.
        images: folder of scenes; None for drawn ones.
        data: the user's own samples in place of simulated patches, or None.
        patches: number of test patches of 128 x 128.
        seed: of the patches.
    """

    float_path: Path
    int8_path: Path
    limits: Limits
    baseline: Path | None
    target: str
    sensor: str
    images: Path | None
    patches: int
    seed: int
    data: Path | None = None


@dataclass(frozen=True)
class Outcome:
    """What the gate found: the comparison, the share of saturated results of each layer, and every check."""

    result: GateResult
    shares: Mapping[str, float]
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check did."""
        return all(check.passed for check in self.checks)

    @property
    def row(self) -> Row:
        """The figures of the comparison, what it costs against the reference, and the worst layer's saturation."""
        return verdict_row(self.result, self.shares)

    def document(self, request: Request, config: Path | None) -> Document:
        """What `gate --json` writes; `config` is the file from which the limits came."""
        arguments = {"max_mae": request.limits.mae, "config": config, "baseline": request.baseline}
        arguments |= {name: getattr(request, name) for name in ("target", *PATCHES)}
        return Document("gate", arguments, (request.float_path, request.int8_path), (self.row,), self.checks)


def run_gate(request: Request) -> Outcome:
    """Judge an INT8 network beside its float one.

    Raises:
        BeersError: a file, a profile or a folder is missing or not what it should be.
    """
    before = None if request.baseline is None else baseline_mae(request.baseline, vars(request))
    floating, int8 = float_model(request.float_path), load_onnx(request.int8_path)
    require_quantised(floating, request.float_path, wanted=False)
    require_quantised(int8, request.int8_path, wanted=True)
    sessions = open_any_size(floating), open_any_size(int8)
    unseen, simulated = _unseen(request, floating)
    result, shares = compare(*sessions, unseen.pairs, simulated), saturated_shares(int8, unseen.degraded)
    checks = judge(result, request.limits, before) + judge_saturation(shares, request.limits)
    checks += file_checks(floating, request.int8_path, int8, request.target)
    return Outcome(result, shares, tuple(checks))


def _unseen(request: Request, model: onnx.ModelProto) -> "tuple[Patches, bool]":
    """What the two are compared on, and whether it is simulated."""
    # These take torch, seconds; what is wrong with the options or the files has been said by now.
    from beers_deploy.quant.calibration import unseen_patches
    from beers_deploy.quant.samples import samples_of

    own = samples_of(model, request.data)
    if own is None:
        sensor = load_sensor(request.sensor)
        return unseen_patches(sensor, request.images, request.patches, request.seed), True
    if request.limits.psnr_drop_db is not None and not any(reference.size for _, reference in own.all.pairs):
        expected, remedy = "references for psnr_drop_db", "give a .npz file with image and reference, or no limit"
        raise OptionError("--data", expected=expected, got="images alone", remedy=remedy)
    return own.all, False


def files_or_shipped(
    float_path: Path | None, int8_path: Path | None, variant: str | None, sensor: str = SENSOR, log: Log = no_log
) -> tuple[Path, Path]:
    """The two files given, or a shipped network in both precisions where neither is, told the sensor.

    Raises:
        OptionError: one file without the other, which have nothing to do with each other; files and a variant.
        ModelError: no network of that name is shipped.
        ProfileError: no such sensor.
    """
    if float_path is None:
        return shipped_pair(variant or VARIANT, sensor, log)
    if int8_path is None:
        remedy = "give its INT8 file too, or none of both for a shipped pair"
        raise OptionError("INT8", expected=f"the INT8 network of {float_path.name}", got="none", remedy=remedy)
    if variant is not None:
        expected, remedy = "it without files", "leave it out, or the files"
        raise OptionError("--variant", expected=expected, got=float_path.name, remedy=remedy)
    known = load_sensor(sensor)
    return float_file(float_path, known, log), int8_file(int8_path, known, log)


def baseline_mae(path: Path, arguments: Mapping[str, Any]) -> float:
    """The MAE in a document that an earlier `gate --json` wrote, of the same patches.

    Args:
        path: the document.
        arguments: of this run of the gate.

    Raises:
        OptionError: no such document, or one of other patches.
    """
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


def _plain(name: str, value: object) -> str:
    """As text; of a folder of images its name, for it may lie elsewhere."""
    return Path(str(value)).name if name == "images" else str(value)


def file_checks(float_model: onnx.ModelProto, int8_path: Path, int8: onnx.ModelProto, target: str) -> list[Check]:
    """What the INT8 file itself shows: the target's rules, then what `quant.structure` looks at."""
    return [*_legality(int8_path, int8, target), *structure_checks(float_model, int8)]


def _legality(path: Path, model: onnx.ModelProto, target: str) -> list[Check]:
    """The DPU's rules; a target without a DPU has none."""
    if not load_target(target).configurations:
        return []
    return [legality(place(read_network(path, fixed_tile_px(model) or TILE_PX), load_dpu(target, None)))]


def sentence(checks: Sequence[Check], passed: str) -> str:
    """The line that ends a command: every check that failed, with its value and its limit, and no other.

    Args:
        checks: all that were made.
        passed: what to say beside their number where none failed.
    """
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
