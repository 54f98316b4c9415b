"""One clip of a thing that swings, filmed from a stand, and nothing else: `make run SCENE=clip DATA=poke.mp4`.

    camera    a pinhole that looks level, `camera_distance` metres away: sets the size of everything
    thing     what moves, cut out of the last frame that is learned from (`motion/thing.py`)
    body      round wherever it is cut across (`one_view.py`)
    held      where it moves least, at its end farthest from where it moves most

of the first clip, where several are given; the others show the same thing by the same camera and are only predicted.
The first half of each clip is seen. What the answer says of stiffness holds for the size and the thickness assumed.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Gt, Lt
from jaxtyping import Bool, Float

from physics3d.checks import LeftTopRightBottom, Length, Name, Pixels, Rate, Share, Text, require_fields
from physics3d.gaussians.cameras import Camera, look_at
from physics3d.motion.thing import moving_thing
from physics3d.scenes.base import AbstractSource, Capture, Take
from physics3d.scenes.clips import FilmedTake, Pieces, clip_files, filmed_takes
from physics3d.scenes.one_view import one_view

HELD = 0.93  # of the largest distance along the thing, counted less where it moves
GRIP = 5.0  # around such pixels, at least [px]


@dataclass(frozen=True, kw_only=True)
class ClipSource(AbstractSource):
    name: Name
    path: Text  # a clip, or a folder of clips
    camera_distance: Length  # from the thing [m]; sets the size of everything
    box: Annotated[tuple[Share, Share, Share, Share], LeftTopRightBottom()] = (0.02, 0.02, 0.98, 0.98)
    pattern: Text = "*"  # of the names of clips in a folder
    fps: Rate | None = None  # at which the clips were filmed [1/s]; None: what their files say
    pieces: Pieces = field(default_factory=dict)  # of clips that are not used whole, by their names without endings [s]
    opening: Annotated[float, Gt(0), Lt(170)] = 50.0  # of the lens, along the longer side [deg]
    longest_side: Annotated[Pixels, Ge(64)] = 640  # frames are reduced to this [px]

    def files(self) -> tuple[str, ...]:
        return tuple(str(path) for path in clip_files(Path(self.path), self.pattern))

    def __call__(self, *, log) -> Capture:
        """Raises ValueError in one line for a clip that cannot be used (`motion/usable.py`) or shows no thing."""
        require_fields(self, "source")
        takes = filmed_takes(
            Path(self.path),
            log=log,
            pattern=self.pattern,
            fps=self.fps,
            pieces=self.pieces,
            longest_side=self.longest_side,
            box=self.box,
        )
        first = takes[0]
        h, w = first.video.shape[1:3]
        camera = level_camera(w, h, opening=self.opening, distance=self.camera_distance)
        kept = [take for take in takes if take.video.shape[1:3] == (h, w)]
        for take in takes:
            if take not in kept:
                log.warn(f"{take.name}: its frames are not {w} x {h} px as those of {first.name}; it is left out")
        seen = len(first.video) // 2
        thing, size = moving_thing(first.video[:seen], at=seen - 1, box=self.box)
        held = held_end(thing, size)
        photograph = first.video[seen - 1].numpy()
        gaussians, moves = one_view(photograph, thing, held, camera, distance=self.camera_distance)
        log.image("thing", _shown(photograph, thing, held))
        log.info(
            f"the thing is {int(thing.sum())} pixels; assumed: it is {self.camera_distance:g} m away, round where it "
            f"is cut across, and held at {int(held.sum())} pixels (previews/thing.png)"
        )
        return Capture(
            name=self.name,
            images=(),
            cameras=(),
            names=(),
            takes=tuple(_take(take, camera, seen if take is first else None) for take in kept),
            gaussians=gaussians,
            moves=moves,
            note=f"one clip tells no depth: a thing {self.camera_distance:g} m away, round where it is cut across",
        )


def level_camera(width: int, height: int, *, opening: float, distance: float) -> Camera:
    """A pinhole that looks along y at the origin, z up; `opening` [deg] along the longer side."""
    f = 0.5 * max(width, height) / float(np.tan(np.radians(opening) / 2))
    pose = look_at(torch.tensor([0.0, -distance, 0.0]), torch.zeros(3))
    return Camera(width=width, height=height, fx=f, fy=f, cx=width / 2, cy=height / 2, world_to_camera=pose)


def held_end(thing: Bool[np.ndarray, "h w"], size: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of the thing that are farthest, along it, from where it moves most, where it moves little."""
    import cv2
    from scipy import sparse

    smooth = cv2.GaussianBlur((size * thing).astype(np.float32), (0, 0), 2) / np.maximum(
        cv2.GaussianBlur(thing.astype(np.float32), (0, 0), 2), 1e-3
    )
    number = np.cumsum(thing).reshape(thing.shape) - 1
    pairs, lengths = [], []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = thing[: thing.shape[0] - di, max(0, -dj) : thing.shape[1] - max(0, dj)]
        b = thing[di:, max(0, dj) : thing.shape[1] + min(0, dj)]
        both = a & b
        left = number[: thing.shape[0] - di, max(0, -dj) : thing.shape[1] - max(0, dj)][both]
        right = number[di:, max(0, dj) : thing.shape[1] + min(0, dj)][both]
        pairs.append(np.stack([left, right]))
        lengths.append(np.full(both.sum(), np.hypot(di, dj)))
    i, j = np.concatenate(pairs, 1)
    graph = sparse.coo_matrix((np.concatenate(lengths), (i, j)), shape=(int(thing.sum()),) * 2).tocsr()
    moves = smooth[thing]
    source = np.flatnonzero(moves > 0.7 * moves.max())
    far = sparse.csgraph.dijkstra(graph, directed=False, indices=source, min_only=True)
    far[~np.isfinite(far)] = 0
    score = far * np.exp(-3 * moves)
    held = np.zeros(thing.shape, bool)
    held[thing] = score > HELD * score.max()
    near = max(GRIP, 1.5 * float(cv2.distanceTransform(thing.astype(np.uint8), cv2.DIST_L2, 5)[held].max()))
    away = cv2.distanceTransform((~held).astype(np.uint8), cv2.DIST_L2, 5)
    return thing & (away <= near)


def _take(filmed: FilmedTake, camera: Camera, seen: int | None) -> Take:
    return Take(
        name=filmed.name,
        role=filmed.role,
        fps=filmed.fps,
        cameras=(camera,),
        videos=(filmed.video,),
        excitation=None,
        release=filmed.release,
        seen=seen,
        posed=None if seen is None else seen - 1,
    )


def _shown(photograph: np.ndarray, thing: np.ndarray, held: np.ndarray) -> np.ndarray:
    shown = np.where(thing[..., None], photograph, photograph // 4)
    shown[held] = (255, 0, 0)
    return shown
