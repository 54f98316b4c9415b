"""Structure from motion: photographs without cameras -> cameras, lens and points, by COLMAP.

    match SIFT features over all pairs (of a video: over neighbours), place one photograph after the other, adjust all
    (of a video: what is not placed is compared with all, and all placed once more)

COLMAP begins with two photographs whose directions to the same points differ by `FIRST_ANGLES`: many where the
photographer walked around, few where all look the same way, so that smaller angles are tried before giving up.
It fixes neither the unit of length, nor where up is, nor the origin; `upright` chooses them (`ground.py`):

    up      = the normal of the floor where there is one, else how the cameras were held
    origin  = the point nearest to all optical axes, dropped onto the floor (z = 0) where there is one
    scale   = camera distance / median distance of the cameras from that point                        [m per unit]

Stills of clips can be placed among the photographs. They have a lens of their own, are compared with every photograph
and not with each other (a stand gives no parallax), and neither up, origin nor scale follows from them.

Schönberger and Frahm (2016); pycolmap is an optional extra.
"""

import contextlib
import signal
import sqlite3
import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from physics3d.scenes.axes import Axes
from physics3d.scenes.ground import FLAT, aim, floor_plane, level
from physics3d.scenes.parallax import share_explained

LEAST_PLACED = 0.5  # share of the photographs that must get a camera
MOST_EXHAUSTIVE = 120  # photographs: above that, only neighbours in the order of their names are compared
NEIGHBOURS = 10  # photographs after each that are compared in a video, and those 2, 4, 8, ... after, up to 2^10
FEATURES = 4096  # of a photograph, at most: the largest
PAIRS_AT_ONCE = 24  # compared between two looks at the progress
FIRST_ANGLES = (16.0, 8.0, 4.0, 2.0)  # tried for the first two photographs [deg]
STANDING = 0.4  # share of the matches that a camera in one place explains above which it did not move
PAIRS_ASKED = 40  # pairs of photographs of which that is asked


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How well the camera of one picture explains the points that it was placed by."""

    points: int
    error: float  # root mean square of the distance between a point's image and where it was seen [px]


@dataclass(frozen=True, kw_only=True)
class Solved:
    """What came out: a COLMAP folder with `images` and `sparse/0`, metres, z up."""

    folder: Path
    placed: tuple[str, ...]  # names of the photographs that have a camera
    lost: tuple[str, ...]  # ... and of those that have none
    error: float  # mean reprojection error [px]
    span: float  # largest angle between two cameras, seen from what they look at [deg]
    floor: bool  # whether a plane of points was taken as the floor
    stills: dict[str, Fit] = field(default_factory=dict)  # by the name of each still


def solve(
    images: Path,
    folder: Path,
    *,
    ordered: bool,
    camera_distance: float,
    seed: int,
    log,
    stills: Mapping[str, str] | None = None,
) -> Solved:
    """Cameras of the pictures in and below `images`, written below `folder`.

    All photographs are by one lens if they are of one size, and so are all `stills`, names of pictures -> the clips
    that they were taken from. Raises ValueError, with what to do, if pycolmap is missing, the camera did not move,
    fewer than half of the photographs can be placed, or one of the stills cannot.
    """
    pycolmap = _pycolmap()
    stills = dict(stills or {})
    found = (p.relative_to(images).as_posix() for p in images.rglob("*") if p.is_file())
    names = sorted(name for name in found if name not in stills)
    if len(names) < 3:
        raise ValueError(f"structure from motion needs at least 3 photographs, there are {len(names)}; take about 30")
    pycolmap.set_random_seed(seed)
    database = folder / "database.db"
    _extract(pycolmap, database, images, names, log)
    if stills:
        _extract(pycolmap, database, images, sorted(stills), log)
        _match(
            pycolmap,
            database,
            folder / "pairs.txt",
            [(s, n) for s in sorted(stills) for n in names],
            seed=seed,
            log=log,
        )
        for still, clip in stills.items():  # before the many pairs of photographs are compared
            if not _compared(pycolmap, database, still):
                raise _unplaced(clip, "not one photograph shows what it shows")
    _match(pycolmap, database, folder / "pairs.txt", pairs(names, ordered=ordered), seed=seed, log=log)
    standing = share_explained(_matches(pycolmap, database, without=set(stills)), _longest_side(pycolmap, database))
    if standing is not None:
        log.metric("matches_without_parallax", standing)
    if standing is not None and standing > STANDING:
        raise ValueError(
            f"the camera must move: one that stands still, turns or zooms explains {100 * standing:.0f} % of what the "
            f"{len(names)} pictures have in common, so they say nothing of depth; walk around the thing"
        )
    every, compared = [*names, *stills], set(pairs(names, ordered=ordered))
    model, angle = _placed(pycolmap, database, images, folder / "models", every, seed, log, needed=set(stills))
    have = _have(model)
    unplaced = {name for name in names if name not in have}
    left = [pair for pair in combinations(names, 2) if set(pair) & unplaced and pair not in compared]
    if 0 < len(left) <= MOST_EXHAUSTIVE**2 / 2:  # where a walk comes by again, neighbours are not those in time
        log.info(f"{len(unplaced)} photographs are not placed: comparing them with all others")
        _match(pycolmap, database, folder / "pairs.txt", left, seed=seed, log=log)
        other, its_angle = _placed(pycolmap, database, images, folder / "again", every, seed, log, needed=set(stills))
        if other is not None and (model is None or _worth(other, set(stills)) > _worth(model, set(stills))):
            model, angle, have = other, its_angle, _have(other)
    placed, lost = tuple(n for n in names if n in have), tuple(n for n in names if n not in have)
    if model is None or not _enough(len(placed), len(names)):
        raise ValueError(
            f"only {len(placed)} of {len(names)} photographs could be placed (not: {', '.join(lost[:6])}"
            f"{', ...' if len(lost) > 6 else ''}); take sharp ones, each overlapping the one before by two thirds, "
            "with texture around the object (a newspaper under it helps), or give cameras: scene.source ColmapSource"
        )
    for name, clip in stills.items():
        if name not in have:
            raise _unplaced(clip, f"too little of it is seen in the {len(placed)} photographs that were placed")
    if angle < FIRST_ANGLES[0]:
        log.warn(
            f"began with two photographs whose directions differ by {angle:g} degrees, for {FIRST_ANGLES[0]:g} placed "
            "fewer pictures, or not all clips"
        )
    floor, span = upright(model, camera_distance, seed, without=set(stills))
    model.write(_made(folder / "sparse" / "0"))
    error = float(model.compute_mean_reprojection_error())
    fits = {name: _fit(model, name) for name in stills}
    return Solved(folder=folder, placed=placed, lost=lost, error=error, span=span, floor=floor, stills=fits)


def upright(model, camera_distance: float, seed: int, *, without: Collection[str] = ()) -> tuple[bool, float]:
    """Turn, scale and shift a pycolmap.Reconstruction as told above, in place, whatever the pictures `without` say.

    Whether there is a floor, and the angle that the cameras span [deg]. Raises ValueError where they look apart.
    """
    pycolmap = _pycolmap()
    asked = [i for i in model.images.values() if i.has_pose and i.name not in without]
    poses = np.stack([i.cam_from_world().matrix() for i in asked])
    points = np.stack([p.xyz for p in model.points3D.values()])
    R, t = poses[:, :, :3], poses[:, :, 3]
    seen = aim(R, t, points)
    if seen is None:
        raise ValueError("the cameras look at no common place; photograph one thing from several sides")
    up, origin = level(R), seen.middle
    plane = floor_plane(points, up, seen.middle, FLAT * seen.distance, seed)
    if plane is not None:
        up = plane[:3]
        origin = seen.middle - (seen.middle @ up + plane[3]) * up
    scale = camera_distance / seen.distance
    Q = Axes(up=(float(up[0]), float(up[1]), float(up[2])), scale=1.0).rotation().numpy()
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(Q), -scale * Q @ origin))
    return plane is not None, seen.span


def pairs(names: list[str], *, ordered: bool) -> list[tuple[str, str]]:
    """Which photographs are compared: all, or in a video (and of very many) each with those that follow."""
    n = len(names)
    if ordered or n > MOST_EXHAUSTIVE:
        steps = sorted({*range(1, NEIGHBOURS + 1), *(2**k for k in range(NEIGHBOURS + 1))})
    else:
        steps = list(range(1, n))
    return [(names[i], names[i + step]) for step in steps for i in range(n - step)]


def _extract(pycolmap, database: Path, images: Path, names: list[str], log) -> None:
    """Features of all photographs, the largest `FEATURES` of each: COLMAP keeps whole octaves, up to twice as many."""
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = FEATURES
    options.num_threads = 1  # pictures are numbered as they are finished, and the answer hangs on their numbers
    mode = pycolmap.CameraMode.SINGLE if _one_size(images, names) else pycolmap.CameraMode.PER_IMAGE
    reader = pycolmap.ImageReaderOptions()
    for some in log.progress([names[i : i + 4] for i in range(0, len(names), 4)], "finding features, by four"):
        pycolmap.extract_features(
            database, images, some, camera_mode=mode, reader_options=reader, extraction_options=options
        )
        if mode == pycolmap.CameraMode.SINGLE:
            reader.existing_camera_id = _camera(pycolmap, database, names[0])  # the lens of the first
    with contextlib.closing(sqlite3.connect(database)) as db, db:
        rows = db.execute("SELECT image_id, rows, cols, data FROM keypoints WHERE rows > ?", (FEATURES,)).fetchall()
        for image, count, columns, data in rows:
            keypoints = np.frombuffer(data, np.float32).reshape(count, columns)
            (described,) = db.execute("SELECT data FROM descriptors WHERE image_id = ?", (image,)).fetchone()
            descriptors = np.frombuffer(described, np.uint8).reshape(count, -1)
            area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])  # x, y, 2 x 2 shape
            kept = np.sort(np.argsort(-area, kind="stable")[:FEATURES])
            for table, array in (("keypoints", keypoints), ("descriptors", descriptors)):
                db.execute(
                    f"UPDATE {table} SET rows = ?, data = ? WHERE image_id = ?",
                    (len(kept), array[kept].tobytes(), image),
                )


def _camera(pycolmap, database: Path, name: str) -> int:
    """COLMAP's number of the lens of a picture."""
    opened = pycolmap.Database.open(database)
    try:
        return opened.read_image_with_name(name).camera_id
    finally:
        opened.close()


