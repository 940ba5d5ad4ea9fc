"""A page opened in a real browser, where one is installed; the test is skipped
where there is none.
"""

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
  const told = document.createElement("pre");
  told.id = "told"; told.textContent = JSON.stringify(look(shown)); document.body.append(told);
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
const tell = (report) => fetch("/told", { method: "POST", body: JSON.stringify(report) });
const drive = async () => { %s };
drive().then(tell, (error) => tell({ failed: String(error) + error.stack }));
</script></body>"""


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


class Server(SimpleHTTPRequestHandler):
    """Serves a folder, a page with a script in it, and takes what the script tells."""

    def __init__(
        self, script: str, missing: str, messages: "Queue[Any]", *arguments: Any, directory: str
    ) -> None:
        self.script = script
        self.missing = missing
        self.told = messages
        super().__init__(*arguments, directory=directory)

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        if self.missing and self.path.endswith(self.missing):
            return self.answer(404, b"")
        if self.path != "/harness":
            return super().do_GET()
        return self.answer(200, (HARNESS % self.script).encode())

    def do_POST(self) -> None:
        self.told.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.answer(200, b"")

    def answer(self, status: int, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


def driven(
    folder: Path, script: str, profile: Path, *, dark: bool = False, missing: str = ""
) -> Any:
    """What a script answers that drives pages of a folder, and may wait for them.

    Args:
        folder: that is served.
        script: the body of an asynchronous function; `frame(address, width)` opens a page.
        profile: an empty folder for the browser.
        dark: whether the reader prefers dark colours.
        missing: the end of a path that is not served.
    """
    command = [
        browser(),
        "--headless",
        # As above.
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
