"""The .ply of 3D Gaussian Splatting, as written by its authors' code and read by every viewer.

One vertex per Gaussian, all float32: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0.. (channel by channel), opacity
(logit), scale_0..2 (ln of standard deviations), rot_0..3 (w x y z).

Other programs write more than that, which is read and said: positions of a map (doubles, far from the origin) are
shifted before they become float32; opacity +inf is opaque; scale -inf, or no scale_2, is flat; opacity or scale that
were stored as they are, not as logit or ln, are told by having no value that those could not have.
"""

from pathlib import Path

import numpy as np
import torch

from physics3d.gaussians.model import Gaussians

POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
DC = tuple(f"f_dc_{i}" for i in range(3))
SCALE, ROTATION = tuple(f"scale_{i}" for i in range(3)), tuple(f"rot_{i}" for i in range(4))
FAR = 1000.0  # a model farther from the origin than so many of its own sizes is shifted: float32 has seven digits
OPAQUE = 15.0  # logit of what is opaque: 3e-7 shines through
THIN = np.log(1000.0)  # what is flat is so much thinner than wide [ln]
NO_LOGIT = 60.0  # all above zero and some above this: not what training ends with, which stops growing near 20
LARGEST = 1e37  # float32 holds a little more
VANISHING = -87.0  # ln of the smallest float32


def read_ply(path: Path, *, log=None) -> Gaussians:
    """Read a trained model; what had to be interpreted is said to `log`.

    Raises ValueError naming the file, the property and how many numbers are wrong.
    """
    from plyfile import PlyData, PlyParseError

    if not Path(path).is_file():
        raise ValueError(f"no file {path}; check the path in the scene's configuration")
    try:
        data = PlyData.read(str(path))
    except (PlyParseError, UnicodeDecodeError, ValueError, EOFError) as error:
        raise ValueError(f"{path} is not a readable .ply: {error}") from error
    if "vertex" not in data or data["vertex"].count == 0:
        raise ValueError(f"{path} holds no vertices; it should have one per Gaussian")
    vertex = data["vertex"].data
    have = vertex.dtype.names
    rest = tuple(f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in have)))
    scale = SCALE if "scale_2" in have else SCALE[:2]  # two: a model of flat Gaussians
    needed = (*POSITION, *DC, *rest, "opacity", *scale, *ROTATION)
    missing = [name for name in needed if name not in have]
    if missing:
        kind = "it is compressed; " if "packed_position" in have else ""
        raise ValueError(
            f"{path} lacks {len(missing)} properties of a 3DGS model: {', '.join(missing)}; {kind}export it as 3DGS"
        )
    if len(rest) not in (0, 9, 24, 45):
        raise ValueError(f"{path} has {len(rest)} properties f_rest_*; degrees 0 to 3 have 0, 9, 24 or 45")
    whole = [name for name in needed if vertex.dtype[name].kind != "f"]
    if whole:
        raise ValueError(f"{path}: {', '.join(whole)} are not floating point numbers; export it as 3DGS")

    def columns(names: tuple[str, ...], allowed: float = 0.0) -> np.ndarray:
        """As float64 [n, k]; finite, but for the infinity `allowed`."""
        for name in names:
            with np.errstate(invalid="ignore"):
                bad = int((~(np.abs(vertex[name]) < LARGEST) & (vertex[name] != allowed)).sum())
            if bad:
                raise ValueError(
                    f"{path}: property {name} holds {bad} non-finite numbers of {len(vertex)}; repair the file or drop "
                    "those Gaussians"
                )
        return np.stack([vertex[name].astype(np.float64) for name in names], -1)

    said: list[str] = []
    mean = _near(columns(POSITION), vertex.dtype["x"].itemsize, said)
    dc = columns(DC)[:, None]
    higher = columns(rest).reshape(len(vertex), 3, -1).swapaxes(1, 2) if rest else dc[:, :0]
    opacity = vertex["opacity"].astype(np.float64)
    if np.isnan(opacity).any():
        columns(("opacity",))
    turn = columns(ROTATION)
    lost = int((np.linalg.norm(turn, axis=1) < 1e-12).sum())
    if lost:
        raise ValueError(f"{path}: {lost} Gaussians of {len(vertex)} have no rotation (rot_0..3 are 0); drop those")
    arrays = {
        "mean": mean,
        "log_scale": _log_scale(columns(scale, -np.inf), mean, _is_share(opacity), path, said),
        "quaternion": turn,
        "opacity_logit": _logit(opacity, path, said),
        "sh": np.concatenate([dc, higher], 1),
    }
    gaussians = Gaussians(**{name: torch.from_numpy(a.astype(np.float32)) for name, a in arrays.items()})
    gaussians.check()
    for line in said if log is not None else ():
        log.warn(f"{path}: {line}")
    return gaussians


