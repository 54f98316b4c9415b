"""Gaussians for the inside of a body, drawn only where it opens: a cut, a tear, a bite.

A reconstruction knows the surface only. Each particle that filling put inside is given one round Gaussian, of the
colour that the nearest surface Gaussians have on average. It is drawn with the opacity

    OPACITY * e,   e = ramp of max_j |x_i - x_j| / |X_i - X_j| from CLOSED to OPEN

over its neighbours j within two spacings at rest: the factor is 0 as long as no two neighbours have come apart, so that
the undeformed scene, and any rigid, compressed or moderately stretched one, is drawn as without them, at no cost.
`paint` refines the colours by

    L_Fill = 1/T sum_views |I_p - I_r|^2

with I_p the scene at rest with the inside drawn (e = 1), I_r without it (docs/method.md, section 7): only the colours
of the inside change, by an optimiser of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import rasterize
from physics3d.gaussians.sh import sh_color
from physics3d.log import Log

CLOSED, OPEN = 1.3, 1.8  # |x_i - x_j| / |X_i - X_j| at which a Gaussian begins to show, and shows fully
OPACITY = 0.95
SIZE = 0.6  # standard deviation [spacings]: neighbours overlap to a closed face
REACH = 2.05  # of the neighbours [spacings]
MOST = 34  # neighbours looked at: a cubic lattice has 32, and the particle is its own
COLORS = 8  # surface Gaussians that give an inner one its colour


@dataclass(frozen=True, kw_only=True)
class Interior:
    gaussians: Gaussians  # one per inner particle, at rest
    particle: Int[Tensor, " i"]  # index into the particles
    neighbours: Int[Tensor, "i k"]  # of each, index into the particles

    @classmethod
    def of(
        cls, surface: Gaussians, position: Float[Tensor, "p 3"], inside: Bool[Tensor, " p"], spacing: float
    ) -> Self | None:
        """For the particles `inside`, `spacing` [m] apart at `position` [m]; None if there is none."""
        from scipy.spatial import cKDTree

        particle = torch.nonzero(inside).flatten()
        if len(particle) == 0 or len(surface) == 0:
            return None
        X = position.double().numpy()
        chosen = X[particle.numpy()]
        distance, near = cKDTree(X).query(chosen, k=list(range(1, min(MOST, len(X)) + 1)))
        near[distance > REACH * spacing] = len(X)
        near = torch.from_numpy(near)
        near = torch.where(near == len(X), particle[:, None], near)  # its own neighbour: never apart
        k = min(COLORS, len(surface))
        distance, shown = cKDTree(surface.mean.double().numpy()).query(chosen, k=list(range(1, k + 1)))
        weight = torch.from_numpy(1 / (distance + spacing / 4)).float() * surface.opacity[shown]
        color = (weight[..., None] * surface.sh[shown][:, :, 0]).sum(1) / weight.sum(1, keepdim=True)
        n = len(particle)
        gaussians = Gaussians(
            mean=position[particle].float(),
            log_scale=torch.full((n, 3), SIZE * spacing).log(),
            quaternion=torch.tensor([1.0, 0, 0, 0]).expand(n, 4).contiguous(),
            opacity_logit=torch.full((n,), OPACITY).logit(),
            sh=color[:, None],
        )
        return cls(gaussians=gaussians, particle=particle, neighbours=near)

    def to(self, device: torch.device | str) -> Self:
        moved = {name: getattr(self, name).to(device) for name in ("gaussians", "particle", "neighbours")}
        return replace(self, **moved)

    def opened(self, X: Float[Tensor, "p 3"], x: Float[Tensor, "p 3"]) -> Float[Tensor, " i"]:
        """e in 0..1 of each when the particles went from X to x [m]."""
        apart = lambda at: (at[self.neighbours] - at[self.particle][:, None]).norm(dim=2)
        before = apart(X.to(x))
        ratio = torch.where(before > 0, apart(x) / before.clamp_min(1e-30), torch.ones_like(before))
        return ((ratio.amax(1) - CLOSED) / (OPEN - CLOSED)).clamp(0, 1)

    def drawn(
        self, X: Float[Tensor, "p 3"], x: Float[Tensor, "p 3"]
    ) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s 3 3"], Float[Tensor, " s"], Float[Tensor, "s 3"]]:
        """Means [m], covariances [m^2], opacities and colours of those that show; they keep their round shape."""
        e = self.opened(X, x)
        at = torch.nonzero(e > 0).flatten()
        g = self.gaussians.select(at)
        return x[self.particle[at]], g.covariance().to(x), (e[at] * OPACITY).to(x), sh_color(g.sh, g.mean).to(x)


def paint(
    interior: Interior,
    surface: Gaussians,
    cameras: Sequence[Camera],
    *,
    background: Float[Tensor, " 3"] | tuple[float, float, float],
    steps: int,
    rate: float = 0.02,
    log: Log,
) -> Interior:
    """Colours of the inside by descent on L_Fill (Adam, `rate` per step); everything else stays as it is."""
    g = interior.gaussians
    sh = g.sh.clone().requires_grad_()
    optimizer = torch.optim.Adam([sh], lr=rate)
    mean, covariance = torch.cat([surface.mean, g.mean]), torch.cat([surface.covariance(), g.covariance()])
    opacity = torch.cat([surface.opacity, g.opacity])
    for step in log.progress(range(steps), "painting the inside"):
        camera = cameras[step % len(cameras)]
        outside = sh_color(surface.sh, surface.mean - camera.centre.to(surface.mean))
        with torch.no_grad():
            known = rasterize(
                surface.mean, surface.covariance(), surface.opacity, outside, camera, background=background
            ).color
        color = torch.cat([outside.detach(), sh_color(sh, g.mean)])
        loss = (
            (rasterize(mean, covariance, opacity, color, camera, background=background).color - known).square().mean()
        )
        log.metric("fill_loss", float(loss.detach()), step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return replace(interior, gaussians=replace(g, sh=sh.detach()))
