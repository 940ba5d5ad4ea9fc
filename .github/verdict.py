"""Report what the action's gate found: a Markdown summary, outputs of the step, and annotations of
the pull request.

    python verdict.py EXIT_CODE RESULTS.json STDERR.txt

It runs on any Python. `$GITHUB_STEP_SUMMARY` and `$GITHUB_OUTPUT` name the files that it adds to;
annotations are workflow commands on standard output.

Names of nodes and files come from the network under test, so all text is escaped for where it goes:
a table of the summary, a code block, or a workflow command.
"""

import json
import os
import re
import sys
from pathlib import Path
from typing import Any

OUTPUTS = {"mae": "MAE", "drop": "PSNR drop"}
"""Names of figures, by those of the action's outputs."""
VERDICTS = {0: "passed", 1: "failed"}
"""By the exit code of the gate; with any other nothing was judged."""
MARKDOWN = re.compile(r"[\\`*_{}\[\]<>()#!|~&@:]")
"""Characters that Markdown or GitHub may read as markup, a link or a mention."""
LAST_LINES = 20
"""Number of lines that are shown of a program that failed without a message, as by a traceback."""


def main(code: int, results: Path, stderr: Path) -> None:
    """Report the gate's verdict, or why there is none.

    Args:
        code: exit code of `beers-deploy gate`, or of `quantize` where that refused the network.
        results: the JSON document of the gate.
        stderr: the messages of the program.
    """
    document = verdict_of(code, results)
    if document is None:
        report_refusal(reason_in(stderr))
        return
    figures = document["rows"][0]["figures"]
    values = {name: figures[figure]["value"] for name, figure in OUTPUTS.items()}
    lines = [f"{name}={value:.6g}" for name, value in values.items() if value is not None]
    add("GITHUB_OUTPUT", [f"verdict={VERDICTS[code]}", *lines])
    add(
        "GITHUB_STEP_SUMMARY",
        ["", f"## INT8 gate: {VERDICTS[code]}", "", *table(document["checks"])],
    )
    for each in document["checks"]:
        if not each["passed"]:
            detail = f" ({plain(each['detail'])})" if each["detail"] else ""
            found = f"found {number(each['value'])}, allowed {allowed(each)}{detail}"
            annotate(f"INT8 gate: {each['name']}", found)


def verdict_of(code: int, results: Path) -> dict[str, Any] | None:
    """Return the gate's document; None if the gate judged nothing, or if the document has another
    verdict.
    """
    if code not in VERDICTS:
        return None
    try:
        document = json.loads(results.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return (
        document
        if isinstance(document, dict) and document.get("verdict") == VERDICTS[code]
        else None
    )


def reason_in(stderr: Path) -> str:
    """Return the message of the error that ended the program; the last lines if there is none.

    It is the last line that begins with the name of the program: lines of progress and warnings may
    come before it.
    """
    text = stderr.read_text(encoding="utf-8", errors="replace") if stderr.is_file() else ""
    lines = [plain(line) for line in text.splitlines() if line.strip()]
    messages = [line for line in lines if line.startswith("beers-deploy: ")]
    return "\n".join(messages[-1:] or lines[-LAST_LINES:]) or "the program printed nothing"


def report_refusal(reason: str) -> None:
    """Write that nothing was judged, with the reason as a block of code."""
    longest = max((len(run) for run in re.findall("`+", reason)), default=0)
    fence = "`" * max(3, longest + 1)  # a block ends at a fence that is as long as its own
    add("GITHUB_OUTPUT", ["verdict=error"])
    add("GITHUB_STEP_SUMMARY", ["", "## INT8 gate: not judged", "", f"{fence}text", reason, fence])
    annotate("INT8 gate: not judged", reason)


def table(checks: list[dict[str, Any]]) -> list[str]:
    """Return the rows of a Markdown table, one for each check."""
    rows = []
    for each in checks:
        verdict = "ok" if each["passed"] else "**failed**"
        cells = (
            cell(each["name"]),
            number(each["value"]),
            cell(allowed(each)),
            verdict,
            cell(each["detail"]),
        )
        rows.append(f"| {' | '.join(cells)} |")
    return ["| check | found | allowed | | |", "|---|---|---|---|---|", *rows]


def allowed(check: dict[str, Any]) -> str:
    """Return the limit of a check with its side and unit."""
    return f"{check['bound']} {number(check['limit'])} {check['unit']}"


def number(value: float | None) -> str:
    """Return a value with four digits; nothing for none."""
    return "" if value is None else f"{value:.4g}"


def plain(text: str) -> str:
    """Replace each character that is not printable (line breaks, controls, changes of direction) by
    a space.
    """
    return "".join(letter if letter.isprintable() else " " for letter in text)


def cell(text: str) -> str:
    """Escape text for a cell of a Markdown table; an entity stands for its character and is never
    markup.
    """
    return MARKDOWN.sub(lambda found: f"&#{ord(found[0])};", plain(text))


def annotate(title: str, message: str) -> None:
    """Print an error annotation, which GitHub shows at the pull request."""
    title = command(plain(title)).replace(":", "%3A").replace(",", "%2C")
    sys.stdout.write(f"::error title={title}::{command(message)}\n")


def command(text: str) -> str:
    """Escape text for a workflow command."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def add(variable: str, lines: list[str]) -> None:
    """Add lines to a file that an environment variable names."""
    with Path(os.environ[variable]).open("a", encoding="utf-8", newline="\n") as stream:
        stream.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]))
