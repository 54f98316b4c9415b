"""The moving Gaussians as a folder of frame0000.ply, frame0001.ply, ...: one 3DGS model per frame (`gaussians/ply.py`).

SuperSplat plays such a folder, and whatever reads a trained 3DGS model reads a frame. Axes and unit are the project's:
z up, metres. Nothing else may lie in the folder: SuperSplat takes it for a sequence only if every file is a numbered
.ply.
"""

from pathlib import Path

from physics3d.export.moving import Moving
from physics3d.gaussians.ply import write_ply
from physics3d.log import Log

HEADER = 2000  # of a file, at most [byte]


def ply_size(moving: Moving) -> int:
    """Of all files [byte]: float32 of position, normal, opacity, scale, rotation, and the harmonics."""
    return len(moving) * (HEADER + moving.count * 4 * (3 + 3 + 1 + 3 + 4 + 3 * moving.harmonics))


def write_ply_sequence(folder: Path, moving: Moving, *, log: Log) -> None:
    """Write every frame into `folder`, made if missing. Raises OSError on a full disk."""
    digits = max(4, len(str(len(moving) - 1)))
    for i, frame in enumerate(log.progress(moving.frames(), "ply", total=len(moving))):
        write_ply(folder / f"frame{i:0{digits}d}.ply", frame)
