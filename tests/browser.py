"""A page in a real browser, Chromium without a window, that a test looks at and drags."""

import base64
import contextlib
import io
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

import numpy as np
from PIL import Image

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_OPTIONS = (
    *("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-gpu-compositing", "--disable-gpu-rasterization"),  # which a processor does faster itself
)
_START = 60.0
"""Longest time that a browser takes to start on a busy machine [s]."""


class Page:
    """A page that is shown; what it asked for is in ``requests``, what went wrong in it in ``failures``."""

    def __init__(self, socket):
        self._socket, self._count = socket, 0
        self.requests, self.failures = [], []
        for domain in ("Runtime", "Network", "Page"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        """Return what a method of Chromium's DevTools protocol answers."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            said = json.loads(self._socket.recv(timeout=_START))
            if said.get("id") == self._count:
                assert "error" not in said, said
                return said["result"]
            if said["method"] == "Network.requestWillBeSent":
                self.requests.append(said["params"]["request"]["url"])
            elif said["method"] == "Runtime.exceptionThrown":
                self.failures.append(said["params"]["exceptionDetails"])

    def evaluate(self, expression):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def picture(self):
        """Return what is seen, 8-bit RGB, shape [height, width, 3]."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    def drag(self, begin, end):
        """Move the mouse with the left button pressed between two places [px]."""
        places = np.linspace(begin, end, 6).tolist()
        kinds = ["mousePressed", *["mouseMoved"] * 4, "mouseReleased"]
        for kind, (x, y) in zip(kinds, places, strict=True):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)


@contextlib.contextmanager
def shown(path, folder, size=(500, 300)):
    """Show a file in a browser that keeps its own things in a folder and reaches no network."""
    from websockets.sync.client import connect  # noqa: PLC0415 - comes with viser

    options = [*_OPTIONS, f"--window-size={size[0]},{size[1]}", "--host-resolver-rules=MAP * ~NOTFOUND"]
    options += ["--remote-debugging-port=0", f"--user-data-dir={folder}", "about:blank"]
    browser = subprocess.Popen([CHROMIUM, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port, end = Path(folder) / "DevToolsActivePort", time.monotonic() + _START
        while not (port.exists() and "\n" in port.read_text()):
            assert browser.poll() is None and time.monotonic() < end, "the browser does not start"
            time.sleep(0.05)
        with urllib.request.urlopen(f"http://127.0.0.1:{port.read_text().split()[0]}/json", timeout=_START) as tabs:
            (tab,) = [entry for entry in json.load(tabs) if entry["type"] == "page"]
        with connect(tab["webSocketDebuggerUrl"], max_size=None, ping_interval=None) as socket:
            page = Page(socket)
            page.call("Page.navigate", url=Path(path).resolve().as_uri())
            while page.evaluate("document.readyState") != "complete":
                time.sleep(0.05)
            yield page
    finally:
        browser.terminate()
        browser.wait(_START)
