"""A page driven in a real browser, where one is installed; a server on this machine counts what it asks for."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from html import escape, unescape
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from deploy.report.page import digest

Report = dict[str, Any]
"""What a script wrote, as JSON has it; "asked": the addresses that the browser asked the server for."""

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
REPORT = """
addEventListener("load", () => {
  const report = {};
  try { drive(report); } catch (error) { report.failed = String(error) + error.stack; }
  const told = document.createElement("pre");
  told.id = "told"; told.textContent = JSON.stringify(report); document.body.append(told);
});
"""
POLICY = re.compile('<meta http-equiv="Content-Security-Policy" content="[^"]*">')
TIMEOUT_S = 180


def browser() -> str:
    """The path of a browser; the test is skipped where there is none."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip("no Chromium or Chrome here to drive the page with")
    return found


def framed(page: str, width: int) -> str:
    """A page that holds another in a frame so wide: a window of a browser has a least width."""
    policy = POLICY.search(page)
    assert policy, "a page without a policy"
    frame = f'<iframe width="{width}" height="900" srcdoc="{escape(page)}"></iframe>'
    return f"<!doctype html><html><head>{policy[0]}</head><body>{frame}</body></html>"


class Server(SimpleHTTPRequestHandler):
    """Serves a folder, and notes what it is asked for."""

    def __init__(self, asked: list[str], *given: Any, directory: str) -> None:
        self.asked = asked
        super().__init__(*given, directory=directory)

    def log_message(self, *_: object) -> None:
        self.asked.append(self.path)


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """The address of a folder on this machine, and the paths that it is asked for."""
    asked: list[str] = []
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Server, asked, directory=str(folder))) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}", asked
        finally:
            server.shutdown()
            thread.join()


def drive(page: str, script: str, folder: Path, *, dark: bool = False) -> Report:
    """What a script's function `drive(report)` writes into its argument, run once the page is loaded.

    The page's own content security policy stays in force: it is told of this script alone, by its digest.
    """
    whole = script + REPORT
    allowed = page.replace("script-src '", f"script-src '{digest(whole)}' '")
    assert allowed != page, "a page without a policy"
    (folder / "page.html").write_text(
        allowed.replace("</body>", f"<script>{whole}</script></body>"), encoding="utf-8"
    )
    with served(folder) as (address, asked):
        shown = opened(f"{address}/page.html", folder / "profile", dark=dark)
    told = re.search(r'<pre id="told">(.*?)</pre>', shown, re.DOTALL)
    assert told, "the script did not run"
    report: Report = json.loads(unescape(told[1]))
    assert "failed" not in report, report["failed"]
    return {**report, "asked": asked}


def opened(address: str, profile: Path, *, dark: bool) -> str:
    """The page as it stands once it is loaded."""
    options = [
        "--headless",
        "--no-sandbox",  # which refuses to run as root, as containers do
        "--disable-gpu",
        f"--user-data-dir={profile}",
        "--window-size=1280,900",
        f"--blink-settings=preferredColorScheme={0 if dark else 1}",
        "--dump-dom",
    ]
    command = [browser(), *options, address]
    return subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=True).stdout
