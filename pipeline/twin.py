"""make twin OUT=folder: a carnation with known material, as photographs and clips on disk, as a person has a thing.

It is then given to the commands that read a person's files; truth.yaml is for whoever judges the answer. Exit codes: 0
done, 1 it could not be written, 2 OUT is not given.
"""

import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

FRAMES, FPS = 90, 30.0  # of each clip: three seconds
WIDTH, HEIGHT = 640, 480  # [px]: structure from motion needs detail
PUSH = 0.15  # how long it is pushed, from the first frame [s]


def main(environment: Mapping[str, str]) -> int:
    out = environment.get("OUT", "")
    if not out:
        print("error: OUT is not given; make twin OUT=<new folder>", file=sys.stderr)
        return 2
    from physics3d.log import Log
    from physics3d.scenes.carnation import CarnationTwin
    from physics3d.scenes.handed_over import hand_over

    folder = Path(out)
    if folder.exists():
        print(f"error: {folder} exists already; remove it, or say OUT=<another folder>", file=sys.stderr)
        return 1
    twin = CarnationTwin(views=40, frames=FRAMES, fps=FPS, push=PUSH, points=500, width=WIDTH, height=HEIGHT)
    try:
        with tempfile.TemporaryDirectory(prefix="physics3d_") as notes:
            thing = hand_over(twin(log=Log(Path(notes), name="twin")), folder, density=twin.density)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    print(f"written   {thing}   the truth is in {folder / 'truth.yaml'}")
    return 0


if __name__ == "__main__":
    sys.exit(main(os.environ))
