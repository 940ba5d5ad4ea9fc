"""What the action's gate found, for the job: the verdict as Markdown on its summary, and as outputs of the step.

    python verdict.py EXIT_CODE RESULTS.json STDERR.txt

Runs on any Python; `$GITHUB_STEP_SUMMARY` and `$GITHUB_OUTPUT` name the files that are added to.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

OUTPUTS = {"mae": "MAE", "drop": "PSNR drop"}
"""Names of figures, by those of the action's outputs."""


def main(code: int, results: Path, stderr: Path) -> None:
    """Tell what the gate's exit code, its document and its messages say."""
    if code in (0, 1):
        document = json.loads(results.read_text(encoding="utf-8"))
        figures = document["rows"][0]["figures"]
        values = {name: figures[figure]["value"] for name, figure in OUTPUTS.items()}
        lines = [f"{name}={value:.6g}" for name, value in values.items() if value is not None]
        add("GITHUB_OUTPUT", [f"verdict={document['verdict']}", *lines])
        add("GITHUB_STEP_SUMMARY", ["", f"## INT8 gate: {document['verdict']}", "", *table(document["checks"])])
    else:
        add("GITHUB_OUTPUT", ["verdict=error"])
        add("GITHUB_STEP_SUMMARY", ["", "## INT8 gate: not judged", "", stderr.read_text(encoding="utf-8").strip()])


def table(checks: list[dict[str, Any]]) -> list[str]:
    """The rows of a Markdown table, one a check."""
    rows = []
    for each in checks:
        allowed = f"{each['bound']} {number(each['limit'])} {each['unit']}"
        verdict = "ok" if each["passed"] else "**failed**"
        cells = cell(each["name"]), number(each["value"]), allowed, verdict, cell(each["detail"])
        rows.append(f"| {' | '.join(cells)} |")
    return ["| check | found | allowed | | |", "|---|---|---|---|---|", *rows]


def number(value: float | None) -> str:
    """A value with four digits; nothing for none."""
    return "" if value is None else f"{value:.4g}"


def cell(text: str) -> str:
    """Text from another's file, which may hold what ends a cell or a line."""
    return "".join(letter if letter.isprintable() and letter != "|" else " " for letter in text)


def add(variable: str, lines: list[str]) -> None:
    """Add lines to a file that an environment variable names; a name of another's file opens no tag in them."""
    with Path(os.environ[variable]).open("a", encoding="utf-8", newline="\n") as stream:
        stream.write("\n".join(lines).replace("<", "&lt;") + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]))
