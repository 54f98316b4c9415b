"""The chain around theta, made linear, z0(theta + d) = z0 + J d, and what its pictures say of theta (`Evidence`).

For priors whose estimate does not depend on the noise: z0 - x0_hat is then a residual, as of any fit of a recording.

J is by differences around theta, from half a step before it to half a step after it. From theta on they cost k motions
instead of 2 k, and are wrong by half a step times the second derivative. What one parameter does less what others make
good of it, which is all that is left along a valley of the loss, may be smaller than that: for the relaxation time of
a carnation such a gradient was zero a third away from where the loss is least, and the valley seemed four times as
steep as it is (on when differences from one side do: Gill, Murray and Wright 1981, Practical Optimization, 8.6).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.learning.fields import AbstractField
from physics3d.learning.loss import COARSER, Chain
from physics3d.learning.sandwich import Evidence, blocks, correlation_length
from physics3d.priors.base import draws
from physics3d.trajectory import NotMoved

STEP = 0.05  # of theta, in differences


@dataclass(frozen=True)
class Linear:
    """The chain around theta: code(theta + d) = code + J d, over all views and frames; sums divided by N pixels."""

    JJ: Tensor  # w J^T J / N [k, k]
    Jr: Tensor  # w J^T (z0 - x0_hat) / N [k]: the SDS gradient


@dataclass(frozen=True)
class _Beside:
    """Two motions whose difference over `width` is a derivative."""

    after: Any
    before: Any
    width: float


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """One view of the motions around theta."""

    video: Float[Tensor, "t h w 3"]  # of theta
    changes: list[Float[Tensor, "t h w 3"]]  # of the video, by every component of theta
    J: Float[Tensor, "d k"]  # on the CPU, like r
    r: Float[Tensor, " d"]  # z0 - x0_hat
    weight: float  # w


def linearise(chain: Chain, field: AbstractField, theta: Tensor, *, seed: int, step: float = STEP) -> Linear:
    """J by differences around theta: 2 k + 1 simulations, none of them differentiated."""
    made = lambda: _linearised(chain, theta, seed, step)
    return Linear(*chain.journal.ask("linearise", theta, seed, step, answer=made))


def _linearised(chain: Chain, theta: Tensor, seed: int, step: float) -> tuple[Tensor, Tensor]:
    k = len(theta)
    JJ, Jr = torch.zeros(k, k).double(), torch.zeros(k).double()
    pixels = sum(clip.numel() for clip in chain.clips.values())
    here, beside = _motions(chain, theta, step)

    def added(view: int) -> tuple[Tensor, Tensor]:
        seen = _around(chain, here, beside, view, seed)
        return seen.weight * seen.J.T @ seen.J, seen.weight * seen.J.T @ seen.r

    for view in chain.clips:
        one, other = chain.journal.ask("view", view, answer=partial(added, view))
        JJ, Jr = JJ + one, Jr + other
    return JJ / pixels, Jr / pixels


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What a chain's pictures say of theta."""

    evidence: Evidence
    push: Float[np.ndarray, " k"]  # phi: change of the theta that fits with ln of the known forces; 0 without any
    grid: Float[np.ndarray, " k"]  # what the cells of a grid are taken for, as change of theta; 0 without a grid
    rms: Float[np.ndarray, " k"]  # change of the code per unit of theta, colour in 0..1


def shown(chain: Chain, field: AbstractField, theta: Tensor, *, seed: int, step: float = STEP) -> Shown:
    """2 k + 1 simulations, two more where a known force drives the motion, and one where a grid moves the body.

    That one is of cells COARSER times as large. Errors of cells are taken to be in proportion to their size (as those
    of contact are, which begins a cell before the wall; a bend's are of higher order, and this too much): the change
    of theta that draws what larger cells draw, divided by COARSER - 1, is what the cells that are used are wrong by.

    Scores are counted where the pictures are: s(x) = g(x) dvideo(x)/dtheta with g the gradient of the SDS loss by the
    colours of pixel x, whatever the prior's code.
    """
    made = lambda: _shown(chain, theta, seed, step)
    told = chain.journal.ask("shown", theta, seed, step, answer=made)
    return Shown(evidence=Evidence(**told["evidence"]), push=told["push"], grid=told["grid"], rms=told["rms"])


