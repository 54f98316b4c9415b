"""Material and start of a motion whose cause nobody knows: free vibration, fitted to the flow of a clip.

What is held and has been let go swings in its modes, whatever set it going. With the stiffness of the springs that
never relax K_0 = sum_i e^(a_i) K_i, summed over zones i of the body, and one Maxwell branch of ratio r and relaxation
time tau, the same for shear and volume,

    K_0 phi_k = omega_k^2 M phi_k,     s^2 + omega_k^2 (1 + r s tau/(1 + s tau)) = 0

every mode has three roots s: an oscillation, and the creep of its dash-pot. The amplitudes are

    q(t) = sum_k phi_k (a_k e^(-d_k t) cos 2 pi f_k t + b_k e^(-d_k t) sin 2 pi f_k t + c_k e^(-r_k t))

but for what large swings do to the two of an oscillation (`large_swing.py`): the material is that of small ones.
Against the flow (`seen_modes.py`) the a, b, c are linear least squares, solved inside for any material (variable
projection, Golub and Pereyra 1973); a mode that a camera hardly sees is held near zero by a hundredth of what its
motion in space would cost if it were seen, and more by as much as its energy is above that of the mode seen most. That
is its motion over the frames: an amplitude at time 0 is smaller the less damping is assumed, and its cost would choose
the damping. The material is sought from the frequency of the clip's largest oscillation (`motion/decay.py`), taken in
turn for the modes whose shapes alone explain most of the motion: no guess of a person's is asked for.

One free motion tells stiffness over density, for the size that was given; zones are taken up only where the clip asks
for them (a tenth of the unexplained motion less).
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize

from physics3d.journal import Journal
from physics3d.learning.large_swing import SMALL, LargeSwing
from physics3d.learning.seen_modes import Observed
from physics3d.log import Log
from physics3d.modes import vibration

MODES = 16  # that a motion is made of
GUESSES = 4  # of the modes that alone explain most, that the largest oscillation may be
FAINT = 0.01  # cost of a motion in space that is not seen, in that of one that is
WIDTH = {"zone": 0.7, "ratio": 2.0, "time": 3.0}  # of what is thought likely beforehand, in the logarithm
LIKELY = {"ratio": 0.3, "time": 0.1}  # r, and tau [s]
PRIOR = 1e-3  # of the motion: what one such width costs
FIRST, FINER = 250, 1200  # materials that are tried, from each guess, and once with zones
ASKED = 0.9  # of the unexplained motion: zones have to leave less
# of the motion: modes that leave so little more than the least are as good. A hold that gives way, or is where the mask
# ends, leaves 8 % of a drawn rod's motion to its own mode; others that are near each other make good half of that
TIE = 0.1


@dataclass(frozen=True, kw_only=True)
class Reduced:
    """The body in a basis of m amplitudes."""

    zones: Float[np.ndarray, "z m m"]  # K_i [N/m]
    rest: Float[np.ndarray, "m m"]  # what holds it [N/m]
    mass: Float[np.ndarray, "m m"]  # [kg]
    weight: Float[np.ndarray, "m m"]  # square of the displacement, mean over the body [1]
    scale: float  # pixels per metre at the body [px/m]
    zone: Int[np.ndarray, " p"]  # of every particle


@dataclass(frozen=True, kw_only=True)
class Material:
    """Logarithms, relative to the body's material at the start but for the last two."""

    stiffness: float
    zones: Float[np.ndarray, " z"]
    ratio: float  # ln r
    time: float  # ln tau [ln s]

    @classmethod
    def of(cls, theta: np.ndarray) -> "Material":
        return cls(stiffness=theta[0], ratio=theta[1], time=theta[2], zones=theta[3:])

    def improbability(self) -> float:
        """Squares of the distances from what is likely, in widths."""
        away = (self.ratio - math.log(LIKELY["ratio"])) / WIDTH["ratio"]
        slow = (self.time - math.log(LIKELY["time"])) / WIDTH["time"]
        return away**2 + slow**2 + float(((self.zones / WIDTH["zone"]) ** 2).sum())


@dataclass(frozen=True, kw_only=True)
class FreeMotion:
    """Modes with their start: the body's motion from time 0 on, and before it as if it had been free."""

    shape: Float[np.ndarray, "m k"]  # phi_k in the basis, of unit mass [kg^(-1/2)]
    frequency: Float[np.ndarray, " k"]  # [Hz]
    damping: Float[np.ndarray, " k"]  # [1/s]
    creep: Float[np.ndarray, " k"]  # r_k [1/s]
    cosine: Float[np.ndarray, " k"]  # a_k, of modes of unit mass [m kg^(1/2)]
    sine: Float[np.ndarray, " k"]  # b_k
    slow: Float[np.ndarray, " k"]  # c_k
    unexplained: float  # share of the motion
    loudness: Float[np.ndarray, " k"]  # rms of each mode when seen [px]
    large: LargeSwing

    def at(self, t: float) -> Float[np.ndarray, " m"]:
        """Amplitudes at time t [s]."""
        one, two, three = time_functions(self.frequency, self.damping, self.creep, self.large, np.array([t]))[..., 0]
        return self.shape @ (self.cosine * one + self.sine * two + self.slow * three)


