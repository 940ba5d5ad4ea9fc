"""A verdict as people and CI jobs read it: one line, Markdown, JUnit XML, outputs of a step.

Who could not be judged at all (a file is missing, a sensor unknown) is told in the same places: a job that shows
JUnit or a summary must not look as if nothing had been asked.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

from model.files import require_regular, require_writable, write_text
from profiles.errors import BeersError, MachineError, printable
from quant.checks import Check


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


def markdown(title: str, checks: Sequence[Check]) -> str:
    """The verdict as a table for a job's summary page."""
    verdict = "passed" if all(check.passed for check in checks) else "FAILED"
    lines = [f"## {title}: {verdict}", "", "| check | found | allowed | |", "|---|---|---|---|"]
    for check in checks:
        cells = check.name, check.found.replace("|", "\\|"), check.allowed, "ok" if check.passed else "**failed**"
        lines.append(f"| {' | '.join(cells)} |")
    return _escaped("\n".join(lines))


def junit(title: str, checks: Sequence[Check]) -> str:
    """The verdict as JUnit XML: a test case a check."""
    suite = _suite(title, tests=len(checks), failures=sum(not check.passed for check in checks))
    for check in checks:
        case = ET.SubElement(suite, "testcase", classname=printable(title), name=check.name)
        if not check.passed:
            text = f"found {check.found}, allowed {check.allowed}"
            ET.SubElement(case, "failure", message=text).text = text
    return ET.tostring(suite, encoding="unicode") + "\n"


def junit_error(title: str, error: BeersError) -> str:
    """JUnit XML of what could not be judged: one test case, an error with the sentence that says why."""
    suite = _suite(title, tests=1, errors=1)
    case = ET.SubElement(suite, "testcase", classname=printable(title), name="input")
    ET.SubElement(case, "error", message=str(error), type=type(error).__name__).text = str(error)
    return ET.tostring(suite, encoding="unicode") + "\n"


@dataclass(frozen=True)
class Reports:
    """The files in which a CI job wants a verdict; None for those that it does not want.

    Attributes:
        summary: Markdown, added to what other steps wrote there, as to $GITHUB_STEP_SUMMARY.
        junit: JUnit XML, written anew.
        outputs: lines NAME=VALUE, added to what stands there, as to $GITHUB_OUTPUT.
    """

    summary: Path | None
    junit: Path | None
    outputs: Path | None

    def write(self, title: str, checks: Sequence[Check], figures: Mapping[str, float]) -> None:
        """Write what is wanted; `figures` are the outputs beside the verdict.

        Raises:
            MachineError: a file cannot be written.
        """
        verdict = "passed" if all(check.passed for check in checks) else "failed"
        _append(self.summary, f"\n{markdown(title, checks)}")
        _append(self.outputs, "".join(f"{name}={value:.6g}\n" for name, value in figures.items()))
        _append(self.outputs, f"verdict={verdict}\n")
        if self.junit is not None:
            write_text(self.junit, junit(title, checks))

    @contextmanager
    def of_bad_input(self, title: str) -> Iterator[None]:
        """Tell bad input in these files too, then let it end the command.

        Raises:
            MachineError: a file cannot be written.
        """
        try:
            require_writable(self.summary, self.junit, self.outputs)
            yield
        except BeersError as error:
            self._tell(title, error)
            raise

    def _tell(self, title: str, error: BeersError) -> None:
        """Each file by itself: one that cannot be written must hide neither what was wrong nor the others."""
        with suppress(MachineError):
            _append(self.summary, f"\n## {title}: not judged\n\n{_escaped(str(error))}")
        with suppress(MachineError):
            _append(self.outputs, "verdict=error\n")
        if self.junit is not None:
            with suppress(MachineError):
                write_text(self.junit, junit_error(title, error))


def _suite(title: str, **counts: int) -> ET.Element:
    numbers = {"tests": 0, "failures": 0, "errors": 0, **counts}
    return ET.Element(
        "testsuite", name=printable(title), attrib={name: str(count) for name, count in numbers.items()}
    )


def _escaped(text: str) -> str:
    """Markdown in which a name of a stranger's file opens no tag."""
    return text.replace("<", "&lt;") + "\n"


def _append(path: Path | None, text: str) -> None:
    """Add to what other steps of a job wrote."""
    if path is None:
        return
    require_regular(path)
    try:
        with path.open("a", encoding="utf-8", newline="\n") as stream:
            stream.write(text)
    except OSError as error:
        got, remedy = error.strerror or str(error), "choose another path"
        raise MachineError(str(path), expected="a file to add to", got=got, remedy=remedy) from error
