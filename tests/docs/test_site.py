"""Tests of the documentation's site, built strictly and opened in a real browser.

They are skipped without MkDocs or a browser. MkDocs is installed by
`pip install -e '.[dev,docs]' --config-settings editable_mode=strict`. Every page is opened at the
width of a desktop and of a telephone.
"""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from tests.deploy.browser import run_script
from tests.project_files import ROOT

Run = Callable[..., Any]

WIDTHS_PX = (1280, 390)
SEARCHES = {
    "halo": "tiling",
    "KV260": "boards",
    "known sensor": "other-sensors",
    "batch handler": "glossary",
}
"""Words to search for, and the page that must be among the first ten results."""
FIRST = 10
LOOK = """
const report = [];
for (const address of %s) {
  const shown = await frame(address, 1280);
  const page = shown.contentDocument;
  const root = page.documentElement;
  for (const width of %s) {
    shown.width = width;
    await sleep(50);
    report.push({
      address, width,
      over: root.scrollWidth - root.clientWidth,
      broken: [...page.images]
        .filter((each) => !each.naturalWidth).map((each) => each.getAttribute("src")),
      scheme: page.body.getAttribute("data-md-color-scheme"),
      back: getComputedStyle(page.body).backgroundColor,
      words: getComputedStyle(page.body).color,
      elsewhere: shown.contentWindow.performance.getEntriesByType("resource")
        .map((each) => each.name)
        .filter((each) => !each.startsWith(location.origin) && !each.startsWith("data:")),
    });
  }
  shown.remove();
}
return report;
"""
SEARCH = """
const shown = await frame("index.html", 1280), page = shown.contentDocument;
const box = page.querySelector("[data-md-component=search-query]"), report = {};
page.querySelector("#__search").checked = true;
box.focus();
const links = () => [...page.querySelectorAll(".md-search-result__link")];
const found = () => links().map((each) => each.getAttribute("href"));
for (const words of %s) {
  box.value = words;
  box.dispatchEvent(new Event("keyup", { bubbles: true }));
  box.dispatchEvent(new Event("input", { bubbles: true }));
  const first = encodeURI(words.split(" ")[0]);
  for (let tries = 0; tries < 50 && !(found().length && found()[0].includes(first)); tries++)
    await sleep(200);
  report[words] = found();
}
return report;
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if find_spec("mkdocs") is None:
        pytest.skip(
            "no MkDocs here: pip install -e '.[docs]' --config-settings editable_mode=strict"
        )
    folder = tmp_path_factory.mktemp("site")
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "--site-dir",
        str(folder),
    ]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    return folder


@pytest.fixture
def run(site: Path, tmp_path: Path) -> Run:
    """Return a function that runs a script in the site and returns the script's answer."""

    def answer(script: str, *, dark: bool = False) -> Any:
        # Without a search no page needs the search index of a megabyte.
        missing = "search_index.json" if script.startswith(LOOK[:20]) else ""
        return run_script(site, script, tmp_path, dark=dark, missing=missing)

    return answer


def pages(site: Path) -> list[str]:
    return sorted(
        str(path.relative_to(site)) for path in site.rglob("*.html") if path.name == "index.html"
    )


def test_no_page_is_wider_than_its_window_and_all_files_are_of_the_site(
    site: Path, run: Run
) -> None:
    looks = run(LOOK % (json.dumps(pages(site)), json.dumps(WIDTHS_PX)))
    assert len(looks) == len(pages(site)) * len(WIDTHS_PX) > 80
    assert [
        (look["address"], look["width"], look["over"]) for look in looks if look["over"] > 0
    ] == []
    assert [(look["address"], look["broken"]) for look in looks if look["broken"]] == []
    elsewhere = [
        look["elsewhere"]
        for look in looks
        if look["elsewhere"] and "architecture" not in look["address"]
    ]
    assert elsewhere == [], (
        "only Mermaid may be loaded from elsewhere; the published site has a copy: see mkdocs.yml"
    )


@pytest.mark.parametrize(("dark", "scheme"), [(False, "default"), (True, "slate")])
def test_the_colours_follow_the_reader_s_preference(
    site: Path, run: Run, dark: bool, scheme: str
) -> None:
    some = [page for page in pages(site) if page.count("/") < 2]
    for look in run(LOOK % (json.dumps(some), json.dumps(WIDTHS_PX)), dark=dark):
        assert look["scheme"] == scheme
        assert (brightness(look["back"]) < brightness(look["words"])) is dark


def brightness(colour: str) -> float:
    return sum(float(level) for level in re.findall(r"[\d.]+", colour)[:3])


def test_the_search_finds_the_expected_pages(run: Run) -> None:
    results = run(SEARCH % json.dumps([*SEARCHES]))
    for words, page in SEARCHES.items():
        first = [*dict.fromkeys(urlsplit(address).path for address in results[words])][:FIRST]
        assert any(path.endswith(f"/{page}/") for path in first), (words, first)
