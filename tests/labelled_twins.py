"""Twins whose labels are known: photographs of meshes, the part that each pixel shows, and Gaussians on the meshes.

A pixel belongs to the part that covers most of it (4 x 4 rays). Gaussians are discs on what some camera sees, with the
label of their mesh, so that no reconstruction is in the way; one of a reconstruction has that of the nearest surface.
"""

from dataclasses import dataclass

import numpy as np
import torch
from analytic_bodies import discs, joined

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.open3d_import import open3d
from physics3d.scenes.ball import RADIUS, checkered_ball
from physics3d.scenes.base import Capture
from physics3d.scenes.carnation import TARGET, photographers
from physics3d.scenes.flower import plant, surroundings
from physics3d.scenes.studio import Light, Mesh, Studio, photographs
from physics3d.segmentation.pixels import depth_in
from physics3d.segmentation.prompts import Prompt

RAYS = 4  # along each side of a pixel
DRAWN_WIDE = 0.02  # by which a person draws a box too large, of the image
NOTHING = 0xFFFFFFFF  # what a ray that hits nothing answers


@dataclass(frozen=True)
class Twin:
    capture: Capture
    studio: Studio
    label_of_mesh: np.ndarray  # [meshes], 0 is static
    parts: tuple[str, ...]  # of labels 1, 2, ...

    def true_map(self, camera: Camera) -> np.ndarray:
        """Label [h, w] of the part that covers most of each pixel."""
        scene, (eye, through) = self.studio.pose().scene, camera.rays()
        right, down = camera.world_to_camera[:2, :3].float().numpy()
        cover = np.zeros((1 + len(self.parts), camera.height, camera.width))
        at = (np.arange(RAYS) + 0.5) / RAYS - 0.5
        for du, dv in np.stack(np.meshgrid(at, at), -1).reshape(-1, 2):
            direction = through.numpy() + du / camera.fx * right + dv / camera.fy * down
            rays = np.concatenate([np.broadcast_to(eye.numpy(), direction.shape), direction], -1)
            face = scene.cast_rays(tensor(rays))["primitive_ids"].numpy()
            shown = np.where(face == NOTHING, 0, self._label(np.where(face == NOTHING, 0, face)))
            cover += shown == np.arange(len(cover))[:, None, None]
        return cover.argmax(0)

    def nearest_label(self, point: np.ndarray) -> np.ndarray:
        """Label [n] of the surface nearest to points [n, 3] [m]."""
        return self._label(self.studio.pose().scene.compute_closest_points(tensor(point))["primitive_ids"].numpy())

    def gaussians(self, count: int, seed: int) -> tuple[Gaussians, torch.Tensor]:
        """About `count` discs on what some camera sees, half of them on what has a label, and their labels."""
        rng, corner = np.random.default_rng(seed), self.studio.vertices[self.studio.faces]
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        twice_area, of_face = np.linalg.norm(cross, axis=1), self._label(np.arange(len(corner)))
        made, labels = [], []
        for chosen in (of_face > 0, of_face == 0):
            weight = twice_area * chosen
            face = rng.choice(len(corner), 2 * count, p=weight / weight.sum())
            u, v = rng.random((2, len(face), 1))
            u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
            point = (1 - u - v) * corner[face, 0] + u * corner[face, 1] + v * corner[face, 2]
            normal = cross[face] / twice_area[face, None]
            keep = np.flatnonzero(self._seen(point, normal))
            keep = keep[: count // 2]
            sigma = 0.9 * np.sqrt(weight.sum() / 2 / len(face) * max(1, len(keep) / (count / 2)))
            made.append(discs(point[keep], normal[keep], rng, sigma=float(sigma), thickness=2e-4))
            labels.append(of_face[face[keep]])
        return joined(*made), torch.from_numpy(np.concatenate(labels))

    def prompts(self, view: int, clicks: int) -> tuple[Prompt, ...]:
        """What a person says: round each part a box drawn a little wide, clicks on it and on what else is in there."""
        camera = self.capture.cameras[view]
        eye, through = camera.rays()
        rays = np.concatenate([np.broadcast_to(eye.numpy(), through.shape), through.numpy()], -1)
        face = self.studio.pose().scene.cast_rays(tensor(rays))["primitive_ids"].numpy()
        thing = np.where(face == NOTHING, -1, self.studio.owner[np.where(face == NOTHING, 0, face).astype(np.int64)])
        label, size, said = np.append(self.label_of_mesh, 0)[thing], np.array([camera.width, camera.height]), []
        for k, part in enumerate(self.parts, 1):
            v, u = np.nonzero(label == k)
            low, high = (np.array([f(u), f(v)]) / size for f in (np.min, np.max))
            box = np.concatenate([np.clip(low - DRAWN_WIDE, 0, 1), np.clip(high + DRAWN_WIDE, 0, 1)])
            inside = np.zeros(label.shape, bool)
            inside[
                round(box[1] * size[1]) : round(box[3] * size[1]), round(box[0] * size[0]) : round(box[2] * size[0])
            ] = 1
            others = np.unique(thing[inside & (label != k)])
            positive = widest(label == k, clicks)
            negative = np.concatenate([widest(inside & (thing == other) & (label != k), 2) for other in others])
            said.append(
                Prompt(
                    part=part,
                    view=view,
                    box=tuple(box.tolist()),
                    positive=tuple(map(tuple, (positive / size).tolist())),
                    negative=tuple(map(tuple, (negative / size).tolist())),
                )
            )
        return tuple(said)

    def _label(self, face: np.ndarray) -> np.ndarray:
        return self.label_of_mesh[self.studio.owner[face.astype(np.int64)]]

    def _seen(self, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
        pose, seen = self.studio.pose(), np.zeros(len(point), bool)
        for camera in self.capture.cameras:
            towards = camera.centre.numpy() - point
            start = point + 5e-4 * np.sign((towards * normal).sum(1))[:, None] * normal
            seen |= ~pose.blocked(start, towards / np.linalg.norm(towards, axis=1)[:, None], reach=3.0)
        return seen


def widest(mask: np.ndarray, count: int) -> np.ndarray:
    """Points [m, 2], at most `count`, where a mask is widest, apart from each other [px]."""
    width, rows, columns, found = depth_in(mask), *np.indices(mask.shape), []
    while len(found) < count and width.max() > 1:
        v, u = np.unravel_index(width.argmax(), width.shape)
        found.append((u + 0.5, v + 0.5))
        width = np.where(np.hypot(rows - v, columns - u) < 1.5 * width[v, u], 0, width)
    return np.array(found).reshape(-1, 2)


def tensor(array: np.ndarray):
    return open3d().core.Tensor(np.ascontiguousarray(array, dtype=np.float32))


def carnation(parts: tuple[str, ...], *, views: int, width: int, seed: int = 0, log: Log) -> Twin:
    """The carnation in its pot; parts ("plant",), or ("stem", "blossom"), or with the "pot" and its soil."""
    green, *leaves, petals = plant(seed)[0]
    meshes = [green, *leaves, petals, *surroundings(seed)]
    what = ["stem"] * (1 + len(leaves)) + ["blossom", "pot", "pot", "table", "table", "wall"]
    if "plant" in parts:
        what = ["plant" if w in ("stem", "blossom") else w for w in what]
    return _photographed("carnation", meshes, what, parts, views, width, seed, log)


def ball(*, views: int, width: int, seed: int = 0, log: Log) -> Twin:
    """The checkered ball on the carnation's table, whose wood is of one of its colours."""
    meshes = [checkered_ball((TARGET[0], TARGET[1], RADIUS)), *surroundings(seed)[2:]]
    return _photographed("ball", meshes, ["ball", "table", "table", "wall"], ("ball",), views, width, seed, log)


def _photographed(
    name: str, meshes: list[Mesh], what: list[str], parts: tuple[str, ...], views: int, width: int, seed: int, log: Log
) -> Twin:
    light = Light(backdrop=(0.80, 0.83, 0.86))
    studio = Studio(meshes, light, openness_rays=8, seed=seed)
    cameras = photographers(views, width, round(0.75 * width))
    images, _, points, colors = photographs(studio.pose(), cameras, points=5000, noise=4e-4, seed=seed, log=log)
    capture = Capture(
        name=name,
        images=tuple(images),
        cameras=tuple(cameras),
        names=tuple(f"view_{i:03d}" for i in range(views)),
        background=light.backdrop,
        points=points,
        point_colors=colors,
    )
    return Twin(capture, studio, np.array([parts.index(w) + 1 if w in parts else 0 for w in what]), parts)


def agreement(found, true, weight=1.0) -> float:
    """Intersection over union, weighted."""
    found, true = np.asarray(found), np.asarray(true)
    return float((weight * (found & true)).sum() / (weight * (found | true)).sum())
