"""Chromium without a screen, by its DevTools: opens a page, moves the mouse, takes pictures; the CPU draws WebGL."""

import base64
import io
import itertools
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE = 120.0  # [s] for a browser that shares two cores with other tests


def chromium() -> str | None:
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Tab:
    def __init__(self, socket):
        self.socket, self.number = socket, itertools.count(1)
        self.said: list[str] = []  # errors of the page

    def call(self, method: str, **parameters):
        number = next(self.number)
        self.socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self.socket.recv(timeout=PATIENCE))
            if answer.get("method") == "Runtime.exceptionThrown":
                self.said.append(answer["params"]["exceptionDetails"]["text"])
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def text(self) -> str:
        """What can be read on the page."""
        return self.evaluate("document.body.innerText")

    def evaluate(self, script: str):
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait_for(self, what: str) -> None:
        end = time.monotonic() + PATIENCE
        while what not in (self.text() or ""):
            assert time.monotonic() < end, f"{what!r} does not appear; there is {self.text()!r}"
            time.sleep(0.2)

    def close_notes(self) -> None:
        """Close what the page says of itself in a corner, e.g. that no GPU draws it."""
        time.sleep(1.0)
        self.evaluate("document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())")
        time.sleep(1.0)

    def picture(self) -> np.ndarray:
        """[h, w, 3] uint8."""
        from PIL import Image

        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def mouse(self, kind: str, x: float, y: float, pressed: bool = True) -> None:
        button = "left" if pressed else "none"
        self.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=x,
            y=y,
            button=button,
            buttons=int(pressed),
            clickCount=int(pressed),
        )


def place_of(page: Any, tab: Tab, point: np.ndarray) -> tuple[float, float]:
    """Where a point of the body [m] is in the window [px], by the camera that the browser says it has. `page` is the
    one of `physics3d.view`."""
    import viser.transforms

    (client,) = page.server.get_clients().values()
    camera = client.camera
    x, y, w, h = tab.evaluate(
        "[...document.querySelectorAll('canvas')].map(c => c.getBoundingClientRect())"
        ".sort((a, b) => b.width * b.height - a.width * a.height).map(r => [r.x, r.y, r.width, r.height])[0]"
    )
    local = viser.transforms.SO3(camera.wxyz).as_matrix().T @ (point * page.pictures.scale - camera.position)
    focal = h / 2 / np.tan(camera.fov / 2)
    return x + w / 2 + focal * local[0] / local[2], y + h / 2 + focal * local[1] / local[2]


@contextmanager
def opened(address: str, folder: Path, *, width: int = 1100, height: int = 620) -> Iterator[Tab]:
    """A tab with the page at `address`; `folder` for what the browser keeps."""
    from websockets.sync.client import connect

    command = [
        chromium(), "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--remote-debugging-port=0", f"--user-data-dir={folder}", f"--window-size={width},{height}", "--mute-audio",
        "--no-first-run", "--disable-dev-shm-usage", "--disable-background-networking", "--no-proxy-server",
        "about:blank",
    ]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            end = time.monotonic() + PATIENCE
            known = folder / "DevToolsActivePort"
            while not (known.is_file() and known.read_text().strip()):
                assert process.poll() is None and time.monotonic() < end, "the browser does not start"
                time.sleep(0.1)
            port = known.read_text().split()[0]
            direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
            with direct.open(f"http://127.0.0.1:{port}/json/list") as answer:
                target = next(t for t in json.load(answer) if t["type"] == "page")
            with connect(target["webSocketDebuggerUrl"], max_size=None, proxy=None) as socket:
                tab = Tab(socket)
                tab.call("Page.enable")
                tab.call("Runtime.enable")
                tab.call("Page.navigate", url=address)
                yield tab
        finally:
            process.terminate()
            process.wait()
