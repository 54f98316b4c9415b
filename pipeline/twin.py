"""make twin OUT=folder: a carnation with known material, as photographs and clips on disk, as a person has a thing.

    make twin OUT=folder ARGS="seed=1 youngs_modulus=3e5 motion=stiffer"       another one

It is then given to the commands that read a person's files; truth.yaml is for whoever judges the answer. Words are
fields of the twin (`physics3d/scenes/carnation.py`). One of another material, or pushed otherwise, needs a motion of
its own, which `make reference-motion` finds; else the grid moves it, which is softer than it says. Exit codes: 0 done,
1 it could not be written, 2 OUT is not given or a word means nothing, 130 Ctrl-C.
"""

import dataclasses
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.filed import one_line
from pipeline.places import new_place
from pipeline.settings import SettingsError

if TYPE_CHECKING:
    from physics3d.scenes.carnation import CarnationTwin

FRAMES, FPS = 90, 30.0  # of each clip: three seconds
WIDTH, HEIGHT = 640, 480  # [px]: structure from motion needs detail
PUSH = 0.15  # how long it is pushed, from the first frame [s]
MOTION = "handed_over"  # of finite elements; after a change of the numbers above: make reference-motion SCENE=carnation
#   ARGS="scene.source.motion=handed_over scene.source.frames=90 scene.source.push=0.15"


def main(words: list[str], environment: Mapping[str, str]) -> int:
    return one_line(lambda: write(words, environment), lambda text: print(text, file=sys.stderr))


def write(words: list[str], environment: Mapping[str, str]) -> None:
    """Raises SettingsError without OUT and for words that mean nothing, ValueError, RuntimeError or OSError where it
    cannot be written."""
    folder = new_place(environment)
    if folder is None:
        raise SettingsError("OUT is not given; make twin OUT=<new folder>")

    from physics3d.log import Log
    from physics3d.scenes.carnation import DISTANCE
    from physics3d.scenes.handed_over import hand_over

    twin = changed(handed_over(), words)
    with tempfile.TemporaryDirectory(prefix="physics3d_") as notes:
        thing = hand_over(twin(log=Log(Path(notes), name="twin")), folder, density=twin.density)
    print(f"written   {thing}   photographed from {DISTANCE:g} m away, and the truth is in {folder / 'truth.yaml'}")


def handed_over() -> "CarnationTwin":
    from physics3d.scenes.carnation import CarnationTwin

    return CarnationTwin(
        views=40, frames=FRAMES, fps=FPS, push=PUSH, motion=MOTION, points=500, width=WIDTH, height=HEIGHT
    )


def changed(twin: "CarnationTwin", words: list[str]) -> "CarnationTwin":
    """The twin with other values. Raises SettingsError for a word that names no field or has no value of its kind."""
    from omegaconf import OmegaConf
    from yaml import YAMLError

    from physics3d.checks import require_fields

    fields = {field.name for field in dataclasses.fields(twin)}
    for word in words:
        if word.partition("=")[0] not in fields or "=" not in word:
            raise SettingsError(f"{word} means nothing; say <field>=<value>, of {', '.join(sorted(fields))}")
    try:
        said = OmegaConf.to_container(OmegaConf.from_dotlist(words))
        twin = dataclasses.replace(twin, **said)  # type: ignore[arg-type]
        require_fields(twin, "twin")
    except (ValueError, YAMLError) as error:
        raise SettingsError(" ".join(str(error).split())) from error
    return twin


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ))
