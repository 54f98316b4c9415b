"""PAC-NeRF's multi-view clips: all_data.json and one RGBA matte per camera C and frame T, data/a_C_T.png.

    [{"file_path": "./data/r_C_T.png", "time": s, "c2w": 3x4 (OpenGL axes, y up), "intrinsic": 3x3}, ...]

Frame 0 of every camera is the static capture; all frames together are one take, "drop": the object falls freely under
gravity onto a floor at y = 0, which is z = 0 here. Instants whose mattes are missing are left out.
Li et al., ICLR 2023.
"""

import json
import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from physics3d.checks import Colour, Factor, Positive, Text, Whole
from physics3d.gaussians.cameras import Camera
from physics3d.scenes.axes import OPENGL_TO_OPENCV, Axes, rigid_inverse
from physics3d.scenes.base import AbstractSource, Capture, Take
from physics3d.scenes.photographs import mattes, read_photograph, require_folder, triple


@dataclass(frozen=True, kw_only=True)
class PacNerfSource(AbstractSource):
    name: Text
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
        images, alphas, cameras, names, videos, times = [], [], [], [], [], {}
        for c in log.progress(sorted(entries), "reading cameras"):
            clip = []
            for t in instants:
                path, entry = entries[c][t]
                image, alpha, size = read_photograph(
                    path, background=triple("background", self.background), resolution=self.resolution
                )
                camera = _camera(path, entry, size, axes)
                times[t] = float(entry["time"])
                clip.append(image)
                if t == 0:
                    images.append(image)
                    alphas.append(alpha)
                    names.append(path.name)
                    cameras.append(camera.scaled(self.resolution) if self.resolution else camera)
                elif image.shape != clip[0].shape:
                    raise ValueError(
                        f"{path} is {tuple(image.shape)}, frame 0 of its camera {tuple(clip[0].shape)}; resize one"
                    )
            videos.append(torch.stack(clip))
        takes: tuple[Take, ...] = ()
        if len(instants) > 1:
            fps = (len(instants) - 1) / (times[instants[-1]] - times[0])
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
        )
        capture.check()
        return capture

    def _read(self) -> tuple[Path, dict[int, dict[int, tuple[Path, dict]]]]:
        """Camera number -> frame number -> (matte that exists, its entry)."""
        folder = require_folder(Path(self.path), "PAC-NeRF capture")
        file = folder / "all_data.json"
        if not file.is_file():
            raise ValueError(f"no camera file at {file}; a PAC-NeRF capture has all_data.json beside data/")
        entries: dict[int, dict[int, tuple[Path, dict]]] = defaultdict(dict)
        try:
            for entry in json.loads(file.read_text()):
                match = re.search(r"[ar]_(-?\d+)_(-?\d+)(\.png)?$", entry["file_path"])
                if match is None:
                    raise ValueError(f"file_path {entry['file_path']!r} is not r_C_T.png")
                path = folder / "data" / f"a_{match[1]}_{match[2]}.png"
                float(entry["time"])
                if path.is_file():
                    entries[int(match[1])][int(match[2])] = path, entry
        except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{file} is not PAC-NeRF's list of file_path, time, c2w and intrinsic: {error!r}"
            ) from error
        if not entries:
            raise ValueError(f"no mattes a_C_T.png in {folder / 'data'}; the mattes of {file} are missing")
        return file, entries


def _camera(path: Path, entry: dict, size: tuple[int, int], axes: Axes) -> Camera:
    try:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3] = torch.tensor(entry["c2w"], dtype=torch.float64)
        K = np.asarray(entry["intrinsic"], np.float64).reshape(3, 3)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: its entry needs c2w (3x4) and intrinsic (3x3): {error!r}") from error
    if not all(0.25 < K[i, 2] / size[i] < 0.75 for i in (0, 1)):
        raise ValueError(
            f"{path} has {size[0]} x {size[1]} pixels, its principal point is {K[0, 2]:g}, {K[1, 2]:g}; "
            "camera file and images disagree"
        )
    camera = Camera(
        width=size[0],
        height=size[1],
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        world_to_camera=axes.world_to_camera(rigid_inverse(pose @ OPENGL_TO_OPENCV, str(path))),
    )
    camera.check(str(path))
    return camera