def _shown(chain: Chain, theta: Tensor, seed: int, step: float) -> dict[str, Any]:
    k = len(theta)
    here, beside = _motions(chain, theta, step)
    if (pushed := chain.pushed) is not None:
        sides = (step / 2, -step / 2)
        after, before = (chain.noted("pushed", theta, side, made=partial(pushed, theta, side)) for side in sides)
        beside.append(_Beside(after, before, step))
    if (coarser := chain.coarser) is not None:
        beside.append(_Beside(chain.noted("coarser", theta, made=partial(coarser, theta)), here, step))

    def added(view: int) -> dict[str, Any]:
        seen = _around(chain, here, beside, view, seed)
        J = seen.J.numpy()
        changes = (change.double().cpu().numpy() for change in seen.changes[:k])
        score, share = _in_blocks(_gradient(chain, seen), changes)
        return dict(JJ=seen.weight * J.T @ J, squares=(J**2).sum(0), count=len(J), score=score, share=share)

    told = [chain.journal.ask("view", view, answer=partial(added, view)) for view in chain.clips]
    JJ, squares = sum(one["JJ"] for one in told), sum(one["squares"] for one in told)
    count, scores, shares = (sum(one["count"] for one in told), [o["score"] for o in told], [o["share"] for o in told])
    taken_for = np.linalg.pinv(JJ[:k, :k], hermitian=True) @ JJ[:k, k:]
    push = taken_for[:, 0] if chain.pushed is not None else np.zeros(k)
    grid = taken_for[:, -1] * step / (COARSER - 1) if chain.coarser is not None else np.zeros(k)
    evidence = dict(JJ=JJ[:k, :k].copy(), score=np.concatenate(scores, 1), share=np.concatenate(shares, 1))
    return dict(evidence=evidence, push=push, grid=grid, rms=np.sqrt(squares[:k] / max(count, 1)))


def _in_blocks(
    g: Float[np.ndarray, "t h w 3"], changes: Iterable[Float[np.ndarray, "t h w 3"]]
) -> tuple[Float[np.ndarray, "t p k"], Float[np.ndarray, "t p k"]]:
    """(scores, shares) of changes of a view's video, as of `Evidence`; g is the gradient by its colours."""
    summed = [((g * change).sum(-1), (change**2).sum(-1)) for change in changes]
    s, I = (np.stack(values, -1) for values in zip(*summed))
    # pixels that change at all; all of them where none does, as in a view that looks away
    whole = I.sum((0, 3))
    counts = whole > 1e-6 * float(whole.max()) if whole.any() else whole == 0
    t, c = len(g), g.shape[-1]
    residual = (g * counts[..., None]).transpose(0, 3, 1, 2).reshape(t * c, *counts.shape)
    row, column = np.nonzero(counts)
    block, number = blocks(row, column, correlation_length(residual))
    added = lambda values: np.stack(
        [[np.bincount(block, f[counts, i], number) for i in range(s.shape[-1])] for f in values]
    ).transpose(0, 2, 1)
    return added(s), added(I)


def apart(chain: Chain, theta: Tensor, others: Sequence[Tensor], *, seed: int) -> list[Evidence]:
    """What the residuals at theta say of the difference to each of the others, as of a derivative: k = 1."""
    told = chain.journal.ask("apart", theta, *others, seed, answer=lambda: _apart(chain, theta, others, seed))
    return [Evidence(**one) for one in told]


