"""Which recording would settle between models that a clip leaves open (`which_model.py`).

Recordings that a person could make next are computed for the whole model and for a simpler one. What moves apart, less
what the simpler one can make good without leaving the first clip,

    N rise = min over d of 1/2 d^T A d + 1/2 |z - z_simpler - J d|^2

tells by the ln B of `likelihood.py` how far each would settle it, were it filmed as well as this clip. (Experiments
designed to discriminate: Atkinson and Fedorov 1975.)
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.impulse import Impulse
from physics3d.learning.linear import STEP, asked, linearise
from physics3d.learning.loss import Chain
from physics3d.learning.which_model import TIE, Verdict, within
from physics3d.log import Log
from physics3d.trajectory import NotMoved

LONGER = 3.0  # than the clip, is what could be filmed next
PULL = 1 / 3  # of the force of a push, that pulls steadily


def film_next(
    chain: Chain,
    theta: Float[Tensor, " k"],
    verdicts: list[Verdict],
    *,
    seed: int,
    log: Log,
) -> dict[str, float]:
    """Recordings that the chain knows how to make -> the ln B that each is expected to add where the clip leaves a tie;
    of several ties the one that it settles least. None where there is none."""
    ties = [verdict for verdict in verdicts if verdict.tie]
    if not ties:
        return {}
    pixels = sum(clip.numel() for clip in chain.clips.values())
    first = [linearise(within(chain, tie.model), tie.model.field, tie.theta, seed=seed).JJ.numpy() for tie in ties]
    found = {}
    for name, make in log.progress(chain.recordings.items(), "what to film next", total=len(chain.recordings)):

        def answer(make=make) -> list[float]:
            simulate = make()
            return [rise(simulate, chain, theta, tie, JJ, seed=seed) for tie, JJ in zip(ties, first)]

        try:
            told = chain.journal.ask("film next", name, theta, *(tie.theta for tie in ties), answer=answer)
        except NotMoved as reason:
            log.info(f"{name}: not asked, for nothing moves the body so ({reason})")
            continue
        found[name] = min(tie.ratio.odds(rise=pixels * one) for tie, one in zip(ties, told))
        log.metric(f"film_next/{name}", found[name])
    best = max(found, key=lambda name: found[name], default=None)
    if best is not None:
        log.info(
            f"to tell: {'; '.join(f'{name} (ln B {value:.1f})' for name, value in found.items())}"
            + ("" if found[best] >= TIE else "; none of them is expected to settle it, were it filmed as this clip is")
        )
    return found


def rise(
    simulate: Callable[[Tensor], Any],
    chain: Chain,
    theta: Tensor,
    tie: Verdict,
    JJ: Float[np.ndarray, "s s"],
    *,
    seed: int,
) -> float:
    """Of the loss of a simpler model in another recording, of the whole at theta, over all views.

    `simulate` makes its motions by the theta of the whole; `JJ` is the first clip's (`Linear`)."""
    places = (tie.theta, *(tie.theta + STEP * torch.eye(len(tie.theta), dtype=tie.theta.dtype)))
    A, b, c, pixels = np.zeros_like(JJ), np.zeros(len(JJ)), 0.0, 0
    motions = [
        chain.noted("recorded", at, made=partial(simulate, at))
        for at in (theta, *(tie.model.whole(place) for place in places))
    ]
    with torch.no_grad():
        for view in chain.clips:
            first, code, _, w = asked(chain, motions[0], view, seed)
            others = [chain.prior.encode(chain.render(motion, view, chain.frames)) for motion in motions[1:]]
            real, here, *beside = (code.flatten().double().cpu().numpy() for code in (code, *others))
            J, apart = np.stack([(code - here) / STEP for code in beside], 1), real - here
            A, b, c = A + w * J.T @ J, b + w * J.T @ apart, c + w * float(apart @ apart)
            pixels += first.numel()
    return max(0.5 * (c - float(b @ np.linalg.pinv(JJ * pixels + A, hermitian=True) @ b)) / pixels, 0.0)


def recordings(
    excitation: tuple[AbstractBoundary, ...], seconds: float
) -> dict[str, tuple[tuple[AbstractBoundary, ...], float]]:
    """What a person could film next of a thing that was filmed for so long [s], in words -> (what sets it going, how
    many times as long it is filmed)."""
    long = LONGER * seconds
    found: dict[str, tuple[tuple[AbstractBoundary, ...], float]] = {
        f"the same again, filmed for {long:.2g} s": (excitation, LONGER)
    }
    pushes = [b for b in excitation if isinstance(b, Impulse) and b.force is not None and any(map(float, b.force))]
    if len(pushes) != 1:  # several together have no side
        return found
    push = pushes[0]
    assert push.force is not None
    x, y, z = map(float, push.force)
    other = lambda **change: tuple(replace(b, **change) if b is push else b for b in excitation)
    found["a push as strong, from another side"] = (
        other(force=(-y, x, z) if math.hypot(x, y) > abs(z) else (z, x, y)),
        1,
    )
    weight = PULL * math.hypot(x, y, z)
    found[f"a steady pull of {weight:.2g} N where it was pushed, as by a weight on a thread, for {long:.2g} s"] = (
        other(force=(PULL * x, PULL * y, PULL * z), duration=long),
        LONGER,
    )
    return found
