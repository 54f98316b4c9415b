"""Trajectory + Gaussians -> video, seen by the cameras of the recording or by a view of the capture."""

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Gt, Le

from physics3d.checks import Device, Text, Whole, require_fields
from physics3d.filling.body import Body
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.deform import Backdrop, render_deformed
from physics3d.gaussians.interior import Interior, paint
from physics3d.gaussians.model import Gaussians
from physics3d.log import Log
from physics3d.pictures import contact_sheet, space_time_slice, to_uint8
from physics3d.scenes.base import Capture, Outline
from physics3d.trajectory import Trajectory
from physics3d.video import Video, write_mp4

LEAST_MOTION = 1.0  # [px]: what moves less is not seen to


@dataclass(frozen=True, kw_only=True)
class Render:
    """Renders every frame of a trajectory.

    With a recorded motion, its cameras are used: of the take to evaluate on if there is one, else those of the take to
    learn from that were held out. A capture without takes is seen from `view`.
    """

    view: Whole | Text | None = None  # index or name of the photograph whose camera is used; None: the first one
    scale: Annotated[float, Gt(0), Le(16)] = 1.0  # pixels of the video per pixel of the camera, along each side
    interior: bool = True  # draw the inside, in the colours of the surface, where the body opens
    paint: Whole = 0  # steps by which the colours of the inside are refined on the photographs' cameras (L_Fill)
    device: Device = "cpu"

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "render")

    def __call__(
        self, capture: Capture, gaussians: Gaussians, body: Body, trajectory: Trajectory, *, log: Log
    ) -> Video:
        """Returns one video per camera. Raises ValueError if `view` is not in the capture."""
        self.check()
        cameras = self.cameras(capture)
        model = gaussians.to(self.device)
        embedding = body.embedding
        rest = trajectory.rest_position.to(self.device)
        background = torch.tensor(capture.background, device=self.device)
        inside = self.inside(capture, model, body, trajectory, log) if self.interior else None
        videos: dict[str, list[torch.Tensor]] = {name: [] for name in cameras}
        count = len(trajectory.position)
        backdrops = {
            name: Backdrop.of(model, embedding, camera, background=background) for name, camera in cameras.items()
        }

        self.say_motion(cameras, trajectory, log)
        for x, F in log.progress(zip(trajectory.position, trajectory.deformation), "render", total=count):
            x, F = x.to(self.device), F.to(self.device)
            for name, backdrop in backdrops.items():
                with torch.no_grad():
                    drawn = render_deformed(
                        model, embedding, rest, x, F, cameras[name],
                        background=background, interior=inside, backdrop=backdrop,
                    )  # fmt: skip
                videos[name].append(to_uint8(drawn.color))
        if any(backdrops.values()):
            static = len(model) - len(embedding.which)
            log.info(f"{static} of {len(model)} Gaussians do not move and were drawn once per camera")
        frames = {name: torch.stack(images) for name, images in videos.items()}
        for name, video in frames.items():
            write_mp4(log.path(f"{name}.mp4"), video, trajectory.fps)
            log.image(f"{name}_frames", contact_sheet(video))
            log.image(f"{name}_space_time", space_time_slice(video, row=video.shape[1] // 2))
        log.info(f"{count} frames from {len(frames)} camera(s): {', '.join(f'{name}.mp4' for name in frames)}")
        return Video(frames=tuple(frames.values()), names=tuple(frames), fps=trajectory.fps)

    def fits(self, outline: Outline) -> None:
        """Raise ValueError if `view` is not one of the photographs, as far as these are known and no take is filmed."""
        if outline.names is None or outline.takes:
            return
        if isinstance(self.view, str) and self.view not in outline.names:
            raise ValueError(f"render.view is {self.view!r}; the photographs are {', '.join(outline.names[:8])}, ...")
        if isinstance(self.view, int) and self.view >= len(outline.names):
            raise ValueError(f"render.view is {self.view}; the capture has views 0 to {len(outline.names) - 1}")

    def say_motion(self, cameras: dict[str, Camera], trajectory: Trajectory, log: Log) -> None:
        """How far the particle that is seen to move most moves in the pictures [px]; a warning if that is nothing, and
        one if the body leaves them."""
        furthest = 0.0
        for name, camera in cameras.items():
            start, depth = camera.project(trajectory.rest_position.double())
            size = torch.tensor([camera.width, camera.height])
            gone = 0
            for x in trajectory.position:
                now, behind = camera.project(x.double())
                seen = (depth > 0) & (behind > 0)
                if seen.any():
                    furthest = max(furthest, float((now - start)[seen].norm(dim=1).max()))
                gone += not bool(((behind > 0) & (now >= 0).all(1) & (now < size).all(1)).any())
            if gone:
                log.warn(
                    f"in {gone} of {len(trajectory.position)} frames nothing of the body is in the picture of {name}; "
                    "push less, catch it earlier (a floor in scene.boundaries), or film from farther off (render.view)"
                )
        log.metric("motion_px", furthest)
        if furthest >= LEAST_MOTION:
            log.info(f"the body moves by up to {furthest:.{0 if furthest >= 10 else 1}f} pixels")
        else:
            log.warn(
                f"nothing is seen to move: at most {furthest:.2g} pixels; push harder (simulate.force, "
                "scene.excitation), soften the material, or let go of what holds it (scene.boundaries, fill.attach)"
            )

    def inside(
        self, capture: Capture, model: Gaussians, body: Body, trajectory: Trajectory, log: Log
    ) -> Interior | None:
        """Gaussians of the filled particles; None where the body has no inside or never opens."""
        surface = model.select(body.embedding.which.to(model.mean.device)).to("cpu")
        found = Interior.of(surface, body.position, body.interior, body.spacing)
        if found is None:
            return None
        widest = torch.stack([found.opened(trajectory.rest_position, x) for x in trajectory.position]).amax(0)
        count = int((widest > 0).sum())
        log.metric("interior_shown", count)
        if count == 0:
            log.info(f"the body never opens: its {len(widest)} inner Gaussians are not drawn")
            return None
        log.info(f"the body opens: {count} of its {len(widest)} inner Gaussians show")
        found = found.to(self.device)
        if self.paint and capture.cameras:
            cameras = [c for i, c in enumerate(capture.cameras) if i not in capture.held_out]
            found = paint(found, model, cameras, background=capture.background, steps=self.paint, log=log)
        return found

    def cameras(self, capture: Capture) -> dict[str, Camera]:
        """The cameras of the video by name; `camera<i>` is number i of the take."""
        take = capture.take("evaluate") or capture.take("learn")
        if take is not None:
            picks = take.held_out_cameras or range(len(take.cameras))
            return {f"camera{i}": take.cameras[i].scaled(self.scale) for i in picks}
        return {"view": capture.seen_from(self.view, key="render.view").scaled(self.scale)}
