"""What a person says about one photograph, carried to the others through the Gaussians.

The mask of the prompted photograph labels the Gaussians that it shows (see `lift`); those that it hides or barely
shows may be the object's where there is room. Drawn from the next camera this says of every pixel which share is the
object's, and the masker finds the outline near there. Views are taken in the order of their angle to the prompted one,
and each adds what it shows, so that the far side is reached step by step. What is farther behind the prompted view's
surface than the object is wide is never part of it: prompt a view that shows it large.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from physics3d.checks import Corners, LeftTopRightBottom, Share, Text, Whole, at_least_one, require_fields
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import Rendered
from physics3d.log import Log
from physics3d.segmentation.lift import contributions, expected, shares
from physics3d.segmentation.masks import AbstractMasker, AbstractVideoMasker
from physics3d.segmentation.pixels import centres, depth_in, eroded, size_of, thinned

UNSEEN = 0.7  # belief that what may be a part is one, before a view shows it: likelier than not, for colours to decide
LEAST_SHOWN = 20  # pixels; a part that shows less in a view is not looked for there


Point = tuple[Share, Share]


@dataclass(frozen=True, kw_only=True)
class Prompt:
    """Where one part is, in one view or in space. Image coordinates: fractions of width and height, from upper left."""

    part: Text = "body"  # several prompts may describe one part
    view: Text | Whole = 0  # name of the photograph, or index in the capture
    positive: tuple[Point, ...] = ()  # points on the part
    negative: tuple[Point, ...] = ()  # points beside it
    box: Annotated[tuple[Share, Share, Share, Share], LeftTopRightBottom()] | None = None
    lower: tuple[float, float, float] | None = None  # corners of a box in space [m] that holds the part
    upper: tuple[float, float, float] | None = None

    RULES = (Corners("lower", "upper"), at_least_one("positive", "box", "lower"))

    @property
    def in_image(self) -> bool:
        return self.box is not None or len(self.positive) > 0

    def check(self) -> None:
        """Raise ValueError naming the entry that cannot be right."""
        require_fields(self, f"prompt for {self.part!r} in view {self.view!r}")

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


@dataclass(frozen=True)
class Room:
    """Space that the object may take: a box along the axes of a view that shows it, as deep as it is wide or high."""

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
        size = (high - low)[:2].max()
        low[2] = np.quantile(local(visible)[:, 2], 0.02)  # outlines, whose depths mix, say nothing of this
        high[2] = low[2] + size
        low[2] -= 0.4 * size  # thin things that reach towards the camera are too few to show in that
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


def told_apart(
    masks: dict[str, Bool[np.ndarray, "h w"]], view: View, masker: AbstractMasker
) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Parts prompted in one view, again: what only one of them claims teaches the masker what the others are not."""
    claims = np.sum(list(masks.values()), axis=0)
    again = {}
    for part, mask in masks.items():
        share = np.where(mask, np.where(claims > 1, 0.5, 1.0), 0.0)
        # a part that lies wholly on another has nothing of its own to learn from
        own = (share == 1).sum() > 0.3 * mask.sum()
        again[part] = masker.refine(view.image, share) if own and (claims > 1).any() else mask
    return again