def _match(pycolmap, database: Path, list_file: Path, wanted: list[tuple[str, str]], *, seed: int, log) -> None:
    options, verification = pycolmap.ImportedPairingOptions(), pycolmap.TwoViewGeometryOptions()
    options.match_list_path, verification.ransac.random_seed = list_file, seed
    bar = log.progress(None, "comparing pairs of photographs", total=len(wanted))
    for i in range(0, len(wanted), PAIRS_AT_ONCE):
        some = wanted[i : i + PAIRS_AT_ONCE]
        list_file.write_text("".join(f"{a} {b}\n" for a, b in some))
        pycolmap.match_image_pairs(database, pairing_options=options, verification_options=verification)
        bar.update(len(some))
    bar.close()


def _compared(pycolmap, database: Path, name: str) -> bool:
    """Whether any other picture shows the same points as this one."""
    opened = pycolmap.Database.open(database)
    try:
        own = opened.read_image_with_name(name).image_id
    finally:
        opened.close()
    with contextlib.closing(sqlite3.connect(database)) as db:
        shared = [i for (i,) in db.execute("SELECT pair_id FROM two_view_geometries WHERE rows > 0")]
    return any(own in pycolmap.pair_id_to_image_pair(pair) for pair in shared)


def _unplaced(clip: str, why: str) -> ValueError:
    return ValueError(
        f"{clip}: its camera cannot be found, {why}; film the thing where it is photographed, in the same light, and "
        "take some of the photographs from where the clip is filmed; or take the clip out of the folder"
    )


