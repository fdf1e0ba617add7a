"""A real headless Chromium for tests of pages: run a script in a page and get back what it returns, or a picture.

The script's answer comes as a POST to a server of this process, so no driver is needed.
"""

from __future__ import annotations

import contextlib
import json
import queue
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--hide-scrollbars", "--no-first-run", "--disable-extensions", "--disable-background-networking",
    "--disable-dev-shm-usage", "--mute-audio",
)  # fmt: skip
WINDOW = "--window-size=900,600"
POLICY = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')

# Float32Arrays travel as base64, which JSON alone would turn into objects.
SENDER = """
<script>(async () => {
  const send = (body) => fetch("http://127.0.0.1:PORT/", {method: "POST", mode: "no-cors", body: JSON.stringify(body,
    (key, value) => {
      if (!ArrayBuffer.isView(value)) return value;
      const bytes = new Uint8Array(value.buffer); let text = "";
      for (let k = 0; k < bytes.length; k += 32768) text += String.fromCharCode(...bytes.subarray(k, k + 32768));
      return {float32: btoa(text)};
    })});
  try {
    for (let k = 0; k < 1200 && !window.lunargr; k++) await new Promise((done) => setTimeout(done, 100));
    await send({result: await (async () => { SCRIPT })()});
  } catch (error) { await send({error: String(error) + " " + (error.stack || "")}); }
})();</script>
"""


def chromium() -> str:
    """Its path; the test is skipped where there is none."""
    for name in NAMES:
        found = shutil.which(name)
        if found:
            return found
    pytest.skip("no Chromium found: install 'chromium' to test pages in a browser")


@contextlib.contextmanager
def _server() -> Iterator[tuple[int, queue.Queue[bytes]]]:
    answers: queue.Queue[bytes] = queue.Queue()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            answers.put(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *arguments: Any) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.server_port, answers
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def run_in_page(page: Path, script: str, *, timeout: float = 180, flags: tuple[str, ...] = ()) -> Any:
    """What the body of an async function returns inside the page, once the page's ``window.lunargr`` is there."""
    program = chromium()
    with _server() as (port, answers), tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        sender = SENDER.replace("PORT", str(port)).replace("SCRIPT", script)
        copy = Path(profile) / "page.html"
        # the page itself may not speak to anyone: the copy that is tested must
        copy.write_text(POLICY.sub("", page.read_text()).replace("</body>", sender + "</body>"))
        profile_flag = f"--user-data-dir={profile}/profile"
        # without a port for debugging, a headless Chromium ends as soon as the page has loaded
        command = [program, *FLAGS, WINDOW, *flags, profile_flag, "--remote-debugging-port=0", copy.as_uri()]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            answer = json.loads(answers.get(timeout=timeout), object_hook=_arrays)
        except queue.Empty:
            raise AssertionError(f"the page gave no answer in {timeout:g} s") from None
        finally:
            process.terminate()
            process.wait(timeout=20)
    assert "error" not in answer, answer["error"]
    return answer["result"]


def _arrays(value: dict[str, Any]) -> Any:
    if set(value) == {"float32"}:
        import base64

        return np.frombuffer(base64.b64decode(value["float32"]), np.float32)
    return value


def read_dom(page: Path, flags: tuple[str, ...] = ("--dump-dom",)) -> str:
    """The page's document after its scripts have run, with nothing in it changed."""
    program = chromium()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            program,
            *FLAGS,
            *flags,
            WINDOW,
            f"--user-data-dir={profile}",
            "--virtual-time-budget=30000",
            page.resolve().as_uri(),
        ]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=180).stdout
