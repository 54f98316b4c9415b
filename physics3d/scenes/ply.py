"""A trained 3D Gaussian model (.ply of 3DGS): the capture already has its Gaussians, reconstruction is left out.

The file holds no cameras, so they are put on a ring around the bulk of the model; its own pictures from there are the
images. Turning the model to z up turns its spherical harmonics too: coefficients c' with Y(Q d) c' = Y(d) c for all d.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Gt, Le, Lt
from jaxtyping import Float64
from torch import Tensor

from physics3d.checks import Colour, Count, Direction, Name, Pixels, Positive, Text, require_fields
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.ply import read_ply
from physics3d.gaussians.render import render
from physics3d.gaussians.sh import sh_basis
from physics3d.pictures import to_uint8
from physics3d.scenes.axes import Axes
from physics3d.scenes.base import AbstractSource, Capture
from physics3d.scenes.photographs import triple
from physics3d.scenes.studio import ring


@dataclass(frozen=True, kw_only=True)
class PlyScene(AbstractSource):
    name: Name
    path: Text  # the .ply file
    up: Direction  # up in the file's coordinates; models trained on COLMAP often have (0, -1, 0)
    scale: Positive  # metres per unit of the file [m]
    views: Count = 24
    elevation: Annotated[float, Ge(-90), Le(90)] = 20.0  # of the ring of cameras [deg]
    opening: Annotated[float, Gt(0), Lt(180)] = 45.0  # of their lenses, across [deg]
    width: Pixels = 320  # [px]
    height: Pixels = 240  # [px]
    background: Colour = (1.0, 1.0, 1.0)  # 0..1
    single_object: bool = False  # one object and nothing else: nothing to segment

    def files(self) -> tuple[str, ...]:
        return (self.path,)

    def __call__(self, *, log) -> Capture:
        require_fields(self, "source")
        gaussians = oriented(read_ply(Path(self.path), log=log), Axes(up=triple("up", self.up), scale=self.scale))
        solid = gaussians.mean[gaussians.opacity >= gaussians.opacity.median()].double()
        centre = solid.median(0).values
        radius = float((solid - centre).norm(dim=1).quantile(0.9))
        if radius == 0:  # one Gaussian, or all at one place
            radius = 3 * float(torch.exp(gaussians.log_scale.double()).amax(1).median())
        cameras = ring(
            tuple(centre.tolist()),
            distance=radius / math.sin(0.5 * math.radians(self.opening) * min(1.0, self.height / self.width)),
            elevation=self.elevation,
            azimuths=np.linspace(-90, 270, self.views, endpoint=False),
            width=self.width,
            height=self.height,
            opening=self.opening,
        )
        with torch.no_grad():
            images = [
                to_uint8(render(gaussians, camera, background=triple("background", self.background)).color)
                for camera in log.progress(cameras, "drawing the views")
            ]
        middle = ", ".join(f"{c:z.3f}" for c in centre.tolist())
        log.info(f"{len(gaussians)} Gaussians; nine tenths of the solid ones within {radius:.3g} m of [{middle}] m")
        capture = Capture(
            name=self.name,
            images=tuple(images),
            cameras=tuple(cameras),
            names=tuple(f"ring_{i:03d}" for i in range(len(cameras))),
            background=triple("background", self.background),
            gaussians=gaussians,
            single_object=self.single_object,
        )
        capture.check()
        return capture


def oriented(gaussians: Gaussians, axes: Axes) -> Gaussians:
    """The model in metres with z up."""
    Q = axes.rotation()
    return replace(
        gaussians,
        mean=axes.points(gaussians.mean),
        log_scale=gaussians.log_scale + math.log(axes.scale),
        quaternion=_product(_quaternion(Q), gaussians.quaternion.double()).to(gaussians.quaternion),
        sh=_turned(gaussians.sh, Q),
    )


def _turned(sh: Tensor, Q: Float64[Tensor, "3 3"]) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    d = torch.nn.functional.normalize(torch.randn(128, 3, dtype=torch.float64, generator=generator), dim=1)
    k = sh.shape[1]
    turn = torch.linalg.lstsq(sh_basis(d @ Q.T, k), sh_basis(d, k)).solution
    return torch.einsum("ij,njc->nic", turn.to(sh), sh)


def _quaternion(Q: Float64[Tensor, "3 3"]) -> Float64[Tensor, "4"]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(Q.numpy()).as_quat()
    return torch.tensor([w, x, y, z], dtype=torch.float64)


def _product(p: Float64[Tensor, "4"], q: Float64[Tensor, "n 4"]) -> Float64[Tensor, "n 4"]:
    """Hamilton product p q, (w, x, y, z)."""
    a, u = p[0], p[1:]
    b, v = q[:, :1], q[:, 1:]
    return torch.cat([a * b - v @ u[:, None], a * v + b * u + torch.linalg.cross(u.expand_as(v), v)], 1)
