"""Test that any text of the network stays text in the outputs of the action."""

import io
import json
import os
import re
import runpy
from contextlib import redirect_stdout
from html import unescape
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from beers_deploy.profiles.figures import Check
from tests.deploy.workflow_steps import ACTION, read_yaml
from tests.project_files import ROOT

VERDICT = runpy.run_path(str(ROOT / ".github/verdict.py"))
HOSTILE = (
    "a|b\n::error::c ` ``` <img src=x> **bold** [l](http://x) @someone \u202e\x1b[31m "
    "&amp; \\| ~~s~~ #1 %0A::x"
)
PINNED = re.compile(r"uses: [\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+")
FIGURES = {"MAE": {"value": 6e-4}, "PSNR drop": {"value": None}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("job")


def reported(folder: Path, code: int, document: object, stderr: str = "") -> tuple[str, str, str]:
    """Return the summary, the outputs and what is printed for a run that ended with this code."""
    names = "GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY"
    for name in names:
        (folder / name).write_bytes(b"")
        os.environ[name] = str(folder / name)
    (folder / "gate.json").write_text(json.dumps(document), encoding="utf-8")
    (folder / "stderr").write_text(stderr, encoding="utf-8", errors="surrogatepass")
    printed = io.StringIO()
    with redirect_stdout(printed):
        VERDICT["main"](code, folder / "gate.json", folder / "stderr")
    texts = [(folder / name).read_text(encoding="utf-8") for name in names]
    for name in names:
        del os.environ[name]
    return texts[1], texts[0], printed.getvalue()


def failed(name: str, detail: str) -> dict[str, Any]:
    check = Check(name, 2.0, 1.0, "dB", detail=detail).to_json()
    return {"verdict": "failed", "rows": [{"figures": FIGURES}], "checks": [check]}


def rendered(markdown: str) -> str:
    return str(MarkdownIt("commonmark").enable(["table", "strikethrough"]).render(markdown))


@settings(max_examples=25)
@given(st.text(), st.text())
@example(HOSTILE, HOSTILE)
def test_a_check_is_one_row_of_plain_text_and_one_annotation(
    folder: Path, name: str, detail: str
) -> None:
    summary, outputs, printed = reported(folder, 1, failed(name, detail))
    assert outputs == "verdict=failed\nmae=0.0006\n"
    html = rendered(summary)
    cells = re.findall("<td>(.*)</td>", html)
    assert html.count("<tr>") == 2
    assert [unescape(cells[0]), unescape(cells[-1])] == [
        VERDICT["plain"](text).strip() for text in (name, detail)
    ]
    assert not any("<" in cell for cell in (cells[0], cells[-1])), "no markup"
    assert all(letter.isprintable() or letter == "\n" for letter in summary)
    assert printed.startswith("::error title=INT8 gate%3A ")
    assert printed.count("\n") == 1


@settings(max_examples=40)
@given(st.text(alphabet=st.characters(exclude_categories=["Cs"])))
@example(HOSTILE)
@example("````")
def test_the_last_message_is_a_block_of_code(folder: Path, reason: str) -> None:
    """Progress, log records and warnings come before the message on standard error."""
    summary, outputs, printed = reported(
        folder,
        2,
        {"verdict": "passed"},
        f"beers-deploy: earlier\nwarning: doubt\nprogress\nbeers-deploy: {reason}\n",
    )
    assert outputs == "verdict=error\n"
    html = rendered(summary)
    assert html.startswith("<h2>INT8 gate: not judged</h2>\n<pre><code")
    assert html.rstrip().endswith("</code></pre>")
    assert html.count("<pre>") == 1
    assert not any(word in html for word in ("earlier", "doubt", "progress"))
    assert all(letter.isprintable() or letter == "\n" for letter in summary)
    assert printed.count("\n") == 1


@pytest.mark.parametrize(
    ("code", "document"),
    [(0, {"verdict": "failed"}), (1, {"verdict": "passed"}), (1, []), (0, 3), (137, {})],
)
def test_a_document_of_another_run_is_no_verdict(code: int, document: object, folder: Path) -> None:
    summary, outputs, printed = reported(folder, code, document, "Traceback\nKilled\n")
    assert outputs == "verdict=error\n"
    assert "Killed" in summary
    assert printed == "::error title=INT8 gate%3A not judged::Traceback%0AKilled\n"


def workflows() -> list[Path]:
    return sorted((ROOT / ".github/workflows").glob("*.yml"))


def used(path: Path) -> list[str]:
    """Return the lines of a workflow or an action that use an action of others."""
    lines = [
        line.strip().removeprefix("- ") for line in path.read_text(encoding="utf-8").splitlines()
    ]
    return [line for line in lines if line.startswith("uses: ") and not line.startswith("uses: ./")]


def test_actions_of_others_are_pinned_by_commit_with_their_version() -> None:
    lines = list(chain.from_iterable(used(path) for path in (*workflows(), ACTION)))
    assert len(lines) > 20
    for line in lines:
        assert PINNED.fullmatch(line), line
    versions = {line.partition("@")[0]: set[str]() for line in lines}
    for line in lines:
        versions[line.partition("@")[0]].add(line)
    assert all(len(uses) == 1 for uses in versions.values()), (
        "one version of an action in all files"
    )


def test_every_workflow_states_the_least_permissions() -> None:
    for path in workflows():
        assert read_yaml(path)["permissions"] == {"contents": "read"}, path.name


def test_the_workflow_to_copy_takes_limits_from_the_protected_branch() -> None:
    (job,) = read_yaml(ROOT / ".github/workflows/int8-gate.yml")["jobs"].values()
    (protected,) = (step["with"] for step in job["steps"] if "ref" in step.get("with", {}))
    assert protected["ref"] == "${{ github.base_ref }}"
    (gate,) = (step["with"] for step in job["steps"] if step.get("id") == "gate")
    assert gate["limits"].startswith(f"{protected['path']}/")
    assert (ROOT / gate["limits"].removeprefix(f"{protected['path']}/")).is_file()