def _near(mean: np.ndarray, stored_bytes: int, said: list[str]) -> np.ndarray:
    """Positions [n, 3] (double), shifted to the origin where float32 could not hold them."""
    size = float(np.ptp(mean, axis=0).max()) or 1.0
    if np.abs(mean).max() <= FAR * size:
        return mean
    unit = 10.0 ** np.floor(np.log10(size))
    offset = np.round(np.median(mean, 0) / unit) * unit
    shift = ", ".join(f"{s:.12g}" for s in -offset)
    said.append(f"far from the origin: shifted by [{shift}], in the units and axes of the file")
    if stored_bytes < 8:
        step = float(np.spacing(np.float32(np.abs(mean).max())))
        said.append(
            f"positions were rounded to steps of {step:g} before they were stored; export doubles, or shift first"
        )
    return mean - offset


def _is_share(opacity: np.ndarray) -> bool:
    """Whether these are opacities: as logits they would all mean 0.5 to 0.73."""
    return bool(opacity.min() >= 0 and 0 < opacity.max() <= 1)


def _logit(opacity: np.ndarray, path: Path, said: list[str]) -> np.ndarray:
    """Finite. Raises ValueError for what is neither a logit nor an opacity, and for a model that nobody can see."""
    finite = opacity[np.isfinite(opacity)]
    if finite.size and finite.min() >= 0 and finite.max() > NO_LOGIT:
        raise ValueError(
            f"{path}: opacity is {finite.min():.3g} to {finite.max():.3g}, neither logits nor 0..1; export it as 3DGS"
        )
    if _is_share(opacity):
        said.append("opacity lies within 0..1 everywhere: taken as it is, not as a logit")
        with np.errstate(divide="ignore"):
            opacity = np.log(opacity) - np.log1p(-opacity)
    if opacity.max() < -np.log(254):
        raise ValueError(f"{path}: no Gaussian is more opaque than 1/255, so nothing would be seen; export it again")
    if np.isinf(opacity).any():
        said.append(f"{int(np.isinf(opacity).sum())} Gaussians are exactly opaque or exactly transparent")
    return np.where(np.isinf(opacity), np.sign(opacity) * OPAQUE, opacity)


def _log_scale(scale: np.ndarray, mean: np.ndarray, as_is: bool, path: Path, said: list[str]) -> np.ndarray:
    """[n, 3], finite. Raises ValueError if a Gaussian has no size at all."""
    from scipy.spatial import cKDTree

    if scale.min() >= 0 and scale.max() > 0 and len(mean) > 1:
        # ln of sizes above one unit, or sizes? whichever is nearer to the distance of neighbours, by a factor of
        # three in favour of sizes where opacity was stored as it is
        spacing = np.median(cKDTree(mean).query(mean, k=2)[0][:, 1])
        widest = np.median(scale.max(1))
        favour = np.log(3.0) if as_is else 0.0
        if spacing > 0 and widest > 0 and abs(np.log(widest / spacing)) < abs(widest - np.log(spacing)) + favour:
            said.append("scale is positive everywhere and fits the distances as it is: not taken as a logarithm")
            with np.errstate(divide="ignore"):
                scale = np.log(scale)
    if scale.shape[1] == 2:
        said.append("there is no scale_2: Gaussians are flat")
        scale = np.concatenate([scale, np.full((len(scale), 1), -np.inf)], 1)
    if scale.max() > -VANISHING:
        raise ValueError(
            f"{path}: {int((scale > -VANISHING).any(1).sum())} Gaussians of {len(scale)} have scale up to "
            f"{scale.max():.3g}, of which the exponential is no number; drop those"
        )
    flat = scale < VANISHING
    points = int(flat.all(1).sum())
    if points:
        raise ValueError(f"{path}: {points} Gaussians of {len(scale)} have no size in any direction; drop those")
    if flat.any():
        said.append(f"{int(flat.any(1).sum())} Gaussians are flat: given a thickness of a thousandth of their width")
    return np.where(flat, scale.max(1, keepdims=True) - THIN, scale)


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Write a model in binary little endian. Raises ValueError if it is not sound, OSError on a full disk."""
    from plyfile import PlyData, PlyElement

    gaussians.check()
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    columns = {
        POSITION: gaussians.mean,
        NORMAL: torch.zeros_like(gaussians.mean),
        DC: gaussians.sh[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): gaussians.opacity_logit[:, None],
        SCALE: gaussians.log_scale,
        ROTATION: gaussians.quaternion,
    }
    vertex = np.empty(len(gaussians), dtype=[(name, "<f4") for names in columns for name in names])
    for names, values in columns.items():
        for name, column in zip(names, values.detach().cpu().float().numpy().T):
            vertex[name] = column
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))
