"""Photographs -> Gaussians: gradient descent on appearance, with Gaussians added where the pictures are wrong.

    loss = (1 - s) |image - photograph|_1 + s (1 - SSIM) + 0.01 mean opacity,   s = `ssim_weight`

Kerbl et al. (2023) split Gaussians by the gradient of their position; here, as in Rota Bulo et al. (2024), by the error
of the pixels they draw: e_i = sum over pixels of (blending weight x absolute error), which is what `contribution`
returns for an error image. Transparent Gaussians are removed, the count grows to a cap, and the early part runs at half
resolution. Photographs with a matte are composited on random colours, so that empty space becomes transparent.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import FIELDS, Gaussians
from physics3d.gaussians.rasterize import NEAR, contribution
from physics3d.gaussians.render import render
from physics3d.gaussians.sh import C0
from physics3d.gaussians.ssim import ssim

OPACITY_WEIGHT = 0.01  # of the mean opacity, in the loss: Gaussians that do not help fade, and are then removed
FADED = 0.02  # opacity below which a Gaussian is removed
SCORED_VIEWS = 8  # photographs looked at to decide where Gaussians are missing
GROWTH = (0.05, 0.7)  # part of the iterations during which Gaussians are added and removed
COARSE = 0.35  # part of the iterations, at the start, at half resolution


@dataclass(frozen=True, kw_only=True)
class Photograph:
    camera: Camera
    color: Float[Tensor, "h w 3"]  # 0..1; where there is a matte, multiplied by it
    alpha: Float[Tensor, "h w"] | None  # matte, 0..1

    def on(self, background: Float[Tensor, " 3"]) -> Float[Tensor, "h w 3"]:
        return self.color if self.alpha is None else self.color + (1 - self.alpha)[..., None] * background

    def scaled(self, factor: float) -> "Photograph":
        """Fewer pixels, each the average of those it covers."""
        camera = self.camera.scaled(factor)
        size = (camera.height, camera.width)
        shrink = lambda maps: torch.nn.functional.interpolate(maps[None], size, mode="bilinear", antialias=True)[0]
        color = shrink(self.color.permute(2, 0, 1)).permute(1, 2, 0).contiguous()
        return Photograph(camera=camera, color=color, alpha=None if self.alpha is None else shrink(self.alpha[None])[0])

    def to(self, device: str) -> "Photograph":
        return replace(self, color=self.color.to(device), alpha=None if self.alpha is None else self.alpha.to(device))


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Step sizes of Adam at the start; they fall to `final` of it, exponentially."""

    mean: float = 1e-3  # times the extent of the scene
    log_scale: float = 1e-2
    quaternion: float = 4e-3
    opacity_logit: float = 5e-2
    sh: float = 1e-2  # degree 0; the higher ones learn 10 times slower
    final: float = 0.05


