"""What a person says about one photograph, carried to the others through rendered depth.

The masked pixels of the prompted view become points of the object, X = o + z(u, v) d(u, v) [m]; projected into the next
view they give a box and, where the rendered depth there says that they are visible, positive points; the pixels
around the object give negative ones in the same way. Views are taken in the order of their angle to the prompted
one, and each adds the points that it shows, so that the far side is reached step by step. What is farther
behind the prompted view's surface than the object is wide is never part of it: prompt a view that shows it large.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.rasterize import Rendered
from physics3d.log import Log
from physics3d.segmentation.masks import AbstractMasker, AbstractVideoMasker
from physics3d.segmentation.pixels import bounds, centres, eroded, share_within, thinned

DEPTH_TOLERANCE = 0.03  # of the depth: farther behind the rendered surface a point is hidden
MOST_CARRIED = 20_000  # points of each sign
LEAST_REFINED = 20  # pixels; a part that shows less in a view is not looked for there


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """Where one part is, in one view or in space. Image coordinates: fractions of width and height, from upper left."""

    part: str = "body"  # several prompts may describe one part
    view: str | int = 0  # name of the photograph, or index in the capture
    positive: tuple[tuple[float, float], ...] = ()  # points on the part
    negative: tuple[tuple[float, float], ...] = ()  # points beside it
    box: tuple[float, float, float, float] | None = None  # left, top, right, bottom
    lower: tuple[float, float, float] | None = None  # corners of a box in space [m] that holds the part
    upper: tuple[float, float, float] | None = None

    @property
    def in_image(self) -> bool:
        return self.box is not None or len(self.positive) > 0

    def check(self) -> None:
        """Raise ValueError naming the entry that cannot be right."""
        name = f"prompt for {self.part!r} in view {self.view!r}"
        if (self.lower is None) != (self.upper is None):
            raise ValueError(f"{name}: give both lower and upper corner of the box in space, or neither")
        if self.lower is not None and not all(a < b for a, b in zip(self.lower, self.upper)):  # type: ignore[arg-type]
            raise ValueError(f"{name}: lower {tuple(self.lower)} must be below upper {tuple(self.upper)} in every axis")  # type: ignore[arg-type]
        if not self.in_image and self.lower is None:
            raise ValueError(f"{name}: give positive points, a box, or lower and upper corners in space")
        for what, points in (("positive", self.positive), ("negative", self.negative)):
            for point in points:
                if len(point) != 2 or not all(0 <= x <= 1 for x in point):
                    raise ValueError(
                        f"{name}: {what} point {tuple(point)} is outside the image; "
                        "give fractions of width and height between 0 and 1"
                    )
        if self.box is not None:
            box = tuple(self.box)
            if len(box) != 4 or not (0 <= box[0] < box[2] <= 1 and 0 <= box[1] < box[3] <= 1):
                raise ValueError(
                    f"{name}: box {box} must be left < right and top < bottom, as fractions of width and height in 0..1"
                )

    def within(self, point: Float[Tensor, "n 3"], margin: float = 0.0) -> Bool[Tensor, " n"]:
        """Which points lie in the box in space, shrunk by the share `margin` on each side; all if there is none."""
        if self.lower is None:
            return torch.ones(len(point), dtype=torch.bool)
        lower, upper = torch.tensor(self.lower).to(point), torch.tensor(self.upper).to(point)
        inset = margin * (upper - lower)
        return ((point >= lower + inset) & (point <= upper - inset)).all(1)


def within_any(boxes: tuple[Prompt, ...], point: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Which points lie in at least one of the boxes in space; all if there is no box."""
    if not boxes:
        return torch.ones(len(point), dtype=torch.bool)
    return torch.stack([p.within(point) for p in boxes]).any(0)


@dataclass(frozen=True)
class View:
    """A photograph and what the reconstruction shows there, at the same size."""

    index: int  # in the capture
    name: str
    image: UInt8[np.ndarray, "h w 3"]
    camera: Camera
    rendered: Rendered

    def points(self, mask: Bool[np.ndarray, "h w"]) -> Float[Tensor, "m 3"]:
        """The visible surface [m] at the masked pixels where the reconstruction is opaque."""
        chosen = torch.from_numpy(mask) & (self.rendered.alpha > 0.5)
        origin, direction = self.camera.rays()
        return origin + self.rendered.depth[chosen][:, None] * direction[chosen]

    def sees(self, point: Float[Tensor, "m 3"]) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
        """Pixel coordinates of points [m], and which of them are in the image and in front of everything else."""
        uv, depth = self.camera.project(point)
        pixel = uv.floor().long()
        inside = (
            (depth > 0) & (pixel >= 0).all(1) & (pixel[:, 0] < self.camera.width) & (pixel[:, 1] < self.camera.height)
        )
        at = torch.where(inside[:, None], pixel, 0)
        surface, opaque = self.rendered.depth[at[:, 1], at[:, 0]], self.rendered.alpha[at[:, 1], at[:, 0]] > 0.5
        seen = inside & opaque & (depth < (1 + DEPTH_TOLERANCE) * surface)
        return uv.numpy(), seen.numpy()