def carry_masks(
    gaussians: Gaussians,
    first: View,
    prompted: dict[str, Bool[np.ndarray, "h w"]],
    rooms: dict[str, Room],
    views: list[View],
    masker: AbstractMasker,
    *,
    log: Log,
) -> dict[int, dict[str, Bool[np.ndarray, "h w"]]]:
    """Masks by view index and part, of the parts prompted in one view together, so that they compete for pixels.

    A view in which the masker finds something else than what was carried to it is left out.
    """
    path = along_path(first, views)
    followed: dict[str, list[np.ndarray]] = {}
    if isinstance(masker, AbstractVideoMasker):
        start = next(k for k, v in enumerate(path) if v.index == first.index)
        followed = {part: masker.follow([v.image for v in path], start, mask) for part, mask in prompted.items()}
    mean = gaussians.mean.cpu()
    allowed = torch.stack([rooms[part].holds(mean) for part in prompted])
    masks = {first.index: {part: mask & ~rooms[part].excludes(first) for part, mask in prompted.items()}}
    seen_in = lambda view: contributions(
        gaussians, [view.camera], [torch.from_numpy(numbered(list(masks[view.index].values())))], 1 + len(prompted)
    )
    weights = seen_in(first)
    centre = torch.stack([room.centre for room in rooms.values()]).mean(0)
    towards = lambda view: torch.nn.functional.normalize(view.camera.centre.to(centre) - centre, dim=0)
    order = sorted((v for v in views if v.index != first.index), key=lambda v: -float(towards(v) @ towards(first)))
    for view in log.progress(order, "carrying the prompt"):
        said, possible = expected(mean, weights, allowed)
        known = shares(gaussians, said, view.camera)
        drawn = known + UNSEEN * shares(gaussians, possible, view.camera)
        if all((share > 0.5).sum() < LEAST_SHOWN for share in known):
            log.info(f"{view.name} hardly shows {' and '.join(prompted)}, left out")
            continue
        found, recall, leak = {}, 1.0, 0.0
        for part, sure, share in zip(prompted, known, drawn):
            mask = np.zeros(share.shape, bool)
            if (share > 0.5).sum() >= LEAST_SHOWN:  # else it is behind another part
                mask = followed[part][path.index(view)] if followed else masker.refine(view.image, share)
                mask = mask & ~clearly_outside(rooms[part], view, share > 0.5)
                recall = min(recall, share_of(sure > 0.5, mask))
                leak = max(leak, share_of(mask, eroded(share < 0.05, 0.1 * size_of(share > 0.5))))
            found[part] = mask
        found = dict(zip(found, contested(list(found.values()), drawn)))
        if recall < 0.6 or leak > 0.3:
            log.info(
                f"{view.name}: a mask holds {100 * recall:.0f} % of what other views say is the object's, and "
                f"{100 * leak:.0f} % of it is far off, left out"
            )
            continue
        masks[view.index] = found
        weights += seen_in(view)
    return masks


def contested(masks: list[Bool[np.ndarray, "h w"]], drawn: Float[np.ndarray, "k h w"]) -> list[Bool[np.ndarray, "h w"]]:
    """Where two parts meet both outlines are guesses: a pixel that both claim is of the one that shows most there."""
    claims = np.where(masks, drawn, -1.0)
    return [mask & (share >= claims.max(0) - 1e-6) for mask, share in zip(masks, drawn)]


def numbered(masks: list[Bool[np.ndarray, "h w"]]) -> Int[np.ndarray, "h w"]:
    """Map of labels 1, 2, ...; a pixel claimed twice belongs to the part named first."""
    labelled = np.zeros(masks[0].shape, np.int64)
    for k in range(len(masks), 0, -1):
        labelled[masks[k - 1]] = k
    return labelled


def clearly_outside(room: Room, view: View, guess: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels well inside the area that shows what is outside the room: where thin things end, depth is a mix.

    Where the reconstruction has gaps no pixel may be well inside; then the room only binds Gaussians.
    """
    return depth_in(room.excludes(view)) > 0.06 * size_of(guess)


def share_of(part: Bool[np.ndarray, "h w"], whole: Bool[np.ndarray, "h w"]) -> float:
    """Share of the part that lies on the whole; 1 for nothing."""
    return float((part & whole).sum() / part.sum()) if part.any() else 1.0


def overlap(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union; 1 for two empty masks."""
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 1.0


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


def refined_masks(
    drawn: Float[np.ndarray, "k h w"], view: View, rooms: list[Room | None], masker: AbstractMasker
) -> list[Bool[np.ndarray, "h w"]]:
    """Masks of parts from their own labels: `drawn` are the shares of pixels that Gaussians with each label contribute.

    A mask that contradicts the labels is replaced by them.
    """
    found = []
    for share, room in zip(drawn, rooms):
        guess = share > 0.5
        mask = np.zeros_like(guess)
        if guess.sum() >= LEAST_SHOWN:
            mask = masker.refine(view.image, share)
            if room is not None:
                mask = mask & ~clearly_outside(room, view, guess)
            mask = mask if overlap(mask, guess) > 0.6 else guess
        found.append(mask)
    return contested(found, drawn)


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
