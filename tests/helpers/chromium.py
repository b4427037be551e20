"""A headless Chromium driven through the DevTools protocol: pages, mouse, keyboard, pictures, requests."""

import base64
import itertools
import json
import os
import shutil
import signal
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

PROGRAM = "/usr/bin/chromium"
needs_chromium = pytest.mark.skipif(
    not Path(PROGRAM).is_file(), reason=f"{PROGRAM} is not there (apt-get install chromium)"
)
# Software GL: there is no screen and no graphics card.
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--disable-gpu-sandbox", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
    "--disable-features=Translate,OptimizationHints,MediaRouter", "--remote-allow-origins=*", "--mute-audio",
)  # fmt: skip
CTRL, SHIFT = 2, 8


class Page:
    """One page and what it asked the network for."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._numbers = socket, itertools.count(1)
        self.requests: list[str] = []
        self.problems: list[str] = []
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, timeout: float = 60.0, **parameters: Any) -> dict[str, Any]:
        """Sends a command and waits for its result; events that come meanwhile are taken note of."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        end = time.monotonic() + timeout
        while True:
            message = json.loads(self._socket.recv(timeout=max(0.01, end - time.monotonic())))
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        kind, facts = message.get("method"), message.get("params", {})
        if kind == "Network.requestWillBeSent":
            self.requests.append(facts["request"]["url"])
        elif kind == "Network.webSocketCreated":
            self.requests.append(facts["url"])
        elif kind == "Runtime.exceptionThrown":
            self.problems.append(facts["exceptionDetails"].get("exception", {}).get("description", "?"))
        elif kind == "Log.entryAdded" and facts["entry"]["level"] == "error":
            self.problems.append(f"{facts['entry']['text']} {facts['entry'].get('url', '')}")

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in found:
            raise RuntimeError(str(found["exceptionDetails"]))
        return found["result"].get("value")

    def text(self) -> str:
        return self.run("document.body ? document.body.innerText : ''") or ""

    def wait(self, holds: Callable[[], Any], timeout: float = 60.0, what: str = "") -> Any:
        """Waits until something holds and returns it."""
        end = time.monotonic() + timeout
        while True:
            value = holds()
            if value:
                return value
            if time.monotonic() > end:
                raise TimeoutError(f"{what or holds}: not within {timeout} s; problems: {self.problems}")
            time.sleep(0.1)

    def picture(self) -> bytes:
        """What is seen, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def mouse(self, kind: str, x: float, y: float, *, held: bool = False, modifiers: int = 0) -> None:
        self.call(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, modifiers=modifiers, button="left" if held else "none",
            buttons=1 if held and kind != "mouseReleased" else 0, clickCount=1 if held else 0,
        )  # fmt: skip

    def press(self, x: float, y: float, modifiers: int = 0) -> None:
        """Moves to a point and presses the left button there."""
        for near in (-3, -1, 0):
            self.mouse("mouseMoved", x + near, y, modifiers=modifiers)
            time.sleep(0.05)
        self.mouse("mousePressed", x, y, held=True, modifiers=modifiers)

    def release(self, x: float, y: float, modifiers: int = 0) -> None:
        self.mouse("mouseReleased", x, y, held=True, modifiers=modifiers)

    def drag(
        self, start: tuple[float, float], end: tuple[float, float], *, modifiers: int = 0, hold: bool = False
    ) -> None:
        """Drags from point to point; ``hold`` keeps the button down."""
        self.press(*start, modifiers)
        for step in range(1, 6):
            x, y = (a + (b - a) * step / 5 for a, b in zip(start, end, strict=True))
            self.mouse("mouseMoved", x, y, held=True, modifiers=modifiers)
        if not hold:
            self.release(*end, modifiers)

    def give_file(self, path: Path) -> None:
        """Gives a file to the page's file input, as its dialog would."""
        root = self.call("DOM.getDocument", depth=-1)["root"]["nodeId"]

        def node() -> int:
            return self.call("DOM.querySelector", nodeId=root, selector="input[type=file]")["nodeId"]

        self.call("DOM.setFileInputFiles", nodeId=self.wait(node, 10, "a file input"), files=[str(path)])

    def press_button(self, label: str, elements: str = "button, [role=tab]") -> None:
        """Clicks the panel's button or tab of this label with the mouse."""
        script = (
            f"(() => {{ const b = {_labelled(label, elements)}; if (!b) return null; "
            "b.scrollIntoView({block: 'nearest'}); "
            "const r = b.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )

        def place() -> Any:
            before = self.run(script)
            time.sleep(0.2)
            return before if before and before == self.run(script) else None

        middle = self.wait(place, 20, f"{label!r}")  # folders open slowly
        self.press(*middle)
        self.release(*middle)
        time.sleep(0.3)


def _labelled(label: str, elements: str) -> str:
    return (
        f"[...document.querySelectorAll({json.dumps(elements)})].filter(e => e.innerText.trim() === "
        f"{json.dumps(label)} && e.offsetParent).pop()"
    )


@contextmanager
def chromium(folder: Path, *, size: tuple[int, int]) -> Iterator[Page]:
    """A fresh browser with one page."""
    home = folder / "chromium"
    home.mkdir(parents=True, exist_ok=True)
    command = [PROGRAM, *FLAGS, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={home}",
               "--remote-debugging-port=0", "about:blank"]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        port = _port(home / "DevToolsActivePort", process)
        with connect(_page_address(port), max_size=1 << 28, open_timeout=20, ping_interval=None) as socket:
            page = Page(socket)
            page.call("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1,
                      mobile=False)  # fmt: skip
            yield page
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        shutil.rmtree(home, ignore_errors=True)


def _port(file: Path, process: subprocess.Popen[bytes]) -> int:
    end = time.monotonic() + 30
    while time.monotonic() < end and process.poll() is None:
        if file.is_file() and len(lines := file.read_text().splitlines()) >= 1 and lines[0]:
            return int(lines[0])
        time.sleep(0.1)
    raise TimeoutError(f"chromium did not start (exit status {process.poll()})")


def _page_address(port: int) -> str:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(f"http://127.0.0.1:{port}/json/list", timeout=20) as answer:
        return next(item["webSocketDebuggerUrl"] for item in json.load(answer) if item["type"] == "page")
