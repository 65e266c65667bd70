"""A headless Chromium for the tests, driven over its debugging pipe: no library, no port, no network."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

FLAGS = ("--headless --no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-background-networking "
         "--disable-component-update --disable-sync --no-first-run --hide-scrollbars --remote-debugging-pipe").split()
TIME_LIMIT_S = 90.0


def chromium() -> str | None:
    """The browser's command, None where there is none: the one LIMN_CHROMIUM names, or one on the path."""
    names = (os.environ.get("LIMN_CHROMIUM", ""), "chromium", "chromium-browser", "google-chrome")
    return next((found for found in map(shutil.which, filter(None, names)) if found), None)


class Browser:
    """One page. problems: what the console or the page complained of; requests: every address that was asked for."""

    def __init__(self, width: int, height: int, mobile: bool = False):
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        to_browser, ours = os.pipe()
        theirs, from_browser = os.pipe()
        self._write, self._read = ours, theirs
        self._process = self._start([to_browser, from_browser])
        self._buffer, self._id, self._events = b"", 0, []
        self.problems: list[str] = []
        self.requests: list[str] = []
        self._session: str | None = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, mobile=mobile, deviceScaleFactor=1)

    def _start(self, ends: list[int]) -> subprocess.Popen:
        """Chromium reads commands from descriptor 3 and answers on 4."""
        def place() -> None:
            high = [os.dup2(end, 90 + k) for k, end in enumerate(ends)]
            for k, end in enumerate(high):
                os.dup2(end, 3 + k)

        command = [chromium(), *FLAGS, f"--user-data-dir={self._profile.name}", "about:blank"]
        silent = subprocess.DEVNULL
        process = subprocess.Popen(command, preexec_fn=place, close_fds=False, stdout=silent, stderr=silent)
        for end in ends:
            os.close(end)
        return process

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_) -> None:
        for end in (self._write, self._read):
            os.close(end)
        self._process.kill()
        self._process.wait()
        self._profile.cleanup()

    def call(self, method: str, **params) -> dict:
        """One command of the DevTools protocol -> its result. RuntimeError when it fails or takes too long."""
        self._id += 1
        message = {"id": self._id, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + TIME_LIMIT_S
        while True:
            answer = self._receive(end - time.monotonic())
            if answer.get("id") == self._id:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def _receive(self, seconds: float) -> dict:
        while b"\0" not in self._buffer:
            if not select.select([self._read], [], [], max(seconds, 0.0))[0]:
                raise RuntimeError("the browser does not answer")
            self._buffer += os.read(self._read, 1 << 20)
        line, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(line)
        self._note(message)
        return message

    def _note(self, message: dict) -> None:
        method, params = message.get("method"), message.get("params", {})
        self._events.append(method)
        if method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            self.problems.append(str(params["exceptionDetails"].get("exception", params)))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.problems.append(str(params["args"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.problems.append(params["entry"]["text"])

    def open(self, path: Path) -> None:
        """Loads a file and waits until it has fired its load event."""
        self._events.clear()
        self.call("Page.navigate", url=path.resolve().as_uri())
        end = time.monotonic() + TIME_LIMIT_S
        while "Page.loadEventFired" not in self._events:
            self._receive(end - time.monotonic())

    def evaluate(self, script: str):
        """The value of a JavaScript expression; promises are awaited."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(f"{script}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def wait_for(self, script: str) -> None:
        """Until the expression is true."""
        end = time.monotonic() + TIME_LIMIT_S
        while not self.evaluate(script):
            if time.monotonic() > end:
                raise RuntimeError(f"never true: {script}")
            time.sleep(0.05)

    def drag(self, start: tuple[float, float], stop: tuple[float, float]) -> None:
        """Pointer down at start, across to stop, up; positions in the window."""
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", stop), ("mouseReleased", stop)):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def click(self, selector: str) -> None:
        """A click in the middle of the element, scrolled into view."""
        x, y = self.middle(selector)
        self.drag((x, y), (x, y))

    def middle(self, selector: str) -> tuple[float, float]:
        """Where the element's middle lies in the window after it was scrolled into view."""
        box = self.evaluate(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)}); e.scrollIntoView({{block: 'center', "
            "behavior: 'instant'}); const r = e.getBoundingClientRect(); "
            "return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        return box[0], box[1]

    def screenshot(self, path: Path, whole: bool = True) -> None:
        """The page, or the window, as a PNG."""
        data = self.call("Page.captureScreenshot", captureBeyondViewport=whole, format="png")["data"]
        path.write_bytes(base64.b64decode(data))

    def emulate(self, media: str) -> None:
        """Styles for "print" or "screen"."""
        self.call("Emulation.setEmulatedMedia", media=media)