@dataclass(frozen=True)
class Room:
    """Space that the object may take: a box along the axes of a view that shows it, as deep as it is wide and high."""

    world_to_camera: Float[Tensor, "4 4"]
    lower: Float[Tensor, " 3"]  # in the camera's axes [m]
    upper: Float[Tensor, " 3"]
    boxes: tuple[Prompt, ...]  # with corners in space: where there are any, it is also in one of them

    @classmethod
    def around(cls, view: View, mask: Bool[np.ndarray, "h w"], prompts: tuple[Prompt, ...] = ()) -> "Room":
        """From the masked surface, with a margin of an eighth.

        Raises ValueError if the reconstruction shows next to nothing there.
        """
        boxes = tuple(p for p in prompts if p.lower is not None)
        silhouette, visible = (p[within_any(boxes, p)] for p in (view.points(mask), view.points(eroded(mask, 2))))
        if len(visible) < 10:
            raise ValueError(
                f"the mask in view {view.name} covers only {len(visible)} opaque pixels of the reconstruction"
                f"{' in the box in space' if boxes else ''}; "
                "choose a view in which the object is large, or reconstruct longer"
            )
        M = view.camera.world_to_camera.to(visible)
        local = lambda point: (point @ M[:3, :3].T + M[:3, 3]).numpy()
        low, high = np.quantile(local(silhouette), (0.005, 0.995), axis=0)
        size = (high - low)[:2].mean()
        low[2] = np.quantile(local(visible)[:, 2], 0.02)  # outlines, whose depths mix, say nothing of this
        high[2] = low[2] + size
        low, high = (torch.from_numpy(v).to(visible) for v in (low - size / 8, high + size / 8))
        return cls(M, low, high, boxes)

    @property
    def centre(self) -> Float[Tensor, " 3"]:
        """[m], in the world."""
        return (0.5 * (self.lower + self.upper) - self.world_to_camera[:3, 3]) @ self.world_to_camera[:3, :3]

    def whole_in(self, camera: Camera) -> bool:
        """Does the camera see most of it: the ball in it that touches the nearest pair of its sides?"""
        uv, depth = camera.project(self.centre[None])
        radius = 0.5 * float((self.upper - self.lower).min())
        reach = radius * min(camera.fx, camera.fy) / float(depth.clamp_min(1e-9))
        u, v = uv[0].tolist()
        return float(depth) > radius and reach <= min(u, v, camera.width - u, camera.height - v)

    def holds(self, point: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        M = self.world_to_camera.to(point)
        local = point @ M[:3, :3].T + M[:3, 3]
        inside = ((local >= self.lower.to(point)) & (local <= self.upper.to(point))).all(1)
        return inside & within_any(self.boxes, point)

    def excludes(self, view: View) -> Bool[np.ndarray, "h w"]:
        """Pixels whose surface is outside."""
        outside = np.zeros(view.image.shape[:2], bool)
        point = view.points(~outside)
        outside[(view.rendered.alpha > 0.5).numpy()] = (~self.holds(point)).numpy()
        return outside


def prompted_mask(prompts: tuple[Prompt, ...], others: tuple[Prompt, ...], view: View, masker: AbstractMasker):
    """Mask [h, w] of one part from its prompts in this view; what is positive for other parts is negative here.

    Raises ValueError naming view and prompts if nothing is found.
    """
    size = np.array([view.camera.width, view.camera.height], float)
    pixels = lambda points: np.array(points, float).reshape(-1, 2) * size
    mask = np.zeros(view.image.shape[:2], bool)
    boxes = [np.array(p.box, float) * np.tile(size, 2) for p in prompts if p.box is not None]
    positive = np.concatenate([pixels(p.positive) for p in prompts])
    negative = np.concatenate([*(pixels(p.negative) for p in prompts), *(pixels(p.positive) for p in others)])
    for box in boxes or [None]:
        mask |= masker(view.image, box=box, positive=positive, negative=negative)
    if not mask.any():
        said = "; ".join(
            f"box {tuple(p.box)}" if p.box is not None else f"points {[tuple(x) for x in p.positive]}" for p in prompts
        )
        raise ValueError(
            f"the mask of {prompts[0].part!r} in view {view.name} is empty for {said}; "
            "move the prompt onto the object, or add positive points"
        )
    return mask


def carry_masks(
    first: View, mask: Bool[np.ndarray, "h w"], room: Room, views: list[View], masker: AbstractMasker, *, log: Log
) -> dict[int, Bool[np.ndarray, "h w"]]:
    """Masks by view index: the first one, and those of the other views that agree with the points carried to them."""
    mask = mask & ~room.excludes(first)
    masks = {first.index: mask}
    inside, outside = first.points(eroded(mask, 2)), first.points(eroded(~mask, 2))
    inside, outside = thinned(inside, MOST_CARRIED), thinned(outside, MOST_CARRIED)
    followed: dict[int, np.ndarray] = {}
    if isinstance(masker, AbstractVideoMasker):
        path = along_path(first, views)
        start = next(k for k, v in enumerate(path) if v.index == first.index)
        followed = dict(zip([v.index for v in path], masker.follow([v.image for v in path], start, mask)))
    towards = lambda view: torch.nn.functional.normalize(view.camera.centre.to(room.centre) - room.centre, dim=0)
    order = sorted((v for v in views if v.index != first.index), key=lambda v: -float(towards(v) @ towards(first)))
    for view in log.progress(order, "carrying the prompt"):
        uv, seen = view.sees(inside)
        if seen.sum() < 0.05 * len(inside):
            log.info(f"{view.name} hardly shows the object, left out")
            continue
        # the side that no view has shown yet may stick out
        box = bounds(uv[seen], 0.3, view.image.shape)
        around, clear = view.sees(outside)
        clear &= ((around >= box[:2]) & (around <= box[2:])).all(1)
        beyond = room.excludes(view)
        if view.index in followed:
            found = followed[view.index] & ~beyond
        else:
            pixels = centres(beyond)
            pixels = pixels[((pixels >= box[:2]) & (pixels <= box[2:])).all(1)]
            found = masker(
                view.image,
                box=box,
                positive=thinned(uv[seen], masker.most_points),
                negative=np.concatenate([thinned(p, masker.most_points // 2) for p in (around[clear], pixels)]),
            )
            found &= ~beyond
        recall, leak = share_within(found, uv[seen]), share_within(found, around[clear])
        if recall < 0.6 or leak > 0.3:
            log.info(
                f"{view.name}: the mask holds {100 * recall:.0f} % of the object's points "
                f"and {100 * leak:.0f} % of those around it, left out"
            )
            continue
        masks[view.index] = found
        inside = thinned(torch.cat([inside, view.points(eroded(found, 2))]), MOST_CARRIED)
        # what this mask may have missed lies next to it, and must not become negative in the next view
        clear_of_it = eroded(~found, 2 + round(0.15 * found.sum() ** 0.5))
        outside = thinned(torch.cat([outside, view.points(clear_of_it)]), MOST_CARRIED)
    return masks


def along_path(first: View, views: list[View]) -> list[View]:
    """All views as a video would show them: from the first in both directions, always on to the nearest camera."""
    path = [first]
    rest = [v for v in views if v.index != first.index]
    distance = lambda a, b: float((a.camera.centre - b.camera.centre).norm())
    while rest:
        ahead, behind = (min(rest, key=lambda v: distance(end, v)) for end in (path[-1], path[0]))
        if distance(path[-1], ahead) <= distance(path[0], behind):
            path.append(ahead)
            rest.remove(ahead)
        else:
            path.insert(0, behind)
            rest.remove(behind)
    return path


def refined_mask(
    share: Float[np.ndarray, "h w"], view: View, room: Room | None, masker: AbstractMasker
) -> Bool[np.ndarray, "h w"]:
    """Mask of a part from its own labels: `share` of each pixel that Gaussians labelled with it contribute.

    A mask that contradicts the labels is replaced by them. Outside its room the part cannot be, but where thin things
    end depth is a mix with what lies behind: that rules out only what is well outside.
    """
    guess = share > 0.5
    if guess.sum() < LEAST_REFINED:
        return np.zeros_like(guess)
    mask = masker.refine(view.image, share)
    if room is not None:
        mask &= ~eroded(room.excludes(view), 0.08 * guess.sum() ** 0.5)
    return mask if (mask & guess).sum() > 0.6 * (mask | guess).sum() else guess


def mask_of_box(prompt: Prompt, view: View, masker: AbstractMasker) -> Bool[np.ndarray, "h w"] | None:
    """Mask of a box in space: its inner pixels are positive, those outside negative, the masker decides between."""
    everything = np.ones(view.image.shape[:2], bool)
    opaque = (view.rendered.alpha > 0.5).numpy()
    point = view.points(everything)
    in_box, core = np.zeros_like(opaque), np.zeros_like(opaque)
    in_box[opaque] = prompt.within(point).numpy()
    core[opaque] = prompt.within(point, margin=0.1).numpy()
    if core.sum() < 10:
        return None
    v, u = np.nonzero(in_box)
    return masker(
        view.image,
        box=np.array([u.min(), v.min(), u.max() + 1, v.max() + 1], float),
        positive=thinned(centres(core), masker.most_points),
        negative=thinned(centres(opaque & ~in_box), masker.most_points),
    )
