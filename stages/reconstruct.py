"""Photographs -> 3D Gaussians."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from annotated_types import Ge

from physics3d.checks import Count, Device, Pixels, Positive, Seed, Share, require_fields
from physics3d.gaussians.adam import Rates
from physics3d.gaussians.densification.adaptive import Adaptive
from physics3d.gaussians.densification.base import AbstractDensification
from physics3d.gaussians.fit import fit
from physics3d.gaussians.floaters import floaters
from physics3d.gaussians.loss import held_out_psnr
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.photograph import Photograph
from physics3d.gaussians.ply import write_ply
from physics3d.gaussians.render import render
from physics3d.gaussians.start import background_points, from_points, random_points
from physics3d.log import Log
from physics3d.scenes.base import Capture

FLOATER_VIEWS = 32  # photographs asked whether they need a Gaussian that stands apart


@dataclass(frozen=True, kw_only=True)
class Reconstruct:
    """Fit Gaussians to the photographs of a capture; also leaves `gaussians.ply` for any 3DGS viewer."""

    iterations: Count = 1500
    max_gaussians: Count = 20_000
    sh_degree: Literal[0, 1, 2, 3] = 1  # 0: colour does not depend on the viewing direction
    longest_side: Annotated[Pixels, Ge(16)] = 320  # photographs are reduced to this [px]
    ssim_weight: Share = 0.2
    rates: Rates = field(default_factory=Rates)
    densification: AbstractDensification = field(default_factory=Adaptive)  # where Gaussians are added and removed
    exposure: bool = False  # learn a gain and an offset per photograph and channel; those held out get none
    floaters: Positive | None = 2.0  # see gaussians/floaters.py [standard deviations]; null: keep them
    check_every: Count = 250  # iterations between looks at how well it fits
    patience: Count = 3  # looks at photographs trained on without improvement before it stops early
    seed: Seed = 0
    device: Device = "cpu"

    def __call__(self, capture: Capture, *, log: Log) -> Gaussians:
        """Raises ValueError for settings out of range or a capture without photographs."""
        self.check()
        photographs = [p.to(self.device) for p in self.photographs(capture)]
        training = [p for i, p in enumerate(photographs) if i not in capture.held_out]
        held_out = [photographs[i] for i in capture.held_out]
        background = torch.tensor(capture.background, device=self.device)
        start = self.start(capture, [p.to("cpu") for p in training])
        size = f"{photographs[0].camera.width} x {photographs[0].camera.height}"
        log.info(
            f"{len(training)} photographs at {size}, {len(held_out)} held out, {len(start)} Gaussians to start with"
        )

        def preview(model: Gaussians, step: int) -> None:
            shown = (held_out or training)[0]
            with torch.no_grad():
                image = render(model, shown.camera, background=background).color
            log.image("photograph_and_render", torch.cat([shown.on(background), image], 1), step)

        gaussians = fit(
            start,
            training,
            held_out,
            background=background,
            iterations=self.iterations,
            max_gaussians=self.max_gaussians,
            ssim_weight=self.ssim_weight,
            rates=self.rates,
            exposure=self.exposure,
            densification=self.densification,
            check_every=self.check_every,
            patience=self.patience,
            seed=self.seed,
            log=log,
            preview=preview,
        )
        if self.floaters is not None and (capture.alphas or capture.single_object):
            gaussians = self.without_floaters(gaussians, training, held_out or training, background, log)
        if held_out:
            value = held_out_psnr(gaussians, held_out, background)
            log.metric("psnr_held_out", value)
            log.info(f"{len(gaussians)} Gaussians, {value:.2f} dB on photographs held out")
        gaussians = gaussians.to("cpu")
        if log.folder is not None:
            write_ply(log.path("gaussians.ply"), gaussians)
        return gaussians

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "reconstruct")
        self.rates.check()
        self.densification.check()

    def without_floaters(
        self, gaussians: Gaussians, training: list[Photograph], views: list[Photograph], background, log: Log
    ) -> Gaussians:
        """Of one object alone: what hangs in the air around it would become particles."""
        spread = training[:: max(1, len(training) // FLOATER_VIEWS)]
        alone = floaters(gaussians, [p.camera for p in spread], deviations=self.floaters or 0)
        rest = gaussians.select(~alone.to(gaussians.mean.device))
        change = held_out_psnr(rest, views, background) - held_out_psnr(gaussians, views, background)
        log.metric("floaters", int(alone.sum()))
        log.metric("psnr_without_floaters_minus_with", change)
        log.info(f"{int(alone.sum())} floating Gaussians removed, which changes the PSNR by {change:+.3f} dB")
        return rest

    def photographs(self, capture: Capture) -> list[Photograph]:
        """All photographs in floating point, reduced, multiplied by their matte where there is one."""
        if not capture.images:
            raise ValueError(f"capture {capture.name} has no photographs to reconstruct from")
        behind = torch.tensor(capture.background)
        result = []
        for i, (image, camera) in enumerate(zip(capture.images, capture.cameras)):
            color, alpha = image.float() / 255, None
            if capture.alphas:
                alpha = capture.alphas[i].float() / 255
                color = (color - (1 - alpha)[..., None] * behind).clamp(0, 1)
            photograph = Photograph(camera=camera, color=color, alpha=alpha)
            factor = self.longest_side / max(camera.width, camera.height)
            result.append(photograph.scaled(factor) if factor < 1 else photograph)
        return result

    def start(self, capture: Capture, training: list[Photograph]) -> Gaussians:
        """From the capture's points, if any, and points of the background, else from random points seen in common."""
        generator = torch.Generator().manual_seed(self.seed)
        count = max(1, self.max_gaussians // 2)
        if capture.points is None:
            points, colors = random_points(training, count, generator)
        else:
            pick = torch.randperm(len(capture.points), generator=generator)[: max(1, 4 * count // 5)]
            points = capture.points[pick].float()
            gray = torch.full_like(points, 0.5)
            colors = gray if capture.point_colors is None else capture.point_colors[pick]
            if not capture.alphas:
                more = max(1 + len(points) // 4, count // 2 - len(points))
                far, far_colors = background_points(training, points, more, generator)
                points, colors = torch.cat([points, far]), torch.cat([colors, far_colors])
        return from_points(points, colors, sh_degree=self.sh_degree)