def time_functions(
    f: np.ndarray, d: np.ndarray, r: np.ndarray, large: LargeSwing, t: np.ndarray
) -> Float[np.ndarray, "3 k t"]:
    """The three functions of time of every mode."""
    return np.concatenate([large.functions(f, d, t), np.exp(-np.minimum(r[:, None] * t, 60.0))[None]])


def roots(
    square: Float[np.ndarray, " k"], ratio: float, time: float
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """(frequency [Hz], damping [1/s], creep [1/s]) of modes of omega_k^2 `square`: the roots of

        tau s^3 + s^2 + omega^2 tau (1 + r) s + omega^2 = 0

    Where a mode creeps back without swinging, its frequency is 0."""
    found = []
    for w in square:
        s = np.roots([time, 1.0, w * time * (1 + ratio), w])
        swings = s[s.imag > 1e-9 * np.abs(s)]
        real = s[np.abs(s.imag) <= 1e-9 * np.abs(s)].real
        if len(swings):
            found.append((swings[0].imag / (2 * np.pi), -swings[0].real, -real[0]))
        else:
            found.append((0.0, -real.max(), -real.min()))
    f, d, r = np.array(found).T
    return f, d, r


def modal(body: Reduced, material: Material) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "m k"]]:
    """omega_k^2 [1/s^2] and phi_k of unit mass, of the springs that never relax."""
    factor = np.exp(material.stiffness + material.zones)
    stiff = np.tensordot(factor, body.zones, 1) + math.exp(material.stiffness) * body.rest
    square, shape = vibration.dense_modes(stiff, body.mass, MODES, shift=1e-6 * float(np.trace(stiff) / len(stiff)))
    return np.maximum(square, 1e-6), shape


@dataclass(frozen=True, kw_only=True)
class Swinging:
    """Least squares for the amplitudes x = (a, b, c) of k modes: |u - J Phi x|^2, Phi = shape times functions."""

    shape: Float[np.ndarray, "m k"]
    frequency: Float[np.ndarray, " k"]  # [Hz]
    damping: Float[np.ndarray, " k"]  # [1/s]
    creep: Float[np.ndarray, " k"]  # [1/s]
    functions: Float[np.ndarray, "3 k t"]  # of time, less those at the reference
    gram: Float[np.ndarray, "t k k"]  # sum w J^T J in the shapes
    normal: Float[np.ndarray, "n n"]  # n = 3 k
    right: Float[np.ndarray, " n"]
    ridge: Float[np.ndarray, " n"]  # what holds faint modes near zero
    square: float  # sum w |u|^2


def swinging(
    body: Reduced,
    material: Material,
    clip: Observed,
    *,
    known: Float[np.ndarray, " m"] | None = None,
    reference: float | None = None,
    large: LargeSwing = SMALL,
) -> Swinging:
    """As `start`."""
    square, shape = modal(body, material)
    f, d, r = roots(square, math.exp(material.ratio), math.exp(material.time))
    t = np.arange(len(clip.gram)) / clip.fps
    functions = time_functions(f, d, r, large, t)
    size = functions**2 @ clip.weight  # of a motion over the frames, whichever of them the flow counts from
    size = np.maximum(size, 1e-9 * size.max())  # what creeps without swinging has no sine
    if reference is not None:
        functions = functions - time_functions(f, d, r, large, np.array([reference]))
    G = np.einsum("mk,tmn,nl->tkl", shape, clip.gram, shape, optimize=True)
    b, square_sum = clip.right, clip.square
    if known is not None:  # u + J q_0 is what the motion has to explain
        b = b + clip.gram @ known
        square_sum = square_sum + 2 * clip.right @ known + np.einsum("m,tmn,n->t", known, clip.gram, known)
    b = b @ shape
    normal = np.einsum("akt,tkl,blt->akbl", functions, G, functions, optimize=True)
    n = 3 * len(f)
    space = np.einsum("mk,mn,nk->k", shape, body.weight, shape) * body.scale**2
    main = int(np.argmax((b**2).sum(0) / np.maximum(np.einsum("tkk->k", G), 1e-30)))
    return Swinging(
        shape=shape,
        frequency=f,
        damping=d,
        creep=r,
        functions=functions,
        gram=G,
        normal=normal.reshape(n, n),
        right=np.einsum("akt,tk->ak", functions, b).reshape(n),
        ridge=FAINT * (size * space * np.maximum(1, square / square[main])).ravel(),
        square=float(square_sum.sum()),
    )


