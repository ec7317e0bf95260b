"""A real browser without a window: Chromium, told what to do through its DevTools protocol."""

import base64
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
#: Rendering by the processor: there may be no graphics card.
OPTIONS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-dev-shm-usage", "--hide-scrollbars", "--remote-debugging-port=0",
)  # fmt: skip
PATIENCE = 120.0


def executable() -> str:
    """Where the browser is; without one skip, but never in continuous integration."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        message = f"no browser: none of {NAMES} is installed (Debian: apt-get install chromium)"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(message)
    return found


class Page:
    """One page: what it asked the network for, what it complained of, how it looks."""

    def __init__(self, connection) -> None:
        self._connection, self._numbers = connection, itertools.count(1)
        self.requests: list[str] = []
        self.complaints: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters):
        number = next(self._numbers)
        self._connection.send(
            json.dumps({"id": number, "method": method, "params": parameters})
        )
        while True:
            message = self._receive()
            if message.get("id") == number:
                assert "error" not in message, (method, message)
                return message["result"]

    def _receive(self):
        message = json.loads(self._connection.recv(timeout=PATIENCE))
        self._note(message)
        return message

    def _note(self, message) -> None:
        method, parameters = message.get("method"), message.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.requests.append(parameters["url"])
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(parameters["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "assert"):
            self.complaints.append(json.dumps(parameters["args"]))
        elif method == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.complaints.append(json.dumps(parameters["entry"]))

    def open(self, url: str) -> None:
        result = self.call("Page.navigate", url=url)
        assert "errorText" not in result, result
        while self._receive().get("method") != "Page.loadEventFired":
            pass

    def evaluate(self, expression: str):
        """The value of a JavaScript expression, which may be a promise."""
        result = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait_for(self, expression: str):
        """Its value as soon as that is true."""
        end = time.monotonic() + PATIENCE
        while not (value := self.evaluate(expression)):
            assert time.monotonic() < end, f"{expression} never became true"
            time.sleep(0.2)
        return value

    def mouse(self, event: str, at: np.ndarray, buttons: int = 1) -> None:
        """Press, move or let go the left button at a pixel; give the page time to see it."""
        x, y = map(float, at)
        button = "none" if event == "mouseMoved" else "left"
        self.call(
            "Input.dispatchMouseEvent", type=event, x=x, y=y, button=button, buttons=buttons,
            clickCount=1,
        )  # fmt: skip
        self.evaluate("new Promise(seen => requestAnimationFrame(() => setTimeout(seen, 100)))")

    def screenshot(self) -> np.ndarray:
        """Red, green and blue of every pixel, 0 to 1, (height, width, 3)."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(imread(io.BytesIO(data)))[..., :3]


@contextmanager
def page(width: int = 800, height: int = 600) -> Iterator[Page]:
    """A fresh browser with one empty page."""
    from websockets.sync.client import connect

    command = [executable(), *OPTIONS, f"--window-size={width},{height}"]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = subprocess.Popen(
            [*command, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            with connect(_address(browser, Path(profile)), max_size=None) as connection:
                yield Page(connection)
        finally:
            # it and the processes that it has started, which may be too busy to be asked
            os.killpg(browser.pid, signal.SIGKILL)
            browser.wait(PATIENCE)


def _address(browser: subprocess.Popen, profile: Path) -> str:
    """The DevTools address of the first page; the browser writes its port into its profile."""
    import urllib.request

    file, end = profile / "DevToolsActivePort", time.monotonic() + PATIENCE
    while time.monotonic() < end and browser.poll() is None:
        if file.exists() and (lines := file.read_text().splitlines()):
            with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json") as answer:
                pages = [one for one in json.load(answer) if one["type"] == "page"]
            if pages:
                return pages[0]["webSocketDebuggerUrl"]
        time.sleep(0.1)
    raise AssertionError(f"the browser did not start (exit code {browser.poll()})")


def red(picture) -> int:
    """How many pixels have the reproduced path's colour."""
    r, g, b = np.moveaxis(picture, -1, 0)
    return int(((r > 0.6) & (g < 0.4) & (b < 0.4)).sum())


def blue_grey(picture) -> int:
    """How many pixels have the robot's colour, in light and in shade."""
    r, _, b = np.moveaxis(picture, -1, 0)
    return int(((b > r + 0.04) & (b < 0.85) & (r > 0.15)).sum())


def yellow(picture) -> int:
    """How many pixels have the colour of a handle under the mouse."""
    r, g, b = np.moveaxis(picture, -1, 0)
    return int(((r > 0.85) & (g > 0.85) & (b < 0.6)).sum())


def draws(page) -> None:
    """Wait until the robot and the path are in the canvas."""
    end = time.monotonic() + PATIENCE
    while blue_grey(picture := page.screenshot()) < 1000 or red(picture) < 30:
        found = f"{blue_grey(picture)} pixels of the robot, {red(picture)} of the path"
        assert time.monotonic() < end, found
