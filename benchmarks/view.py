"""How many frames a second the page of make view gets across, and what it looks like.

    make run SCENE=carnation PROFILE=smoke
    make bench-view [ARGS="scene=carnation profile=smoke"]     ->   docs/results/view.md, view.jpg

The Gaussians of the run are repeated until COUNT of them move; a hand pulls at the middle of the upper half. Frames are
counted where they arrive, by a client of the page's own protocol on this machine that draws nothing: simulation,
colours, packing and sending share the cores with it. The picture is Chromium's, of the run's own Gaussians.
"""

import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from browser import chromium, opened, place_of
from machine import machine

from physics3d.log import Log
from physics3d.view.page import Page
from physics3d.view.run import Run
from pipeline.settings import compose
from pipeline.view import finished, loaded
from pipeline.words import literal_paths

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
COUNT, SECONDS, PORT = 20_000, 10.0, 8478
LARGE = 0.5  # of a frame's bytes: messages that are larger are frames
QUALITY = 85  # of the picture


def main(words: list[str]) -> None:
    words = words or ["scene=carnation", "profile=smoke"]
    config, picked = compose(literal_paths(words))
    shelf = Path(config["output"]).expanduser().resolve() / "artifacts"
    run = loaded(config, finished(config, shelf, f"make run SCENE={picked['scene']} PROFILE={picked['profile']}"))
    rows = measure(repeated(run, COUNT))
    lines = [
        "# The page of make view: frames a second",
        "",
        f"`make bench-view`: {run.name}, {len(run.body.position)} particles, {COUNT} moving Gaussians (its own, "
        f"repeated), {SECONDS:g} s each. {machine('cpu')}.",
        "",
        "| what moves | frames/s that arrive | motion [ms] | drawing [ms] | MB a frame | simulated s per s |",
        "|---|---|---|---|---|---|",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        "Frames are counted where they arrive, by a client that draws nothing. What a browser draws of them depends on",
        "its graphics; over a slow line, frames that are overtaken are left out.",
    ]
    (RESULTS / "view.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    if chromium() is None:
        print("no chromium: no picture")
        return
    picture(run, RESULTS / "view.jpg")


def repeated(run: Run, count: int) -> Run:
    """With `count` Gaussians, all of them moving: those that move, over and over."""
    old = run.body.embedding
    which = torch.arange(count) % len(old.which)
    embedding = type(old)(which=torch.arange(count), neighbours=old.neighbours[which], weights=old.weights[which])
    gaussians = run.gaussians.select(old.which[which])
    return replace(run, gaussians=gaussians, body=replace(run.body, embedding=embedding))


def served(run: Run) -> tuple[Page, Callable[[], None]]:
    """A page that is served by a thread, and how to end it."""
    page = Page(run, host="127.0.0.1", port=PORT, save=lambda impulses, notes: "", log=Log(None))
    page.prepare()
    over = threading.Event()

    def work() -> None:
        while not over.is_set():
            page.serve(0.5)

    thread = threading.Thread(target=work)
    thread.start()

    def end() -> None:
        over.set()
        thread.join()
        page.server.stop()

    return page, end


def measure(run: Run) -> list[tuple[str, ...]]:
    page, end = served(run)
    rows = []
    try:
        with Client(page) as client:
            for name, kind, live in (
                ("the run, as a picture", "picture", False),
                ("the run, by speed", "speed", False),
                ("a live pull, as a picture", "picture", True),
                ("a live pull, by stress", "stress", True),
            ):
                page.kind.value = kind
                if live and page.live is not None:
                    page.mode = "live"
                    page.live.grab(upper(run))
                    page.live.pull(np.array([0.02, 0.0, 0.0]))
                time.sleep(2.0)  # until the rate has settled
                before, simulated, begun = client.frames, time_of(page), time.perf_counter()
                time.sleep(SECONDS)
                took = time.perf_counter() - begun
                _, motion, drawing, _, size = page.rate()
                passed = f"{(time_of(page) - simulated) / took:.2f}" if live else "-"
                frames = (client.frames - before) / took
                rows.append((name, f"{frames:.1f}", f"{motion:.0f}", f"{drawing:.0f}", f"{size / 1e6:.2f}", passed))
    finally:
        end()
    return rows


def time_of(page: Page) -> float:
    return page.live.time if page.live is not None else 0.0


def upper(run: Run) -> int:
    """A particle of the middle of the upper half."""
    x = run.body.position
    z = x[:, 2]
    there = torch.nonzero(z > z.min() + 0.75 * (z.max() - z.min())).flatten()
    return int(there[(x[there] - x[there].mean(0)).norm(dim=1).argmin()])


class Client:
    """Speaks to a page as a browser does, counts the frames and throws them away."""

    def __init__(self, page: Page):
        self.page, self.frames, self.over = page, 0, False

    def __enter__(self) -> "Client":
        import msgspec
        import viser
        from viser._messages import ViewerCameraMessage
        from websockets.sync.client import connect

        self.socket = connect(
            f"ws://127.0.0.1:{PORT}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None, proxy=None
        )
        start = self.page.server.initial_camera
        camera = ViewerCameraMessage(
            wxyz=(1.0, 0.0, 0.0, 0.0), position=tuple(start.position), fov=start.fov, near=0.1, far=1000.0,
            image_height=600, image_width=800, look_at=tuple(start.look_at), up_direction=(0.0, 0.0, 1.0),
        )  # fmt: skip
        self.socket.send(msgspec.msgpack.encode(camera.as_serializable_dict([])))
        self.thread = threading.Thread(target=self.receive)
        self.thread.start()
        return self

    def receive(self) -> None:
        least = LARGE * 32 * len(self.page.pictures.moving)
        while not self.over:
            try:
                self.frames += len(self.socket.recv(timeout=0.2)) > least
            except TimeoutError:
                continue

    def __exit__(self, *_: object) -> None:
        self.over = True
        self.thread.join()
        self.socket.close()


def picture(run: Run, path: Path) -> None:
    """The page while a hand pulls, as Chromium draws it."""
    from PIL import Image

    page, end = served(run)
    try:
        with (
            tempfile.TemporaryDirectory(prefix="physics3d_") as folder,
            opened(f"http://127.0.0.1:{PORT}", Path(folder), width=1280, height=720) as tab,
        ):
            tab.wait_for("frames/s")
            tab.close_notes()
            at = run.body.position[upper(run)].double().numpy()
            u, v = place_of(page, tab, at)
            tab.mouse("mouseMoved", u, v, pressed=False)
            tab.mouse("mousePressed", u, v)
            for share in range(1, 9):
                tab.mouse("mouseMoved", u + 12 * share, v)
                time.sleep(0.2)
            tab.wait_for("Pulled with")
            time.sleep(4.0)
            Image.fromarray(tab.picture()).save(path, quality=QUALITY)
    finally:
        end()
    print(f"written   {path}")


if __name__ == "__main__":
    main(sys.argv[1:])
