"""Measures of the motion itself, which a frozen picture cannot win.

u(t, x) [px] is the optical flow from frame 0 to frame t (`motion/flow.py`), M the pixels where the reference moves
(`motion/shapes.py`).

    motion PSNR   PSNR over {(t, x): the reference differs from its own frame 0 by more than 0.1}
    flow error    |u - u_ref| / |u_ref|, L2 over M and t: 0 is the same motion, 1 standing still, 2 the opposite
    signal s(t)   u projected on the reference's dominant pattern of motion (first singular vector) [px rms]
    frequency f [Hz], damping d [1/s]     of the best  s(t) = c + exp(-d t) (a cos 2 pi f t + b sin 2 pi f t)

The damped oscillation is the largest of up to three terms fitted together (`motion/decay.py`). It is reported only
where they explain 80 % of the variance and at least one and a half periods were seen; its phase is that in the middle
of the clip.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.metrics.image import check_pair, decibel, per_frame
from physics3d.motion.decay import fit_decay

CHANGE = 0.1  # of 0..1: a pixel that differs by more has changed


@dataclass(frozen=True)
class Oscillation:
    frequency: float  # [Hz]
    damping: float  # [1/s]
    explained: float  # fraction of the variance of the signal
    phase: float  # of cos(2 pi f (t - t_m) + phase), t_m the middle of the clip [rad]


def motion_psnr(video: UInt8[Tensor, "t h w 3"], reference: UInt8[Tensor, "t h w 3"]) -> tuple[float | None, str]:
    """(PSNR [dB] over the pixels that moved in the reference, "") or (None, reason). ValueError for unequal shapes."""
    import cv2

    check_pair(video, reference)
    first = reference[0].cpu().numpy()

    def summed(a: np.ndarray, b: np.ndarray) -> tuple[float, int]:
        moved = np.asarray((cv2.absdiff(b, first) > CHANGE * 255).any(-1), np.uint8)
        return cv2.norm(a, b, cv2.NORM_L2SQR, mask=moved) / 255**2, 3 * int(moved.sum())

    totals, counts = zip(*per_frame(video, reference, summed))
    if sum(counts) == 0:
        return None, f"no pixel of the reference changes by more than {CHANGE:g}: it does not move"
    return decibel(sum(totals) / sum(counts)), ""


def flow_error(u: np.ndarray, u_ref: np.ndarray, where: np.ndarray) -> float:
    """|u - u_ref| / |u_ref| over the pixels `where`: 1 for a frozen picture."""
    return float(np.linalg.norm(u[:, where] - u_ref[:, where]) / np.linalg.norm(u_ref[:, where]))


def dominant(u: np.ndarray, where: np.ndarray) -> Float[np.ndarray, " n"]:
    """The pattern of motion that most of a flow is, over the pixels `where`; its largest signal is positive."""
    flat = u[:, where].reshape(len(u), -1)
    pattern = np.linalg.eigh((flat @ flat.T).astype(float))[1][:, -1] @ flat  # by way of the small side
    pattern /= np.linalg.norm(pattern)
    s = flat @ pattern
    return pattern * np.sign(s[np.abs(s).argmax()]) / math.sqrt(where.sum())


def signal(u: np.ndarray, pattern: np.ndarray, where: np.ndarray) -> Float[np.ndarray, " t"]:
    """Displacement along the dominant pattern of the reference [px]."""
    return u[:, where].reshape(len(u), -1) @ pattern


def oscillation(s: Float[np.ndarray, " t"], fps: float) -> tuple[Oscillation | None, str]:
    """(largest damped oscillation in a signal, "") or (None, reason)."""
    n = len(s)
    if n < 8 or float(((s - s.mean()) ** 2).sum()) < 1e-12 * n:
        return None, "the signal is too short or does not move"
    decay = fit_decay(np.asarray(s, float)[:, None], fps, most=3)
    main = decay.main()
    explained = 0.0 if main is None else decay.explained
    if main is None or explained < 0.8:
        return None, f"a damped oscillation explains only {100 * explained:.0f} % of the motion"
    frequency, damping = float(decay.frequency[main]), float(decay.damping[main])
    if frequency * n / fps < 1.5:
        return None, f"only {frequency * n / fps:.1f} periods were seen"
    phase = math.atan2(-float(decay.sine[main, 0]), float(decay.cosine[main, 0])) + math.pi * frequency * (n - 1) / fps
    return Oscillation(frequency, damping, decay.explained, math.remainder(phase, 2 * math.pi)), ""


def phase_error(found: Oscillation, reference: Oscillation) -> float:
    """How far an oscillation is ahead of the reference's in the middle of the clip [deg], -180 to 180."""
    return math.degrees(math.remainder(found.phase - reference.phase, 2 * math.pi))
