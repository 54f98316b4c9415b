"""Modes of a body as a clip shows them: frequencies, dampings and shapes that no material has to explain.

A mask that ends too high, a stem that is not round, soil that gives way: the modes of the model are then not those of
the thing, but together they still span its motion. So what is seen is taken apart into a few oscillations whose shapes
are combinations of the first modes of the model (modal identification; Friswell and Mottershead 1995, Finite Element
Model Updating in Structural Dynamics):

    q(t) = q_0 + sum_j psi_j e^(-d_j (t + g l(t))) (a_j cos p_j(t) + b_j sin p_j(t)),     p_j(t) = 2 pi f_j (t - k l(t))

f_j and d_j are those of small swings; large ones are slower, by the share k at time 0, and die out faster, by the share
g, as a power n of the amplitude (`large_swing.py`, which has l): 1, or 2 where that leaves a tenth less. q_0 is where
the thing comes to rest in a take whose picture at rest is another one's.

Amplitudes and shapes are linear least squares inside (variable projection, Golub and Pereyra 1973), as in
`free_motion.py`; f, d, k and g are refined from what `motion/decay.py` reads off. An oscillation is taken up if it
leaves `ASKED` of the unexplained motion or less. Cosine and sine of each then share one shape, as those of a mode do,
and another take of the same thing has its own a, b and q_0, and k and g as its amplitude. Nothing wider than the first
take is known: a wider one has its k and g. A stem that is not quite round swings otherwise in another direction, soil
and air are not the same every day: frequencies and dampings of a take may be others by one factor each, as far as its
own frames tell more than what is likely.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import optimize

from physics3d.learning.free_motion import FAINT, PRIOR, Material, Reduced, modal
from physics3d.learning.large_swing import LargeSwing
from physics3d.learning.seen_modes import Observed
from physics3d.motion.decay import Decay

SPAN = 8  # modes of the model that shapes are made of
MOST = 4  # oscillations
ASKED = 0.7  # of the unexplained motion
SEEN = 1e-4  # what FAINT is for shapes that were read off a clip
# of what is likely: k; g, for what softens by a tenth by rubbing has about as much damping again; and, in the logarithm
WIDTH = {"slowing": 0.1, "loss": 1.0, "frequency": 0.05, "damping": 1.0}
# what frequencies and dampings of one thing differ by from take to take, in the logarithm
TAKES = np.array([0.03, 0.3])
LEAST_DAMPING = 0.005  # that a refinement starts from, in 2 pi f
# k, g; a g below 0 is none, and costs: to rub and to drag the air takes more from a large swing. What creeps back, and
# two neighbours that beat, look in a short clip as if small ones died out faster, with a damping that the thing has not
LEAST_LARGE, MOST_LARGE = np.array([-0.3, -0.9]), np.array([0.3, 3.0])
TOLD = 0.9  # of the unexplained motion: the square of the amplitude has to leave less than the amplitude itself does


@dataclass(frozen=True, kw_only=True)
class Oscillations:
    """What all takes of a thing share; sorted by what they explain."""

    shape: Float[np.ndarray, "m j"]  # psi_j in the basis [m per m]
    span: Float[np.ndarray, "m k"]  # the modes that the shapes are made of
    frequency: Float[np.ndarray, " j"]  # [Hz]
    damping: Float[np.ndarray, " j"]  # [1/s]
    large: LargeSwing  # of a swing of the mean square `power`
    power: float  # [m^2]

    def functions(self, t: Float[np.ndarray, " n"], large: LargeSwing) -> Float[np.ndarray, "j 2 n"]:
        """Cosine and sine of every oscillation at times t [s], for the amplitude of one take."""
        return large.functions(self.frequency, self.damping, t).swapaxes(0, 1)


@dataclass(frozen=True, kw_only=True)
class Swing:
    """One take: how its oscillations start. Time 0 is the first frame of its window."""

    modes: Oscillations
    amplitude: Float[np.ndarray, "j 2"]  # a_j, b_j
    rest: Float[np.ndarray, " m"]  # q_0 [m]
    large: LargeSwing  # of its amplitude
    unexplained: float  # share of the motion

    def at(self, t: float) -> Float[np.ndarray, " m"]:
        """Amplitudes of the basis at time t [s]."""
        f = self.modes.functions(np.array([t]), self.large)[..., 0]
        return self.rest + self.modes.shape @ (self.amplitude * f).sum(1)

    def loudest(self, t: float) -> int:
        """The oscillation with the largest displacement around time t [s]."""
        size = np.linalg.norm(self.modes.shape, axis=0) * np.linalg.norm(self.amplitude, axis=1)
        return int(np.argmax(size * np.exp(-self.modes.damping * t)))

    def stopped(self) -> "Swing":
        """The same, at rest from now on."""
        return replace(self, amplitude=np.zeros_like(self.amplitude))


def identified(body: Reduced, clip: Observed, decay: Decay, *, reference: float | None) -> Swing:
    """The oscillations of a clip that is free from its first frame on, with its start.

    `decay`: of the same frames, with at least one oscillation. The flow counts from the frame at time `reference` [s],
    or, if that is None, from a picture of the body at rest.
    """
    _, shape = modal(body, Material(stiffness=0.0, zones=np.zeros(len(body.zones)), ratio=0.0, time=0.0))
    span = shape[:, :SPAN]
    space = np.einsum("mk,mn,nk->k", span, body.weight, span) * body.scale**2
    gram = np.einsum("mk,tmn,nl->tkl", span, clip.gram, span, optimize=True)
    right, moved = clip.right @ span, float(clip.square.sum())
    t = np.arange(len(gram)) / clip.fps

    def solved(f: np.ndarray, d: np.ndarray, large: LargeSwing) -> tuple[np.ndarray, float, float]:
        """(cosine and sine of every oscillation [j, 2, k], what is left, with the cost of what is not seen)."""
        functions = lambda t: large.functions(f, d, t).swapaxes(0, 1)
        F = _since(functions, t, reference).reshape(-1, len(t))
        n = len(F) * len(space)
        normal = np.einsum("at,tkl,bt->akbl", F, gram, F, optimize=True).reshape(n, n)
        b = np.einsum("at,tk->ak", F, right).reshape(n)
        ridge = FAINT * np.kron(functions(t).reshape(-1, len(t)) ** 2 @ clip.weight, space)
        x = np.linalg.solve(normal + np.diag(ridge), b)
        left = moved - 2 * x @ b + x @ normal @ x
        return x.reshape(len(f), 2, -1), left / moved, (left + x @ (ridge * x)) / moved

    def named(theta: np.ndarray, poles: np.ndarray, exponent: float) -> tuple[np.ndarray, np.ndarray, LargeSwing]:
        f, d = poles[:, 0] * np.exp(theta[2::2]), poles[:, 1] * np.exp(theta[3::2])
        k, g = float(theta[0]), max(float(theta[1]), 0.0)
        return f, d, LargeSwing(slower=k, sooner=g, exponent=exponent, damping=float(d[0]))

    def cost(theta: np.ndarray, poles: np.ndarray, exponent: float) -> float:
        large, by_f, by_d = theta[:2], theta[2::2], theta[3::2]
        if np.abs(theta[2:]).max() > 5 or np.any((large < LEAST_LARGE) | (large > MOST_LARGE)):
            return 1e3
        unlikely = float((large[0] / WIDTH["slowing"]) ** 2 + (large[1] / WIDTH["loss"]) ** 2)
        unlikely += float(((by_f / WIDTH["frequency"]) ** 2 + (by_d / WIDTH["damping"]) ** 2).sum())
        return solved(*named(theta, poles, exponent))[2] + PRIOR * unlikely

    swings = np.flatnonzero(decay.frequency > 0)
    swings = swings[np.argsort(-decay.amplitude(decay.end)[swings])]
    least = LEAST_DAMPING * 2 * np.pi * decay.frequency
    candidates = [np.array([decay.frequency[j], max(decay.damping[j], least[j])]) for j in swings]

    def apart(exponent: float) -> tuple[float, tuple[np.ndarray, np.ndarray, LargeSwing]]:
        """(what is left, frequencies, dampings and law) of the oscillations with this exponent."""
        left, poles, large, best = list(candidates), np.zeros((0, 2)), np.zeros(2), 1.0
        while left and len(poles) < MOST:
            theta = np.concatenate([large, np.zeros(2 + 2 * len(poles))])
            at = int(np.argmin([cost(theta, np.vstack([poles, c]), exponent) for c in left]))
            tried = np.vstack([poles, left.pop(at)])
            found = optimize.minimize(
                cost, theta, args=(tried, exponent), method="Powell", options=dict(xtol=1e-3, ftol=1e-6, maxfev=1500)
            )
            if len(poles) and found.fun > ASKED * best:
                continue
            f, d, law = named(found.x, tried, exponent)
            poles, large, best = np.stack([f, d], 1), found.x[:2], found.fun
        f, d = poles.T
        return solved(f, d, law)[1], (f, d, law)

    rubs, smooth = (apart(exponent) for exponent in (1.0, 2.0))
    worth = lambda one: one[0] / ASKED ** len(one[1][0])  # the wrong law is made good by more oscillations
    f, d, large = smooth[1] if worth(smooth) < TOLD * worth(rubs) else rubs[1]
    both = solved(f, d, large)[0] * np.sqrt(space)
    one = np.stack([np.linalg.svd(pair)[2][0] for pair in both]) / np.sqrt(space)
    modes = Oscillations(shape=span @ one.T, span=span, frequency=f, damping=d, large=large, power=1.0)
    swing = _start(body, clip, modes, large, known=None, reference=reference)
    return replace(swing, modes=replace(modes, power=_power(body, swing)))


def another_take(body: Reduced, clip: Observed, modes: Oscillations, known: Float[np.ndarray, " m"] | None) -> Swing:
    """The start, and the place of rest, of another take of the same thing, free from its first frame on; and by which
    factors all its frequencies and all its dampings are others, as far as its frames tell.

    The flow counts from a picture in which the body has the amplitudes `known`; None: from its picture at rest."""
    place = np.zeros(len(modes.shape)) if known is None else known

    def started(factors: np.ndarray) -> Swing:
        by_f, by_d = np.exp(factors)
        own = replace(
            modes,
            frequency=by_f * modes.frequency,
            damping=by_d * modes.damping,
            large=replace(modes.large, damping=by_d * modes.large.damping),
        )
        large = own.large
        for _ in range(4):  # amplitude and frequency hang on each other, weakly
            swing = _start(body, clip, own, large, known=place)
            ratio = min(1.0, math.sqrt(_power(body, swing) / own.power))  # nothing wider was seen
            large = own.large.of_amplitude(ratio)
        return replace(swing, large=large)

    def cost(factors: np.ndarray) -> float:
        if np.abs(factors).max() > 2:
            return 1e3
        # a likelihood whose noise is what is left, and a frame one piece of evidence: noise alone moves nothing
        left = math.log(max(started(factors).unexplained, 1e-9))
        return left + float(((factors / TAKES) ** 2).sum()) / len(clip.gram)

    found = optimize.minimize(cost, np.zeros(2), method="Powell", options=dict(xtol=1e-3, ftol=1e-6, maxfev=200))
    return started(found.x)


def _start(
    body: Reduced,
    clip: Observed,
    modes: Oscillations,
    large: LargeSwing,
    *,
    known: Float[np.ndarray, " m"] | None,
    reference: float | None = None,
) -> Swing:
    """Least squares for a, b, and q_0 where the flow counts from a picture of another take (`known`)."""
    t = np.arange(len(clip.gram)) / clip.fps
    F = _since(lambda t: modes.functions(t, large), t, reference)
    count = len(F)
    basis = np.repeat(modes.shape, 2, 1)  # [m, 2 j], each times its function of time
    functions = F.reshape(2 * count, -1)
    size = modes.functions(t, large).reshape(2 * count, -1) ** 2 @ clip.weight
    faint = np.full(2 * count, SEEN)
    b, square = clip.right, clip.square
    if known is not None:
        basis = np.hstack([basis, modes.span])
        functions = np.vstack([functions, np.ones((modes.span.shape[1], len(t)))])
        size = np.concatenate([size, np.full(modes.span.shape[1], clip.weight.sum())])
        faint = np.concatenate([faint, np.full(modes.span.shape[1], FAINT)])
        b = b + clip.gram @ known  # u + J q is what the motion has to explain
        square = square + 2 * clip.right @ known + np.einsum("m,tmn,n->t", known, clip.gram, known)
    gram = np.einsum("mx,tmn,ny->txy", basis, clip.gram, basis, optimize=True)
    normal = np.einsum("xt,txy,yt->xy", functions, gram, functions, optimize=True)
    right = np.einsum("xt,tx->x", functions, b @ basis)
    space = np.einsum("mx,mn,nx->x", basis, body.weight, basis) * body.scale**2
    x = np.linalg.solve(normal + np.diag(faint * space * size), right)
    left = float(square.sum() - 2 * x @ right + x @ normal @ x)
    return Swing(
        modes=modes,
        amplitude=x[: 2 * count].reshape(count, 2),
        rest=basis[:, 2 * count :] @ x[2 * count :],
        large=large,
        unexplained=left / max(float(square.sum()), 1e-30),
    )


def _since(
    functions: Callable[[np.ndarray], np.ndarray], t: Float[np.ndarray, " n"], reference: float | None
) -> Float[np.ndarray, "j 2 n"]:
    """The functions at times t, less what they are at the time `reference` [s] if there is one."""
    return functions(t) if reference is None else functions(t) - functions(np.array([reference]))


def _power(body: Reduced, swing: Swing) -> float:
    """Mean square of the displacement at time 0, over the body and a period [m^2]."""
    each = np.einsum("mj,mn,nj->j", swing.modes.shape, body.weight, swing.modes.shape)
    return float((each * (swing.amplitude**2).sum(1)).sum() / 2)
