"""Which way is up, where the floor is and what the cameras look at, told by cameras and points alone.

up      = the unit u of least  mean_i (u.x_i)^2 + 0.005 |u - (u.y) y|^2,  x_i the cameras' right, y their mean up:
          people hold the horizon level; if a plane of points lies within 15 degrees of that, the plane's normal
middle  = the point nearest to all optical axes; the points' median where the axes do not meet before the cameras
span    = the largest angle between two cameras, as seen from the middle
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

TILT = 15.0  # largest angle between the cameras' level and the floor's normal [deg]
TOWARDS_MEAN_UP = 0.005  # weight of the cameras' mean up, for cameras that do not turn around the object
FLOOR = 0.08  # least share of the points that makes a plane a floor
TRIALS = 1000  # planes through three points that are tried
FLAT = 0.01  # thickness of a floor, over the distance of the cameras
PARALLEL = 1e-3  # mean squared sine of the axes' angles below which they are taken as parallel


@dataclass(frozen=True, kw_only=True)
class Aim:
    """What cameras look at, in their own coordinates and units."""

    middle: Float64[np.ndarray, "3"]
    distance: float  # of the cameras from the middle, median
    span: float  # [deg]


def aim(R: Float64[np.ndarray, "n 3 3"], t: Float64[np.ndarray, "n 3"], points: np.ndarray | None) -> Aim | None:
    """Of cameras X_c = R X + t, and points [m, 3] if there are any. None if axes and points leave it open."""
    centres, axes = -np.einsum("nji,nj->ni", R, t), R[:, 2]
    middle = nearest_to_axes(centres, axes)
    across = np.linalg.eigvalsh(np.eye(3) - axes.T @ axes / len(axes))[0]
    ahead = ((middle - centres) * axes).sum(1) > 0
    if across < PARALLEL or ahead.mean() < 0.5:
        if points is None or len(points) == 0:
            return None
        middle = np.median(points, 0)
    away = centres - middle
    distance = np.linalg.norm(away, axis=1)
    if not distance.min() > 0:
        return None
    unit = away / distance[:, None]
    span = float(np.degrees(np.arccos(np.clip(unit @ unit.T, -1, 1)).max()))
    return Aim(middle=middle, distance=float(np.median(distance)), span=span)


def level(R: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, "3"]:
    """Unit up of cameras with world-to-camera rotations R (OpenCV axes), held level by a person."""
    right, up = R[:, 0], -R[:, 1].mean(0)
    up = up / np.linalg.norm(up)
    cost = np.einsum("ni,nj->ij", right, right) / len(R) + TOWARDS_MEAN_UP * (np.eye(3) - np.outer(up, up))
    best = np.linalg.eigh(cost)[1][:, 0]
    return best * (1 if best @ up >= 0 else -1)


def nearest_to_axes(centres: Float64[np.ndarray, "n 3"], axes: Float64[np.ndarray, "n 3"]) -> np.ndarray:
    """The point nearest to all lines through `centres` along the unit vectors `axes`, by least squares."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    return np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centres), rcond=None)[0]


def floor_plane(
    points: Float64[np.ndarray, "n 3"], up: np.ndarray, middle: np.ndarray, thickness: float, seed: int
) -> np.ndarray | None:
    """(n, d) of the plane n.x + d = 0 with unit n near `up`, below `middle`, of the most points; None if there is none.

    Walls and table tops are found first where they have more points, and set aside.
    """
    rng = np.random.default_rng(seed)
    left, total = points, len(points)
    for _ in range(5):
        if len(left) < max(20, FLOOR * total):
            return None
        plane, inside = fullest_plane(left, thickness, rng)
        if inside.sum() < FLOOR * total:
            return None
        plane = plane * (1 if plane[:3] @ up >= 0 else -1)
        if plane[:3] @ up > np.cos(np.radians(TILT)) and plane[:3] @ middle + plane[3] > -2 * thickness:
            return plane
        left = left[~inside]
    return None


def fullest_plane(
    points: Float64[np.ndarray, "n 3"], thickness: float, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "4"], Bool[np.ndarray, " n"]]:
    """((n, d) of the plane n.x + d = 0 with the most points within `thickness`, which these are), of three or more.

    Random sample consensus (Fischler and Bolles 1981), then least squares over the points found. Open3D has it as well,
    but on threads, and finds another plane each time.
    """
    a, b, c = points[rng.integers(len(points), size=(TRIALS, 3))].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)  # three in a row: no plane
    offsets = np.where(length[:, 0] > 0, -(normals * a).sum(1), np.inf)
    near = lambda n, d: np.abs(points @ n + d) < thickness
    inside = near(*max(zip(normals, offsets), key=lambda one: near(*one).sum()))
    if inside.sum() < 3:
        return np.zeros(4), inside  # all in one line
    middle = points[inside].mean(0)
    normal = np.linalg.svd(points[inside] - middle, full_matrices=False)[2][2]
    return np.append(normal, -normal @ middle), inside
