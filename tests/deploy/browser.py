"""Functions that open a page in a real browser. Without one, the test is skipped."""

import json
import re
import shutil
import subprocess
from functools import partial
from html import escape, unescape
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
REPORT = """
addEventListener("load", () => {
  const shown = document.querySelector("iframe").contentDocument;
  const report = document.createElement("pre");
  report.id = "report"; report.textContent = JSON.stringify(look(shown));
  document.body.append(report);
});
"""
TIMEOUT_S = 240
HARNESS = """<!doctype html><body><script>
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));
const frame = (address, width) => new Promise((done) => {
  const made = document.createElement("iframe");
  Object.assign(made, { width, height: 900, onload: () => done(made) });
  made.src = address;
  document.body.append(made);
});
const send = (report) => fetch("/report", { method: "POST", body: JSON.stringify(report) });
const run = async () => { %s };
run().then(send, (error) => send({ failed: String(error) + error.stack }));
</script></body>"""


def browser() -> str:
    """Return the path of a browser, or skip the test if none is installed."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip("no Chromium or Chrome here to drive the page with")
    return path


def inspect_page(
    page: str, look: str, folder: Path, *, width_px: int = 1280, dark: bool = False
) -> Any:
    """Open a page and return the result of a script.

    Args:
        page: the HTML of the page.
        look: the body of the script's function `look(document)`.
        folder: where the page and the browser's profile are written.
        width_px: the width of the window.
        dark: whether the reader prefers dark colours.
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
    match = re.search(r'<pre id="report">(.*?)</pre>', dom, re.DOTALL)
    assert match, "the script did not run"
    return json.loads(unescape(match[1]))


class Server(SimpleHTTPRequestHandler):
    """Serves a folder and a page with a script, and receives the script's report."""

    def __init__(
        self, script: str, missing: str, messages: "Queue[Any]", *arguments: Any, directory: str
    ) -> None:
        self.script = script
        self.missing = missing
        self.messages = messages
        super().__init__(*arguments, directory=directory)

    def log_message(self, *_: object) -> None:
        """Write no log."""

    def do_GET(self) -> None:
        if self.missing and self.path.endswith(self.missing):
            return self.answer(404, b"")
        if self.path != "/harness":
            return super().do_GET()
        return self.answer(200, (HARNESS % self.script).encode())

    def do_POST(self) -> None:
        self.messages.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.answer(200, b"")

    def answer(self, status: int, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


def run_script(
    folder: Path, script: str, profile: Path, *, dark: bool = False, missing: str = ""
) -> Any:
    """Run a script that opens pages of a folder, and return its report.

    Args:
        folder: the folder to serve.
        script: the body of an asynchronous function; `frame(address, width)` opens a page.
        profile: an empty folder for the browser.
        dark: whether the reader prefers dark colours.
        missing: the end of a path that is not served.
    """
    command = [
        browser(),
        "--headless",
        # Chromium refuses to run as root with its sandbox.
        "--no-sandbox",
        "--disable-gpu",
        "--remote-debugging-port=0",
        "--window-size=1400,1000",
        f"--user-data-dir={profile}",
        f"--blink-settings=preferredColorScheme={0 if dark else 1}",
    ]
    messages: Queue[Any] = Queue()
    handler = partial(Server, script, missing, messages, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        address = f"http://127.0.0.1:{server.server_address[1]}/harness"
        started = subprocess.Popen([*command, address], stderr=subprocess.DEVNULL)
        try:
            report = messages.get(timeout=TIMEOUT_S)
        finally:
            started.terminate()
            started.wait()
            server.shutdown()
            thread.join()
    assert "failed" not in report, report["failed"]
    return report
