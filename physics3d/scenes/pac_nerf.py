"""PAC-NeRF's multi-view clips: all_data.json and one RGBA matte per camera C and frame T, data/a_C_T.png.

    [{"file_path": "./data/r_C_T.png", "time": s, "c2w": 3x4 (OpenGL axes, y up), "intrinsic": 3x3}, ...]

Frame 0 of every camera is the static capture; all frames together are one take, "drop": the object falls freely under
gravity onto a floor at y = 0, which is z = 0 here. Instants whose mattes are missing are left out.
Li et al., ICLR 2023.
"""

import json
import math
import re
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from physics3d.checks import Colour, Factor, Name, Positive, Text, Whole
from physics3d.gaussians.cameras import Camera
from physics3d.scenes.axes import OPENGL_TO_OPENCV, Axes, rigid_inverse
from physics3d.scenes.base import AbstractSource, Capture, Take
from physics3d.scenes.lens import Lens
from physics3d.scenes.named import read_text
from physics3d.scenes.photographs import mattes, read_photograph, require_folder, triple
from physics3d.scenes.posed import pinhole, where


@dataclass(frozen=True, kw_only=True)
class PacNerfSource(AbstractSource):
    name: Name
    path: Text  # the folder that holds all_data.json and data/
    truth: dict[str, float]  # material parameters as reported, SI; {} if unknown
    truth_source: str = ""  # who reports them, and what others recovered
    held_out_cameras: tuple[Whole, ...] = ()  # positions among the cameras in order; for evaluation only
    resolution: Factor | None = None  # factor on both image sides, in (0, 1]
    background: Colour = (1.0, 1.0, 1.0)  # put behind the mattes, 0..1
    scale: Positive = 1.0  # metres per unit [m]

    def files(self) -> tuple[str, ...]:
        file, entries = self._read()
        return (str(file), *(str(path) for frames in entries.values() for path, _ in frames.values()))

    def __call__(self, *, log) -> Capture:
        file, entries = self._read()
        axes = Axes(up=(0.0, 1.0, 0.0), scale=self.scale)
        axes.check()
        if not set(self.held_out_cameras) < set(range(len(entries))):
            raise ValueError(
                f"held_out_cameras is {tuple(self.held_out_cameras)}; {file} has cameras 0..{len(entries) - 1}, "
                "not all of them may be held out"
            )
        instants = sorted(set.intersection(*(set(frames) for frames in entries.values())))
        if 0 not in instants:
            raise ValueError(f"{file.parent}/data: frame 0 is missing for some camera; every camera needs a_C_0.png")
        instants = [t for t in instants if t >= 0]
        if instants != list(range(len(instants))):
            raise ValueError(f"{file.parent}/data: the cameras share frames {instants}; restore the missing a_C_T.png")
        images, alphas, cameras, names, videos = [], [], [], [], []
        times: dict[int, float] = {}
        for c in log.progress(sorted(entries), "reading cameras"):
            clip = []
            for t in instants:
                path, entry = entries[c][t]
                lens, pose = _camera(path, entry, axes)
                read = read_photograph(
                    path,
                    lens=lens,
                    size=None,
                    background=triple("background", self.background),
                    resolution=self.resolution,
                )
                camera = pinhole(read.lens, pose, str(path))
                if not math.isclose(times.setdefault(t, float(entry["time"])), float(entry["time"]), abs_tol=1e-6):
                    raise ValueError(
                        f"{path} is of time {entry['time']} s, frame {t} of another camera of {times[t]} s; they "
                        "must film at the same instants"
                    )
                clip.append(read.image)
                if t == 0:
                    images.append(read.image)
                    alphas.append(read.alpha)
                    names.append(path.name)
                    cameras.append(camera)
                elif read.image.shape != clip[0].shape:
                    raise ValueError(
                        f"{path} is {tuple(read.image.shape)}, frame 0 of its camera {tuple(clip[0].shape)}; resize one"
                    )
                elif not _same(camera, cameras[-1]):
                    raise ValueError(
                        f"{path}: its camera differs from that of frame 0; a camera of a take stands still"
                    )
            videos.append(torch.stack(clip))
        takes: tuple[Take, ...] = ()
        if len(instants) > 1:
            duration = times[instants[-1]] - times[0]
            if not 0 < duration < math.inf:
                raise ValueError(
                    f"{file}: time runs from {times[0]} to {times[instants[-1]]} s; it must increase by frame"
                )
            fps = (len(instants) - 1) / duration
            take = Take(
                name="drop",
                role="learn",
                fps=round(fps, 6),
                cameras=tuple(cameras),
                videos=tuple(videos),
                held_out_cameras=tuple(self.held_out_cameras),
            )
            takes = (take,)
        capture = Capture(
            name=self.name,
            images=tuple(images),
            cameras=tuple(cameras),
            names=tuple(names),
            held_out=tuple(self.held_out_cameras),
            alphas=mattes(names, alphas),
            background=triple("background", self.background),
            takes=takes,
            single_object=True,
            truth=dict(self.truth),
            truth_source=self.truth_source,
            floor=0.0,
        )
        capture.check()
        where(capture, log)
        return capture

    def _read(self) -> tuple[Path, dict[int, dict[int, tuple[Path, dict]]]]:
        """Camera number -> frame number -> (matte that exists, its entry)."""
        folder = require_folder(Path(self.path), "PAC-NeRF capture")
        file = folder / "all_data.json"
        if not file.is_file():
            raise ValueError(f"no camera file at {file}; a PAC-NeRF capture has all_data.json beside data/")
        entries: dict[int, dict[int, tuple[Path, dict]]] = defaultdict(dict)
        try:
            for entry in json.loads(read_text(file)):
                match = re.search(r"[ar]_(-?\d+)_(-?\d+)(\.png)?$", entry["file_path"])
                if match is None:
                    raise ValueError(f"file_path {entry['file_path']!r} is not r_C_T.png")
                path = folder / "data" / f"a_{match[1]}_{match[2]}.png"
                if not math.isfinite(float(entry["time"])):
                    raise ValueError(f"time of {entry['file_path']!r} is {entry['time']}")
                camera, frame = int(match[1]), int(match[2])
                if frame in entries.get(camera, {}):
                    raise ValueError(f"{entry['file_path']!r} is listed twice")
                if path.is_file():
                    entries[camera][frame] = path, entry
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{file} is not PAC-NeRF's list of file_path, time, c2w and intrinsic: {error!r}"
            ) from error
        if not entries:
            raise ValueError(f"no mattes a_C_T.png in {folder / 'data'}; the mattes of {file} are missing")
        return file, entries


