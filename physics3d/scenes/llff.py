"""LLFF: <path>/poses_bounds.npy and the photographs in <path>/images, in the order of their names.

Each row of poses_bounds.npy holds 17 numbers: a 3 x 5 matrix by rows, and the depths of the nearest and farthest thing.
The matrix is [camera-to-world rotation | centre | (height, width, focal length) in pixels]; the rotation's columns are
the camera's down, right and backward directions. Mildenhall et al. (2019), Local Light Field Fusion.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from physics3d.checks import Text
from physics3d.scenes.axes import rigid_inverse
from physics3d.scenes.lens import Lens
from physics3d.scenes.photographs import require_folder
from physics3d.scenes.pictures import photographs_in
from physics3d.scenes.posed import AbstractPosedSource, Points, Posed


@dataclass(frozen=True, kw_only=True)
class LlffSource(AbstractPosedSource):
    """`path` is the folder that holds poses_bounds.npy."""

    images: Text = "images"  # the folder of the photographs, below `path`; reduced copies (images_4) are right as well

    def files(self) -> tuple[str, ...]:
        file, _, images = self._rows()
        return (str(file), *(str(path) for path in images))

    def read(self, log) -> tuple[list[Posed], Points | None]:
        file, rows, images = self._rows()
        posed = []
        for path, row in zip(images, rows):
            matrix = row[:15].reshape(3, 5)
            height, width, focal = matrix[:, 4]
            if not (min(height, width, focal) > 0 and np.isfinite(matrix[:, 4]).all()):
                raise ValueError(
                    f"{path}: {file.name} gives height {height:g}, width {width:g}, focal length {focal:g}; all "
                    "must be positive"
                )
            down, right, back, centre = matrix[:, :4].T
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3] = torch.from_numpy(np.stack([right, down, -back, centre], 1))
            posed.append(
                Posed(
                    path=path,
                    name=path.name,
                    lens=partial(_lens, float(focal)),
                    size=(round(width), round(height)),
                    world_to_camera=rigid_inverse(pose, str(path)),
                )
            )
        return posed, None

    def _rows(self) -> tuple[Path, np.ndarray, list[Path]]:
        folder = require_folder(Path(self.path), "LLFF capture")
        file = folder / "poses_bounds.npy"
        if not file.is_file():
            raise ValueError(f"no camera file at {file}; an LLFF capture has poses_bounds.npy beside images/")
        try:
            rows = np.asarray(np.load(file, allow_pickle=False), np.float64)
        except (ValueError, OSError, EOFError) as error:
            raise ValueError(f"cannot read {file}: {error}; the file is damaged or no array") from error
        if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0:
            raise ValueError(f"{file} has shape {rows.shape}; one row of 17 numbers for each image is needed")
        images = photographs_in(require_folder(folder / self.images, "folder of images"))
        if len(images) != len(rows):
            raise ValueError(
                f"{file} has {len(rows)} rows, {folder / self.images} {len(images)} images; they must "
                "agree, row by name"
            )
        return file, rows, images


def _lens(focal: float, width: int, height: int) -> Lens:
    return Lens(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)
