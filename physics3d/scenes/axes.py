"""From the coordinates of a source to ours: metres, z up, OpenCV cameras.

x = s Q x_source,    Q the shortest rotation that takes the source's up to (0, 0, 1),  s metres per source unit
a camera with X_c = R x_source + t  (t in source units)  becomes  X_c' = R Q^T x + s t
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from physics3d.gaussians.cameras import Camera

FAR = 1e9  # of a camera from the origin [source units]: nobody maps farther
OPENGL_TO_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # of camera axes: y and z flip


@dataclass(frozen=True, kw_only=True)
class Axes:
    up: tuple[float, float, float]  # the direction away from the ground, in the source's coordinates; any length
    scale: float  # metres per source unit [m]

    def check(self) -> None:
        """Raise ValueError unless `up` is a direction and `scale` positive."""
        up = torch.tensor([float(u) for u in self.up], dtype=torch.float64)
        if up.shape != (3,) or not torch.isfinite(up).all() or up.norm() == 0:
            raise ValueError(f"up is {tuple(self.up)}; give the upward direction in the source's axes, e.g. [0, 1, 0]")
        if not 0 < self.scale < float("inf"):
            raise ValueError(f"scale is {self.scale}; give metres per unit of the source, e.g. 1.0")

    def rotation(self) -> Float64[Tensor, "3 3"]:
        """Q with Q up = |up| (0, 0, 1); a quarter or half turn about x where that is the shortest or all are equal."""
        self.check()
        up = torch.tensor([float(u) for u in self.up], dtype=torch.float64)
        up = up / up.norm()
        z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        if up[2] < -1 + 1e-12:
            return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
        a, b, c = torch.linalg.cross(up, z).tolist()
        K = torch.tensor([[0, -c, b], [c, 0, -a], [-b, a, 0]], dtype=torch.float64)
        return torch.eye(3, dtype=torch.float64) + K + K @ K / (1 + up[2])

    def points(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Source coordinates -> metres, z up."""
        return (self.scale * points.double() @ self.rotation().T).to(points.dtype)

    def world_to_camera(self, source: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
        """A rigid source-to-camera matrix (OpenCV camera axes, source units) -> the same camera for our world [m]."""
        M = torch.eye(4, dtype=torch.float64)
        M[:3, :3] = source[:3, :3] @ self.rotation().T
        M[:3, 3] = self.scale * source[:3, 3]
        return M

    def report(self, cameras: list[Camera], log) -> None:
        """Say which way the photographer held the camera on average: the best guess where the source has no up."""
        down = torch.stack([c.world_to_camera[1, :3] for c in cameras]).mean(0)
        up = -self.rotation().T @ down / down.norm()
        mean = ", ".join(f"{u:.3f}" for u in up)
        log.info(f"cameras' mean up in the source's axes is [{mean}]; up is set to {[*self.up]}")


def rigid_inverse(pose: Float64[Tensor, "4 4"], name: str) -> Float64[Tensor, "4 4"]:
    """camera_to_world -> world_to_camera. Raises ValueError naming `name` if the pose is not a finite rigid motion."""
    if not torch.isfinite(pose).all():
        raise ValueError(f"{name}: the camera pose holds NaN or infinity; drop this image or solve its camera again")
    if pose.abs().max() > FAR:
        raise ValueError(f"{name}: the camera is {float(pose.abs().max()):.3g} units away; solve it again")
    R = pose[:3, :3]
    if (R @ R.T - torch.eye(3, dtype=torch.float64)).abs().max() > 1e-3 or torch.det(R) < 0:
        raise ValueError(f"{name}: the camera pose is not a rotation and a translation; remove its scale or mirroring")
    U, _, Vh = torch.linalg.svd(R)  # nearest rotation: files store six digits
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3] = (U @ Vh).T
    M[:3, 3] = -M[:3, :3] @ pose[:3, 3]
    return M