def start(
    body: Reduced,
    material: Material,
    clip: Observed,
    *,
    known: Float[np.ndarray, " m"] | None = None,
    reference: float | None = None,
    large: LargeSwing = SMALL,
) -> tuple[FreeMotion, float]:
    """(the motion that fits a clip best, its cost [px^2]). Time 0 is the first frame of the clip.

    The flow counts from the frame at time `reference` [s], or from a picture of which the amplitudes `known` are given.
    """
    swing = swinging(body, material, clip, known=known, reference=reference, large=large)
    x = np.linalg.solve(swing.normal + np.diag(swing.ridge), swing.right)
    left = float(swing.square - 2 * x @ swing.right + x @ swing.normal @ x)
    a, s, c = x.reshape(3, -1)
    q = np.einsum("ak,akt->kt", x.reshape(3, -1), swing.functions)
    power = np.einsum("kt,tkk,kt->k", q, swing.gram, q)
    loudness = np.sqrt(np.maximum(power, 0) / float(clip.weight.sum()))
    motion = FreeMotion(
        shape=swing.shape,
        frequency=swing.frequency,
        damping=swing.damping,
        creep=swing.creep,
        cosine=a,
        sine=s,
        slow=c,
        unexplained=left / max(swing.square, 1e-30),
        loudness=loudness,
        large=large,
    )
    return motion, left + float(x @ (swing.ridge * x))


def fit(
    body: Reduced,
    clip: Observed,
    *,
    release: int,
    reference: int | None,
    frequency: float,
    large: LargeSwing = SMALL,
    log: Log,
) -> tuple[Material, FreeMotion]:
    """The material that explains frames from `release` on, and the motion, whose time 0 is that frame.

    `frequency`: of the clip's largest oscillation, of small swings [Hz]; `reference`: the frame that the flow counts
    from; None: a picture of the body at rest.
    """
    window, zones = clip.window(release, len(clip.gram)), len(body.zones)
    at = None if reference is None else (reference - release) / clip.fps
    moved = float(window.square.sum())

    journal = Journal(log)

    def cost(theta: np.ndarray) -> float:
        material = Material.of(theta)
        if not np.all(np.abs(theta) < 40):
            return 1e3
        misfit = lambda: float(start(body, material, window, reference=at, large=large)[1]) / moved
        tried.update()
        return journal.ask("misfit", theta.tolist(), answer=misfit) + PRIOR * material.improbability()

    nothing = np.zeros(zones)
    square, shape = modal(body, Material(stiffness=0.0, zones=nothing, ratio=0.0, time=0.0))
    alone = np.sum((window.right @ shape) ** 2, 0) / np.einsum("mk,tmn,nk->k", shape, window.gram, shape, optimize=True)
    # what is held nowhere drifts in six modes; a leaf may swing slowly, but it is not most of what is seen
    likely = np.argsort(np.where(square > 1e-9 * square.max(), -alone, 0.0), kind="stable")[:GUESSES]
    swings = np.sqrt(square[likely]) / (2 * np.pi)
    tried = log.progress(None, "trying materials, at most", total=FIRST * len(swings) + (FINER if zones > 1 else 0))
    tries: list[tuple[float, optimize.OptimizeResult]] = []
    for guess in swings:
        first = np.array([2 * math.log(frequency / guess), math.log(LIKELY["ratio"]), math.log(LIKELY["time"])])
        found = _descended(lambda x: cost(np.concatenate([x, nothing])), first, FIRST)
        log.info(f"largest oscillation taken for a mode at {guess:.3g} Hz: {100 * found.fun:.1f} % left unexplained")
        tries.append((float(guess), found))
    least = min(found.fun for _, found in tries)
    level = [(guess, found) for guess, found in tries if found.fun <= least + TIE]
    guess, best = min(level, key=lambda one: one[0])
    # neighbours of two planes are no other answer
    if others := sorted(f for f, _ in level if f > 1.5 * guess):
        log.warn(
            f"the oscillation may as well be a mode at {others[0]:.3g} Hz of the start, and the thing softer by a "
            f"factor {(others[0] / guess) ** 2:.3g}; the lowest is taken, which pushes move most. Another take may tell"
        )
    theta = np.concatenate([best.x, nothing])
    if zones > 1:
        finer = _descended(cost, theta, FINER)
        asked = finer.fun < ASKED * best.fun
        log.info(
            f"stiffness by zones leaves {100 * finer.fun:.1f} % unexplained, one stiffness {100 * best.fun:.1f} %: "
            + ("zones are taken" if asked else "one is enough")
        )
        if asked:
            theta = finer.x
    tried.close()
    # told one way: zones are zero in the mean
    theta[0], theta[3:] = theta[0] + theta[3:].mean(), theta[3:] - theta[3:].mean()
    material = Material.of(theta)
    return material, start(body, material, window, reference=at, large=large)[0]


def _descended(cost, first: np.ndarray, evaluations: int) -> optimize.OptimizeResult:
    return optimize.minimize(cost, first, method="Powell", options=dict(maxfev=evaluations, xtol=1e-3, ftol=1e-6))
