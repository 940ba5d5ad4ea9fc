"""Test that every kind of output shows text of others' files on its line, and neither obeys it nor
reads it as markup.

The files are networks (metadata, names of nodes and tensors), images and samples (names), sensors
and boards.
"""

import io
import json
import logging
import re
from collections.abc import Callable
from html.parser import HTMLParser
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.cells import cell_len
from rich.console import Console
from rich.text import Text

from beers_deploy.cli.commands import COMMANDS
from beers_deploy.cli.run import logged
from beers_deploy.kit.record import _page, bill_of
from beers_deploy.model import progress
from beers_deploy.profiles.errors import one_line, visible
from beers_deploy.profiles.figures import Check, Row, measured, unavailable
from beers_deploy.report.page import Picture, Report, Section, render
from beers_deploy.report.plots import look, new_figure, svg_of
from beers_deploy.results import Input, Table
from beers_deploy.tables.markup import markdown_table, markdown_text
from beers_deploy.tables.terminal import PIPE_WIDTH, print_rows
from tests.project_files import ROOT

HOSTILE = (
    "a|b\n::error::c\r\x1b[31m\x9b31m\x00 \u202egnp.exe\u2066 ``` <img src=x onerror=y> "
    "[l](http://x) "
    "[red]r[/red] [/b] &lt;"
)
TEXT = st.text(alphabet=st.characters(exclude_categories=["Cs"]))


def any_text(test: Callable[[str], None]) -> Callable[[], None]:
    """Run a test on any text, and on one with every trick."""
    return settings(max_examples=40)(given(TEXT)(example(HOSTILE)(test)))


HEAD = {"html", "head", "meta", "title", "style", "body", "script"}
TABLES = {
    "h1",
    "h2",
    "p",
    "div",
    "table",
    "thead",
    "tbody",
    "tr",
    "th",
    "td",
    "small",
    "ul",
    "li",
    "b",
}
TAGS = HEAD | TABLES
"""The tags of a page of ours without a picture."""


def rows_with(text: str) -> list[Row]:
    """Return rows that have `text` wherever a row may have a text."""
    figure = measured(1.5, text, text)
    return [
        Row("t", text, {"size": figure, text: unavailable("px", text)}, {text: text, "word": text})
    ]


def all_printable(text: str, allowed: str = "\n\t\N{NO-BREAK SPACE}") -> bool:
    return all(letter.isprintable() or letter in allowed for letter in text)