def _camera(path: Path, entry: dict, axes: Axes) -> tuple[Callable[[int, int], Lens], Float64[Tensor, "4 4"]]:
    """The lens for the size of the picture, and where it was [m]. Raises ValueError naming the picture."""
    try:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3] = torch.tensor(entry["c2w"], dtype=torch.float64)[:3]
        K = np.asarray(entry["intrinsic"], np.float64).reshape(3, 3)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: its entry needs c2w (3x4) and intrinsic (3x3): {error!r}") from error
    if not np.isfinite(K).all() or np.abs(K[[1, 2, 2, 2], [0, 0, 1, 2]] - (0, 0, 0, 1)).max() > 1e-6:
        raise ValueError(f"{path}: intrinsic is {K.tolist()}; it must be finite, [[fx, s, cx], [0, fy, cy], [0, 0, 1]]")

    def lens(width: int, height: int) -> Lens:
        if not all(0.25 < c / side < 0.75 for c, side in ((K[0, 2], width), (K[1, 2], height))):
            raise ValueError(
                f"{path} has {width} x {height} pixels, its principal point is {K[0, 2]:g}, {K[1, 2]:g}; "
                "camera file and images disagree"
            )
        fx, skew, cx, _, fy, cy = K[:2].ravel().tolist()
        return Lens(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, skew=skew)

    return lens, axes.world_to_camera(rigid_inverse(pose @ OPENGL_TO_OPENCV, str(path)))


def _same(a: Camera, b: Camera) -> bool:
    """Whether two cameras agree to a hundredth of a pixel and of a millimetre."""
    one, other = ((c.fx, c.fy, c.cx, c.cy) for c in (a, b))
    return bool(np.allclose(one, other, atol=0.01)) and bool(
        torch.allclose(a.world_to_camera, b.world_to_camera, rtol=0, atol=1e-5)
    )