def _fit(model, name: str) -> Fit:
    """Of one picture that is placed."""
    image = model.find_image_with_name(name)
    seen = [p for p in image.points2D if p.has_point3D()]
    points = np.stack([model.points3D[p.point3D_id].xyz for p in seen])
    local = image.cam_from_world() * points
    off = image.camera.img_from_cam(local) - np.stack([p.xy for p in seen])
    return Fit(points=len(seen), error=float(np.sqrt((off**2).sum(1).mean())))


def _matches(pycolmap, database: Path, *, without: Collection[str] = ()):
    """Verified matches of pairs of photographs, spread over all pairs, from the middle of the pictures [px]."""
    opened = pycolmap.Database.open(database)
    try:
        cameras = {c.camera_id: np.array([c.width, c.height]) / 2 for c in opened.read_all_cameras()}
        pictures = opened.read_all_images()
        middle = {i.image_id: cameras[i.camera_id] for i in pictures}
        skipped = {i.image_id for i in pictures if i.name in without}
        with contextlib.closing(sqlite3.connect(database)) as db:
            found = [
                i for (i,) in db.execute("SELECT pair_id FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id")
            ]
        found = [i for i in found if not skipped & set(pycolmap.pair_id_to_image_pair(i))]
        for k in np.unique(np.linspace(0, len(found) - 1, min(len(found), PAIRS_ASKED)).round().astype(int)):
            a, b = pycolmap.pair_id_to_image_pair(found[k])
            index = np.asarray(opened.read_two_view_geometry(a, b).inlier_matches)
            yield tuple(opened.read_keypoints(i)[index[:, c], :2] - middle[i] for c, i in enumerate((a, b)))
    finally:
        opened.close()


