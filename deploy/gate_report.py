"""The gate's verdict as what a CI job wants to read: Markdown and JUnit XML."""

from pathlib import Path
from xml.etree import ElementTree as ET

from model.files import write_text
from quant.limits import Check


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
