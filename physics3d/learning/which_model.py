"""Which model a clip speaks for.

A viscoelastic solid of one branch holds two simpler ones: its spring alone, and its branch alone, which flows in the
end (Maxwell). Both are fitted to the same clip, begun where they answer its swing of angular frequency w as the whole
does, with S and D of `mirror.py`,

    without the viscous branch   E' = S
    without the elastic branch   x' = S/D,  m' = S (1 + x'^2)/x'^2,  tau' = x'/w

what is left out being LITTLE of what it was. How much the clip speaks for the whole against each is ln B of
`likelihood.py`; B of less than 20 is a tie (Kass and Raftery 1995): a part that nothing asks for may be there all the
same. `film_next.py` says which recording would settle it.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.learning.course import Point
from physics3d.learning.fields import DENSITY, GlobalField, physical
from physics3d.learning.likelihood import Ratio, ratios
from physics3d.learning.loss import Chain
from physics3d.learning.mirror import NAMES, slow_and_fast
from physics3d.learning.polish import polish
from physics3d.log import Log

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
        density=physical(field, base).get(DENSITY),
    )
    return Simpler(name=name, field=left, base=base, kept=kept)


def compared(
    chain: Chain,
    field: GlobalField,
    theta: Float[Tensor, " k"],
    *,
    omega: float,
    steps: int,
    stay: float | Float[Tensor, " k"],
    seed: int,
    log: Log,
) -> list[Verdict]:
    """What the clip says of the simpler models of what was learned at theta: by about ten motions each."""
    verdicts, pull = [], torch.as_tensor(stay).expand(len(theta))
    for model in simpler(field, theta, omega):
        log.info(f"the same clip {model.name}")
        own = within(chain, model)
        found, course = polish(
            own, model.field, model.field.zero(), steps=steps, stay=pull[model.kept], seed=seed, log=log
        )
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
    return replace(chain, simulate=lambda theta: chain.simulate(model.whole(theta)), pushed=None, coarser=None)


def other_end(field: GlobalField, end: Point, one: Ratio) -> Verdict:
    """Of the same model where a polish ended in another valley (`mirror.py`)."""
    name = f"with a relaxation time of {physical(field, end.theta)[NAMES[2]]:.2g} s"
    model = Simpler(name=name, field=field, base=field.zero(), kept=list(range(len(end.theta))))
    return Verdict(model=model, theta=end.theta, ratio=one)
