"""A finished run in the browser: make view SCENE=... [PROFILE=...] [PORT=8080] [LISTEN=127.0.0.1].

The words are those of the run (python -m pipeline ...), so that what is shown is what they computed; nothing is
computed again. PORT and LISTEN come by way of the environment. It listens on this machine only, unless LISTEN says
otherwise; from another one, ssh forwards one port. A poke can be saved as a scene in conf/scene/. Exit codes: 0 ended
by Ctrl-C, 1 it cannot be shown, 2 the command line is wrong.
"""

import importlib.util
import os
import re
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.flow import first, plan
from pipeline.settings import CONF, SettingsError, compose
from pipeline.stage import StageError, Step, Unknown, build, damage
from pipeline.words import literal_paths

PORT, LISTEN = "8080", "127.0.0.1"
REMEDY = "make view PORT=<a number from 1024 to 65535>"


def main(words: list[str], environment: Mapping[str, str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        config, picked = compose(literal_paths(words))
    except SettingsError as error:
        return _fail(str(error), 2)
    try:
        show(config, picked, environment)
    except KeyboardInterrupt:
        return 0
    except (StageError, ValueError, OSError) as error:
        return _fail(" ".join(str(error).split()), 1)
    return 0


def show(config: dict[str, Any], picked: dict[str, str], environment: Mapping[str, str]) -> None:
    """Serve the page until interrupted. Raises StageError, ValueError or OSError with one line."""
    shelf = Path(config["output"]).expanduser().resolve() / "artifacts"
    again = " ".join(f"{g.upper()}={picked[g]}" for g in ("scene", "profile", "method"))
    steps = finished(config, shelf, f"make run {again}")
    for file in pictures(steps["render"].folder):
        print(file)
    if importlib.util.find_spec("viser") is None:
        raise ValueError("viser is not installed, which makes the page; run make setup, or pip install 'viser>=1.1'")
    port, host = free(environment.get("PORT") or PORT, environment.get("LISTEN") or LISTEN)

    from physics3d.log import Log
    from physics3d.view import poke
    from physics3d.view.page import Page

    def save(impulses: tuple[Any, ...], notes: tuple[str, ...]) -> str:
        name = poke.keep(CONF / "scene", picked["scene"], impulses, notes)
        command = " ".join([f"make run SCENE={name}", *(f"{g.upper()}={picked[g]}" for g in ("profile", "method"))])
        return f"Saved as `conf/scene/{name}.yaml`: `{command}`"

    page = Page(loaded(config, steps), host=host, port=port, save=save, log=Log(None))
    address = f"http://{'127.0.0.1' if host in ('', '0.0.0.0') else host}:{port}"
    print(f"open      {address}   (Ctrl-C ends it)")
    if host == LISTEN:
        print(f"by ssh    ssh -L {port}:127.0.0.1:{port} <this machine>, then open the same address", flush=True)
    else:
        print(f"warning: whoever reaches {host or 'this machine'} may use the page and save scenes", flush=True)
    if environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"):
        webbrowser.open(address)
    threading.Thread(target=page.prepare, daemon=True).start()
    try:
        page.serve()
    finally:
        page.server.stop()


def finished(config: dict[str, Any], shelf: Path, command: str) -> dict[str, Step]:
    """The steps of a run by name, up to its video, all of them whole. Raises StageError naming the `command` that
    computes what is missing or damaged."""
    try:
        capture = first(config, shelf, ask=False)
        steps = [capture]
        _require(capture, shelf, command)
        steps = plan(config, capture, ask=False).steps
    except Unknown:
        raise StageError(_nothing(shelf, command)) from None
    names = {step.name: step for step in steps}
    last = list(names).index("render")
    for step in steps[: last + 1]:
        _require(step, shelf, command)
    return names


def _require(step: Step, shelf: Path, command: str) -> None:
    reason = damage(step)
    if reason is None:
        return
    if not os.path.lexists(step.folder):
        raise StageError(_nothing(shelf, command, step.name))
    raise StageError(f"the stored result of {step.name} is damaged ({reason}); {command} computes it again")


def _nothing(shelf: Path, command: str, step: str = "") -> str:
    """What to say where nothing, or not everything, has been computed; the last run is named, if there was one."""
    missing = f"{step} of this run is not computed yet" if step and step != "capture" else "nothing is computed yet"
    latest = shelf / ".latest"
    folder = shelf / latest.read_text().strip() if latest.is_file() else None
    other = f" (the last run's video is in {folder})" if folder is not None and folder.is_dir() else ""
    return f"{missing}{other}; {command}"


def pictures(folder: Path) -> tuple[Path, ...]:
    """The videos and previews of a rendering."""
    return tuple(sorted(folder.glob("*.mp4")) + sorted((folder / "previews").glob("*")))


def loaded(config: dict[str, Any], steps: dict[str, Step]) -> Any:
    """The run, read from its artifacts. Raises StageError naming one that cannot be read."""
    from physics3d.artifact import AbstractArtifact, ArtifactError
    from physics3d.view.run import Run

    def read(name: str) -> Any:
        try:
            return AbstractArtifact.load(steps[name].folder)
        except ArtifactError as error:
            raise StageError(
                f"the stored result of {name} is damaged ({error}); remove that folder, and run again"
            ) from (error)

    capture = read("capture")
    simulate = build(config["simulate"], "cpu", "simulate")
    return Run(
        name=config["scene"]["name"],
        world=simulate.world,
        capture=capture,
        gaussians=read("reconstruct") if "reconstruct" in steps else capture.gaussians,
        body=read("fill"),
        parameters=read("learn" if "learn" in steps else "guess").parameters,
        trajectory=read("simulate"),
    )


def free(port: str, host: str) -> tuple[int, str]:
    """Port and address that can be listened on. Raises ValueError with the remedy."""
    if not re.fullmatch("[0-9]{1,5}", port) or not 0 < int(port) < 65536:
        raise ValueError(f"PORT={port} is no port; {REMEDY}")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # one that was closed a moment ago is free
        try:
            probe.bind((host, int(port)))
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ValueError(f"port {port} of {host} cannot be served ({reason}); {REMEDY}") from error
    return int(port), host


def _fail(text: str, code: int) -> int:
    print(f"error: {text}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ))