def _longest_side(pycolmap, database: Path) -> float:
    opened = pycolmap.Database.open(database)
    try:
        return float(max(max(c.width, c.height) for c in opened.read_all_cameras()))
    finally:
        opened.close()


def _placed(
    pycolmap, database: Path, images: Path, folder: Path, names: list[str], seed: int, log, needed: Collection[str] = ()
):
    """The pycolmap.Reconstruction with the most of what is `needed`, and of those the largest (None: nothing), and the
    first angle that gave it [deg]."""
    best, its_angle, most = None, FIRST_ANGLES[0], (0, 0)
    for angle in FIRST_ANGLES:
        options = pycolmap.IncrementalPipelineOptions()
        options.min_model_size, options.mapper.init_min_tri_angle = 3, angle
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
        options.num_threads = options.mapper.num_threads = 1  # sums of many threads are another answer each time
        bar = log.progress(None, f"placing photographs, from {angle:g} degrees", total=len(names))
        models = pycolmap.incremental_mapping(
            database,
            images,
            _made(folder / f"{angle:g}"),
            options,
            next_image_callback=lambda bar=bar: bar.update() and None,
        )
        bar.close()
        for model in models.values():
            worth = _worth(model, needed)
            if worth > most:
                best, its_angle, most = model, angle, worth
        if most[0] == len(needed) and _enough(most[1], len(names)):
            break
    return best, its_angle


def _have(model) -> set[str]:
    """The pictures that have a camera; of no model none."""
    return {image.name for image in model.images.values() if image.has_pose} if model else set()


def _worth(model, needed: Collection[str]) -> tuple[int, int]:
    """How many of the pictures `needed` it has placed, and how many in all."""
    if not needed:
        return 0, model.num_reg_images()
    return len(_have(model) & set(needed)), model.num_reg_images()


def _enough(placed: int, of: int) -> bool:
    return placed >= max(3, LEAST_PLACED * of)


def _pycolmap():
    # before pycolmap, whose own compression library Pillow would otherwise be bound to: writing a PNG then crashes
    from PIL import Image  # noqa: F401

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
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value  # what failed is said by us, in one line
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
