"""Whether a clip can be learned from: one camera that stands still, one thing that swings within the picture.

Looked at on frames reduced to 320 px, within seconds, before minutes are spent:

    cut        two neighbouring frames, reduced to 32 px, differ by more than 12 grey levels and by six times the usual
    camera     what moves alike in most of the picture (a similarity by RANSAC on points spread over it): over 1 px
    still      no pixel moves by half a pixel (`shapes.moving`)
    outside    pixels along the border change by more than 0.6 of what pixels change by where the thing moves most
    short      the thing went one way and still moved when the clip ended, or less than half a period was seen
    empty      nothing moves within the box that a person drew

What may be right is not refused but doubted, in one line, as early:

    driven     the decay of the first half misses the second by more than half of the motion, rms: a hand that never
               lets go, wind, another push; measured: 0.19 at most on eight recordings of what was let go, more than
               0.5 in 42 of 46 drawn motions of what was not
    steady     the loss factor d/(pi f) of what swings is below 0.005, hardly that of a ruler of steel: a fan, a motor
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from physics3d.motion.clip import Clip
from physics3d.motion.decay import Decay, fit_decay
from physics3d.motion.flow import flow, greys, size, trust
from physics3d.motion.release import free_decay
from physics3d.motion.shapes import moving, shapes
from physics3d.video import reduced

SIDE = 320  # [px]
CUT = 12.0  # grey levels
SHAKE = 1.0  # [px of the reduced frames]
SHAPES = 3
MISSED = 0.5  # of the motion
STEADY = 0.005  # loss factor


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What a clip says at first sight; displacements in px of the clip's own frames."""

    where: Bool[np.ndarray, "h w"]  # what moves, in pixels of the clip
    largest: float  # displacement from the frame of rest [px]
    decay: Decay
    release: int  # first frame of the free decay
    rest: int  # the frame that shows the thing nearest to rest
    from_rest: float  # ... and how far from it, rms over what moves [px]
    doubts: tuple[str, ...]  # why what is learned from it may be wrong, one sentence each

    def said(self) -> str:
        main = self.decay.main()
        swing = "no oscillation"
        if main is not None:
            swing = f"{self.decay.frequency[main]:.2f} Hz, damping {self.decay.damping[main]:.2f} 1/s"
        return (
            f"moves by up to {self.largest:.1f} px, {swing}; free from frame {self.release} on, nearest to rest in "
            f"frame {self.rest} ({self.from_rest:.1f} px from it)"
        )


def check_clip(clip: Clip, *, box: tuple[float, float, float, float] | None = None) -> Findings:
    """`box`: left, top, right, bottom of the thing, as fractions. Raises ValueError for each of the above."""
    name = clip.path.name
    if len(clip.frames) < 8:
        raise ValueError(f"{name}: {len(clip.frames)} frames; a motion needs at least 8, better two seconds")
    factor = min(1.0, SIDE / max(clip.frames.shape[1:3]))
    small = reduced(clip.frames, *scaled(clip.frames, factor))
    cut = cut_at(small)
    if cut is not None:
        raise ValueError(
            f"{name}: there is a cut before frame {cut} ({cut / clip.fps:.2f} s); hand over one piece of it, or "
            "name it by scene.source.pieces"
        )
    last = len(small) - 1
    u = flow(small, reference=last)
    shake = shaken(small[last], u)
    if shake > SHAKE:
        raise ValueError(
            f"{name}: the camera moves (by {shake / factor:.1f} px over most of the picture); film from a stand"
        )
    where = moving(u)
    if where is None:
        raise ValueError(f"{name}: nothing moves by more than {0.5 / factor:.1f} px; film closer, or push harder")
    if crosses_border(small, u):
        raise ValueError(f"{name}: the thing leaves the picture (what moves touches its border); step back")
    if box is not None:
        where &= inside(box, *where.shape)
        if not where.any():
            raise ValueError(
                f"{name}: nothing moves within the box {list(box)}; the mask is empty, draw it around the thing"
            )
    found = shapes(u, trust(small, u, reference=last), where, count=SHAPES)
    decay, release = free_decay(found.signal, clip.fps)
    main, seconds = decay.main(), (len(small) - release) / clip.fps
    if one_way(found.signal[:, 0]) or (main is not None and decay.frequency[main] * seconds < 0.5):
        most = float(np.percentile(size(u), 99.9)) / factor
        raise ValueError(
            f"{name}: {len(small) / clip.fps:.2f} s are shorter than half a period of the motion; film longer, and "
            f"push harder if nothing but noise moves there (by up to {most:.1f} px)"
        )
    rest, distance = rest_frame(found.signal, decay, release)
    h, w = clip.frames.shape[1:3]
    full = torch.nn.functional.interpolate(torch.from_numpy(where)[None, None].float(), (h, w))[0, 0] > 0.5
    return Findings(
        where=full.numpy(),
        largest=float(np.percentile(size(u - u[rest]), 99.9)) / factor,
        decay=decay,
        release=release,
        rest=rest,
        from_rest=distance / factor,
        doubts=doubted(found.signal, clip.fps, decay, release),
    )


def scaled(frames: Tensor, factor: float) -> tuple[int, int]:
    """(height, width) of frames times `factor`, at least 8 px."""
    h, w = frames.shape[1:3]
    return max(8, round(h * factor)), max(8, round(w * factor))


