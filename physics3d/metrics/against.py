"""All measures of a clip against a reference: likeness of the pictures and of the motion, and why one is missing."""

import numpy as np
from jaxtyping import Bool, UInt8
from torch import Tensor

from physics3d.metrics.image import likeness, mean
from physics3d.metrics.motion import (
    Oscillation,
    dominant,
    flow_error,
    motion_psnr,
    oscillation,
    phase_error,
    signal,
)
from physics3d.metrics.video import vmaf
from physics3d.motion.flow import flow
from physics3d.motion.shapes import moving

Cells = dict[str, tuple[float | None, str]]  # measure -> (number, "") or (None, why there is none)
Lines = dict[str, list[float]]  # measure -> number of every frame
STILL = "the reference moves by less than half a pixel"


class Reference:
    """A clip to compare with: its flow and its oscillation are found once.

    Where the `thing` is seen in its first frame may be told: flow error and damping are then those of its own pixels as
    well, `thing_flow_error` and `thing_damping`. Beside a thing, and on walls and tables without texture, the flow of
    two clips may differ where nothing moves."""

    def __init__(self, clip: UInt8[Tensor, "t h w 3"], fps: float, *, thing: Bool[np.ndarray, "h w"] | None = None):
        self.clip, self.fps = clip, fps
        self.u = flow(clip)
        self.where = moving(self.u)
        self.swing: Oscillation | None = None
        self.why = STILL
        self.thing = None if thing is None or self.where is None else self.where & thing
        if self.where is not None:
            self.pattern = dominant(self.u, self.where)
            self.swing, self.why = self._swing(self.u)

    def itself(self) -> tuple[Cells, str]:
        """Frequency and damping of the reference, and why it has no oscillation if so."""
        if self.where is None:
            return self._cells(None, STILL), ""
        return self._cells(self.swing, "") | self._damping_of_thing(self.u), self.why

    def measure(self, clip: UInt8[Tensor, "t h w 3"]) -> tuple[Cells, Lines, str]:
        """Every measure, those that every frame has, and why the clip has no oscillation if so. Raises ValueError for
        unequal shapes."""
        like = likeness(clip, self.clip)
        many = None if like.ms_ssim is None else mean(like.ms_ssim)
        cells: Cells = {"psnr": (like.psnr, ""), "ssim": (mean(like.ssim), ""), "ms_ssim": (many, like.why)}
        cells["vmaf"] = vmaf(clip, self.clip)
        motion, why = self.motion(clip)
        return cells | motion, {"PSNR [dB]": like.psnr_per_frame, "SSIM": like.ssim}, why

    def motion(self, clip: UInt8[Tensor, "t h w 3"]) -> tuple[Cells, str]:
        """The measures of the motion alone."""
        cells: Cells = {"motion_psnr": motion_psnr(clip, self.clip)}
        if self.where is None:
            return cells | {"flow_error": (None, STILL)} | self._cells(None, STILL), ""
        u = flow(clip)
        cells["flow_error"] = flow_error(u, self.u, self.where), ""
        if self.thing is not None and self.thing.any():
            cells["thing_flow_error"] = flow_error(u, self.u, self.thing), ""
        found, why = self._swing(u)
        return cells | self._cells(found, "") | self._damping_of_thing(u), why

    def _swing(self, u: np.ndarray) -> tuple[Oscillation | None, str]:
        assert self.where is not None
        return oscillation(signal(u, self.pattern, self.where), self.fps)

    def _damping_of_thing(self, u: np.ndarray) -> Cells:
        if self.thing is None or not self.thing.any():
            return {}
        found, _ = oscillation(signal(u, dominant(self.u, self.thing), self.thing), self.fps)
        return {"thing_damping": (None if found is None else found.damping, "")}

    def _cells(self, found, why: str) -> Cells:
        if found is None:
            return {name: (None, why) for name in ("frequency", "damping", "phase")}
        ahead = None if self.swing is None else phase_error(found, self.swing)
        return {"frequency": (found.frequency, ""), "damping": (found.damping, ""), "phase": (ahead, "")}
