"""Laws of models that are compared: a clip speaks for what made it, or for nobody; what should settle a tie does."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.linalg import expm

from physics3d.boundaries.impulse import Impulse
from physics3d.learning.fields import GlobalField, physical
from physics3d.learning.film_next import film_next, recordings
from physics3d.learning.likelihood import ratio
from physics3d.learning.loss import Chain
from physics3d.learning.mirror import NAMES
from physics3d.learning.sandwich import Evidence
from physics3d.learning.search import search
from physics3d.learning.which_model import LITTLE, TIE, compared, simpler
from physics3d.log import Log
from physics3d.priors.exemplar import Exemplar

E, M, TAU, NU = 40.0, 16.0, 0.15, 0.3  # a mass of 1 kg on a spring of E N/m beside a branch: 1 Hz
NOISE = 0.005  # of the colours, which its motion changes by 0.07 at most


def swing(spring: float, branch: float, time: float, *, seconds: float, frames: int, pull: bool = False) -> np.ndarray:
    """Places [m] of a mass of 1 kg on a spring [N/m] beside a branch [N/m] whose dash-pot gives way in `time` [s],
    pushed by 10 N for a tenth of a second, or pulled by 2 N for good. The linear system in closed form."""
    A = np.array(
        [[0.0, 1.0, 0.0, 0.0], [-spring - branch, 0.0, branch, 1.0], [1 / time, 0.0, -1 / time, 0.0], [0.0] * 4]
    )
    last = np.diag([1.0, 1.0, 1.0, 0.0])
    state, found, now = np.array([0.0, 0.0, 0.0, 2.0 if pull else 10.0]), [], 0.0
    for t in np.linspace(0, seconds, frames):
        if not pull and now < 0.1 <= t:
            state, now = last @ expm(A * (0.1 - now)) @ state, 0.1
        state, now = expm(A * (t - now)) @ state, t
        found.append(state[0])
    return np.array(found)


def pictures(place: torch.Tensor) -> torch.Tensor:
    """Of a motion of one place: 40 pixels that grow darker or brighter with it, each by its own share."""
    gain = torch.linspace(-1, 1, 40).reshape(1, 1, 40, 1)
    return (0.5 + 0.5 * place.float()[:, None, None, None] * gain).expand(-1, 1, -1, 3)


def chain_of(field: GlobalField, values: tuple[float, float, float], *, also_pulled: bool = False, **timing) -> Chain:
    """The chain of a thing with these values, filmed with noise; `also_pulled`: the steady pull after it."""
    made = lambda pull, at: torch.from_numpy(swing(*at, pull=pull, **timing))
    longer = timing | dict(seconds=3 * timing["seconds"])

    def filmed(at: tuple[float, float, float]) -> torch.Tensor:
        one = made(False, at)
        return torch.cat([one, torch.from_numpy(swing(*at, pull=True, **longer))]) if also_pulled else one

    def numbers(theta: torch.Tensor) -> tuple[float, float, float]:
        found = field.parameters(theta)
        spring, branch, time = (float(found[name]) for name in NAMES)
        return spring, 2 * (1 + NU) * branch, time

    noise = NOISE * torch.randn(pictures(filmed(values)).shape, generator=torch.Generator().manual_seed(0))
    return Chain(
        simulate=lambda theta: filmed(numbers(theta)),
        render=lambda motion, view, frames: pictures(motion)[frames],
        clips={0: pictures(filmed(values)) + noise},
        prior=Exemplar(blur=(0.0,)),
        recordings={
            "again": lambda: lambda theta: made(False, numbers(theta)),
            "pull": lambda: lambda theta: torch.from_numpy(swing(*numbers(theta), pull=True, **longer)),
        },
    )


def field_of(spring: float, branch: float, time: float) -> GlobalField:
    values = {NAMES[0]: spring, "poissons_ratio": NU, NAMES[1]: branch / (2 * (1 + NU)), NAMES[2]: time}
    return GlobalField(start={name: torch.tensor(value).double() for name, value in values.items()}, learn=NAMES)


@pytest.fixture
def field() -> GlobalField:
    return field_of(E, M, TAU)


@pytest.mark.parametrize("off", [7.0, 10.0, 40.0, 0.1])
def test_a_search_finds_a_valley_that_its_steps_skip(off):
    """Eight swings that hardly die leave a valley a tenth wide in stiffness to either side; the steps are factors of
    two."""
    little = M / 4
    field = field_of(off * E, off * little, TAU)
    chain = chain_of(field, (E, little, TAU), seconds=8.0, frames=96)
    stiffer = torch.tensor([1.0, 1.0, 0.0]).double()
    offsets = [i * math.log(2) for i in range(-4, 5)]
    theta, course = search(chain, field, stiffer, offsets, seed=0, log=Log(None))
    found = float(field.parameters(theta)[NAMES[0]])
    assert found == pytest.approx(E, rel=0.1)
    assert course[-1].loss < 0.5 * chain.still(field.zero(), 0)


def test_simpler_models_begin_with_the_same_swing():
    """Complex stiffness at w of the whole and of each part alone; Ferry (1980), ch. 3."""
    for spring, branch, time, omega in ((40.0, 16.0, 0.15, 6.3), (10.0, 90.0, 2.0, 1.0), (5.0, 1.0, 0.01, 30.0)):
        field = field_of(spring, branch, time)

        def answer(theta, field=field, omega=omega) -> complex:
            E, m, tau = (float(field.parameters(theta)[name]) for name in NAMES)
            return E + 2 * (1 + NU) * m * 1j * omega * tau / (1 + 1j * omega * tau)

        whole = answer(field.zero())
        elastic, flowing = (model.whole(model.field.zero()) for model in simpler(field, field.zero(), omega))
        assert answer(elastic).real == pytest.approx(whole.real, rel=2 * LITTLE * (1 + branch / spring))
        # what is left of the spring adds a thousandth of it
        assert abs(answer(flowing) - whole) <= 2 * LITTLE * abs(whole)


def test_a_simpler_model_has_the_numbers_of_the_whole(field):
    """By its own theta and as part of the whole, the density too where it is learned."""
    field = replace(field, density=500.0)
    theta = torch.tensor([0.3, -0.2, 0.1, 0.25]).double()
    for model in simpler(field, theta, 6.0):
        own = torch.linspace(0.1, 0.4, len(model.kept)).double()
        whole = physical(field, model.whole(own))
        assert physical(model.field, own) == pytest.approx({name: whole[name] for name in model.field.names})


def test_nothing_is_left_out_of_what_is_not_learned_apart(field):
    assert simpler(replace(field, learn=NAMES[:2]), torch.zeros(2).double(), 6.0) == []
    assert simpler(replace(field, learn=(), ties=(NAMES[:2], NAMES[2:])), torch.zeros(2).double(), 6.0) == []
    assert simpler(field, field.zero(), 0.0) == []


@pytest.mark.parametrize(
    "values, tie, asked",
    [
        ((E, M, TAU), (), ("viscous", "elastic")),
        # a spring may as well be a branch that gives way in an hour: whether that is excluded says the noise
        ((E + M, LITTLE * M, TAU), ("viscous",), ()),
        ((LITTLE * E, E + M, 1.5), ("elastic",), ("viscous",)),
    ],
    ids=["whole", "a spring", "a flowing branch"],
)
def test_a_long_clip_speaks_for_what_made_it(field, values, tie, asked):
    """Five seconds, with the steady pull: the parts that are there are asked for, what is not there is not."""
    chain = chain_of(field, values, also_pulled=True, seconds=5.0, frames=60)
    known = (values[0], values[1] / (2 * (1 + NU)), values[2])
    theta = torch.tensor([math.log(now / float(field.start[name])) for now, name in zip(known, NAMES)]).double()
    verdicts = compared(chain, field, theta, omega=6.5, steps=8, stay=0.0, seed=0, log=Log(None))
    found = {verdict.model.name.split()[2]: verdict.tie for verdict in verdicts}
    assert all(found[part] for part in tie) and not any(found[part] for part in asked) and len(found) == 2


def test_what_is_said_to_settle_a_tie_does(field):
    """Half a second of a swing leaves a spring or a flowing branch; a pull that stays tells, the same swing again
    hardly: so it is said beforehand, and so it is when it has been filmed."""
    timing = dict(seconds=0.6, frames=24)
    how = dict(steps=8, stay=0.0, seed=0, log=Log(None))
    short = chain_of(field, (E, M, TAU), **timing)
    verdicts = compared(short, field, field.zero(), omega=6.5, **how)
    flowing = [verdict for verdict in verdicts if "elastic" in verdict.model.name]
    assert flowing[0].tie
    promised = film_next(short, field.zero(), flowing, seed=0, log=Log(None))
    assert promised["pull"] > TIE > promised["again"]
    both = compared(chain_of(field, (E, M, TAU), also_pulled=True, **timing), field, field.zero(), omega=6.5, **how)
    assert next(verdict for verdict in both if "elastic" in verdict.model.name).odds > TIE


def test_a_likelihood_ratio_counts_residuals_as_often_as_they_are_independent():
    """A straight line through data whose errors are the same in blocks of four pixels and two frames: the truth is at
    T > t^2 in about one draw of ten, as it would be of independent errors (Student's t), not in most."""
    generator = np.random.default_rng(0)
    beyond, naive = 0, 0
    for _ in range(300):
        J = generator.normal(size=(24, 48))
        J[:, :] = np.repeat(np.repeat(generator.normal(size=(12, 12)), 2, 0), 4, 1)
        error = np.repeat(np.repeat(generator.normal(size=(12, 12)), 2, 0), 4, 1)
        best = float((J * error).sum() / (J**2).sum())  # the truth is 0
        residual, change = best * J - error, -best * J
        rise = 0.5 * float((error**2).sum() - (residual**2).sum())
        score = (change * residual).reshape(24, 12, 4).sum(2)[..., None]
        share = (change**2).reshape(24, 12, 4).sum(2)[..., None]
        found = ratio(
            Evidence(JJ=np.array([[float((change**2).sum())]]), score=score, share=share),
            rise=rise,
            loss=0.5 * float((residual**2).sum()),
        )
        beyond += found.statistic > stats.t.ppf(0.95, found.freedom) ** 2
        naive += 2 * rise > stats.chi2.ppf(0.9, 1)
    assert 0.03 <= beyond / 300 <= 0.2 and naive / 300 > 0.4


def test_recordings_are_such_as_a_person_can_make():
    """A push as strong, across the first; a steady pull along it, weaker, to the end of a longer clip."""
    for force in ((0.09, 0.02, 0.0), (0.0, 0.0, -0.3), (0.1, 0.0, 0.05)):
        push = Impulse(force=force, centre=(0.0, 0.0, 0.2), radius=0.05, duration=0.1)
        still = Impulse(acceleration_of_each=(0.0, 0.0, -1.0), centre=(0.0, 0.0, 0.2), radius=0.05, duration=1.0)
        (again, long), (aside, _), (pulled, longer) = recordings((push, still), 2.0).values()
        assert again == (push, still) and aside[1] == pulled[1] == still and long == longer == 3
        one, two, weak = np.array(force), np.array(aside[0].force), np.array(pulled[0].force)
        assert np.linalg.norm(two) == pytest.approx(np.linalg.norm(one))
        assert abs(one @ two) <= 0.3 * (one @ one)  # another side
        assert np.cross(one, weak) == pytest.approx(np.zeros(3)) and 0 < weak @ one < 0.5 * (one @ one)
        assert pulled[0].duration >= 3 * 2.0
    assert len(recordings((push, push), 2.0)) == len(recordings((still,), 2.0)) == len(recordings((), 2.0)) == 1