def cut_at(frames: Tensor) -> int | None:
    """The first frame after a cut."""
    tiny = greys(reduced(frames, *scaled(frames, 32 / max(frames.shape[1:3])))).astype(float)
    jumps = np.abs(np.diff(tiny, axis=0)).mean((1, 2))
    worst = int(jumps.argmax())
    return worst + 1 if jumps[worst] > max(CUT, 6 * float(np.median(jumps))) else None


def shaken(reference: Tensor, u: Float[np.ndarray, "t h w 2"]) -> float:
    """Largest shift of a corner of the picture by what most of it does [px]; 0 where no motion has the majority."""
    import cv2

    cv2.setRNGSeed(0)
    grey = greys(reference[None])[0]
    strength = cv2.cornerMinEigenVal(cv2.GaussianBlur(grey, (0, 0), 1.0), 5)
    h, w = grey.shape
    points = []
    for rows in np.array_split(np.arange(h), 12):
        for columns in np.array_split(np.arange(w), 12):
            cell = strength[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            i, j = np.unravel_index(cell.argmax(), cell.shape)
            if cell[i, j] > 1e-5:  # flat cells tell nothing
                points.append((columns[0] + j, rows[0] + i))
    if len(points) < 12:
        return 0.0
    at = np.array(points, np.float32)
    corners = np.array([[0, 0], [w, 0], [0, h], [w, h]], np.float32)
    largest = 0.0
    for t in np.linspace(0, len(u) - 1, 9).round().astype(int):
        there = at + u[t, at[:, 1].astype(int), at[:, 0].astype(int)]
        similarity, chosen = cv2.estimateAffinePartial2D(at, there, method=cv2.RANSAC, ransacReprojThreshold=0.6)
        if similarity is not None and chosen.mean() > 0.5:
            shift = corners @ similarity[:, :2].T + similarity[:, 2] - corners
            largest = max(largest, float(np.linalg.norm(shift, axis=1).max()))
    return largest


def crosses_border(frames: Tensor, u: Float[np.ndarray, "t h w 2"]) -> bool:
    """By colours, for flow along the border is a guess: half of what it would follow is not in the picture."""
    import cv2

    grey = np.stack([cv2.GaussianBlur(g.astype(np.float32), (0, 0), 1.5) for g in greys(frames)])
    change = np.abs(grey - grey[-1]).max(0)
    farthest = size(u).max(0)
    usual = np.percentile(change[farthest > 0.5 * np.percentile(farthest, 99.9)], 90)
    edge = np.concatenate([change[:3].ravel(), change[-3:].ravel(), change[:, :3].ravel(), change[:, -3:].ravel()])
    return bool((edge > max(0.6 * usual, 10.0)).mean() > 0.01)


def inside(box: tuple[float, float, float, float], h: int, w: int) -> Bool[np.ndarray, "h w"]:
    """Pixels of a box given as fractions. Raises ValueError if it is none."""
    left, top, right, bottom = box
    if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
        raise ValueError(f"box is {list(box)}; give left, top, right, bottom as fractions, e.g. [0.2, 0.1, 0.8, 0.9]")
    x, y = (np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h
    return ((y > top) & (y < bottom))[:, None] & ((x > left) & (x < right))[None]


def one_way(s: Float[np.ndarray, " t"]) -> bool:
    """Whether a signal went one way only and was still going when the clip ended."""
    span = s.max() - s.min()
    back = max((np.maximum.accumulate(s) - s).max(), (s - np.minimum.accumulate(s)).max())
    forth = min((np.maximum.accumulate(s) - s).max(), (s - np.minimum.accumulate(s)).max())
    tail = max(2, len(s) // 5)
    return bool(forth < 0.1 * span and back > 0 and abs(s[-1] - s[-tail]) > 0.1 * span)


def doubted(signal: Float[np.ndarray, "t k"], fps: float, decay: Decay, release: int) -> tuple[str, ...]:
    """Why a motion may be no free decay; nothing where too few frames are left to tell."""
    half, main = (len(signal) + release) // 2, decay.main()
    if half - release < 8:
        return ()
    seen, later = signal[release:half], signal[half:]
    early = fit_decay(signal[:half], fps, first=release)
    rest = later - early.at(np.arange(half, len(signal)) / fps)
    missed = float(np.sqrt((rest**2).mean() / ((seen - seen.mean(0)) ** 2).mean()))
    if missed > MISSED:
        return (
            "what its second half shows does not follow from its first: a hand, wind, another push or another thing is "
            "in it, or too few swings; let go, draw the box around the thing, and film five swings or more",
        )
    if main is None or decay.damping[main] + 2 * decay.damping_error[main] > STEADY * np.pi * decay.frequency[main]:
        return ()
    return (
        f"its swing of {decay.frequency[main]:.2f} Hz hardly dies out: if a fan, a motor or a hand drives it, what is "
        "learned is not its material, and if it is another thing, the box is to leave that out; push once and let go",
    )


def rest_frame(signal: Float[np.ndarray, "t k"], decay: Decay, release: int) -> tuple[int, float]:
    """(frame after the release that is nearest to where the decay ends, distance [unit of the signal])."""
    distance = np.linalg.norm(signal[release:] - decay.constant, axis=1)
    nearest = int(distance.argmin())
    return release + nearest, float(distance[nearest])
