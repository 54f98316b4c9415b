"""Photographs + Gaussians + what a person pointed at -> which Gaussians may move."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge

from physics3d.checks import Count, Device, Pixels, Whole, require_fields
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render
from physics3d.log import Log
from physics3d.pictures import tiled
from physics3d.scenes.base import Capture, Outline
from physics3d.segmentation import Segmentation
from physics3d.segmentation.belief import one_hot, shares
from physics3d.segmentation.carry_masks import carry_masks, refined_masks
from physics3d.segmentation.claims import numbered, told_apart
from physics3d.segmentation.lift import contributions, lift
from physics3d.segmentation.maskers.base import AbstractMasker
from physics3d.segmentation.maskers.grabcut import GrabCut
from physics3d.segmentation.neighbours import beside_static, islands
from physics3d.segmentation.previews import tinted
from physics3d.segmentation.prompted import mask_of_boxes, prompted_mask
from physics3d.segmentation.prompts import Prompt, within_any
from physics3d.segmentation.rooms import Room
from physics3d.segmentation.views import View, spread_out, view_of

LEAST_PIXELS = 20  # a mask smaller than this is no mask


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Mattes of the capture where it has them and no prompt says more; else prompts, carried to other views."""

    prompts: tuple[Prompt, ...] = ()
    masker: AbstractMasker = field(default_factory=GrabCut)
    views: Count = 16  # photographs that are masked, spread around the object
    size: Annotated[Pixels, Ge(32)] = 480  # longer side of the photographs as they are masked [px]
    rounds: Whole = 2  # of masking every photograph again, by what all together say
    device: Device = "cpu"

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "segment")
        for prompt in self.prompts:
            prompt.check()

    def fits(self, outline: Outline) -> None:
        """Raise ValueError if a prompt is for a photograph that is not there, as far as that is known."""
        if not outline.names:
            return
        for prompt in self.prompts:
            if prompt.in_image:
                _index(outline, prompt.view)
        if not self.prompts and outline.mattes is False:
            raise ValueError(
                f"segment.prompts is empty and {outline.name} has no mattes; say what moves, e.g. "
                "scene.prompts=[{view: 0, box: [0.3, 0.2, 0.7, 0.8]}] in fractions of width and height"
            )

    def __call__(self, capture: Capture, gaussians: Gaussians, *, log: Log) -> Segmentation:
        """Raises ValueError naming view and prompt if a prompt is outside the image or finds nothing."""
        self.check()
        self.fits(capture.outline)
        parts = tuple(dict.fromkeys(p.part for p in self.prompts)) or ("body",)
        gaussians = gaussians.to(self.device)

        if capture.images:
            said, rooms = self._prompted(capture, gaussians, parts, log)
            every = self._views(capture, gaussians, said, rooms, log)
            views, maps = self._maps(capture, gaussians, every, parts, said, rooms, log)
            label = self._lift(gaussians, views, maps, parts, rooms)
            for _ in range(self.rounds if self.prompts else 0):
                views, maps = every, self._refine(gaussians, label, every, parts, rooms, capture, log)
                label = self._lift(gaussians, views, maps, parts, rooms)
            log.image("masks", tiled([tinted(v.image, m.numpy()) for v, m in zip(views, maps)]))
            gaussians = gaussians.to("cpu")
        else:
            views, maps = [], []
            gaussians = gaussians.to("cpu")
            label = self._boxes_only(gaussians, parts)

        apart = islands(gaussians.mean, gaussians.opacity, label)
        label[apart] = 0
        touch = beside_static(gaussians.mean, gaussians.opacity, label)
        for k, part in enumerate(parts, 1):
            count = int((label == k).sum())
            log.info(f"{part}: {count} of {len(label)} Gaussians")
            log.metric(f"gaussians_{part}", count)
            if count == 0:
                raise ValueError(
                    f"no Gaussian belongs to {part!r}; correct segment.prompts, see the previews of segment"
                )
        log.info(f"{int(apart.sum())} Gaussians of small islands went back to static")
        log.info(f"{int(touch.sum())} moving Gaussians lie next to static ones")
        log.metric("islands", int(apart.sum()))
        log.metric("beside_static", int(touch.sum()))
        self._show(capture, gaussians, label, log)

        masks = None
        if views:
            height, width = (max(m.shape[k] for m in maps) for k in (0, 1))
            masks = torch.zeros(len(maps), height, width, dtype=torch.uint8)
            for target, labelled in zip(masks, maps):
                target[: labelled.shape[0], : labelled.shape[1]] = labelled.to(torch.uint8)
        return Segmentation(label=label, parts=parts, masks=masks, mask_views=tuple(v.index for v in views))

    def _prompted(
        self, capture: Capture, gaussians: Gaussians, parts: tuple[str, ...], log: Log
    ) -> tuple[dict[str, tuple[View, np.ndarray]], dict[str, Room]]:
        """For each part that is prompted in an image: that view with its mask, and the space that the part may take."""
        said: dict[str, tuple[View, np.ndarray]] = {}
        in_image = [(p, _index(capture.outline, p.view)) for p in self.prompts if p.in_image]
        for index in dict.fromkeys(index for _, index in in_image):
            view, here = view_of(capture, gaussians, index, self.size), [p for p, i in in_image if i == index]
            masks = {}
            for part in dict.fromkeys(p.part for p in here):
                if part in said:
                    raise ValueError(
                        f"the prompts of {part!r} are in several views; give those of one part in one view"
                    )
                own, others = (tuple(p for p in here if (p.part == part) == same) for same in (True, False))
                masks[part] = prompted_mask(own, others, view, self.masker)
            said |= {part: (view, mask) for part, mask in told_apart(masks, view, self.masker).items()}
        said = {part: said[part] for part in parts if part in said}
        rooms = {
            part: Room.around(view, mask, tuple(p for p in self.prompts if p.part == part))
            for part, (view, mask) in said.items()
        }
        for part, (view, _) in said.items():
            log.info(f"{part}: prompted in {capture.names[view.index]}")
        return said, rooms

    def _maps(
        self, capture: Capture, gaussians: Gaussians, views: list[View], parts, said, rooms: dict[str, Room], log: Log
    ) -> tuple[list[View], list[torch.Tensor]]:
        """The views that could be masked, and for each a map of labels [h, w]."""
        masks: dict[str, dict[int, np.ndarray]] = {}
        for first in {view.index: view for view, _ in said.values()}.values():
            here = {part: mask for part, (view, mask) in said.items() if view.index == first.index}
            carried = carry_masks(
                gaussians,
                first,
                here,
                {p: rooms[p] for p in here},
                views,
                self.masker,
                log=log,  # type: ignore[arg-type]
            )
            masks |= {part: {i: found[part] for i, found in carried.items()} for part in here}
        for part in parts:
            own = tuple(p for p in self.prompts if p.part == part)
            if part not in said and own:
                found = {v.index: mask_of_boxes(own, v, self.masker) for v in log.progress(views, "masking the boxes")}
                masks[part] = {i: m for i, m in found.items() if m is not None}
            elif part not in said:
                masks[part] = {v.index: np.ones(v.image.shape[:2], bool) for v in views}
            if sum(m.sum() for m in masks[part].values()) < LEAST_PIXELS:
                names = ", ".join(v.name for v in views[:4])
                raise ValueError(f"the masks of {part!r} are empty in {names}, ...; correct segment.prompts {own}")

        kept, maps = [], []
        for view in views:
            if not all(view.index in masks[part] for part in parts):
                continue
            maps.append(_labelled([masks[part][view.index] for part in parts], view, capture))
            kept.append(view)
        if not kept or not any(bool(m.any()) for m in maps):
            raise ValueError(f"no view shows all of {', '.join(parts)}; prompt them in a view that shows them")
        log.info(f"{len(kept)} of {len(capture.images)} photographs masked")
        return kept, maps

    def _lift(self, gaussians, views: list[View], maps: list[torch.Tensor], parts: tuple[str, ...], rooms):
        """Label int32 [n]; nothing outside a part's box in space or its room belongs to it."""
        weights = contributions(gaussians, [v.camera for v in views], maps, 1 + len(parts))
        mean = gaussians.mean.cpu()
        label = lift(mean, weights)
        for k, part in enumerate(parts, 1):
            allowed = rooms[part].holds(mean) if part in rooms else within_any(self._boxes(part), mean)
            label[(label == k) & ~allowed] = 0
        return label

    def _refine(
        self, gaussians, label, views: list[View], parts: tuple[str, ...], rooms, capture: Capture, log: Log
    ) -> list[torch.Tensor]:
        """Maps again, each view now masked by what all views together say."""
        maps = []
        for view in log.progress(views, "refining masks"):
            drawn = shares(gaussians, one_hot(label, len(parts)), view.camera)
            masks = refined_masks(drawn, view, [rooms.get(part) for part in parts], self.masker)
            maps.append(_labelled(masks, view, capture))
        return maps

    def _views(self, capture: Capture, gaussians: Gaussians, said, rooms: dict[str, Room], log: Log) -> list[View]:
        """The prompted views, and training photographs that show the parts whole, spread by farthest camera."""
        first = list(dict.fromkeys(view.index for view, _ in said.values()))
        training = [i for i in range(len(capture.images)) if i not in capture.held_out or i in first]
        whole = [i for i in training if i in first or all(r.whole_in(capture.cameras[i]) for r in rooms.values())]
        candidates = whole if len(whole) >= min(self.views, 4) else training
        if len(candidates) < len(training):
            log.info(f"{len(candidates)} of {len(training)} photographs show the whole object")
        chosen = spread_out(capture.cameras, candidates, first, self.views)
        return [view_of(capture, gaussians, i, self.size) for i in log.progress(chosen, "rendering depth")]

    def _boxes(self, part: str) -> tuple[Prompt, ...]:
        return tuple(p for p in self.prompts if p.part == part and p.lower is not None)

    def _boxes_only(self, gaussians: Gaussians, parts: tuple[str, ...]) -> torch.Tensor:
        """Without photographs a part is what lies in its box in space."""
        label = torch.zeros(len(gaussians), dtype=torch.int32)
        for k, part in reversed(list(enumerate(parts, 1))):
            boxes = self._boxes(part)
            if not boxes:
                raise ValueError(
                    f"the capture has no photographs, so {part!r} needs a box in space: give lower and upper [m]"
                )
            label[within_any(boxes, gaussians.mean)] = k
        return label

    def _show(self, capture: Capture, gaussians: Gaussians, label: torch.Tensor, log: Log) -> None:
        """What moves and what stays, cut apart, from up to eight views."""
        if log.folder is None or not capture.cameras:
            return
        which = np.linspace(0, len(capture.cameras) - 1, min(8, len(capture.cameras))).round().astype(int)
        for name, chosen in (("moving", label > 0), ("static", label == 0)):
            if not chosen.any():
                continue
            pictures = []
            for i in which:
                camera = capture.cameras[i]
                camera = camera.scaled(min(1.0, 320 / max(camera.width, camera.height)))
                with torch.no_grad():
                    color = render(gaussians.select(chosen), camera, background=(1.0, 1.0, 1.0)).color
                pictures.append((color.clamp(0, 1) * 255).round().to(torch.uint8).numpy())
            log.image(name, tiled(pictures))


def _index(outline: Outline, view: str | int) -> int:
    """Index of a view given by name or number. Raises ValueError listing some names."""
    names = outline.names or ()
    if isinstance(view, int) and 0 <= view < len(names):
        return view
    if view in names:
        return names.index(view)
    raise ValueError(
        f"prompt: view {view!r} is not in {outline.name}; give an index below {len(names)} or a name such as "
        + ", ".join(names[:3])
    )


def _labelled(masks: list[np.ndarray], view: View, capture: Capture) -> torch.Tensor:
    """Map of labels [h, w]; a pixel outside the matte belongs to none."""
    import cv2

    labelled = numbered(masks)
    if capture.alphas:
        size = view.camera.width, view.camera.height
        labelled[cv2.resize(capture.alphas[view.index].numpy(), size, interpolation=cv2.INTER_AREA) < 128] = 0
    return torch.from_numpy(labelled)
