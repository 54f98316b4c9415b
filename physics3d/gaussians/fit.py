"""Photographs -> Gaussians: gradient descent on appearance, with Gaussians added where the pictures are wrong.

The loss is in `loss.py`. The count grows to a cap (`densification/` says how). The early part runs at a quarter and
half resolution, and colour starts to depend on the viewing direction degree by degree. Photographs may differ in
exposure (`exposure.py`). A fit that was stopped goes on from its checkpoint.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.checkpoint import Checkpoint
from physics3d.gaussians.adam import Moments, Rates, stepped
from physics3d.gaussians.densification.base import AbstractDensification
from physics3d.gaussians.exposure import Exposure
from physics3d.gaussians.loss import held_out_psnr, psnr, reconstruction_loss
from physics3d.gaussians.model import FIELDS, Gaussians
from physics3d.gaussians.photograph import Photograph
from physics3d.gaussians.rasterize import contribution
from physics3d.gaussians.render import render

SCORED_VIEWS = 8  # photographs looked at to decide where Gaussians are missing
GROWTH = (0.05, 0.7)  # part of the iterations during which Gaussians are added and removed
COARSE = ((0.1, 0.25), (0.35, 0.5))  # until which part of the iterations, at what share of the resolution
LEAST_SIDE = 80  # photographs are not reduced below this [px]
SH_WARM_UP = 0.3  # part of the iterations after which all degrees of the harmonics are learned
BETTER = 0.05  # gain of PSNR that counts as improvement [dB]


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

    checkpoint, begin = Checkpoint(log), 0
    if kept := checkpoint.load():
        begin, queue, best, stale, recent = (kept[k] for k in ("step", "queue", "best", "stale", "recent"))
        model = kept["model"].to(device)
        moments = {name: (m.to(device), v.to(device)) for name, (m, v) in kept["moments"].items()}
        generator.set_state(kept["generator"])
        if lenses is not None:
            lenses.restore(kept["lenses"])

    steps = log.progress(range(begin, iterations), "fitting Gaussians", total=iterations, done=begin)
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
        penalty = densification.penalty(model, extent)
        loss = reconstruction_loss(
            image, drawn.alpha, truth, photograph.alpha, penalty=penalty, ssim_weight=ssim_weight
        )
        loss.backward()
        fall = rates.final**done
        model = stepped(model, moments, rates, extent, step, fall)
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
        state = dict(step=step + 1, queue=queue, best=best, stale=stale, recent=recent, model=model, moments=moments)
        state |= dict(generator=generator.get_state(), lenses=lenses and lenses.state())
        checkpoint.save(state, f"at step {step + 1} of {iterations}")
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
