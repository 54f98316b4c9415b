"""Writers of small captures in every format, all from the same cameras and points, so that loaders must agree."""

import json
import struct
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.scenes.axes import Axes

WIDTH, HEIGHT, FOCAL = 48, 36, 60.0


def cameras(count: int = 5) -> list[Camera]:
    """On a spiral around the origin, in metres with z up; square pixels, central principal point (as Blender has)."""
    found = []
    for i in range(count):
        a = 2 * np.pi * i / count
        position = torch.tensor([0.9 * np.cos(a), 0.9 * np.sin(a), 0.25 + 0.1 * i], dtype=torch.float64)
        found.append(
            Camera(
                width=WIDTH,
                height=HEIGHT,
                fx=FOCAL,
                fy=FOCAL,
                cx=WIDTH / 2,
                cy=HEIGHT / 2,
                world_to_camera=look_at(position, torch.tensor([0.02, -0.01, 0.1])),
            )
        )
    return found


def points() -> tuple[torch.Tensor, torch.Tensor]:
    """[n, 3] in metres, colours [n, 3] uint8."""
    rng = np.random.default_rng(1)
    return torch.from_numpy(rng.uniform(-0.2, 0.2, (20, 3))), torch.from_numpy(
        rng.integers(0, 256, (20, 3), dtype=np.uint8)
    )


def picture(camera: Camera, points_: torch.Tensor, colors: torch.Tensor) -> np.ndarray:
    """Grey, with a pixel of its colour where each point is seen."""
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    uv, depth = camera.project(points_)
    for (u, v), z, color in zip(uv.floor().long().tolist(), depth.tolist(), colors.numpy()):
        if z > 0 and 0 <= u < WIDTH and 0 <= v < HEIGHT:
            image[v, u] = color
    return image


def to_source(camera: Camera, axes: Axes) -> torch.Tensor:
    """world_to_camera in the coordinates of a source with these axes."""
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3] = camera.world_to_camera[:3, :3] @ axes.rotation()
    M[:3, 3] = camera.world_to_camera[:3, 3] / axes.scale
    return M


def opengl_pose(world_to_camera: torch.Tensor) -> torch.Tensor:
    """camera_to_world whose columns are the camera's right, up (against OpenCV's y), backward (against z) and place."""
    R, t = world_to_camera[:3, :3], world_to_camera[:3, 3]
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.stack([R[0], -R[1], -R[2], -R.T @ t], 1)
    return pose


def points_to_source(axes: Axes) -> np.ndarray:
    return (points()[0] @ axes.rotation() / axes.scale).numpy()


def write_images(folder: Path, name: str = "{:02d}.png") -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    names = [name.format(i) for i in range(len(cameras()))]
    for file, camera in zip(names, cameras()):
        Image.fromarray(picture(camera, *points())).save(folder / file)
    return names


def write_transforms(folder: Path, axes: Axes, *, blender: bool) -> None:
    names = write_images(folder / "images")
    frames = []
    for name, camera in zip(names, cameras()):
        pose = opengl_pose(to_source(camera, axes))
        file = f"./images/{name}".removesuffix(".png") if blender else f"images/{name}"
        frames.append({"file_path": file, "transform_matrix": pose.tolist()})
    head = (
        {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL)}
        if blender
        else {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    )
    (folder / "transforms.json").write_text(json.dumps({**head, "frames": frames[::-1]}))
    np.savez(folder / "points3D.npz", xyz=points_to_source(axes).astype(np.float32), rgb=points()[1].numpy())


def quaternion(R: torch.Tensor) -> list[float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(R.numpy()).as_quat().tolist()
    return [w, x, y, z]


def write_colmap(folder: Path, axes: Axes, *, binary: bool) -> None:
    names = write_images(folder / "images")
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    xyz, rgb = points_to_source(axes), points()[1].numpy()
    poses = [to_source(camera, axes) for camera in cameras()]
    rows = [(quaternion(M[:3, :3]), M[:3, 3].tolist()) for M in poses]
    if not binary:
        (sparse / "cameras.txt").write_text(
            f"# comment\n1 SIMPLE_PINHOLE {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
            f"2 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
        )
        lines = ["# comment"]
        for i, (name, (q, t)) in enumerate(zip(names, rows)):
            lines += [" ".join(map(repr, [i + 1, *q, *t])) + f" {1 + i % 2} {name}", "1.0 2.0 1" if i % 2 else ""]
        (sparse / "images.txt").write_text("\n".join(lines) + "\n")
        every = " ".join(f"{i + 1} 0" for i in range(len(names)))
        (sparse / "points3D.txt").write_text(
            "".join(
                f"{i + 1} {' '.join(map(repr, p.tolist()))} {' '.join(map(str, c.tolist()))} 0.5 {every}\n"
                for i, (p, c) in enumerate(zip(xyz, rgb))
            )
        )
        return
    data = struct.pack("<Q", 2)
    data += struct.pack("<iiQQ3d", 1, 0, WIDTH, HEIGHT, FOCAL, WIDTH / 2, HEIGHT / 2)
    data += struct.pack("<iiQQ4d", 2, 1, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (sparse / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(names))
    for i, (name, (q, t)) in enumerate(zip(names, rows)):
        data += struct.pack("<i7di", i + 1, *q, *t, 1 + i % 2) + name.encode() + b"\0"
        data += struct.pack("<Q", i) + i * struct.pack("<ddq", 1.0, 2.0, -1)
    (sparse / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(xyz))
    for i, (p, c) in enumerate(zip(xyz, rgb)):
        data += struct.pack("<Q3d3BdQ", i + 1, *p, *map(int, c), 0.5, len(names))
        for j in range(len(names)):
            data += struct.pack("<ii", j + 1, 0)
    (sparse / "points3D.bin").write_bytes(data)
    (sparse / "rigs.bin").write_bytes(b"not needed")
    (sparse / "frames.bin").write_bytes(b"not needed")


def write_pac_nerf(folder: Path, axes: Axes) -> None:
    """Three frames; the matte shows the left half."""
    (folder / "data").mkdir(parents=True)
    entries = []
    for c, camera in enumerate(cameras()):
        pose = opengl_pose(to_source(camera, axes))
        K = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
        for t in range(-1, 4):
            entry = {"file_path": f"./data/r_{c}_{t}.png", "time": t / 24, "c2w": pose[:3].tolist(), "intrinsic": K}
            entries.append(entry)
            if 0 <= t < 3:  # the first and the last instant have no mattes, as in the published files
                image = picture(camera, *points())
                image[t] = 0
                matte = np.where(np.arange(WIDTH) < WIDTH // 2, 255, 0).astype(np.uint8)
                rgba = np.dstack([image, np.broadcast_to(matte, (HEIGHT, WIDTH))])
                Image.fromarray(rgba).save(folder / "data" / f"a_{c}_{t}.png")
    (folder / "all_data.json").write_text(json.dumps(entries[::-1]))
