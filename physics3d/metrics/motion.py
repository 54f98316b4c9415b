"""Measures of the motion itself, which a frozen picture cannot win.

u(t, x) [px] is the optical flow from frame 0 to frame t (DIS, Kroeger et al. 2016), M the pixels where the reference
moves.

    motion PSNR   PSNR over {(t, x): the reference differs from its own frame 0 by more than 0.1}
    flow error    |u - u_ref| / |u_ref|, L2 over M and t: 0 is the same motion, 1 standing still, 2 the opposite
    signal s(t)   u projected on the reference's dominant pattern of motion (first singular vector) [px rms]
    frequency f [Hz], damping d [1/s]     of the best  s(t) = c + exp(-d t) (a cos 2 pi f t + b sin 2 pi f t)

The damped oscillation is fitted by variable projection: c, a, b are linear, (f, d) are searched on a grid and
refined. It is reported only where it explains 80 % of the variance and at least one and a half periods were seen.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.metrics.image import check_pair, decibel

CHANGE = 0.1  # of 0..1: a pixel that differs by more has changed
STILL = 0.1  # of the largest displacement: pixels that move less are not in M


@dataclass(frozen=True)
class Oscillation:
    frequency: float  # [Hz]
    damping: float  # [1/s]
    explained: float  # fraction of the variance of the signal


def motion_psnr(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> tuple[float | None, str]:
    """(PSNR [dB] over the pixels that moved in the reference, "") or (None, reason). ValueError for unequal shapes."""
    check_pair(video, reference)
    total, count = 0.0, 0
    for a, b in zip(video, reference):
        moved = (b.float() - reference[0].float()).abs().amax(-1) > CHANGE * 255
        total += float(((a[moved].double() - b[moved].double()) ** 2).sum()) / 255**2
        count += 3 * int(moved.sum())
    if count == 0:
        return None, f"no pixel of the reference changes by more than {CHANGE:g}: it does not move"
    return decibel(total / count), ""


def flow(video: UInt8[Tensor, "t h w 3"]) -> Float[np.ndarray, "t h w 2"]:
    """Displacement of what is seen at each pixel of frame 0, from frame 0 to frame t [px]."""
    import cv2

    grey = [cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY) for frame in video.numpy()]
    method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
    fields, last = [np.zeros((*grey[0].shape, 2), np.float32)], None
    for frame in grey[1:]:
        last = method.calc(grey[0], frame, None if last is None else last.copy())  # starting from the last one
        fields.append(last)
    return np.stack(fields)


def moving(u_ref: Float[np.ndarray, "t h w 2"]) -> np.ndarray | None:
    """M: boolean [h, w], or None if the reference stands still (no pixel moves by half a pixel)."""
    size = np.linalg.norm(u_ref, axis=-1).max(0)
    largest = float(np.percentile(size, 99.9))
    return None if largest < 0.5 else size > STILL * largest


def flow_error(u: np.ndarray, u_ref: np.ndarray, where: np.ndarray) -> float:
    """|u - u_ref| / |u_ref| over the pixels `where`: 1 for a frozen picture."""
    return float(np.linalg.norm(u[:, where] - u_ref[:, where]) / np.linalg.norm(u_ref[:, where]))


def signal(u: np.ndarray, u_ref: np.ndarray, where: np.ndarray) -> Float[np.ndarray, " t"]:
    """Displacement along the reference's dominant pattern [px], its largest reference value positive."""
    flat = u_ref[:, where].reshape(len(u_ref), -1)
    pattern = np.linalg.svd(flat, full_matrices=False)[2][0]
    s_ref = flat @ pattern
    pattern = pattern * np.sign(s_ref[np.abs(s_ref).argmax()]) / math.sqrt(where.sum())
    return u[:, where].reshape(len(u), -1) @ pattern


def oscillation(s: Float[np.ndarray, " t"], fps: float) -> tuple[Oscillation | None, str]:
    """(damped oscillation fitted to a signal, "") or (None, reason)."""
    from scipy.optimize import minimize

    n, t = len(s), np.arange(len(s)) / fps
    variance = float(((s - s.mean()) ** 2).sum())
    if n < 8 or variance < 1e-12 * n:
        return None, "the signal is too short or does not move"

    def misfit(parameters) -> float:
        f, d = parameters
        decay = np.exp(-np.clip(d * t, -20, 20))
        basis = np.stack([np.ones(n), decay * np.cos(2 * np.pi * f * t), decay * np.sin(2 * np.pi * f * t)], 1)
        return float(((s - basis @ np.linalg.lstsq(basis, s, rcond=None)[0]) ** 2).sum())

    duration = n / fps
    frequencies = np.linspace(0.5 / duration, 0.4 * fps, 2 * n)
    dampings = np.concatenate([[0.0], np.geomspace(0.1 / duration, 30 / duration, 12)])
    start = min(((f, d) for f in frequencies for d in dampings), key=misfit)
    step = np.array([[0, 0], [frequencies[1] - frequencies[0], 0], [0, 0.2 * start[1] + 0.2 / duration]])
    best = minimize(misfit, start, method="Nelder-Mead", options={"initial_simplex": np.array(start) + step})
    frequency, damping, explained = float(best.x[0]), float(best.x[1]), 1 - best.fun / variance
    if explained < 0.8:
        return None, f"a damped oscillation explains only {100 * explained:.0f} % of the motion"
    if frequency * duration < 1.5:
        return None, f"only {frequency * duration:.1f} periods were seen"
    return Oscillation(frequency, damping, explained), ""
