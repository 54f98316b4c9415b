"""How many frames a second the page of make view gets across, and what it looks like.

    make run SCENE=carnation; make run SCENE=ball PROFILE=smoke
    make bench-view [ARGS="scene=carnation"]     ->   docs/results/view.md, view.jpg

The carnation is pulled at without a grid; the ball, which lies on a floor, by one, as fine as it is and finer, and the
ball of honey, which flows.
The Gaussians of a run are repeated until COUNT of them move; a hand pulls at the middle of the upper half. Frames are
counted where they arrive, by a client of the page's own protocol on this machine that draws nothing: simulation,
colours, packing and sending share the cores with it. The picture is Chromium's, of the run's own Gaussians.
"""

import itertools
import os
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

from physics3d.gaussians.embedding import embed
from physics3d.log import Log
from physics3d.materials.newtonian import Newtonian
from physics3d.view.page import Page
from physics3d.view.run import Run
from pipeline.settings import compose
from pipeline.view import finished, loaded
from pipeline.words import literal_paths

RESULTS = Path(__file__).resolve().parent.parent / "docs" / "results"
COUNT, SECONDS, PORT = 20_000, 10.0, 8478
FINER = 3
LARGE = 0.5  # of a frame's bytes: messages that are larger are frames
QUALITY = 85  # of the picture


def main(words: list[str]) -> None:
    run, ball = read(words or ["scene=carnation"]), read(["scene=ball", "profile=smoke"])
    honey = replace(ball.world, material=Newtonian(), start=Newtonian().example)
    rows, told, load = [], [], os.getloadavg()[0]
    for name, moved, pulled_only in (
        (run.name, run, False),
        (ball.name, ball, True),
        (f"ball, {FINER} times as fine", finer(ball, FINER), True),
        ("ball of honey", replace(ball, world=honey, parameters=honey.estimate().parameters), True),
    ):
        found, how = measure(repeated(moved, COUNT), pulled_only)
        rows += [(name, *row) for row in found]
        told += [f"- {name}: {len(moved.body.position)} particles. {how}"]
    lines = [
        "# The page of make view: frames a second",
        "",
        f"`make bench-view`: {COUNT} moving Gaussians (those of the run, repeated), {SECONDS:g} s each. "
        f"{machine('cpu')}, which had a load of {load:.0f} of other work.",
        "",
        "| scene | what moves | frames/s that arrive | motion [ms] | drawing [ms] | MB a frame | simulated s per s |",
        "|---|---|---|---|---|---|---|",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        *told,
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


def read(words: list[str]) -> Run:
    """A run, from its artifacts. Raises StageError naming what has to be computed before."""
    config, picked = compose(literal_paths(words))
    shelf = Path(config["output"]).expanduser().resolve() / "artifacts"
    return loaded(config, finished(config, shelf, f"make run SCENE={picked['scene']} PROFILE={picked['profile']}"))


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


def finer(run: Run, times: int) -> Run:
    """At rest, with cells and spacings so many times smaller: each particle in `times`^3 cubes."""
    old, step = run.body, run.body.spacing / times
    line = (torch.arange(times) - (times - 1) / 2) * step
    x = (old.position[:, None] + torch.cartesian_prod(line, line, line)).flatten(0, 1)
    each = lambda value: value.repeat_interleave(times**3, 0)
    which = old.embedding.which
    body = replace(
        old,
        position=x,
        volume=each(old.volume) / times**3,
        part=each(old.part),
        interior=each(old.interior),
        attached=None if old.attached is None else each(old.attached),
        matter=None,
        spacing=step,
        embedding=embed(run.gaussians.mean[which], which, x, step),
    )
    still = replace(
        run.trajectory,
        rest_position=x,
        position=x[None],
        velocity=torch.zeros(1, len(x), 3),
        deformation=torch.eye(3).expand(1, len(x), 3, 3),
    )
    return replace(run, world=replace(run.world, dx=run.world.dx / times), body=body, trajectory=still)


def measure(run: Run, pulled_only: bool) -> tuple[list[tuple[str, ...]], str]:
    """Rows of the table, and what the page says of how the body is moved."""
    page, end = served(run)
    rows = []
    try:
        with Client(page) as client:
            kinds = [k for k in ("picture", "speed", "stress") if k != "stress" or not page.pictures.no_stress]
            for live, kind in itertools.product((False, True), kinds):
                if pulled_only and not live:
                    continue
                name = f"{'a live pull' if live else 'the run'}, {'as a' if kind == 'picture' else 'by'} {kind}"
                page.kind.value = kind
                if live:
                    pull(page, upper(run), np.array([0.02, 0.0, 0.0]))
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
    return rows, page.live.mover.how if page.live is not None else ""


def pull(page: Page, particle: int, way: np.ndarray) -> None:
    """Drag the handle next to a particle by so much [m], as a browser says it."""
    x = page.run.body.position.double().numpy()
    which = int(np.linalg.norm(x[page._held_by] - x[particle], axis=1).argmin())
    for phase, end in (("start", np.zeros(3)), ("move", way * page.pictures.scale)):
        page.asked.put(("drag", phase, which, np.zeros(3), end))


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
