"""A body from one outline: round wherever it is cut across.

The body is the union of all balls whose circles fit into the outline, their centres in one plane parallel to the
picture (Igarashi et al. 1999 blow up sketches to the same end),

    z(x)^2 = max over c of  r(c)^2 - |x - c|^2          r(c): distance of pixel c from the outline  [px]

so a stem becomes a rod and a blossom a ball, a leaf is too thick, and what lies behind is the front's mirror image.
Gaussians lie on the front and on the back, one every few pixels, in the colours of the photograph.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians

DC = 0.28209479177387814  # spherical harmonic of degree 0
OPAQUE = 8.0  # logit of the opacity
EDGE = 0.25  # of the slope: where the surface runs away from the camera, discs tilt no further


def rounded(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """z [px]: half the thickness at every pixel, 0 outside."""
    from scipy import ndimage

    # from the middle of a pixel to the middle of the nearest one outside: the outline is half a pixel nearer
    radius = np.maximum(ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] - 0.5, 0.5) * mask
    square = np.zeros(mask.shape)
    h, w = mask.shape
    # a ball that lies within the ball of a neighbour adds nothing
    centres = mask & (ndimage.maximum_filter(radius, footprint=_CROSS) - radius < 0.99)
    for i, j in zip(*np.nonzero(centres)):
        r = radius[i, j]
        a = math.ceil(r)
        rows, columns = slice(max(0, i - a), min(h, i + a + 1)), slice(max(0, j - a), min(w, j + a + 1))
        y, x = np.ogrid[rows, columns]
        part = square[rows, columns]
        np.maximum(part, r * r - (y - i) ** 2 - (x - j) ** 2, out=part)
    return np.sqrt(square) * mask


_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)


def one_view(
    photograph: UInt8[np.ndarray, "h w 3"],
    thing: Bool[np.ndarray, "h w"],
    held: Bool[np.ndarray, "h w"],
    camera: Camera,
    *,
    distance: float,
    stride: int = 2,
) -> tuple[Gaussians, Bool[torch.Tensor, " n"]]:
    """(Gaussians of the front, of the back and of what is behind the thing, whether each one moves).

    Pixels of the `thing` that are `held` do not move. The thing's middle plane is `distance` metres away; what is
    behind lies a quarter farther, filled in from around where the thing hides it.
    """
    import cv2

    depth = rounded(thing)
    pixel = distance / camera.fx  # [m] at the thing
    slope = np.stack(np.gradient(cv2.GaussianBlur(depth.astype(np.float32), (0, 0), 1.0)), -1)[..., ::-1]
    slope = np.clip(slope, -1 / EDGE, 1 / EDGE)
    behind = cv2.inpaint(photograph, cv2.dilate(thing.astype(np.uint8), np.ones((7, 7))), 5, cv2.INPAINT_TELEA)
    parts = []
    for sign in (1, -1):
        i, j = np.nonzero(thing & _lattice(thing.shape, stride))
        normal = np.concatenate([-slope[i, j], -np.ones((len(i), 1))], 1) * [1, 1, sign]
        z = distance - sign * pixel * depth[i, j]
        parts.append((*_discs(camera, photograph, i, j, z, normal, stride), ~held[i, j]))
    i, j = np.nonzero(_lattice(thing.shape, stride))
    flat = np.tile([0.0, 0.0, -1.0], (len(i), 1))
    back = _discs(camera, behind, i, j, np.full(len(i), 1.25 * distance), flat, stride)
    parts.append((*back, np.zeros(len(i), bool)))
    mean, scale, quaternion, colour, moves = (np.concatenate(column) for column in zip(*parts))
    R, t = camera.world_to_camera[:3, :3].double(), camera.world_to_camera[:3, 3].double()
    gaussians = Gaussians(
        mean=((torch.from_numpy(mean) - t) @ R).float(),
        log_scale=torch.from_numpy(scale).log().float(),
        quaternion=_turned(torch.from_numpy(quaternion), R).float(),
        opacity_logit=torch.full((len(mean),), OPAQUE),
        sh=torch.from_numpy((colour / 255 - 0.5) / DC).float()[:, None],
    )
    return gaussians, torch.from_numpy(moves)


def _lattice(shape: tuple[int, int], stride: int) -> np.ndarray:
    i, j = np.indices(shape)
    return (i % stride == 0) & (j % stride == 0)


def _discs(camera: Camera, picture, i, j, z, normal, stride: int):
    """Means, standard deviations and quaternions in the camera's axes, and colours, of discs through pixels (i, j)."""
    mean = np.stack([(j + 0.5 - camera.cx) / camera.fx * z, (i + 0.5 - camera.cy) / camera.fy * z, z], 1)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    breadth = 0.6 * stride * z / camera.fx / np.maximum(np.abs(normal[:, 2]), EDGE) ** 0.5
    scale = np.stack([breadth, breadth, 0.1 * breadth], 1)
    # the shortest turn that takes the third axis to the normal
    sign = np.where(normal[:, 2:] < 0, -1.0, 1.0)
    n = normal * sign
    quaternion = np.stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))], 1)
    return mean, scale, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True), picture[i, j].astype(float)


def _turned(q: torch.Tensor, R: torch.Tensor) -> torch.Tensor:
    """Quaternions q of the camera's axes in the world's: R^T after q."""
    from scipy.spatial.transform import Rotation

    there = Rotation.from_matrix(R.T.numpy()) * Rotation.from_quat(q[:, [1, 2, 3, 0]].numpy())
    return torch.from_numpy(there.as_quat())[:, [3, 0, 1, 2]]
