"""make twin OUT=folder: a carnation with known material, as photographs and clips on disk, as a person has a thing.

It is then given to the commands that read a person's files; truth.yaml is for whoever judges the answer. Exit codes: 0
done, 1 it could not be written, 2 OUT is not given, 130 Ctrl-C.
"""

import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from pipeline.filed import one_line
from pipeline.places import new_place
from pipeline.settings import SettingsError

FRAMES, FPS = 90, 30.0  # of each clip: three seconds
WIDTH, HEIGHT = 640, 480  # [px]: structure from motion needs detail
PUSH = 0.15  # how long it is pushed, from the first frame [s]


def main(environment: Mapping[str, str]) -> int:
    return one_line(lambda: write(environment), lambda text: print(text, file=sys.stderr))


def write(environment: Mapping[str, str]) -> None:
    """Raises SettingsError without OUT, ValueError, RuntimeError or OSError where it cannot be written."""
    folder = new_place(environment)
    if folder is None:
        raise SettingsError("OUT is not given; make twin OUT=<new folder>")

    from physics3d.log import Log
    from physics3d.scenes.carnation import DISTANCE, CarnationTwin
    from physics3d.scenes.handed_over import hand_over

    twin = CarnationTwin(views=40, frames=FRAMES, fps=FPS, push=PUSH, points=500, width=WIDTH, height=HEIGHT)
    with tempfile.TemporaryDirectory(prefix="physics3d_") as notes:
        thing = hand_over(twin(log=Log(Path(notes), name="twin")), folder, density=twin.density)
    print(f"written   {thing}   photographed from {DISTANCE:g} m away, and the truth is in {folder / 'truth.yaml'}")


if __name__ == "__main__":
    sys.exit(main(os.environ))
