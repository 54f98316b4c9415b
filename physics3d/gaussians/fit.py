"""Photographs -> Gaussians: gradient descent on appearance, with Gaussians added where the pictures are wrong.

    loss = (1 - s) |image - photograph|_1 + s (1 - SSIM) + a |alpha - matte|_1 + the densification's penalty

s = `ssim_weight`, a = `MATTE_WEIGHT` where there are mattes, which makes empty space transparent. The count grows to a
cap (`densify.py` says how). The early part runs at a quarter and half resolution, and colour starts to depend on the
viewing direction degree by degree. Photographs may differ in exposure: image_i = g_i colour + b_i per channel, learned
beside the Gaussians, with the means over the photographs held at ln g = 0, b = 0.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.checks import Factor, NotNegative, require_fields
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.densify import AbstractDensification, Moments
from physics3d.gaussians.model import FIELDS, Gaussians
from physics3d.gaussians.rasterize import NEAR, Rendered, contribution
from physics3d.gaussians.render import render
from physics3d.gaussians.sh import C0
from physics3d.gaussians.ssim import ssim

MATTE_WEIGHT = 0.2  # of the error in alpha, in the loss
SCORED_VIEWS = 8  # photographs looked at to decide where Gaussians are missing, or whether to stop
GROWTH = (0.05, 0.7)  # part of the iterations during which Gaussians are added and removed
COARSE = ((0.1, 0.25), (0.35, 0.5))  # until which part of the iterations, at what share of the resolution
LEAST_SIDE = 80  # photographs are not reduced below this [px]
SH_WARM_UP = 0.3  # part of the iterations after which all degrees of the harmonics are learned
BETTER = 0.05  # gain of PSNR that counts as improvement [dB]


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

    mean: NotNegative = 1e-3  # times the extent of the scene
    log_scale: NotNegative = 8e-2
    quaternion: NotNegative = 2e-2
    opacity_logit: NotNegative = 5e-2
    sh: NotNegative = 1e-2  # degree 0; the higher ones learn 10 times slower
    exposure: NotNegative = 1e-2  # of a photograph, where exposures are learned
    final: Factor = 0.05

    def check(self) -> None:
        """Raise ValueError naming field, value and remedy."""
        require_fields(self, "rates")


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
    """Up to `count` points [m, 3] [m] that most cameras see, inside every matte, and their mean colours [m, 3].

    Drawn around the point nearest to all optical axes, in a box that shrinks to what is seen in common. Raises
    ValueError if the cameras see nothing in common.
    """
    picks = torch.linspace(0, len(photographs) - 1, min(24, len(photographs))).round().long().tolist()
    views = [photographs[i] for i in picks]
    centres = torch.stack([p.camera.centre for p in views]).double()
    axes = torch.stack([p.camera.world_to_camera[2, :3] for p in views]).double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    middle = torch.linalg.lstsq(across.sum(0), (across @ centres[..., None]).sum(0)).solution[:, 0]
    reach = (centres - middle).norm(dim=-1).median()
    lower, upper = middle - reach, middle + reach
    points, colors = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3)
    for _ in range(40):
        tried = lower + (upper - lower) * torch.rand(50_000, 3, generator=generator, dtype=torch.float64)
        keep, color = _seen_in_common(tried, views)
        points, colors = torch.cat([points, tried[keep]]), torch.cat([colors, color[keep]])
        if len(points) >= count:
            break
        if len(points) >= 10:
            margin = 0.2 * (points.amax(0) - points.amin(0))
            lower = torch.maximum(lower, points.amin(0) - margin)
            upper = torch.minimum(upper, points.amax(0) + margin)
    if not len(points):
        raise ValueError("the cameras see no common space; check the poses, or give the capture points")
    return points[:count].float(), colors[:count]


def _seen_in_common(points: Float[Tensor, "m 3"], views: list[Photograph]) -> tuple[Tensor, Float[Tensor, "m 3"]]:
    """Which points six tenths of the views see, and none sees outside its matte; the mean colour they are seen in."""
    seen, inside = torch.zeros(len(points)), torch.ones(len(points), dtype=torch.bool)
    color = torch.zeros(len(points), 3)
    for p in views:
        uv, z = p.camera.project(points)
        u, v = uv.floor().long().unbind(-1)
        visible = (z > NEAR) & (u >= 0) & (u < p.camera.width) & (v >= 0) & (v < p.camera.height)
        u, v = u[visible], v[visible]
        seen[visible] += 1
        color[visible] += p.color[v, u]
        if p.alpha is not None:
            inside[visible] &= p.alpha[v, u] > 0.1
    return inside & (seen >= 0.6 * len(views)), color / seen.clamp_min(1)[:, None]


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


class Exposure:
    """Gain and offset per photograph and channel [photographs, 3], and one step of Adam on those of one photograph."""

    def __init__(self, count: int, device: torch.device):
        self.values = torch.zeros(2, count, 3, device=device)  # ln of the gain, offset
        self.mean, self.square = torch.zeros_like(self.values), torch.zeros_like(self.values)

    def of(self, i: int) -> Float[Tensor, "2 3"]:
        return self.values[:, i].clone().requires_grad_()

    @staticmethod
    def applied(drawn: Rendered, values: Float[Tensor, "2 3"], behind: Float[Tensor, " 3"]) -> Float[Tensor, "h w 3"]:
        """The background is not part of the photograph: it keeps its colour."""
        beside = (1 - drawn.alpha)[..., None] * behind
        return torch.exp(values[0]) * (drawn.color - beside) + values[1] * drawn.alpha[..., None] + beside

    def step(self, i: int, gradient: Float[Tensor, "2 3"], size: float) -> None:
        # each photograph comes by rarely: its second moment forgets faster than the Gaussians'
        self.mean[:, i].lerp_(gradient, 0.2)
        self.square[:, i].lerp_(gradient.square(), 0.05)
        self.values[:, i] -= size * self.mean[:, i] / (self.square[:, i].sqrt() + 1e-12)
        self.values -= self.values.mean(1, keepdim=True)


def fit(
    start: Gaussians,
    photographs: list[Photograph],
    held_out: list[Photograph],
    *,
    background: Float[Tensor, " 3"],
    iterations: int,
    max_gaussians: int,
    densification: AbstractDensification,
    ssim_weight: float,
    rates: Rates,
    exposure: bool,
    check_every: int,
    patience: int,
    seed: int,
    log,
    preview: Callable[[Gaussians, int], None],
) -> Gaussians:
    """Fit `start` to the photographs. Stops early when `patience` checks in a row bring less than 0.05 dB.

    A check is the mean PSNR of some photographs that are trained on, always the same; those held out are measured
    beside it and decide nothing, so that their PSNR is that of photographs never looked at. `preview` is called at
    every check with the model and the iteration. Same seed, same machine: same result (CPU).
    """
    generator = torch.Generator().manual_seed(seed)
    device = photographs[0].color.device
    centres = torch.stack([p.camera.centre for p in photographs])
    extent = float((centres - centres.mean(0)).norm(dim=-1).max()) * 1.1
    coarse = {factor: _reduced(photographs, factor) for _, factor in COARSE}
    model, first = start.to(device, torch.float32), len(start)
    moments: Moments = {}
    lenses = Exposure(len(photographs), device) if exposure else None
    degrees = round(math.sqrt(start.sh.shape[1]))  # how many, with degree 0
    queue: list[int] = []
    best, stale, recent = -math.inf, 0, float("nan")
    looked_at = range(0, len(photographs), max(1, len(photographs) // SCORED_VIEWS))

    steps = log.progress(range(iterations), "fitting Gaussians", total=iterations)
    for step in steps:
        if not queue:
            queue = torch.randperm(len(photographs), generator=generator).tolist()
        which, done = queue.pop(), step / iterations
        level = next((coarse[factor] for until, factor in COARSE if done < until), photographs)
        photograph = level[which]

        model = replace(model, **{name: getattr(model, name).detach().requires_grad_() for name in FIELDS})
        known = min(degrees, 1 + int(degrees * done / SH_WARM_UP)) ** 2
        drawn = render(replace(model, sh=model.sh[:, :known]), photograph.camera, background=background)
        image, truth = drawn.color, photograph.on(background)
        if lenses is not None:
            values = lenses.of(which)
            image = lenses.applied(drawn, values, background)
        loss = (1 - ssim_weight) * (image - truth).abs().mean() + densification.penalty(model, extent)
        if ssim_weight > 0:
            loss = loss + ssim_weight * (1 - ssim(image, truth))
        if photograph.alpha is not None:
            loss = loss + MATTE_WEIGHT * (drawn.alpha - photograph.alpha).abs().mean()
        loss.backward()
        fall = rates.final**done
        model = _adam(model, moments, rates, extent, step, fall)
        model = densification.stirred(model, fall * rates.mean / extent, generator)
        if lenses is not None:
            lenses.step(which, values.grad, fall * rates.exposure)  # type: ignore[arg-type]
        value = psnr(image.detach(), truth)
        recent = value if math.isnan(recent) else 0.95 * recent + 0.05 * value
        steps.set_postfix(psnr=f"{recent:.1f} dB", gaussians=str(len(model)), refresh=False)

        done = (step + 1) / iterations
        if (step + 1) % densification.every == 0 and GROWTH[0] <= done <= GROWTH[1]:
            part = (done - GROWTH[0]) / (GROWTH[1] - GROWTH[0])
            wanted = round(first + (max_gaussians - first) * min(1.0, 1.25 * part))
            picks = torch.randperm(len(photographs), generator=generator)[:SCORED_VIEWS].tolist()
            views = [level[i] for i in picks]
            error = partial(drawn_error, model, views, background)
            model = densification.renewed(model, moments, error, wanted, generator)
        if (step + 1) % check_every == 0 or step + 1 == iterations:
            now = _training_psnr(model, photographs, looked_at, lenses, background)
            log.metric("psnr_train", now, step + 1)
            log.metric("gaussians", len(model), step + 1)
            if held_out:
                log.metric("psnr_held_out", held_out_psnr(model, held_out, background), step + 1)
            stale = 0 if now > best + BETTER else stale + 1
            best = max(best, now)
            preview(model, step + 1)
            if stale >= patience and done > GROWTH[1]:
                log.info(f"training PSNR no longer improves after {step + 1} iterations")
                break
    steps.close()
    return model


def _training_psnr(
    model: Gaussians, photographs: list[Photograph], which: range, lenses: Exposure | None, background: Tensor
) -> float:
    """Mean PSNR [dB] over some of the photographs that are trained on, each with its exposure."""
    values = []
    with torch.no_grad():
        for i in which:
            drawn = render(model, photographs[i].camera, background=background)
            image = drawn.color if lenses is None else lenses.applied(drawn, lenses.of(i), background)
            values.append(psnr(image, photographs[i].on(background)))
    return sum(values) / len(values)


def drawn_error(model: Gaussians, views: list[Photograph], background: Float[Tensor, " 3"]) -> Float[Tensor, " n"]:
    """Error that each Gaussian draws in the view where it is largest: sum of blending weight x absolute error [px]."""
    error = torch.zeros(len(model), device=model.mean.device)
    for p in views:
        wrong = (render(model, p.camera, background=background).color - p.on(background)).abs().mean(-1)
        error = torch.maximum(error, contribution(model, p.camera, wrong[None])[:, 0])
    return error


def _reduced(photographs: list[Photograph], factor: float) -> list[Photograph]:
    factor = max(factor, LEAST_SIDE / min(min(p.color.shape[:2]) for p in photographs))
    return photographs if factor >= 1 else [p.scaled(factor) for p in photographs]


def _adam(model: Gaussians, moments: Moments, rates: Rates, extent: float, step: int, fall: float) -> Gaussians:
    """One step of Adam (0.9, 0.999) on every field; `moments` are kept beside the fields so that they follow splits."""
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