class Tags(HTMLParser):
    """Collects the tags of a page and its text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags = set[str]()
        self.attributes = set[str]()
        self.words = list[str]()
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@any_text
def test_a_page_has_the_text_and_no_tag_of_it(text: str) -> None:
    picture = Picture(text, "data:,", text)
    html = render(
        Report(text, text, [Section(text, rows_with(text), text)], [picture], [text], sorts=True)
    )
    assert all_printable(html)
    parsed = Tags(html)
    assert parsed.tags <= TAGS | {"figure", "img", "figcaption"}
    assert "onerror" not in parsed.attributes
    assert visible(text).strip() in "".join(parsed.words)


@any_text
def test_a_notebook_has_the_text_and_no_tag_of_it(text: str) -> None:
    table = Table("check", {}, (), tuple(rows_with(text)), notes=(text,))
    assert all_printable(table._repr_html_())
    assert Tags(table._repr_html_()).tags <= TAGS
    assert repr(table).isprintable()


@any_text
def test_a_terminal_has_each_line_of_ours_and_no_other(text: str) -> None:
    outputs = []
    for words in (text, "plain"):
        stream = io.StringIO()
        row = Row("t", "one", {"size": measured(1.5, "px", "here")}, {"word": words[:20]})
        print_rows(f"t{words[:20]}", [row] * 2, Console(file=stream, width=PIPE_WIDTH))
        outputs.append(stream.getvalue())
    assert all_printable(outputs[0], "\n")
    assert outputs[0].count("\n") == outputs[1].count("\n")


@any_text
def test_a_record_of_the_log_is_one_line(text: str) -> None:
    stream = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stderr", stream)
        with logged(COMMANDS["restore"], quiet=False, verbose=False):
            logging.getLogger("beers_deploy.deploy").info("wrote %s", text)
    assert stream.getvalue() == f"wrote {one_line(text)}\n"


@any_text
def test_progress_is_one_line_without_markup(text: str) -> None:
    stream = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stderr", stream)
        with progress.reporting(True), progress.steps("work", 1) as bar:
            bar.advance(1, text)
        with progress.reporting(True), progress.progress("work"):
            progress.step(text)
    lines = stream.getvalue().split("\n")
    assert len(lines) == 3
    assert all_printable("".join(lines), "")
    terminal = io.StringIO()
    bar_on_terminal = progress._new_bar()
    bar_on_terminal.add_task(one_line(text), total=1)
    Console(file=terminal, width=10_000).print(
        bar_on_terminal.make_tasks_table(bar_on_terminal.tasks)
    )
    # rich omits characters that no terminal shows alone, such as a modifier of an emoji.
    plain_text = io.StringIO()
    Console(file=plain_text, width=10_000).print(Text(one_line(text)), end="")
    shown = plain_text.getvalue().rstrip("\n")
    # A modifier alone has no width, and a table omits it.
    is_shown = cell_len(shown) > 0
    assert not is_shown or terminal.getvalue().startswith(shown), "a name in brackets is no markup"


@any_text
def test_a_cell_of_markdown_is_one_cell_of_plain_text(text: str) -> None:
    lines = markdown_table([Row("t", text, {"size": measured(1.5, "px", "here")}, {"word": text})])
    html = MarkdownIt("commonmark").enable(["table", "strikethrough"]).render("\n".join(lines))
    assert html.count("<tr>") == 2
    assert html.count("<td>") == 3
    assert Tags(html).tags == {"table", "thead", "tbody", "tr", "th", "td"}
    assert all_printable("\n".join(lines), "\n")
    assert "\n" not in markdown_text(text)


def document(text: str) -> tuple[Table, dict[str, Any]]:
    """Return a judged table and the record of its network."""
    check = Check("MAE", 2.0, 1.0, "dB", detail=text)
    table = Table("gate", {}, (Input(text, "0" * 64),), tuple(rows_with(text)), (check,), (text,))
    network = {"name": text, "precision": "INT8", "sha256": "0" * 64}
    record = {
        "tool": {"name": "beers-deploy", "version": "1", "code_sha256": "0" * 64},
        "network": network,
        "says": {text: text, "sensor": text},
        "limitations": [text],
        "passed": False,
        "results": {"inputs": [{"name": text, "sha256": "0" * 64}]},
    }
    record |= dict.fromkeys(("weights_sha256", "training", "sensors_in_range", "licence"))
    return table, record


@any_text
def test_a_record_has_the_text_of_a_network_s_metadata_escaped(text: str) -> None:
    table, record = document(text)
    html = render(_page(table, record))
    assert all_printable(html)
    assert Tags(html).tags <= TAGS


@any_text
def test_a_bill_of_materials_has_names_on_one_line(text: str) -> None:
    pytest.importorskip("cyclonedx")
    _, record = document(text)
    bill = bill_of(record)
    assert all_printable(bill, "\n")
    content = json.loads(bill)
    component = content["metadata"]["component"]
    assert component["name"] == one_line(text)
    assert all(entry["name"].isprintable() for entry in component["properties"])
    assert all(entry["value"].isprintable() for entry in component["properties"])


@any_text
def test_a_drawing_has_the_text_as_words(text: str) -> None:
    pytest.importorskip("matplotlib")
    with look():
        figure = new_figure(100, 100)
        svg = svg_of(figure, text)
    assert all_printable(svg)
    root = ET.fromstring(svg)  # noqa: S314 - our own
    kinds = {element.tag.rpartition("}")[2] for element in root.iter()}
    assert not kinds & {"img", "script", "foreignObject"}


def test_no_output_is_written_past_the_functions_that_escape() -> None:
    """Only these modules write to a terminal, and each was reviewed once."""
    printing = re.compile(
        r"typer\.echo\(|\bconsole\.print\(|std(out|err)\.write\(|(?<![.\w>])print\("
    )
    parts = ("deploy", "model", "quant", "profiles")
    paths = chain.from_iterable((ROOT / part).rglob("*.py") for part in parts)
    writers = {path.relative_to(ROOT).as_posix() for path in paths if printing.search(_code(path))}
    allowed = {
        "deploy/__main__.py",
        "deploy/cli/commands.py",
        "deploy/cli/run.py",
        "deploy/cli/streams.py",
        "deploy/results.py",
        "deploy/tables/terminal.py",
        "model/progress.py",
    }
    # These run on a board, by themselves, and host.py prints numbers alone.
    assert writers - allowed == {"deploy/kit/host.py", "deploy/kit/measure.py"}


def _code(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    return "\n".join(line for line in lines if not line.strip().startswith((">>>", "...", "#")))
