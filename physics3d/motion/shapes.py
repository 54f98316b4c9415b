"""Shapes of a motion: the few patterns of displacement whose sum, with one signal of time each, is the flow.

    u(t, x) = sum_k s_k(t) phi_k(x),     mean over M of |phi_k|^2 = 1,     so that s_k is in px rms over M

M are the pixels that move. The signals are the first singular vectors of the flow over M, a pixel weighing as much as
its flow can be trusted; the shapes are then the weighted regression of the flow on the signals at every pixel, times

    g(x) = max(0, 1 - K/(n - K) * residual(x)/explained(x))         (smoothed over 2 px)

which is 0 where K signals explain no more than K signals explain of noise (positive-part James-Stein): a background
that stands still gets no motion.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from physics3d.motion.flow import size

STILL = 0.1  # of the largest displacement: pixels that move less are not in M
LEAST = 0.5  # a clip in which no pixel moves by so much stands still [px]
SMOOTH = 2.0  # [px]


@dataclass(frozen=True, kw_only=True)
class Shapes:
    shape: Float[np.ndarray, "k h w 2"]  # phi_k, 0 outside M
    signal: Float[np.ndarray, "t k"]  # s_k of the frames they were found in [px rms over M]
    where: Bool[np.ndarray, "h w"]  # M


def moving(u: Float[np.ndarray, "t h w 2"]) -> Bool[np.ndarray, "h w"] | None:
    """M, or None if nothing moves (no pixel by half a pixel)."""
    farthest = np.maximum.reduce([size(frame) for frame in u])
    largest = float(np.percentile(farthest, 99.9))
    return None if largest < LEAST else farthest > STILL * largest


def shapes(
    u: Float[np.ndarray, "t h w 2"],
    weight: Float[np.ndarray, "t h w"],
    where: Bool[np.ndarray, "h w"],
    *,
    count: int,
) -> Shapes:
    """The first `count` shapes, or as many as there are frames less two."""
    import cv2

    flow, trusted = u[:, where], weight[:, where]
    n, count = len(flow), max(1, min(count, len(flow) - 2))
    size = np.sqrt(trusted.mean(0))
    flat = (flow * size[None, :, None]).reshape(n, -1)
    value, left = np.linalg.eigh((flat @ flat.T).astype(float))  # singular vectors by way of the small side
    signal = left[:, : -count - 1 : -1] * np.sqrt(np.maximum(value[: -count - 1 : -1], 0))
    phi = regression(flow, trusted, signal)
    scale = np.sqrt((phi**2).sum((1, 2)) / where.sum())
    phi, signal = phi / scale[:, None, None], signal * scale
    explained = np.einsum("tk,kpc->tpc", signal, phi)
    maps = []
    for part in (explained, flow - explained):
        full = np.zeros(where.shape, np.float32)
        full[where] = (trusted[..., None] * part**2).sum((0, 2))
        maps.append(cv2.GaussianBlur(full, (0, 0), SMOOTH))
    gain = np.clip(1 - count / (n - count) * maps[1] / np.maximum(maps[0], 1e-12), 0, 1)
    full = np.zeros((count, *where.shape, 2), np.float32)
    full[:, where] = phi * gain[where][None, :, None]
    return Shapes(shape=full, signal=signal, where=where)


def regression(
    flow: Float[np.ndarray, "t p 2"], weight: Float[np.ndarray, "t p"], signal: Float[np.ndarray, "t k"]
) -> Float[np.ndarray, "k p 2"]:
    """phi at every pixel that minimises sum_t w |u - sum_k s_k phi_k|^2."""
    normal = np.einsum("tk,tl,tp->pkl", signal, signal, weight, optimize=True)
    normal += 1e-6 * np.diag((signal**2).sum(0))  # a pixel that is never trusted does not move
    right = np.einsum("tk,tp,tpc->pkc", signal, weight, flow, optimize=True)
    return np.linalg.solve(normal, right).transpose(1, 0, 2)


def signals(
    u: Float[np.ndarray, "t h w 2"], weight: Float[np.ndarray, "t h w"], found: Float[np.ndarray, "k h w 2"]
) -> Float[np.ndarray, "t k"]:
    """s at every frame that minimises sum_x w |u - sum_k s_k phi_k|^2: a flow in terms of shapes that are known."""
    where = (found != 0).any((0, 3))
    phi, trusted = found[:, where], weight[:, where]
    normal = np.einsum("tp,kpc,lpc->tkl", trusted, phi, phi, optimize=True)
    right = np.einsum("tp,tpc,kpc->tk", trusted, u[:, where], phi, optimize=True)
    return np.linalg.solve(normal, right[..., None])[..., 0]
