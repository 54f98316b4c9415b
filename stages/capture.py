"""The first stage: whatever the scene's source is -> a Capture, with pictures of what was read.

To any source a clip may be added that somebody, or a video model, made of the picture that `make still` writes: it is
seen by a camera that is known, and by a push that is not.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from physics3d.checks import Text, Whole, require_fields
from physics3d.pictures import contact_sheet
from physics3d.scenes.base import AbstractSource, Capture
from physics3d.scenes.clips import clip_files, filmed_takes, require_same_view
from physics3d.video import write_mp4


@dataclass(frozen=True, kw_only=True)
class LoadCapture:
    """Call the source, say what came back, and keep previews of the views and of every take."""

    source: AbstractSource
    clip: Text | None = None  # file of a motion seen from `view`, learned from in the place of the source's own takes
    view: Whole | Text | None = None  # index or name of the photograph whose camera sees it; None: the first one

    def __post_init__(self):
        require_fields(self, "capture")

    def files(self) -> tuple[str, ...]:
        """The clip; the source says itself what it reads."""
        return () if self.clip is None else tuple(map(str, clip_files(Path(self.clip))))

    def __call__(self, *, log) -> Capture:
        """Raises ValueError as the source does, and for a clip that cannot be used."""
        capture = self.source(log=log)
        if self.clip is not None:
            capture = self.with_clip(capture, log)
        capture.check()
        if capture.note:
            log.info(capture.note)
        training = len(capture.images) - len(set(capture.held_out))
        log.metric("views", training)
        log.metric("views_held_out", len(set(capture.held_out)))
        log.metric("points", 0 if capture.points is None else len(capture.points))
        if capture.images:
            h, w = capture.images[0].shape[:2]
            log.info(f"{training} views to train on, {len(set(capture.held_out))} held out, {w} x {h} pixels")
            log.image("views", contact_sheet(_same_size(capture.images), columns=5, count=15))
        if capture.points is not None:
            extent = capture.points.quantile(0.95, dim=0) - capture.points.quantile(0.05, dim=0)
            log.info(
                f"{len(capture.points)} points; nine tenths of them within {' x '.join(f'{e:.3g}' for e in extent)} m"
            )
        for take in capture.takes:
            t = len(take.videos[0])
            log.info(f"take {take.name} ({take.role}): {t} frames at {take.fps:g} fps from {len(take.cameras)} cameras")
            log.image(f"take_{take.name}", contact_sheet(take.videos[0]))
            if log.folder is not None:
                write_mp4(log.path(f"previews/take_{take.name}.mp4"), take.videos[0], take.fps)
        return capture

    def with_clip(self, capture: Capture, log) -> Capture:
        """The capture with the clip as its only take."""
        assert self.clip is not None
        (take, *more) = filmed_takes(Path(self.clip), log=log)
        if more:
            raise ValueError(f"capture.clip is {self.clip}, a folder of {1 + len(more)} clips; name one of them")
        h, w = take.video.shape[1:3]
        camera = capture.seen_from(self.view, key="render.view").framed(w, h)
        if capture.images:
            number = capture.names.index(self.view) if isinstance(self.view, str) else self.view or 0
            require_same_view(take, capture.images[number], clip=Path(self.clip).name, key="render.view")
        if capture.takes:
            log.info(f"left out, for a clip is learned from: {', '.join(t.name for t in capture.takes)}")
        return replace(capture, takes=(take.seen_by(camera),))


def _same_size(images: tuple[Tensor, ...]) -> Tensor:
    """[n, h, w, 3] with the height of the smallest; each is stretched by nearest pixels where sizes differ."""
    h, w = min((tuple(i.shape[:2]) for i in images), default=(1, 1))
    rows = [torch.arange(h) * i.shape[0] // h for i in images]
    columns = [torch.arange(w) * i.shape[1] // w for i in images]
    return torch.stack([i[r][:, c] for i, r, c in zip(images, rows, columns)])
