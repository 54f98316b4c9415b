"""Pinhole cameras in metres, OpenCV axes: x right, y down, z forward; pixel centres at integer + 0.5.

X_c = R X_w + t,   u = fx X_c/Z_c + cx,   v = fy Y_c/Z_c + cy
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A pinhole camera without distortion."""

    width: int  # [px]
    height: int  # [px]
    fx: float  # focal length [px]
    fy: float  # [px]
    cx: float  # principal point [px], (width/2, height/2) is the centre of the image
    cy: float  # [px]
    world_to_camera: Tensor  # [4, 4] float64, rigid, OpenCV axes [m]

    @property
    def centre(self) -> Tensor:
        """Position of the camera in the world [m], shape [3]."""
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -R.T @ t

    def scaled(self, factor: float) -> "Camera":
        """The same view with `factor` times as many pixels along each side, rounded to whole pixels."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def framed(self, width: int, height: int) -> "Camera":
        """From the same place into a picture of width x height pixels: all that this one sees, in its middle, and more
        on two sides where the shapes differ."""
        s = min(width / self.width, height / self.height)
        cx, cy = s * (self.cx - self.width / 2) + width / 2, s * (self.cy - self.height / 2) + height / 2
        return replace(self, width=width, height=height, fx=self.fx * s, fy=self.fy * s, cx=cx, cy=cy)

    def check(self, name: str = "camera") -> None:
        """Raise ValueError naming the field if this is not a rigid pinhole camera."""
        M = self.world_to_camera
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"{name}: size {self.width}x{self.height} and focal length {self.fx:g}, {self.fy:g} must be positive"
            )
        if M.shape != (4, 4) or not torch.isfinite(M).all():
            raise ValueError(f"{name}: world_to_camera must be a finite 4x4 matrix")
        R = M[:3, :3].double()
        if (R @ R.T - torch.eye(3, dtype=R.dtype)).abs().max() > 1e-4 or torch.det(R) < 0:
            raise ValueError(f"{name}: world_to_camera is not a rigid motion; remove scale or mirroring from the pose")

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points [n, 3] -> pixel coordinates [n, 2] and depth [n] along the optical axis [m]."""
        M = self.world_to_camera.to(points)
        local = points @ M[:3, :3].T + M[:3, 3]
        depth = local[:, 2]
        uv = torch.stack([self.fx * local[:, 0] / depth + self.cx, self.fy * local[:, 1] / depth + self.cy], -1)
        return uv, depth

    def rays(self, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
        """Origin [3] and unscaled directions [h, w, 3] through pixel centres; the parameter is depth along the axis."""
        v, u = torch.meshgrid(
            torch.arange(self.height, dtype=dtype) + 0.5, torch.arange(self.width, dtype=dtype) + 0.5, indexing="ij"
        )
        local = torch.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, torch.ones_like(u)], -1)
        M = self.world_to_camera.to(dtype)
        return self.centre.to(dtype), local @ M[:3, :3]


def look_at(position: Tensor, target: Tensor, *, up: tuple[float, float, float] = (0, 0, 1)) -> Tensor:
    """world_to_camera [4, 4] float64 of a camera at `position` [m] looking at `target`, image up along `up`."""
    position, target = position.double(), target.double()
    forward = torch.nn.functional.normalize(target - position, dim=0)
    right = torch.linalg.cross(forward, torch.tensor(up, dtype=torch.float64))
    if right.norm() < 1e-6:
        raise ValueError("look_at: the viewing direction is parallel to up; choose another up vector")
    right = right / right.norm()
    R = torch.stack([right, torch.linalg.cross(forward, right), forward])
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3], M[:3, 3] = R, -R @ position
    return M
