"""The motion to learn from where none was recorded: what the scene itself would do, filmed by one of its cameras.

A prior that knows what videos look like needs no recording. It is shown the body under the scene's own excitation and
says what is unlikely about it. The take made here says how that is filmed; its video is the picture at rest, standing
still, of which priors are told the first frame and estimators may subtract the score.
"""

from dataclasses import dataclass

import torch

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.impulse import Force, excited
from physics3d.checks import Frames, Rate, Text, Whole
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render
from physics3d.pictures import to_uint8
from physics3d.scenes.base import Capture, Footage, Take


@dataclass(frozen=True, kw_only=True)
class Imagined:
    """What is simulated and from where it is seen."""

    frames: Frames
    fps: Rate  # [1/s]
    excitation: tuple[AbstractBoundary, ...] = ()
    force: Force | None = None  # takes the place of the force of every Impulse above [N]; None: none does
    view: Whole | Text | None = None  # index or name of the photograph whose camera is used; None: the first one

    @property
    def footage(self) -> Footage:
        return Footage(name="imagined", role="learn", frames=self.frames, fps=self.fps)

    def take(self, capture: Capture, gaussians: Gaussians, *, falls: bool, device: str) -> Take:
        """`falls`: it moves by itself, by its weight or because it is thrown. Raises ValueError if nothing sets the
        body in motion or the view is not in the capture."""
        excitation = excited(self.excitation, self.force)
        if not excitation and not falls:
            raise ValueError(
                "nothing was recorded and nothing pushes the body (simulate.force is zero or simulate.excitation is "
                "empty), so a video model would be shown a still picture; set simulate.force"
            )
        camera = capture.seen_from(self.view, key="render.view")
        with torch.no_grad():
            still = render(gaussians.to(device), camera, background=capture.background).color
        video = to_uint8(still)[None].expand(self.frames, -1, -1, -1)
        return Take(
            name="imagined", role="learn", fps=self.fps, cameras=(camera,), videos=(video,), excitation=excitation
        )
