"""Which model a clip speaks for, and which recording would settle what it leaves open.

A viscoelastic solid of one branch holds two simpler ones: its spring alone, and its branch alone, which flows in the
end (Maxwell). Both are fitted to the same clip, begun where they answer its swing of angular frequency w as the whole
does, with S and D of `mirror.py`,

    without the viscous branch   E' = S
    without the elastic branch   x' = S/D,  m' = S (1 + x'^2)/x'^2,  tau' = x'/w

what is left out being LITTLE of what it was. How much the clip speaks for the whole against each is ln B of
`likelihood.py`; B of less than 20 is a tie (Kass and Raftery 1995): a part that nothing asks for may be there all the
same. Where one is left, recordings that a person could make next are computed for both. What moves apart, less what the
simpler one can make good without leaving the first clip,

    N rise = min over d of 1/2 d^T A d + 1/2 |z - z_simpler - J d|^2

tells by the same ln B how far each would settle it, were it filmed as well as this clip. (Experiments designed to
discriminate: Atkinson and Fedorov 1975.)
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary
from physics3d.boundaries.impulse import Impulse
from physics3d.learning.course import Point
from physics3d.learning.fields import GlobalField, physical
from physics3d.learning.likelihood import Ratio, ratios
from physics3d.learning.linear import STEP, asked, linearise
from physics3d.learning.loss import Chain
from physics3d.learning.mirror import NAMES, slow_and_fast
from physics3d.learning.polish import polish
from physics3d.log import Log

LONGER = 3.0  # than the clip, is what could be filmed next
PULL = 1 / 3  # of the force of a push, that pulls steadily
LITTLE = 1e-3  # of a part that is left out
TIE = math.log(20.0)  # ln B up to which a simpler model is not excluded


@dataclass(frozen=True, kw_only=True)
class Simpler:
    """A model with a part left out, in numbers of its own."""

    name: str
    field: GlobalField
    base: Float[Tensor, " k"]  # theta of the whole where that of this one is zero
    kept: list[int]  # components of the whole that this one has

    def whole(self, theta: Float[Tensor, " s"]) -> Float[Tensor, " k"]:
        """The theta of the whole model."""
        return self.base.index_add(0, torch.tensor(self.kept), theta)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What a clip says of a simpler model; `theta` is its own."""

    model: Simpler
    theta: Float[Tensor, " s"]
    ratio: Ratio  # of the whole to it

    @property
    def odds(self) -> float:
        """ln B, above zero where the clip speaks for the whole."""
        return self.ratio.odds(len(self.model.base) - len(self.theta))

    @property
    def tie(self) -> bool:
        """Whether the clip could as well be of the simpler one."""
        return self.odds < TIE

    @property
    def words(self) -> str:
        """For a person."""
        return "explains the clip as well: a tie" if self.tie else "does not explain the clip"


def simpler(field: GlobalField, theta: Float[Tensor, " k"], omega: float) -> list[Simpler]:
    """Those inside of what was learned; none where its three numbers are not learned apart, or nothing swings."""
    values = {name: float(torch.as_tensor(value).mean()) for name, value in field.parameters(theta).items()}
    moduli = slow_and_fast(values)
    groups = {name: i for i, group in enumerate(field.groups) for name in group}
    spring, branch, time = (groups.get(name) for name in NAMES)
    if moduli is None or spring is None or branch is None or time is None or len({spring, branch, time}) < 3:
        return []
    E, m = moduli
    x = omega * values[NAMES[2]]
    if not x > 0:
        return []
    stored, lost = E + m * x**2 / (1 + x**2), m * x / (1 + x**2)
    other = stored / lost
    branches = sorted({i for name, i in groups.items() if name.startswith("branch_")})
    times = sorted({i for name, i in groups.items() if name.endswith("relaxation_time")})
    elastic = {spring: math.log(stored / E)} | {i: math.log(LITTLE) for i in branches}
    flowing = {spring: math.log(LITTLE)} | {i: math.log(stored * (1 + other**-2) / m) for i in branches}
    flowing |= {i: math.log(other / x) for i in times}
    return [
        _without("without the viscous branch", field, theta, elastic, {*branches, *times}),
        _without("without the elastic branch", field, theta, flowing, {spring}),
    ]


def _without(name: str, field: GlobalField, theta: Tensor, change: dict[int, float], out: set[int]) -> Simpler:
    base = theta.detach().clone()
    for i, amount in change.items():
        base[i] += amount
    kept = [i for i in range(len(theta)) if i not in out]
    groups = [field.groups[i] for i in kept if i < len(field.groups)]
    left = replace(
        field,
        start={name: value.detach() for name, value in field.parameters(base).items()},
        learn=tuple(name for group in groups for name in group),
        ties=tuple(group for group in groups if len(group) > 1),
        start_velocity=field.velocity(base).detach(),
    )
    return Simpler(name=name, field=left, base=base, kept=kept)


def compared(
    chain: Chain,
    field: GlobalField,
    theta: Float[Tensor, " k"],
    *,
    omega: float,
    steps: int,
    stay: float,
    seed: int,
    log: Log,
) -> list[Verdict]:
    """What the clip says of the simpler models of what was learned at theta: by about ten motions each."""
    verdicts = []
    for model in simpler(field, theta, omega):
        log.info(f"the same clip {model.name}")
        own = within(chain, model)
        found, course = polish(own, model.field, model.field.zero(), steps=steps, stay=stay, seed=seed, log=log)
        loss = course[-1].loss if course else own.measure(found, seed)
        (one,) = ratios(chain, theta, [(model.whole(found), loss)], seed=seed)
        verdict = Verdict(model=model, theta=found, ratio=one)
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in physical(model.field, found).items())
        log.info(f"{model.name}: {verdict.words} (ln B {verdict.odds:+.1f}; {numbers})")
        log.metric(f"model/{model.name}", verdict.odds)
        verdicts.append(verdict)
    return verdicts


def within(chain: Chain, model: Simpler) -> Chain:
    """The chain of a simpler model."""
    return replace(chain, simulate=lambda theta: chain.simulate(model.whole(theta)), pushed=None)


def other_end(field: GlobalField, end: Point, one: Ratio) -> Verdict:
    """Of the same model where a polish ended in another valley (`mirror.py`)."""
    name = f"with a relaxation time of {physical(field, end.theta)[NAMES[2]]:.2g} s"
    model = Simpler(name=name, field=field, base=field.zero(), kept=list(range(len(end.theta))))
    return Verdict(model=model, theta=end.theta, ratio=one)


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

        told = chain.journal.ask("film next", name, theta, *(tie.theta for tie in ties), answer=answer)
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
    with torch.no_grad():
        motions = [simulate(theta), *(simulate(tie.model.whole(place)) for place in places)]
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
