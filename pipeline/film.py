"""make film SCENE=... [OUT=film.mp4] [SIZE=1280x720] [LENGTH=...]: the motion, seen from a camera that goes round it.

The words of `make run` say of which scene; OUT, SIZE and LENGTH come by way of the environment. Without LENGTH the
camera goes round in six seconds or a little more, in which the motion is played whole times. Exit codes: 0 done, 1 it
could not be made, 2 a word means nothing, 130 Ctrl-C.
"""

import math
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path

from pipeline.filed import beside, megabytes, one_line, vacant
from pipeline.places import new_place
from pipeline.settings import SettingsError

ROUND = 6.0  # once round in less makes people dizzy [s]
LARGEST = 8192  # side of a film that players take [px]


def main(words: list[str], environment: Mapping[str, str]) -> int:
    return one_line(lambda: film(words, environment), lambda text: print(text, file=sys.stderr))


def film(words: list[str], environment: Mapping[str, str]) -> None:
    """Raises SettingsError, StageError, ValueError, RuntimeError or OSError with one line."""
    width, height = size_of(environment.get("SIZE") or "1280x720")
    seconds = _seconds(environment.get("LENGTH") or "")
    out = new_place(environment, ".mp4")

    import torch

    from physics3d.export.turntable import Turntable
    from physics3d.log import Log
    from physics3d.video import write_mp4
    from pipeline.__main__ import device
    from pipeline.moving import scene_motion

    made = scene_motion(words)
    place = device(made.device)
    trajectory, fps = made.trajectory, made.trajectory.fps
    once = len(trajectory.position)
    count = once * math.ceil(ROUND * fps / once) if seconds is None else max(1, round(seconds * fps))
    target = out or Path(f"exports/{made.scene}_turntable.mp4")
    vacant(target)
    table = Turntable(width=width, height=height, frames=count)
    log = Log(target.parent, name="film")
    print(f"writing   {count} frames of {width} x {height} px at {fps:g} per second, into {target}", flush=True)
    with beside(target) as hidden:
        pictures = table(
            made.gaussians.to(place),
            made.body.embedding,
            trajectory,
            interior=made.interior and made.interior.to(place),
            background=made.capture.background,
        )
        write_mp4(hidden, torch.stack(list(log.progress(pictures, "film", total=count))), fps)
        size = hidden.stat().st_size
    print(f"written   {target}   {count / fps:.1f} s, {megabytes(size)}")


def size_of(text: str) -> tuple[int, int]:
    """Width and height [px]. Raises SettingsError."""
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    width, height = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(2 <= side <= LARGEST and side % 2 == 0 for side in (width, height)):
        raise SettingsError(f"SIZE={text}: take <width>x<height> in pixels, both even and at most {LARGEST}: 1280x720")
    return width, height


def _seconds(text: str) -> float | None:
    if not text:
        return None
    if not re.fullmatch(r"\d{1,4}(\.\d+)?", text) or float(text) <= 0:
        raise SettingsError(f"LENGTH={text} is no length of a film; take a number above 0, e.g. 6")
    return float(text)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ))