def psnr(image: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio of pictures in 0..1 [dB]."""
    return -10 * math.log10(max(float((image.clamp(0, 1) - truth).square().mean()), 1e-12))


def held_out_psnr(gaussians: Gaussians, photographs: list[Photograph], background: Tensor) -> float:
    """Mean PSNR [dB] over photographs, on one background."""
    with torch.no_grad():
        values = [psnr(render(gaussians, p.camera, background=background).color, p.on(background)) for p in photographs]
    return sum(values) / len(values)


def from_points(points: Tensor, colors: Tensor, *, sh_degree: int) -> Gaussians:
    """One round Gaussian per point [m, 3], as wide as the mean distance to the three nearest others, opacity 0.1."""
    from scipy.spatial import cKDTree

    array = points.double().numpy()
    distance = cKDTree(array).query(array, k=min(4, len(array)))[0].reshape(len(array), -1)[:, 1:]
    width = torch.from_numpy(distance).mean(-1) if distance.size else torch.full((len(array),), 0.01)
    width = width.clamp(width.median() * 0.1, width.median() * 10).clamp_min(1e-6)
    sh = torch.zeros(len(points), (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (colors.float() - 0.5) / C0
    return Gaussians(
        mean=points.float(),
        log_scale=torch.log(width).float()[:, None].repeat(1, 3),
        quaternion=torch.tensor([1.0, 0, 0, 0]).repeat(len(points), 1),
        opacity_logit=torch.full((len(points),), math.log(0.1 / 0.9)),
        sh=sh,
    )


def random_points(photographs: list[Photograph], count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points [count, 3] [m] that most cameras see, inside every matte, and their mean colours [count, 3].

    Drawn around the point nearest to all optical axes. Raises ValueError if the cameras see nothing in common.
    """
    picks = torch.linspace(0, len(photographs) - 1, min(24, len(photographs))).round().long().tolist()
    views = [photographs[i] for i in picks]
    centres = torch.stack([p.camera.centre for p in views]).double()
    axes = torch.stack([p.camera.world_to_camera[2, :3] for p in views]).double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    middle = torch.linalg.lstsq(across.sum(0), (across @ centres[..., None]).sum(0)).solution[:, 0]
    reach = (centres - middle).norm(dim=-1).median()
    points, colors, enough = [], [], False
    for _ in range(40):
        tried = middle + reach * (2 * torch.rand(50_000, 3, generator=generator, dtype=torch.float64) - 1)
        seen, inside, color = (
            torch.zeros(len(tried)),
            torch.ones(len(tried), dtype=torch.bool),
            torch.zeros(len(tried), 3),
        )
        for p in views:
            uv, z = p.camera.project(tried)
            u, v = uv.floor().long().unbind(-1)
            visible = (z > NEAR) & (u >= 0) & (u < p.camera.width) & (v >= 0) & (v < p.camera.height)
            u, v = u[visible], v[visible]
            seen[visible] += 1
            color[visible] += p.color[v, u]
            if p.alpha is not None:
                inside[visible] &= p.alpha[v, u] > 0.1
        keep = inside & (seen >= 0.6 * len(views))
        points.append(tried[keep])
        colors.append(color[keep] / seen[keep, None])
        enough = sum(map(len, points)) >= count
        if enough:
            break
    if not sum(map(len, points)):
        raise ValueError("the cameras see no common space; check the poses, or give the capture points")
    return torch.cat(points)[:count].float(), torch.cat(colors)[:count]


def background_points(
    photographs: list[Photograph], points: Tensor, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Points [count, 3] [m] on rays through random pixels, as far as the farther half of `points`, with their colours.

    Structure from motion finds nothing on bare walls; without these, holes stay there.
    """
    found, colors = [], []
    for i, share in enumerate(torch.arange(count).chunk(min(count, len(photographs)))):
        photograph = photographs[(i * len(photographs)) // min(count, len(photographs))]
        uv, z = photograph.camera.project(points.double())
        w, h = photograph.camera.width, photograph.camera.height
        inside = (z > NEAR) & (uv >= 0).all(-1) & (uv[:, 0] < w) & (uv[:, 1] < h)
        if not inside.any():
            continue
        pixel = torch.randint(w * h, (len(share),), generator=generator)
        level = 0.5 + 0.5 * torch.rand(len(share), generator=generator, dtype=torch.float64)
        origin, direction = photograph.camera.rays(torch.float64)
        found.append(origin + torch.quantile(z[inside], level)[:, None] * direction.reshape(-1, 3)[pixel])
        colors.append(photograph.color.reshape(-1, 3)[pixel])
    return (torch.cat(found).float(), torch.cat(colors)) if found else (points[:0].float(), torch.zeros(0, 3))


def fit(
    start: Gaussians,
    photographs: list[Photograph],
    held_out: list[Photograph],
    *,
    background: Float[Tensor, " 3"],
    iterations: int,
    max_gaussians: int,
    ssim_weight: float,
    rates: Rates,
    densify_every: int,
    check_every: int,
    patience: int,
    seed: int,
    log,
    preview: Callable[[Gaussians, int], None],
) -> Gaussians:
    """Fit `start` to the photographs. Stops early when `patience` checks of the held-out PSNR bring less than 0.05 dB.

    `preview` is called at every check with the model and the iteration. Same seed, same machine: same result (CPU).
    """
    generator = torch.Generator().manual_seed(seed)
    device = photographs[0].color.device
    centres = torch.stack([p.camera.centre for p in photographs])
    extent = float((centres - centres.mean(0)).norm(dim=-1).max()) * 1.1
    coarse = [p.scaled(0.5) for p in photographs]
    model, moments, first = start.to(device, torch.float32), {}, len(start)  # type: ignore[var-annotated]
    queue: list[int] = []
    best, stale, recent = -math.inf, 0, float("nan")

    steps = log.progress(range(iterations), "fitting Gaussians", total=iterations)
    for step in steps:
        if not queue:
            queue = torch.randperm(len(photographs), generator=generator).tolist()
        small = step < COARSE * iterations and min(coarse[0].color.shape[:2]) >= 32
        photograph = (coarse if small else photographs)[queue.pop()]
        behind = background if photograph.alpha is None else torch.rand(3, generator=generator).to(device)

        model = replace(model, **{name: getattr(model, name).detach().requires_grad_() for name in FIELDS})
        image, truth = render(model, photograph.camera, background=behind).color, photograph.on(behind)
        loss = (1 - ssim_weight) * (image - truth).abs().mean() + OPACITY_WEIGHT * model.opacity.mean()
        if ssim_weight > 0:
            loss = loss + ssim_weight * (1 - ssim(image, truth))
        loss.backward()
        model = _adam(model, moments, rates, extent, step, iterations)
        value = psnr(image.detach(), truth)
        recent = value if math.isnan(recent) else 0.95 * recent + 0.05 * value
        steps.set_postfix(psnr=f"{recent:.1f} dB", gaussians=str(len(model)), refresh=False)

        done = (step + 1) / iterations
        if (step + 1) % densify_every == 0 and GROWTH[0] <= done <= GROWTH[1]:
            part = (done - GROWTH[0]) / (GROWTH[1] - GROWTH[0])
            wanted = round(first + (max_gaussians - first) * min(1.0, 1.25 * part))
            picks = torch.randperm(len(photographs), generator=generator)[:SCORED_VIEWS].tolist()
            views = [(coarse if small else photographs)[i] for i in picks]
            model = _renew(model, moments, views, background, wanted)
        if (step + 1) % check_every == 0 or step + 1 == iterations:
            log.metric("psnr_train", recent, step + 1)
            log.metric("gaussians", len(model), step + 1)
            if held_out:
                now = held_out_psnr(model, held_out, background)
                log.metric("psnr_held_out", now, step + 1)
                stale = 0 if now > best + 0.05 else stale + 1
                best = max(best, now)
            preview(model, step + 1)
            if stale >= patience and done > GROWTH[1]:
                log.info(f"held-out PSNR no longer improves after {step + 1} iterations")
                break
    steps.close()
    return model


def _adam(model: Gaussians, moments: dict, rates: Rates, extent: float, step: int, iterations: int) -> Gaussians:
    """One step of Adam (0.9, 0.999) on every field; `moments` are kept beside the fields so that they follow splits."""
    fall = rates.final ** (step / iterations)
    new = {}
    with torch.no_grad():
        for name in FIELDS:
            value = getattr(model, name)
            m, v = moments.setdefault(name, (torch.zeros_like(value), torch.zeros_like(value)))
            m.lerp_(value.grad, 0.1)
            v.lerp_(value.grad.square(), 0.001)
            size = fall * getattr(rates, name) * math.sqrt(1 - 0.999 ** (step + 1)) / (1 - 0.9 ** (step + 1))
            change = m / (v.sqrt() + 1e-15) * size
            if name == "mean":
                change *= extent
            if name == "sh":
                change[:, 1:] *= 0.1
            new[name] = value - change
    return replace(model, **new)


def _renew(model: Gaussians, moments: dict, views: list[Photograph], background: Tensor, wanted: int) -> Gaussians:
    """Remove faded Gaussians and split those that draw the most error in two, until there are `wanted`."""
    with torch.no_grad():
        error = torch.zeros(len(model), device=model.mean.device)
        for p in views:
            wrong = (render(model, p.camera, background=background).color - p.on(background)).abs().mean(-1)
            error = torch.maximum(error, contribution(model, p.camera, wrong[None])[:, 0])
        keep = torch.nonzero(model.opacity > FADED)[:, 0]
        if len(keep) == 0:
            raise ValueError("every Gaussian faded away; check the photographs' cameras, or give the capture points")
        count = max(0, min(wanted - len(keep), len(keep)))
        split = torch.zeros(len(model), dtype=torch.bool, device=keep.device)
        split[keep[torch.topk(error[keep], count).indices]] = True
        model, parents = model.select(torch.cat([keep, torch.nonzero(split)[:, 0]])), split[keep]
        twin = torch.cat([parents, torch.ones(count, dtype=torch.bool, device=keep.device)])
        side = torch.ones(len(model), device=keep.device)
        side[len(keep) :] = -1
        # two halves of the longest axis: centres 0.5 sigma from the middle, 0.6 times as long, 0.85 times as thick
        longest = torch.nn.functional.one_hot(model.log_scale.argmax(-1), 3).to(model.mean)
        axis = torch.einsum("nij,nj->ni", model.rotation(), longest * torch.exp(model.log_scale))
        thinner = math.log(0.85) + (math.log(0.6) - math.log(0.85)) * longest
        mean = torch.where(twin[:, None], model.mean + 0.5 * side[:, None] * axis, model.mean)
        log_scale = torch.where(twin[:, None], model.log_scale + thinner, model.log_scale)
        for name, pair in moments.items():
            moments[name] = tuple(torch.cat([a[keep], torch.zeros_like(a[:count])]) for a in pair)
    return replace(model, mean=mean, log_scale=log_scale)
