"""Clips whose motion is known: an analytic texture at displaced coordinates, before another that stands still."""

import math

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from physics3d.video import ffmpeg

FPS = 30.0


def decaying(t, frequency=2.0, damping=0.8, amplitude=6.0, phase=0.4):
    """amplitude exp(-d t) cos(2 pi f t + phase)"""
    return amplitude * np.exp(-damping * t) * np.cos(2 * math.pi * frequency * t + phase)


def texture(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """0..1, the same wherever it is looked at: a sum of waves of 6 to 25 px."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.broadcast(x, y).shape)
    for _ in range(24):
        k, angle, phase = 2 * math.pi / rng.uniform(6, 25), rng.uniform(0, math.pi), rng.uniform(0, 2 * math.pi)
        total += np.sin(k * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return np.clip(0.5 + total / 24, 0, 1)


def swaying(
    shift: Float[np.ndarray, " t"], *, h: int = 96, w: int = 128, noise: float = 0.0, seed: int = 0, camera: float = 0.0
) -> UInt8[Tensor, "t h w 3"]:
    """A round thing that sways sideways by `shift` [px]; `noise` in grey levels; `camera` moves all [px of `shift`]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:h, :w].astype(float)
    frames = []
    for s in shift:
        back = texture(x - camera * s, y, 1)
        inside = np.clip((0.32 * h - np.hypot(x - w / 2 - s, y - h / 2)) / 2 + 0.5, 0, 1)
        frames.append((1 - inside) * 0.6 * back + inside * (0.3 + 0.7 * texture(x - s, y, 2)))
    grey = 255 * np.stack(frames) + noise * rng.normal(size=(len(frames), h, w))
    return torch.from_numpy(np.clip(grey + 0.5, 0, 255).astype(np.uint8))[..., None].expand(-1, -1, -1, 3).contiguous()


def encode(frames: Tensor, path, *words: str, fps: float = FPS, before: tuple[str, ...] = ()) -> None:
    """Written by ffmpeg itself, not by the project; `words` are options of the encoder, `before` of the source."""
    import subprocess

    h, w = frames.shape[1:3]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{w}x{h}", "-r", f"{fps:g}", *before, "-i", "-"]
    command = [ffmpeg(), "-v", "error", "-y", *source, *(words or ("-c:v", "libx264", "-crf", "8")), str(path)]
    subprocess.run(command, input=frames.contiguous().numpy().tobytes(), check=True)


def swinging_rod(
    bend: Float[np.ndarray, " t"],
    *,
    h: int = 144,
    w: int = 192,
    foot: int = 130,
    length: int = 105,
    radius: float = 7.0,
) -> UInt8[Tensor, "t h w 3"]:
    """A rod, held at its foot, whose tip moves sideways by `bend` [px] as that of a clamped beam under its own weight,
    which is the first mode of vibration to 1.5 %: u(z) = z^2 (6 - 4 z + z^2)/3."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:h, :w].astype(float)
    up = np.clip((foot - y) / length, 0, 1)
    shape = up**2 * (6 - 4 * up + up**2) / 3
    wall = texture(x, y, 1)[..., None] * (90.0, 110.0, 190.0)
    frames = []
    for b in bend:
        away = x + 0.5 - w / 2 - b * shape
        inside = np.clip((radius - np.abs(away)) + 0.5, 0, 1) * (y > foot - length)
        skin = (0.4 + 0.6 * texture(away, y, 2))[..., None] * (240.0, 150.0, 70.0)
        frames.append(inside[..., None] * skin + (1 - inside[..., None]) * wall)
    video = np.stack(frames) + rng.normal(size=(len(frames), h, w, 3))
    return torch.from_numpy(np.clip(video + 0.5, 0, 255).astype(np.uint8))


def thin_rod(bend, *, width):
    """(clip of a rod, its displacement at every pixel per px of its tip, the rod's pixels in a frame at rest)."""
    foot, length = 130, 105
    video = swinging_rod(bend, foot=foot, length=length, radius=width / 2)
    y, x = np.mgrid[: video.shape[1], : video.shape[2]].astype(float)
    up = np.clip((foot - y) / length, 0, 1)
    rod = (np.abs(x + 0.5 - video.shape[2] / 2) < width / 2) & (up > 0) & (up < 1)
    return video, up**2 * (6 - 4 * up + up**2) / 3, rod
