"""The .ply of 3D Gaussian Splatting, as written by its authors' code and read by every viewer.

One vertex per Gaussian, all float32: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0.. (channel by channel), opacity
(logit), scale_0..2 (ln of standard deviations), rot_0..3 (w x y z).
"""

from pathlib import Path

import numpy as np
import torch

from physics3d.gaussians.model import Gaussians

POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
DC = tuple(f"f_dc_{i}" for i in range(3))
SCALE, ROTATION = tuple(f"scale_{i}" for i in range(3)), tuple(f"rot_{i}" for i in range(4))


def read_ply(path: Path) -> Gaussians:
    """Read a trained model. Raises ValueError naming the file, the property and how many numbers are wrong."""
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
    missing = [name for name in (*POSITION, *DC, *rest, "opacity", *SCALE, *ROTATION) if name not in have]
    if missing:
        raise ValueError(
            f"{path} lacks {len(missing)} properties of a 3DGS model: {', '.join(missing)}; export it as 3DGS"
        )
    if len(rest) not in (0, 9, 24, 45):
        raise ValueError(f"{path} has {len(rest)} properties f_rest_*; degrees 0 to 3 have 0, 9, 24 or 45")

    def columns(names: tuple[str, ...]) -> torch.Tensor:
        for name in names:
            bad = int((~np.isfinite(vertex[name])).sum())
            if bad:
                raise ValueError(
                    f"{path}: property {name} holds {bad} non-finite numbers of {len(vertex)}; repair the file or drop "
                    "those Gaussians"
                )
        return torch.from_numpy(np.stack([vertex[name].astype(np.float32) for name in names], -1))

    dc = columns(DC)[:, None]
    higher = columns(rest).reshape(len(vertex), 3, -1).transpose(1, 2) if rest else dc[:, :0]
    gaussians = Gaussians(
        mean=columns(POSITION),
        log_scale=columns(SCALE),
        quaternion=columns(ROTATION),
        opacity_logit=columns(("opacity",))[:, 0],
        sh=torch.cat([dc, higher], 1),
    )
    gaussians.check()
    return gaussians


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
