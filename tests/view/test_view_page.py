"""The page: who can reach it, and what a browser makes of it."""

import socket
import threading
import time
import urllib.error
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from browser import chromium, opened, place_of
from looked_at import run

from physics3d.log import Log
from physics3d.view.page import Page

DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def page():
    kept: list = []

    def save(impulses, notes):
        kept.append((impulses, notes))
        return "kept"

    page = Page(run(frames=20), host="127.0.0.1", port=free_port(), save=save, log=Log(None))
    page.kept = kept
    over = threading.Event()

    def work():
        while not over.is_set():
            page.serve(0.5)

    page.prepare()
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    yield page
    over.set()
    thread.join()
    page.server.stop()


def test_this_machine_is_answered_and_no_other(page):
    port = page.server.get_port()
    with DIRECT.open(f"http://127.0.0.1:{port}") as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()
    # all of 127.0.0.0/8 is this machine: what listens everywhere answers there as well
    with pytest.raises(urllib.error.URLError, match="refused"):
        DIRECT.open(f"http://127.0.0.2:{port}", timeout=10)


def test_a_taken_port_is_refused(page):
    with pytest.raises(OSError, match="taken"):
        Page(page.run, host="127.0.0.1", port=page.server.get_port(), save=lambda i, n: "", log=Log(None))


def test_a_poke_by_the_grid_says_so_and_how_it_differs_is_kept_with_it(monkeypatch):
    monkeypatch.setattr("physics3d.view.by_grid.RATE", 1e3)
    monkeypatch.setattr("physics3d.view.by_grid.CELLS", 4)
    kept: list = []
    free = replace(run(frames=1).world, boundaries=())
    page = Page(
        run(frames=2, world=free),
        host="127.0.0.1",
        port=free_port(),
        save=lambda impulses, notes: kept.append(notes) or "kept",
        log=Log(None),
    )
    try:
        page.prepare()
        page.turn(0.0)
        assert "reduced size" in page._told.content and not page._save.disabled
        page.live.advance(0.1)
        page.live.grab(int(page.run.body.position[:, 2].argmax()))
        page.live.pull(np.array([0.02, 0.0, 0.0]))
        page.live.advance(0.1)
        page.asked.put(("save",))
        page.turn(0.0)
        assert [note.split()[0] for note in kept[-1]] == ["poked", "poked"]
        assert "cells of 100 mm" in kept[-1][0] and "after the body was at rest" in kept[-1][1]
    finally:
        page.server.stop()


@pytest.mark.skipif(chromium() is None, reason="no chromium; on Debian: apt install chromium")
def test_a_body_that_is_dragged_in_a_browser_follows_and_the_poke_is_kept(page, tmp_path):
    """Pressed at its top, drawn to the right and held there: it bends to the right, on the page and in numbers."""
    with opened(f"http://127.0.0.1:{page.server.get_port()}", tmp_path / "browser") as tab:
        tab.wait_for("frames/s")
        tab.wait_for("Drag any part")
        tab.wait_for("Recorded clip")
        page.play.value = False
        page.time, page.stale = 0.0, True
        tab.wait_for("still")
        tab.close_notes()  # that no GPU draws it: they lie over the body
        at = np.array([0.0, -0.05, 0.37])
        u, v = place_of(page, tab, at)
        before = tab.picture()
        tab.mouse("mouseMoved", u, v, pressed=False)
        tab.mouse("mousePressed", u, v)
        to, _ = place_of(page, tab, at + np.array([0.06, 0.0, 0.0]))
        for share in (0.2, 0.4, 0.6, 0.8, 1.0):
            tab.mouse("mouseMoved", u + share * (to - u), v)
            time.sleep(0.1)
        tab.wait_for("Pulled with")
        end = time.monotonic() + 60
        while (moved := page.live.mover.particles()[0][:, 0] - page.run.body.position[:, 0]).max() < 0.04:
            assert time.monotonic() < end, f"it moved by {moved.max():.3g} m"
            time.sleep(0.2)
        pulled = tab.picture()
        assert page.live.hold is not None and page.live.force[0] > 5 * abs(page.live.force[1:]).max()
        # the middle third of the window has the body; what was beside it is not white any more
        assert np.abs(pulled.astype(int) - before).max(2).mean() > 2
        tab.mouse("mouseReleased", to, v)
        tab.wait_for("Let go")
        page.asked.put(("save",))
        tab.wait_for("kept")
        (impulses, notes) = page.kept[-1]
        assert notes == () and impulses[0].force[0] > 0 and impulses[0].centre[2] > 0.3
        assert not tab.said, tab.said
