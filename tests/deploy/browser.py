"""A page opened in a real browser, where one is installed; the test is skipped
where there is none.
"""

import json
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
REPORT = """
addEventListener("load", () => {
  const shown = document.querySelector("iframe").contentDocument;
  const told = document.createElement("pre");
  told.id = "told"; told.textContent = JSON.stringify(look(shown)); document.body.append(told);
});
"""
TIMEOUT_S = 180


def browser() -> str:
    """The path of a browser; the test is skipped where there is none."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip("no Chromium or Chrome here to drive the page with")
    return path


def seen(page: str, look: str, folder: Path, *, width_px: int = 1280, dark: bool = False) -> Any:
    """What the body of a script's function `look(document)` returns of a page
    in a window so wide.
    """
    frame = f'<iframe width="{width_px}" height="900" srcdoc="{escape(page)}"></iframe>'
    script = f"<script>const look = (document) => {{ {look} }};{REPORT}</script>"
    (folder / "page.html").write_text(
        f"<!doctype html><body>{frame}{script}</body>", encoding="utf-8"
    )
    options = [
        "--headless",
        # Chromium's sandbox refuses to run as root, which is the user of containers.
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={folder / 'profile'}",
        f"--blink-settings=preferredColorScheme={0 if dark else 1}",
        "--dump-dom",
    ]
    command = [browser(), *options, (folder / "page.html").as_uri()]
    dom = subprocess.run(
        command, capture_output=True, text=True, timeout=TIMEOUT_S, check=True
    ).stdout
    match = re.search(r'<pre id="told">(.*?)</pre>', dom, re.DOTALL)
    assert match, "the script did not run"
    return json.loads(unescape(match[1]))
