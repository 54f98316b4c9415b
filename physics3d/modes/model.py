"""A body as the solver without a grid sees it: everything that does not change from one run to the next.

    matter (pieces, points)  ->  splines  ->  stiffness, mass  ->  static responses, modes of vibration
                                                               ->  a basis of few fields, few points

Built once, with the parameters that the world starts from; a learned material moves in the same basis.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from physics3d.boundaries.base import AbstractBoundary, Setting
from physics3d.journal import Journal
from physics3d.log import Log
from physics3d.materials.base import Values
from physics3d.matter import Matter, in_blocks, in_one_piece, of_particles, points
from physics3d.modes import basis, cubature, lattice, vibration, wide
from physics3d.modes.conditions import Conditions, Refused, conditions
from physics3d.modes.dynamics import TOLERANCE, Pull, Spring, System
from physics3d.modes.stress import Points
from physics3d.world import World

# spacing of the splines, in edges of a piece: the first with at most MOST_SPLINES of them. Their knots lie anywhere in
# the pieces, so that splines as near to each other as these would be integrated too softly
CELL = (4 / 3, 1.6, 2, 2.5, 3, 4, 6, 8)
MOST_SPLINES = 2500
BLOCK = 2.5  # edges of a piece: of splines that far apart, what hangs together in the half of it is integrated as one
PIN = 1e3  # stiffness of a pin, in that of a cube of the piece behind it
MODES = 12  # of vibration, whose components are fields of the basis
QUADRATURE = 300  # points of integration
SMOOTH = 30.0  # times the highest mode: what would swing faster is smoothed out of a start
RIGID = 1e-3  # of the highest mode: what swings slower is a rigid motion, if nothing holds the body
MOST_GROUPS = 8  # materials that differ; more are a field
# two resolutions: splines so many times as far apart, so many modes of theirs, and the power of their distance by which
# a stiffness is wrong at least (2.2 for the brim of the hat, 4 and more for the cord, which shows from 1.5 on)
APART = 1.25
LOOKED_AT = 4
ORDER = 2
UNRESOLVED = math.log(10)  # of a body in loose bits: modes say nothing of its stiffness


@dataclass(frozen=True, kw_only=True)
class Model:
    """A body in a basis of r functions s_j: u(X) = sum_j s_j(X) q_j, q [r, 3] in m."""

    world: World
    conditions: Conditions
    values: np.ndarray  # s_j at the particles [p, r]
    slopes: np.ndarray  # their gradients at the particles [3 p, r] [1/m]
    gradient: np.ndarray  # at the points of integration [3 n, r] [1/m]
    weight: np.ndarray  # [n] [m^3]
    owner: np.ndarray  # [n] particle
    mass: np.ndarray  # [r, r] [kg]
    stiffness: np.ndarray  # at rest, pins included, all dash-pots stuck [3 r, 3 r] [N/m]
    first_moment: np.ndarray  # int rho s_j [r] [kg]
    load_fields: np.ndarray  # int rho s_j weight of each load [b, r] [kg]
    springs: tuple[Spring, ...]
    particle_mass: np.ndarray  # [p] [kg]
    omega: np.ndarray  # of the modes with all dash-pots stuck [1/s]
    shapes: np.ndarray  # their amplitudes [m, r, 3], of unit mass
    exact_omega: np.ndarray  # the same of the splines, before the reduction [1/s]
    coarser: Callable[[], "Model"]  # of the same body, by splines APART times as far from each other, of few modes

    @functools.cached_property
    def projection(self) -> np.ndarray:
        """[3 r, 3 free particles]: amplitudes of the smoothest field that has given vectors at the particles,

            minimise sum_p m_p |sum_j s_j(X_p) a_j - v_p|^2 + a.K a/(SMOOTH omega_max)^2

        What the particles do not say, how a section one particle across turns, is then as the body would have it."""
        free = ~self.conditions.held
        S = self.values[free]
        left = S.T * self.particle_mass[free]
        matrix = np.kron(left @ S, np.eye(3)) + self.stiffness / (SMOOTH * self.omega.max()) ** 2
        matrix += 1e-12 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
        return np.linalg.solve(matrix, np.kron(left, np.eye(3)))

    @property
    def count(self) -> int:
        return self.values.shape[1]

    def system(self, coefficients: np.ndarray) -> System:
        """Ready to run from the undeformed state; coefficients [k, n] at the points of integration."""
        return System(
            gradient=self.gradient,
            mass=self.mass,
            points=Points(self.world.material, coefficients, self.weight),
            springs=self.springs,
            drag=self.world.damping,
            tolerance=TOLERANCE[self.world.dtype],
        )

    def too_stiff(self) -> float:
        """How much stiffer (ln) the first modes are than those of the same body by splines as near as one likes, about,
        in the mean over the energies that known loads give them: judged by coarser splines, for an error in the h-th
        power of their distance is 1/(APART^h - 1) of what the two differ by. Takes a few seconds."""
        held = any(spring.pull is None for spring in self.springs)
        which = slice(0 if held else 6, LOOKED_AT if held else 6 + LOOKED_AT)  # no rigid motion of a free body
        here, there = (np.maximum(one.exact_omega[which], 1e-30) for one in (self, self.coarser()))
        if not len(here) == len(there) == len(self.shapes[which]) or not here.size:  # of a few splines
            return 0.0
        error = np.minimum(2 * np.abs(np.log(there / here)) / (APART**ORDER - 1), UNRESOLVED)
        pushes = [load.acceleration.double().numpy() for load in self.conditions.loads]
        work = [np.einsum("mri,r,i->m", self.shapes[which], f, a) for f, a in zip(self.load_fields, pushes)]
        energy = np.square(work).sum(0) / np.square(here) if work else np.zeros(len(here))
        return float(np.average(error, weights=energy if energy.sum() > 0 else None))

    def modes(self, coefficients: np.ndarray, count: int | None) -> list[vibration.Mode]:
        """Frequencies and loss factors of the lowest modes of vibration, `count` of them or all; their shapes are those
        of this material with stuck dash-pots."""
        points = Points(self.world.material, coefficients, self.weight)
        stuck = points.tangent(np.zeros((len(self.weight), 3, 3)), vibration.STUCK)
        held_by = sum((np.kron(s.matrix, np.eye(3)) for s in self.springs if s.pull is None), 0 * self.stiffness)
        whole = vibration.stiffness(self.gradient, stuck) + held_by
        mass, faint = np.kron(self.mass, np.eye(3)), 1e-6 * self.omega.max() ** 2
        square, found = vibration.dense_modes(whole, mass, len(self.omega), shift=faint)
        held = any(spring.pull is None for spring in self.springs)
        swings = np.full(len(square), held) | (square > (RIGID * np.sqrt(square.max())) ** 2)
        shapes = found.T.reshape(len(square), -1, 3)[swings][:count]
        strain = np.stack([(self.gradient @ shape).reshape(-1, 3, 3) for shape in shapes])
        kappa = vibration.relaxation(self.world.material, coefficients, self.weight, strain)
        by_holds = np.array([sum(np.vdot(s, k.matrix @ s) for k in self.springs if k.pull is None) for s in shapes])
        return vibration.damped(lambda t: kappa(t) + by_holds)


def model(
    world: World,
    position: Tensor,
    volume: Tensor,
    *,
    parameters: Values,
    boundaries: Sequence[AbstractBoundary],
    matter: Matter | None = None,
    modes: int = MODES,
    points_: int = QUADRATURE,
    swings_widely: bool = True,
    cells: Sequence[float] = CELL,
    log: Log,
) -> Model:
    """The model of particles at `position` [p, 3] m of `volume` [p] m^3, each a cube of the body unless `matter` says
    better. `parameters` are those whose modes of vibration the basis is made of. One that does not swing widely needs
    no fields of the second order (`wide.py`). `cells`: spacings of the splines, in edges of a piece, of which the first
    serves that is not too near. Raises Refused (a ValueError) where a boundary needs the grid."""
    x, V = position.detach().cpu().double(), volume.detach().cpu().double()
    lower, upper = ((float(a), float(b), float(c)) for a, b, c in (x.amin(0), x.amax(0)))
    setting = Setting(position=x, mass=world.density * V, volume=V, lower=lower, upper=upper, dx=world.dx)
    if matter is None:
        matter = of_particles(x, V)
    whole_matter = matter
    found = conditions(boundaries, setting, in_one_piece(matter))
    matter = found.matter
    size = matter.size
    # where the particles are, on the piece of theirs that is nearest
    seat = _seats(x.numpy(), matter)
    free = np.flatnonzero(seat >= 0)
    pins = found.pins
    single, block = matter, np.arange(len(matter.position))
    for cell in cells:
        if cell >= BLOCK:
            matter, block = in_blocks(single, cell / 2 * size)
        at, weight, piece = points(matter)
        centres = matter.position.numpy()
        places = np.concatenate([at, *(centres[block[p.piece]] for p in pins), centres[block[seat[free]]]])
        pieces = np.concatenate([piece, *(block[p.piece] for p in pins), block[seat[free]]])
        splines = lattice.splines(places, pieces, matter.links.numpy(), len(matter.position), cell * size)
        if splines.count <= MOST_SPLINES:
            break
    N, G = splines.at(at, piece)
    owner = matter.owner.numpy()[piece]
    share = sparse.csr_matrix((single.volume.numpy(), (block, np.arange(len(block)))))
    share = sparse.diags(1 / matter.volume.numpy()) @ share  # of every piece in its block

    def at_points(of_particle: np.ndarray) -> np.ndarray:
        """What particles are given, in the mean over what a point stands for."""
        return (share @ of_particle[single.owner.numpy()].astype(float))[piece]

    of_all = world.material.coefficients({k: torch.as_tensor(v).double() for k, v in parameters.items()})
    coefficients = of_all.detach().cpu().expand(-1, len(x)).numpy()[:, owner]
    modulus = world.material.wave_modulus(torch.from_numpy(coefficients)).numpy()
    stuck = Points(world.material, coefficients, weight)
    K = vibration.stiffness(G, stuck.tangent(np.zeros((len(weight), 3, 3)), vibration.STUCK))
    scalar_mass = (N.T @ sparse.diags(world.density * weight) @ N).tocsr()
    M = sparse.kron(scalar_mass, sparse.identity(3), format="csr")

    stiff = np.zeros(len(matter.position))
    np.maximum.at(stiff, piece, modulus)
    permanent = sparse.csr_matrix((splines.count, splines.count))
    for p in pins:
        S, _ = splines.at(p.position, block[p.piece], continued_from=centres[block[p.piece]])
        permanent = permanent + S.T @ sparse.diags(PIN * stiff[block[p.piece]] / size * p.area) @ S
    held = permanent.nnz > 0
    springs = [Spring(matrix=permanent)] if held else []
    # functions that hold next to no matter do not make matrices singular
    faint = np.full(splines.count, vibration.FAINT * float(np.median(modulus)) * splines.H)
    for grip in found.grips:
        mine = at_points(grip.particles)
        if not mine.any():
            raise Refused("a moved or held region has no free matter in it")
        k = mine * PIN * modulus * weight / size**2
        matrix = N.T @ sparse.diags(k) @ N
        first = np.stack([N.T @ k, *(N.T @ (k * (at[:, a] - grip.point[a])) for a in range(3))], 1)
        springs.append(Spring(matrix=matrix.tocsr(), pull=Pull(motion=grip.motion, first=first), until=grip.until))
    load_weight = np.array([at_points(load.weight) for load in found.loads]).reshape(-1, len(owner))
    load_fields = (N.T @ (world.density * weight * load_weight).T).T
    first_moment = N.T @ (world.density * weight)

    span = float(np.linalg.norm(np.ptp(at, axis=0)))
    values, slopes = _at_particles(splines, x.numpy(), np.where(seat >= 0, block[seat], -1), centres)
    rest = (permanent + sparse.diags(faint)).tocsr()
    shift = _shift(world, modulus, span, held)
    journal = Journal(log)

    def modes_of(whole: sparse.csr_matrix, count: int) -> tuple[np.ndarray, np.ndarray]:
        question = ("modes of vibration", whole.diagonal(), M.diagonal(), count, shift)
        return journal.ask(*question, answer=lambda: vibration.modes(whole, M, count, shift=shift))

    exact, shapes = modes_of((K + _three(rest)).tocsr(), modes + (0 if held else 6))
    log.info(
        f"{len(single.position)} pieces, {splines.count} splines {1e3 * splines.H:.3g} mm apart, {len(weight)} points"
    )
    # Rayleigh's quotients: what was added to keep the matrix regular changes shapes a little, and these not at all
    elastic = K + _three(permanent)
    exact = np.maximum(np.einsum("nm,nm->m", shapes, elastic @ shapes), 0.0)
    swings = np.ones(len(exact), bool) if held else exact > 1e-3 * exact[6]  # no rigid motion
    fields = [shapes[:, swings]]
    sources = [*load_fields] + ([first_moment] if any(world.gravity) else [])
    rigid = shapes[:, ~swings]
    regular = (K + _three(rest) + shift * M).tocsr()
    factored = functools.cache(lambda: vibration.Factor(regular))
    responses = _responses(factored, sources, M, rigid)
    if responses.size:
        fields.append(responses)
    if found.grips:
        gripped = rest + sum(s.matrix for s in springs if s.pull is not None)
        everything = (K + _three(gripped)).tocsr()
        _, more = modes_of(everything, modes)
        pulls = [s.pull.first[:, k] for s in springs if s.pull is not None for k in range(4)]
        fields += [
            more,
            _responses(lambda: vibration.Factor((everything + shift * M).tocsr()), [*sources, *pulls], M, rigid[:, :0]),
        ]
    scalars = basis.turned(np.concatenate(fields, 1), G, weight)
    if not held:
        affine = (splines.affine() - [0, *at.mean(0)]) * [span, 1, 1, 1] / np.sqrt(weight.sum())
        scalars = np.concatenate([affine, scalars], 1)
    C = basis.independent(scalars, N, G, weight, span)
    still = np.zeros((len(weight), 3, 3))
    tangent = stuck.tangent(still, vibration.STUCK)

    def in_basis(matrix: sparse.spmatrix) -> np.ndarray:
        return np.kron(C.T @ (matrix @ C), np.eye(3))

    seen = wide.swings(N, G, weight, shapes[:, swings], exact[swings])
    if swings_widely and seen.modes.size:
        forces = wide.second_order(G, stuck, seen.modes)
        forces -= M @ (rigid @ (rigid.T @ forces))
        answers = -_answers(factored(), forces, M, rigid)
        whole = vibration.stiffness(G @ C, tangent) + in_basis(rest + shift * scalar_mass)
        of_basis = (C.T @ forces.reshape(splines.count, -1)).reshape(len(whole), -1)
        held_by_basis = of_basis.T @ np.linalg.solve(whole, of_basis)
        more = wide.missing(answers, forces, held_by_basis, seen.energy)
        if more.size:
            C = basis.independent(np.concatenate([scalars, basis.turned(more, G, weight)], 1), N, G, weight, span)
            log.info(f"{more.shape[1]} fields of the second order, for wide swings")
    slopes_there = G @ C
    mass = C.T @ (scalar_mass @ C)
    K = vibration.stiffness(slopes_there, tangent)
    group = _groups(coefficients)
    if group.max() + 1 > MOST_GROUPS:  # a field of parameters: every particle counts
        which, factor = np.arange(len(weight)), np.ones(len(weight))
    else:
        whole = K + in_basis(rest)
        _, own_modes = vibration.dense_modes(whole, np.kron(mass, np.eye(3)), modes, shift=shift)
        which, factor = journal.ask(
            "points of integration",
            whole,
            points_,
            answer=lambda: cubature.chosen(slopes_there, tangent, whole, own_modes, group, points_),
        )
    slopes_there = np.ascontiguousarray(slopes_there.reshape(len(weight), 3, -1)[which].reshape(3 * len(which), -1))
    K = vibration.stiffness(slopes_there, tangent[:, which] * factor[:, None, None])
    K += in_basis(permanent)
    lowest, shapes = vibration.dense_modes(K, np.kron(mass, np.eye(3)), len(exact), shift=shift)
    both = np.flatnonzero(swings[: len(lowest)])[:4]  # the basis of a few loose bits has fewer modes than the splines
    off = np.abs(np.sqrt(np.maximum(lowest[both] / exact[both], 0)) - 1)
    log.info(
        f"basis of {C.shape[1]} fields, integrated at {len(which)} points: its first frequencies are within "
        f"{100 * off.max(initial=0):.2g} % of those of the splines"
    )
    return Model(
        world=world,
        conditions=found,
        values=values @ C,
        slopes=slopes @ C,
        gradient=slopes_there,
        weight=weight[which] * factor,
        owner=owner[which],
        mass=mass,
        stiffness=K,
        first_moment=C.T @ first_moment,
        load_fields=load_fields @ C,
        springs=tuple(_in_basis(s, C) for s in springs),
        particle_mass=setting.mass.numpy(),
        omega=np.sqrt(np.maximum(lowest, 0)),
        shapes=shapes.T.reshape(-1, C.shape[1], 3),
        exact_omega=np.sqrt(np.maximum(exact, 0)),
        coarser=functools.partial(
            model,
            world,
            position,
            volume,
            parameters=parameters,
            boundaries=boundaries,
            matter=whole_matter,
            modes=LOOKED_AT,
            points_=len(weight),
            swings_widely=False,
            cells=(APART * cell,),
            log=Log(None),
        ),
    )


def _in_basis(spring: Spring, C: np.ndarray) -> Spring:
    pull = None if spring.pull is None else replace(spring.pull, first=C.T @ spring.pull.first)
    return Spring(matrix=C.T @ (spring.matrix @ C), pull=pull, until=spring.until)


def _three(scalar: sparse.spmatrix) -> sparse.csr_matrix:
    return sparse.kron(scalar, sparse.identity(3), format="csr")


def _shift(world: World, modulus: np.ndarray, span: float, held: bool) -> float:
    """What makes the stiffness of a free body positive [1/s^2]: far below any vibration."""
    return (1e-6 if held else 1e-4) * float(np.median(modulus)) / (world.density * span**2)


def _responses(
    factored: Callable[[], vibration.Factor], sources: list[np.ndarray], M: sparse.csr_matrix, rigid: np.ndarray
) -> np.ndarray:
    """Static responses [3 f, k] to each scalar source along each axis, relative to the `rigid` motions [3 f, n] of a
    free body, M-orthonormal: under a force it accelerates, and bends by what the force differs from its inertia.
    `factored` gives the stiffness, factored."""
    if not sources:
        return np.zeros((M.shape[0], 0))
    columns = np.concatenate([np.kron(s[:, None], np.eye(3)[:, [i]]) for s in sources for i in range(3)], 1)
    relieved = columns - M @ (rigid @ (rigid.T @ columns))
    bends = np.abs(relieved).max(0) > 1e-6 * np.abs(columns).max(0)
    if not bends.any():
        return np.zeros((M.shape[0], 0))
    return _answers(factored(), relieved[:, bends], M, rigid)


def _answers(factor: vibration.Factor, relieved: np.ndarray, M: sparse.csr_matrix, rigid: np.ndarray) -> np.ndarray:
    """Static responses [3 f, k] to forces [3 f, k] without their rigid part, without rigid motions."""
    found = factor(relieved)
    return found - rigid @ (rigid.T @ (M @ found))


def _groups(coefficients: np.ndarray) -> np.ndarray:
    """Points of the same material have the same number."""
    _, group = np.unique(coefficients, axis=1, return_inverse=True)
    return group.reshape(-1)


def _seats(x: np.ndarray, matter: Matter) -> np.ndarray:
    """The piece [p] of each particle that is nearest to it; -1: it has none, it is held."""
    seat = np.full(len(x), -1)
    owner, at = matter.owner.numpy(), matter.position.numpy()
    distance = np.linalg.norm(at - x[owner], axis=1)
    order = np.lexsort((distance, owner))
    first, where = np.unique(owner[order], return_index=True)
    seat[first] = order[where]
    return seat


def _at_particles(splines: lattice.Splines, x: np.ndarray, seat: np.ndarray, centres: np.ndarray):
    """Values [p, count] and gradients [3 p, count] at the particles, zero where they are held; `seat` [p] is the piece
    that each sits on, and `centres` [m, 3] m those of the pieces."""
    free = np.flatnonzero(seat >= 0)
    N, G = splines.at(x[free], seat[free], continued_from=centres[seat[free]])
    spread = sparse.csr_matrix((np.ones(len(free)), (free, np.arange(len(free)))), shape=(len(x), len(free)))
    return (spread @ N).tocsr(), (sparse.kron(spread, sparse.identity(3), format="csr") @ G).tocsr()
