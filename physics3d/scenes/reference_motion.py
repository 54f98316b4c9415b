"""The motion of a twin that finite elements found once, kept beside the code: `motions/<name>.npz`.

Finite elements take minutes and a mesher that nobody else needs, so their answer is kept, as few fields,

    x(X, t) = X + sum_k a_k(t) phi_k(X),    F(X, t) = I + sum_k a_k(t) Phi_k(X)      (singular value decomposition)

at the material points that carry the twin's vertices. A file serves one twin only, whatever its seed paints and
scatters: solids, material, holds and pushes are written in it and compared; any other twin is moved by the grid, and
the log says so. `make reference-motion` writes it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from physics3d.boundaries.base import AbstractBoundary
from physics3d.open3d_import import open3d
from physics3d.scenes.studio import Mesh
from physics3d.world import World

FOLDER = Path(__file__).parent / "motions"
MOST = 4000  # material points
ENOUGH = 2e-6  # largest displacement that the fields leave out [m]
LENGTH = 0.01  # that makes a displacement of a deformation [m]

Pokes = Mapping[str, tuple[AbstractBoundary, ...]]  # role of the take -> what sets the body going


@dataclass(frozen=True, kw_only=True)
class Moved:
    """A body at the frames of one take."""

    place: Float[np.ndarray, "p 3"]  # at rest [m]
    position: Float[np.ndarray, "t p 3"]  # [m]
    deformation: Float[np.ndarray, "t p 3 3"]  # F [1]


def evenly(place: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "q 3"]:
    """MOST of the points at most, as far apart as can be: what is kept is to be small."""
    if len(place) <= MOST:
        return place
    geometry, utility = open3d().geometry, open3d().utility
    cloud = geometry.PointCloud(utility.Vector3dVector(place.astype(float)))
    found = cloud.farthest_point_down_sample(MOST, 0)
    return np.asarray(found.points).astype(place.dtype)


def path_of(name: str) -> Path:
    return FOLDER / f"{name}.npz"


def described(world: World, pokes: Pokes) -> str:
    """What the motion follows from, but for the shape; the cells of a grid are no part of it."""
    return repr((replace(world, dx=1.0), sorted(pokes.items())))


def shape_of(solids: Sequence[Mesh]) -> Float[np.ndarray, "n 7"]:
    """Vertices of each solid: how many, their mean and their deviation [m]."""
    return np.array([[len(m.vertices), *m.vertices.mean(0), *m.vertices.std(0)] for m in solids], float)


def save(
    path: Path, world: World, pokes: Pokes, solids: Sequence[Mesh], fps: float, moved: Mapping[str, Moved], made: str
) -> float:
    """Write the file -> the largest error of a position that its fields make [m]."""
    place = next(iter(moved.values())).place
    rows = [_flat(one) for one in moved.values()]
    U, S, V = np.linalg.svd(np.concatenate(rows).astype(float), full_matrices=False)
    rank = next(k for k in range(1, len(S) + 1) if k == len(S) or np.abs((U[:, k:] * S[k:]) @ V[k:]).max() < ENOUGH)
    scale = np.abs(V[:rank]).max(1)
    fields = (V[:rank] / scale[:, None]).astype(np.float16)
    amplitude = (U[:, :rank] * S[:rank] * scale).astype(np.float32)
    ends = np.cumsum([len(row) for row in rows])
    path.parent.mkdir(exist_ok=True)
    takes: dict[str, Any] = {f"take_{r}": a for r, a in zip(moved, np.split(amplitude, ends[:-1]))}
    half = path.with_suffix(".part.npz")
    np.savez_compressed(
        half, place=place.astype(np.float32), fields=fields, fps=fps, described=described(world, pokes), made=made,
        shape=shape_of(solids), **takes,
    )  # fmt: skip
    half.replace(path)
    return float(np.abs(amplitude @ fields.astype(float) - np.concatenate(rows)).max())


def recorded(
    path: Path, world: World, pokes: Pokes, solids: Sequence[Mesh], *, frames: int, fps: float
) -> tuple[dict[str, Moved], str] | None:
    """(motion of every take by its role, how it was found), or None where the file is of another twin or of none."""
    if not path.exists():
        return None
    with np.load(path) as file:
        shape = shape_of(solids)
        same = file["shape"].shape == shape.shape and np.allclose(file["shape"], shape, rtol=0, atol=1e-5)
        every = float(file["fps"]) / fps
        roles = [f"take_{role}" for role in pokes]
        if not same or str(file["described"]) != described(world, pokes) or every != round(every):
            return None
        if any(role not in file or (frames - 1) * round(every) >= len(file[role]) for role in roles):
            return None
        place, fields = file["place"].astype(float), file["fields"].astype(float)
        moved = {}
        for role in pokes:
            state = file[f"take_{role}"][:: round(every)][:frames].astype(float) @ fields
            u, slope = np.split(state.reshape(frames, len(place), 12), [3], axis=2)
            F = np.eye(3) + slope.reshape(frames, len(place), 3, 3) / LENGTH
            moved[role] = Moved(place=place, position=place + u, deformation=F)
        return moved, str(file["made"])


def _flat(moved: Moved) -> Float[np.ndarray, "t n"]:
    slope = LENGTH * (moved.deformation - np.eye(3)).reshape(*moved.position.shape[:2], 9)
    return np.concatenate([moved.position - moved.place, slope], 2).reshape(len(moved.position), -1)
