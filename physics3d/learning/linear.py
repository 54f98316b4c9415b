"""The chain around theta, made linear: code(theta + d) = code + J d, and how well parameters can be told from it."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from physics3d.learning.fields import GlobalField
from physics3d.learning.loss import Chain


@dataclass(frozen=True)
class Linear:
    """The chain around theta: code(theta + d) = code + J d, over all views and frames; sums divided by N pixels."""

    JJ: Tensor  # w J^T J / N [k, k]
    Jr: Tensor  # w J^T (z0 - x0_hat) / N [k]: the SDS gradient
    rms: Tensor  # of the columns of J [k], colour in 0..1
    residual: float  # rms of z0 - x0_hat
    count: int  # numbers in the code


def linearise(chain: Chain, field: GlobalField, theta: Tensor, *, seed: int, step: float = 0.05) -> Linear:
    """J by forward differences in theta: k + 1 simulations, none of them differentiated."""
    k, frames = len(theta), torch.arange(len(next(iter(chain.clips.values()))))
    JJ, Jr, squares, residual, count, pixels = (
        torch.zeros(k, k).double(),
        torch.zeros(k).double(),
        torch.zeros(k),
        0.0,
        0,
        0,
    )
    with torch.no_grad():
        motions = [chain.simulate(t) for t in (theta, *(theta + step * torch.eye(k, dtype=theta.dtype)))]
        for view, clip in chain.clips.items():
            codes = [chain.prior.encode(chain.render(motion, view, frames)) for motion in motions]
            generator = torch.Generator().manual_seed(seed)
            level = chain.prior.level(generator)
            noise = torch.randn(codes[0].shape, generator=generator).to(codes[0])
            condition = chain.prior.condition(clip[0], (clip,))
            estimate = chain.prior.x0_hat(level.alpha * codes[0] + level.sigma * noise, level, condition)
            J = torch.stack([(code - codes[0]).flatten() / step for code in codes[1:]], 1).double().cpu()
            r, w = (codes[0] - estimate).flatten().double().cpu(), chain.prior.weight(level)
            JJ, Jr, squares = JJ + w * J.T @ J, Jr + w * J.T @ r, squares + J.square().sum(0)
            residual, count, pixels = residual + float(r.square().sum()), count + len(r), pixels + clip.numel()
    return Linear(JJ / pixels, Jr / pixels, (squares / count).sqrt(), math.sqrt(residual / count), count)


def sensitivity(chain: Chain, field: GlobalField, theta: Tensor, *, seed: int) -> dict[str, tuple[float, float]]:
    """How well each component can be told: name -> (change of the code per unit of theta [rms x 255], error of theta).

    The error is sqrt(diag(s^2 (J^T J)^-1)) with the residual's mean square s^2, as if residuals were independent from
    pixel to pixel: they are not, so it is a lower bound. Infinite if unobservable.
    """
    around = linearise(chain, field, theta, seed=seed)
    scale = around.rms.clamp_min(1e-12).double()
    correlation = around.JJ / around.JJ.diagonal().sqrt().clamp_min(1e-12).outer(
        around.JJ.diagonal().sqrt().clamp_min(1e-12)
    )
    variance = torch.linalg.pinv(correlation, hermitian=True).diagonal() / scale**2 * around.residual**2 / around.count
    error = torch.where(255 * around.rms > 1e-3, variance.clamp_min(0).sqrt(), torch.inf)
    return {name: (255 * float(r), float(e)) for name, r, e in zip(field.names, around.rms, error)}
