"""make export SCENE=... FORMAT=ply|usd|gltf|spz [OUT=<new folder>] [FRAME=<number>]: motion for other programs.

    ply    frame0000.ply, frame0001.ply, ...: SuperSplat plays the folder
    usd    <scene>.usdc: OpenUSD's Gaussian splats with time samples, the particles, the material
    gltf   <scene>.glb: one frame (FRAME, else 0), KHR_gaussian_splatting
    spz    <scene>.spz: one frame (FRAME, else 0), a tenth as large

The words of `make run` say of which scene; FORMAT, OUT and FRAME come by way of the environment. What it will take on
the disk is said first; the folder gets its name when everything is in it. Exit codes: 0 done, 1 nothing to export or no
room, 2 a word means nothing, 130 Ctrl-C.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from pipeline.filed import beside, megabytes, one_line, vacant
from pipeline.places import new_place
from pipeline.settings import SettingsError

FORMATS = ("ply", "usd", "gltf", "spz")
USAGE = f"make export SCENE=<scene> FORMAT={'|'.join(FORMATS)} [OUT=<new folder>]"
ONE_FRAME = ("gltf", "spz")


def main(words: list[str], environment: Mapping[str, str]) -> int:
    return one_line(lambda: export(words, environment), lambda text: print(text, file=sys.stderr))


def export(words: list[str], environment: Mapping[str, str]) -> None:
    """Raises SettingsError, StageError, ValueError, RuntimeError or OSError with one line."""
    kind, frame = environment.get("FORMAT", ""), environment.get("FRAME") or "0"
    if kind not in FORMATS:
        raise SettingsError(f"FORMAT={kind}: take one of {', '.join(FORMATS)}; {USAGE}")
    if not frame.isdecimal():
        raise SettingsError(f"FRAME={frame} is no number of a frame; the first is 0")
    out = new_place(environment)

    from physics3d.export.gltf import glb_size, write_glb
    from physics3d.export.moving import Moving
    from physics3d.export.ply import ply_size, write_ply_sequence
    from physics3d.export.spz import spz_size, write_spz
    from physics3d.export.usd import usd_size, write_usd
    from physics3d.log import Log
    from pipeline.moving import scene_motion

    made = scene_motion(words)
    name, body, trajectory = made.scene, made.body, made.trajectory
    moving = Moving(gaussians=made.gaussians, embedding=body.embedding, trajectory=trajectory, interior=made.interior)
    target = out or Path(f"exports/{name}_{kind}")
    vacant(target)
    size = {
        "ply": lambda: ply_size(moving),
        "usd": lambda: usd_size(moving, body),
        "gltf": lambda: glb_size(moving.count, moving.harmonics),
        "spz": lambda: spz_size(moving.count, moving.harmonics),
    }[kind]()
    frames = f"frame {int(frame)}" if kind in ONE_FRAME else f"{len(moving)} frames at {trajectory.fps:g} per second"
    print(f"writing   {frames} of {moving.count} Gaussians, at most {megabytes(size)}, into {target}", flush=True)
    with beside(target, size) as folder:
        folder.mkdir()
        if kind == "ply":
            write_ply_sequence(folder, moving, log=Log(folder.parent, name="export"))
        elif kind == "usd":
            log = Log(folder.parent, name="export")
            write_usd(folder / f"{name}.usdc", moving, body, made.world, made.estimate.parameters, log=log)
        elif kind == "gltf":
            write_glb(folder / f"{name}.glb", moving.frame(int(frame)))
        else:
            write_spz(folder / f"{name}.spz", moving.frame(int(frame)))
        files = [file for file in folder.iterdir() if file.is_file()]
        written = sum(file.stat().st_size for file in files)
    print(f"written   {target}   {len(files)} file{'s' * (len(files) > 1)}, {megabytes(written)}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ))