def _apart(chain: Chain, theta: Tensor, others: Sequence[Tensor], seed: int) -> list[dict[str, Any]]:
    places = chain.journal.log.progress((theta, *others), "comparing with what else was tried")
    motions = [chain.motion(place) for place in places]

    def added(view: int) -> list[dict[str, Any]]:
        first, code, r, w = asked(chain, motions[0], view, seed)
        g = _gradient(chain, _Seen(video=first, changes=[], J=torch.zeros(len(r), 0), r=r, weight=w))
        found = []
        for motion in motions[1:]:  # one at a time: videos are large
            with torch.no_grad():
                video = chain.render(motion, view, chain.frames)
                square = w * float((chain.prior.encode(video) - code).double().square().sum())
            score, share = _in_blocks(g, [(video - first).double().cpu().numpy()])
            found.append(dict(square=square, score=score, share=share))
        return found

    told = [chain.journal.ask("view", view, answer=partial(added, view)) for view in chain.clips]
    return [
        dict(
            JJ=np.full((1, 1), sum(one["square"] for one in views)),
            score=np.concatenate([one["score"] for one in views], 1),
            share=np.concatenate([one["share"] for one in views], 1),
        )
        for views in zip(*told)
    ]


def _motions(chain: Chain, theta: Tensor, step: float) -> tuple[Any, list[_Beside]]:
    """(the motion at theta; for each component those half a step after theta and before it). Where nothing moves the
    body on one of both sides, theta stands for it. Raises NotMoved where nothing does on either."""
    half = step / 2 * torch.eye(len(theta), dtype=theta.dtype)
    places = chain.journal.log.progress((theta, *(theta + half), *(theta - half)), "looking around")
    here, *others = [_moved(chain, place) for place in places]
    if here is None:
        here = chain.motion(theta)  # says why
    beside = []
    for i, (after, before) in enumerate(zip(others[: len(theta)], others[len(theta) :], strict=True)):
        if after is None and before is None:
            chain.motion(theta + half[i])  # says why
        sides = (after is not None) + (before is not None)
        beside.append(_Beside(here if after is None else after, here if before is None else before, sides * step / 2))
    return here, beside


def _moved(chain: Chain, theta: Tensor) -> Any:
    """None where nothing moves the body."""
    try:
        return chain.motion(theta)
    except NotMoved:
        return None


def _around(chain: Chain, here: Any, beside: list[_Beside], view: int, seed: int) -> _Seen:
    """A view of them."""
    first, _, r, weight = asked(chain, here, view, seed)
    changes, columns = [], []
    with torch.no_grad():
        for pair in beside:
            after, before = (chain.render(motion, view, chain.frames) for motion in (pair.after, pair.before))
            changes.append((after - before) / pair.width)
            difference = chain.prior.encode(after) - chain.prior.encode(before)
            columns.append(difference.flatten().double().cpu() / pair.width)
    return _Seen(video=first, changes=changes, J=torch.stack(columns, 1), r=r, weight=weight)


def asked(chain: Chain, motion: Any, view: int, seed: int) -> tuple[Tensor, Tensor, Tensor, float]:
    """(video [t, h, w, 3], its code, r, w) of one view of a motion."""
    assert chain.certain, "a diffusion model's answers are no residuals"
    with torch.no_grad():
        video = chain.render(motion, view, chain.frames)
        code = chain.prior.encode(video)
        draw = draws(chain.prior, code, torch.Generator().manual_seed(seed), levels=1)[0]
        estimate = chain.prior.estimate(code, draw, chain.condition(view, chain.frames))
        return video, code, (code - estimate).flatten().double().cpu(), chain.prior.weight(draw.level)


def _gradient(chain: Chain, seen: _Seen) -> Float[np.ndarray, "t h w 3"]:
    """Of w/2 |encode(video) - x0_hat|^2 by the video."""
    video = seen.video.detach().clone().requires_grad_()
    code = chain.prior.encode(video)
    (code * (seen.weight * seen.r).reshape(code.shape).to(code)).sum().backward()
    assert video.grad is not None
    return video.grad.double().cpu().numpy()
