"""The gate: figures against limits, the file against the DPU's rules, and what a CI job wants to read."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import onnx

from deploy.dpu.board import load_dpu
from deploy.dpu.placement import place
from deploy.dpu.reading import read_network
from deploy.shipped import shipped_pair
from model.files import write_text
from profiles.errors import OptionError
from profiles.text import read_json
from quant.limits import Check
from quant.onnx_file import fixed_tile_px
from quant.session import open_any_size, run

RELUS = ("Relu", "Max")
TILE_PX = 640


def files_or_shipped(float_path: Path | None, int8_path: Path | None, variant: str) -> tuple[Path, Path]:
    """The two files given, or the shipped pair where neither is.

    Raises:
        OptionError: one file without the other: two networks that have nothing to do with each other.
        ModelError: no pair of that name is shipped.
    """
    if float_path is None:
        return shipped_pair(variant)
    if int8_path is None:
        remedy = "give its INT8 file too, or none of both for a shipped pair"
        raise OptionError("INT8", expected=f"the INT8 network of {float_path.name}", got="none", remedy=remedy)
    return float_path, int8_path


def structure_checks(
    float_model: onnx.ModelProto, int8_path: Path, int8: onnx.ModelProto, target: str
) -> list[Check]:
    """Is the INT8 file legal, does it keep every ReLU, does it compute the same with and without optimisation?"""
    failed = place(read_network(int8_path, fixed_tile_px(int8) or TILE_PX), load_dpu(target, None)).failed
    first = f"{failed[0].op.name}: {failed[0].broken[0].finding.reason}" if failed else "every node keeps the rules"
    wanted, kept = (relu_count(model) for model in (float_model, int8))
    image = np.random.default_rng(0).random((1, 1, 97, 101), dtype=np.float32)
    plain, optimised = (run(open_any_size(int8, optimise=o), image) for o in (False, True))
    difference = float(np.abs(plain - optimised).max())
    return [
        Check("legal on the DPU", not failed, first, f"the rules of {target}"),
        Check("ReLUs kept", kept == wanted, str(kept), str(wanted)),
        Check("optimised equals unoptimised", difference == 0, f"{difference:.3g} apart", "the same bits"),
    ]


def relu_count(model: onnx.ModelProto) -> int:
    """ReLUs in any spelling of ours: Relu, or the larger of a value and the zero point."""
    return sum(node.op_type in RELUS for node in model.graph.node)


def baseline_mae(path: Path | None) -> float | None:
    """The MAE in a document that an earlier `gate --json` wrote.

    Raises:
        OptionError: no such document.
    """
    if path is None:
        return None
    try:
        document: Any = read_json(path)
        return float(next(row["figures"]["MAE"]["value"] for row in document["rows"] if row["table"] == "gate"))
    except (OSError, ValueError, KeyError, TypeError, StopIteration) as error:
        got = "no such file" if not path.exists() else "another document"
        remedy = "give what 'gate --json' wrote"
        raise OptionError(str(path), expected="a gate's results", got=got, remedy=remedy) from error


def markdown(title: str, checks: list[Check]) -> str:
    """The verdict as a table for a job's summary page."""
    verdict = "passed" if all(check.passed for check in checks) else "FAILED"
    lines = [f"## {title}: {verdict}", "", "| check | found | allowed | |", "|---|---|---|---|"]
    lines += [f"| {c.name} | {c.found} | {c.allowed} | {'ok' if c.passed else '**failed**'} |" for c in checks]
    return "\n".join(lines).replace("<", "&lt;") + "\n"


def junit(title: str, checks: list[Check]) -> str:
    """The verdict as JUnit XML: a test case a check."""
    failures = str(sum(not check.passed for check in checks))
    suite = ET.Element("testsuite", name=title, tests=str(len(checks)), failures=failures)
    for check in checks:
        case = ET.SubElement(suite, "testcase", classname=title, name=check.name)
        if not check.passed:
            text = f"found {check.found}, allowed: {check.allowed}"
            ET.SubElement(case, "failure", message=text).text = text
    return ET.tostring(suite, encoding="unicode") + "\n"


def write_summaries(title: str, checks: list[Check], summary: Path | None, junit_path: Path | None) -> None:
    """Write what was asked for."""
    if summary is not None:
        write_text(summary, markdown(title, checks))
    if junit_path is not None:
        write_text(junit_path, junit(title, checks))
