"""Structure from motion: photographs without cameras -> pinhole cameras, undistorted photographs and points, by COLMAP.

    match SIFT features over all pairs (of a video: over neighbours), place one photograph after the other, adjust all

COLMAP fixes neither the unit of length, nor where up is, nor the origin; `upright` chooses them:

    up      = the unit u of least  mean_i (u.x_i)^2 + 0.005 |u - (u.y) y|^2,  x_i the cameras' right, y their mean up:
              people hold the horizon level; if a plane of points lies within 15 degrees of that, the plane's normal
    origin  = the point nearest to all optical axes, dropped onto that plane (the floor, z = 0) where there is one
    scale   = camera distance / median distance of the cameras from that point                        [m per unit]

Schönberger and Frahm (2016); pycolmap is an optional extra.
"""

import signal
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from physics3d.open3d_import import open3d
from physics3d.scenes.axes import Axes

LEAST_PLACED = 0.5  # share of the photographs that must get a camera
MOST_EXHAUSTIVE = 120  # photographs: above that, only neighbours in the order of their names are compared
FEATURES = 4096  # of a photograph, at most
TILT = 15.0  # largest angle between the cameras' level and the floor's normal [deg]
TOWARDS_MEAN_UP = 0.005  # weight of the cameras' mean up, for cameras that do not turn around the object
FLOOR = 0.08  # least share of the points that makes a plane a floor
FLAT = 0.01  # thickness of a floor, over the distance of the cameras


@dataclass(frozen=True, kw_only=True)
class Solved:
    """What came out: a COLMAP folder with `images` and `sparse/0`, metres, z up."""

    folder: Path
    placed: tuple[str, ...]  # names of the photographs that have a camera
    lost: tuple[str, ...]  # ... and of those that have none
    error: float  # mean reprojection error [px]
    floor: bool  # whether a plane of points was taken as the floor


def solve(images: Path, folder: Path, *, ordered: bool, camera_distance: float, seed: int, log) -> Solved:
    """Cameras of the photographs in `images`, all by one lens if they are of one size; written below `folder`.

    Raises ValueError, with what to do, if pycolmap is missing or fewer than half of the photographs can be placed.
    """
    pycolmap = _pycolmap()
    names = sorted(p.name for p in images.iterdir())
    if len(names) < 3:
        raise ValueError(f"structure from motion needs at least 3 photographs, there are {len(names)}; take about 30")
    pycolmap.set_random_seed(seed)
    database = folder / "database.db"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = FEATURES
    mode = pycolmap.CameraMode.SINGLE if _one_size(images, names) else pycolmap.CameraMode.PER_IMAGE
    reader = pycolmap.ImageReaderOptions()
    for some in log.progress([names[i : i + 4] for i in range(0, len(names), 4)], "finding features, by four"):
        pycolmap.extract_features(
            database, images, some, camera_mode=mode, reader_options=reader, extraction_options=extraction
        )
        if mode == pycolmap.CameraMode.SINGLE:
            reader.existing_camera_id = 1  # the lens of the first
    log.info(f"matching the features of {len(names)} photographs")
    if ordered or len(names) > MOST_EXHAUSTIVE:
        pycolmap.match_sequential(database)
    else:
        pycolmap.match_exhaustive(database)
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size, options.random_seed = 3, seed
    placing = log.progress(None, "placing photographs", total=len(names))
    models = pycolmap.incremental_mapping(
        database, images, _made(folder / "models"), options, next_image_callback=lambda: placing.update() and None
    )
    placing.close()
    model = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    placed = sorted(i.name for i in model.images.values() if i.has_pose) if model else []
    lost = tuple(n for n in names if n not in set(placed))
    if model is None or len(placed) < max(3, LEAST_PLACED * len(names)):
        raise ValueError(
            f"only {len(placed)} of {len(names)} photographs could be placed (not: {', '.join(lost[:6])}"
            f"{', ...' if len(lost) > 6 else ''}); take sharp ones, each overlapping the one before by two thirds, "
            "with texture around the object (a newspaper under it helps), or give cameras: scene.source ColmapSource"
        )
    floor = upright(model, camera_distance, seed)
    model.write(_made(folder / "upright"))
    pycolmap.undistort_images(folder / "pinhole", folder / "upright", images, jpeg_quality=97)
    _made(folder / "pinhole" / "sparse" / "0")
    for file in (folder / "pinhole" / "sparse").glob("*.bin"):
        file.rename(file.parent / "0" / file.name)
    error = float(model.compute_mean_reprojection_error())
    return Solved(folder=folder / "pinhole", placed=tuple(placed), lost=lost, error=error, floor=floor)


def upright(model, camera_distance: float, seed: int) -> bool:
    """Turn, scale and shift a pycolmap.Reconstruction as told above, in place. Whether there is a floor."""
    pycolmap = _pycolmap()
    poses = np.stack([i.cam_from_world().matrix() for i in model.images.values() if i.has_pose])
    points = np.stack([p.xyz for p in model.points3D.values()])
    R, t = poses[:, :, :3], poses[:, :, 3]
    centres = -np.einsum("nji,nj->ni", R, t)
    middle = nearest_to_axes(centres, R[:, 2])
    reach = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    up, origin = level(R), middle
    plane = floor_plane(points, up, middle, FLAT * reach, seed)
    if plane is not None:
        up = plane[:3]
        origin = middle - (middle @ up + plane[3]) * up
    scale = camera_distance / reach
    Q = Axes(up=(float(up[0]), float(up[1]), float(up[2])), scale=1.0).rotation().numpy()
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(Q), -scale * Q @ origin))
    return plane is not None


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
    o3d = open3d()
    o3d.utility.random.seed(seed)
    left, total = points, len(points)
    for _ in range(5):
        if len(left) < max(20, FLOOR * total):
            return None
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(left))
        plane, inside = cloud.segment_plane(thickness, 3, 1000)
        if len(inside) < FLOOR * total:
            return None
        plane = np.asarray(plane) / np.linalg.norm(plane[:3])
        plane = plane * (1 if plane[:3] @ up >= 0 else -1)
        if plane[:3] @ up > np.cos(np.radians(TILT)) and plane[:3] @ middle + plane[3] > -2 * thickness:
            return plane
        left = np.delete(left, inside, 0)
    return None


def _pycolmap():
    handler = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise ValueError(
            "photographs without cameras need pycolmap, which is not installed; .venv/bin/python -m pip install "
            "pycolmap (it is the extra 'sfm'), or solve the cameras elsewhere and take ColmapSource"
        ) from error
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)  # COLMAP's would end the process with a stack of C++
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    return pycolmap


def _one_size(images: Path, names: list[str]) -> bool:
    from PIL import Image

    sizes = set()
    for name in names:
        with Image.open(images / name) as file:
            sizes.add(file.size)
    return len(sizes) == 1


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
