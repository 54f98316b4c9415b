"""make still SCENE=... [OUT=still.png] [SIZE=1024x576]: the scene at rest, as one hands it to an image-to-video model.

The picture is drawn from the camera of `render.view`, in the shape that the model wants: all of the photograph is in
its middle. The clip that comes back, of the same shape and of any size, is a take whose camera is known:

    make run SCENE=... ARGS="capture.clip=clip.mp4"

The words of `make run` say of which scene, which must have been reconstructed. Exit codes: 0 done, 1 it could not be
made, 2 a word means nothing, 130 Ctrl-C.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from pipeline.filed import beside, filed, one_line
from pipeline.film import size_of
from pipeline.places import new_place


def main(words: list[str], environment: Mapping[str, str]) -> int:
    return one_line(lambda: still(words, environment), lambda text: print(text, file=sys.stderr))


def still(words: list[str], environment: Mapping[str, str]) -> None:
    """Raises SettingsError, StageError, ValueError or OSError with one line."""
    width, height = size_of(environment.get("SIZE") or "1024x576")
    out = new_place(environment, ".png")
    config, _, steps = filed(words, "capture", "reconstruct")

    import torch
    from PIL import Image

    from physics3d.gaussians.render import render
    from physics3d.pictures import to_uint8
    from pipeline.moving import read

    capture = read(steps["capture"])
    gaussians = read(steps["reconstruct"]) if "reconstruct" in steps else capture.gaussians
    camera = capture.seen_from(config["render"]["view"], key="render.view").framed(width, height)
    with torch.no_grad():
        picture = to_uint8(render(gaussians, camera, background=capture.background).color)
    target = out or Path(f"exports/{capture.name}_still.png")
    with beside(target) as hidden:
        Image.fromarray(picture.numpy()).save(hidden, format="PNG")
    print(f"written   {target}   {width} x {height} px; make a clip of it, then ARGS=capture.clip=<its file>")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ))
