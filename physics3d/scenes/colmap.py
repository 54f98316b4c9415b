"""COLMAP: photographs in <path>/images and a model in <path>/sparse/0, or <path>/sparse as its undistorter writes it.

Pictures of lenses with distortion (SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV) are undistorted as they are read.
Fisheye and panoramic cameras are no perspective cameras and refused.
"""

import fnmatch
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from physics3d.checks import Text
from physics3d.scenes.axes import rigid_inverse
from physics3d.scenes.colmap_model import PERSPECTIVE, ColmapCamera, ColmapImage, ColmapModel, read_model
from physics3d.scenes.lens import Lens
from physics3d.scenes.named import find, present, require_unique
from physics3d.scenes.photographs import require_folder
from physics3d.scenes.posed import AbstractPosedSource, Points, Posed, fixed


@dataclass(frozen=True, kw_only=True)
class ColmapSource(AbstractPosedSource):
    """`path` is the folder that holds sparse and images; up is often near (0, -1, 0)."""

    images: Text = "images"  # the folder of the photographs, below `path`; the model's names are relative to it
    only: Text = "*"  # pattern of the image names to use, e.g. "viewm0/*"; points then come from these images only

    def files(self) -> tuple[str, ...]:
        model = self._model()
        return (*(str(f) for f in model.files), *(str(path) for path, _ in self._found(model)))

    def read(self, log) -> tuple[list[Posed], Points | None]:
        model = self._model()
        found = self._found(model, log)
        posed = []
        for path, image in found:
            if image.camera not in model.cameras:
                raise ValueError(
                    f"{path}: its camera {image.camera} is not in {model.files[0]}; the model is incomplete"
                )
            camera = model.cameras[image.camera]
            posed.append(
                Posed(
                    path=path,
                    name=image.name,
                    lens=fixed(_lens(camera, path)),
                    size=(camera.width, camera.height),
                    world_to_camera=_pose(image, path),
                )
            )
        seen = np.isin(model.point_image, [image.id for _, image in found])
        kept = np.unique(model.point_index[seen])
        points = Points(xyz=model.xyz[kept], rgb=model.rgb[kept].astype(np.float32) / 255) if len(kept) else None
        return posed, points

    def _found(self, model: ColmapModel, log=None) -> list[tuple[Path, ColmapImage]]:
        folder = require_folder(Path(self.path) / self.images, "folder of images")
        chosen = sorted((i for i in model.images if fnmatch.fnmatch(i.name, self.only)), key=lambda i: i.name)
        if not chosen:
            raise ValueError(
                f"no image of {model.files[1]} matches only={self.only!r}; it has {len(model.images)} images"
            )
        require_unique([i.name for i in chosen], model.files[1])
        found = [(find(folder, image.name), image) for image in chosen]
        there = present((path for path, _ in found), folder, model.files[1], log)
        return [(path, image) for path, image in found if path in there]

    def _model(self) -> ColmapModel:
        return read_model(require_folder(Path(self.path), "COLMAP capture"))


def _lens(camera: ColmapCamera, path: Path) -> Lens:
    if camera.model not in PERSPECTIVE:
        raise ValueError(
            f"{path}: camera model {camera.model} is no perspective camera; known are {', '.join(PERSPECTIVE)}: run "
            "colmap image_undistorter first"
        )
    p = dict(zip(PERSPECTIVE[camera.model], camera.parameters))
    return Lens(
        width=camera.width,
        height=camera.height,
        fx=p.get("f", p.get("fx", 0.0)),
        fy=p.get("f", p.get("fy", 0.0)),
        cx=p["cx"],
        cy=p["cy"],
        radial=tuple(p.get(k, 0.0) for k in ("k1", "k2", "k3")),
        denominator=tuple(p.get(k, 0.0) for k in ("k4", "k5", "k6")),
        tangential=(p.get("p1", 0.0), p.get("p2", 0.0)),
    )


def _pose(image: ColmapImage, path: Path) -> Float64[Tensor, "4 4"]:
    length = math.hypot(*image.quaternion)
    if length == 0:
        raise ValueError(f"{path}: the quaternion of its pose is zero; drop this image or solve its camera again")
    if abs(length - 1) > 0.01:
        raise ValueError(f"{path}: the quaternion of its pose has length {length:.3g}, not 1; solve its camera again")
    w, x, y, z = (q / length for q in image.quaternion)
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3] = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )
    M[:3, 3] = torch.tensor(image.translation, dtype=torch.float64)
    rigid_inverse(M, str(path))  # only for its check
    return M
