"""A family of small films in which one thing is random, and known: how stiff a stem with a blossom is.

    ln E ~ N(ln MODE, SPREAD^2),   density 300 kg/m^3, Poisson's ratio 0.3

A square stem stands on the ground and carries an ellipsoid; both are one neo-Hookean solid, cut into cubes of half the
stem's width. Its blossom is poked sideways for 40 ms, at the beginning of the film, and the body sways freely for the
rest of it. Drawn are: the stem's width and height, the blossom's size, flatness and colours, the side
and the direction of the poke, the speed that it would give the blossom if nothing held it, and the camera. Everything
but ln E and the poke can be seen in the first frame, so that the frequency of the film tells E.

Films are made in milliseconds from the modes of vibration of one body, in closed form: with R_m the answer of an
oscillator of frequency omega_m and drag c to the poke,

    u(X, t) = sum_m phi_m(X) (phi_m . f) R_m(t),   R'' + c R' + omega^2 R = 1 while the poke lasts, 0 after it.

All bodies of one form share their modes: a body that is `size` times as large and E/E_0 times as stiff has frequencies
omega sqrt(E/E_0)/size and, under the same acceleration of the blossom, the same displacements otherwise. The solver of
`modes/rollout.py`, whose modes these are, moves the same bodies with large rotations; `Stem.world` and `Poke.impulse`
are for it, and for the grid.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from physics3d.boundaries.fixed_region import FixedRegion
from physics3d.boundaries.impulse import Impulse
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.rasterize import rasterize
from physics3d.log import Log
from physics3d.materials.neo_hookean import NeoHookean
from physics3d.modes.rollout import Solver
from physics3d.scenes.studio import ring
from physics3d.world import World

MODE, SPREAD = 1.0e6, 0.35  # of Young's modulus [Pa]: median, standard deviation of the logarithm
DENSITY, POISSON, DRAG = 300.0, 0.3, 1.0  # [kg/m^3], 1, [1/s]
SPEED, SPEED_SPREAD = 0.30, 0.15  # that a poke would give a free blossom [m/s]: median, deviation of the logarithm
PUSH = 0.04  # how long it lasts [s]
# of a film, square: 0.3 s, about half a period, so that two films differ the more, the more their frequencies do, up to
# twice; over a whole period a film of twice the frequency is nearer to the right one than one of 1.7 times
FRAMES, FPS, PIXELS = 16, 50.0, 32
WIDTH = 0.018  # of the stem of a body of size 1 [m]
MODES, POINTS = 6, 80  # of vibration, of integration: a stem bends in few ways
BACKGROUND = (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Stem:
    """A body: its form, and how large and stiff it is."""

    cubes: int  # height of the stem, in half widths
    blossom: float  # half width of the blossom, in widths of the stem
    flat: float  # its half height, in its half width
    size: float = 1.0  # times WIDTH is the width of the stem
    youngs_modulus: float = MODE  # [Pa]

    @classmethod
    def draw_form(cls, rng: np.random.Generator) -> Self:
        """Of size 1 and the usual stiffness."""
        return cls(
            cubes=int(rng.integers(18, 22)), blossom=float(rng.uniform(1.65, 2.1)), flat=float(rng.uniform(0.8, 1.05))
        )

    def draw_size(self, rng: np.random.Generator) -> Self:
        return replace(self, size=float(np.exp(rng.uniform(np.log(15.5 / 18), np.log(20.5 / 18)))))

    @property
    def edge(self) -> float:
        """Of a cube [m]."""
        return 0.5 * WIDTH * self.size

    @property
    def centre(self) -> tuple[float, float, float]:
        """Of the blossom [m]."""
        return (0.0, 0.0, self.edge * (self.cubes + 2 * 0.8 * self.blossom * self.flat))

    def cubes_at(self) -> tuple[Float[Tensor, "p 3"], Bool[Tensor, " p"]]:
        """Centres of all cubes [m], and which are of the blossom; float64."""
        side, up = np.arange(-6, 6) + 0.5, np.arange(0, 40) + 0.5
        at = np.stack(np.meshgrid(side, side, up, indexing="ij"), -1).reshape(-1, 3)
        radius = 2 * self.blossom
        height = np.array(self.centre)[2] / self.edge
        away = (at - [0, 0, height]) / [radius, radius, radius * self.flat]
        blossom = (away**2).sum(1) < 1
        stem = (np.abs(at[:, :2]) < 1).all(1) & (at[:, 2] < self.cubes)
        kept = blossom | stem
        return torch.from_numpy(self.edge * at[kept]), torch.from_numpy(blossom[kept])

    def volumes(self) -> Float[Tensor, " p"]:
        """Of all cubes [m^3], float64."""
        at, _ = self.cubes_at()
        return torch.full((len(at),), self.edge**3, dtype=torch.float64)

    def world(self) -> World:
        """Held at its lowest layer of cubes."""
        return World(
            material=NeoHookean(),
            density=DENSITY,
            start={"youngs_modulus": self.youngs_modulus, "poissons_ratio": POISSON},
            dx=2 * self.edge,
            gravity=(0.0, 0.0, 0.0),
            boundaries=(FixedRegion(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 1.01 * self.edge)),),
            damping=DRAG,
            solver="modes",
        )


@dataclass(frozen=True, kw_only=True)
class Poke:
    """The blossom is accelerated sideways, all of it alike."""

    speed: float  # that it would have at the end if nothing held it [m/s]
    azimuth: float  # towards where, 0 is +x [rad]

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """To either side, up to 30 degrees out of the plane of the picture."""
        side = 0.0 if rng.random() < 0.5 else math.pi
        return cls(
            speed=SPEED * float(np.exp(SPEED_SPREAD * rng.normal())),
            azimuth=side + float(rng.uniform(-math.pi / 6, math.pi / 6)),
        )

    @property
    def acceleration(self) -> tuple[float, float, float]:
        """[m/s^2]"""
        a = self.speed / PUSH
        return (a * math.cos(self.azimuth), a * math.sin(self.azimuth), 0.0)

    def impulse(self, stem: Stem) -> Impulse:
        """The same as a boundary of a scene: on what is within the blossom's largest radius of its centre."""
        reach = 1.01 * 2 * stem.blossom * stem.edge * max(1.0, stem.flat)
        return Impulse(acceleration_of_each=self.acceleration, centre=stem.centre, radius=reach, duration=PUSH)


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colours, and the camera."""

    blossom: tuple[float, float, float]  # sRGB
    stem: tuple[float, float, float]
    camera: Camera

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        """From the front, up to 15 degrees beside it, 5 to 20 degrees above the ground."""
        import colorsys

        blossom = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.6, 0.95), rng.uniform(0.6, 0.95))
        stem = colorsys.hsv_to_rgb(rng.uniform(0.2, 0.42), rng.uniform(0.4, 0.8), rng.uniform(0.35, 0.6))
        return cls(blossom=blossom, stem=stem, camera=front(rng.uniform(5, 20), rng.uniform(-15, 15)))


def front(elevation: float, beside: float) -> Camera:
    """A camera that sees 0.32 m of the stem and what is around it; angles in degrees."""
    (camera,) = ring(
        (0.0, 0.0, 0.12),
        distance=0.7,
        elevation=elevation,
        azimuths=[beside - 90.0],
        width=PIXELS,
        height=PIXELS,
        opening=26.0,
    )
    return camera


@dataclass(frozen=True, kw_only=True)
class Swaying:
    """The modes of vibration of one form, at size 1 and E = MODE."""

    omega: Float[Tensor, " m"]  # [1/s]
    answer: Float[Tensor, "m 3 p 3"]  # phi_m (phi_m . f) for unit accelerations of the blossom along the axes
    slope: Float[Tensor, "m 3 p 3 3"]  # its derivative after X [1/m]

    @classmethod
    def of(cls, form: Stem, *, log: Log) -> Self:
        """Computed in one to three seconds; size and stiffness of `form` are ignored."""
        unit = replace(form, size=1.0, youngs_modulus=MODE)
        at, _ = unit.cubes_at()
        push = Poke(speed=SPEED, azimuth=0.0).impulse(unit)
        model = Solver.of(
            unit.world(), at, unit.volumes(), excitation=(push,), modes=MODES, points=POINTS, log=log
        ).model
        # phi_m . f of a unit acceleration along an axis: its component of the mode, weighted with the poked mass
        drive = np.einsum("r,mri->mi", model.load_fields[0], model.shapes)
        phi = np.einsum("pr,mri->mpi", model.values, model.shapes)
        slope = np.einsum("par,mri->mpia", model.slopes.reshape(len(at), 3, -1), model.shapes)
        return cls(
            omega=torch.from_numpy(model.omega[: len(phi)]),
            answer=torch.from_numpy(drive[:, :, None, None] * phi[:, None]),
            slope=torch.from_numpy(drive[:, :, None, None, None] * slope[:, None]),
        )

    def move(
        self, stem: Stem, poke: Poke, *, modulus: Float[Tensor, ""] | None = None
    ) -> tuple[Float[Tensor, "t p 3"], Float[Tensor, "t p 3 3"]]:
        """Positions [m] and deformation gradients of the cubes in every frame, differentiable in `modulus` [Pa], which
        takes the place of the stem's own."""
        E = torch.as_tensor(stem.youngs_modulus if modulus is None else modulus, dtype=torch.float64)
        time = torch.arange(FRAMES, dtype=torch.float64)[:, None] / FPS
        omega = self.omega * torch.sqrt(E / MODE) / stem.size
        # the poke ends: what it would do if it went on, less what it would do from its end on
        signal = step_answer(omega, time) - step_answer(omega, (time - PUSH).clamp(min=0))
        a = torch.tensor(poke.acceleration, dtype=torch.float64)
        u = torch.einsum("tm,mapi,a->tpi", signal, self.answer, a)
        H = torch.einsum("tm,mapij,a->tpij", signal, self.slope, a) / stem.size
        at, _ = stem.cubes_at()
        return at + u, torch.eye(3, dtype=torch.float64) + H


def step_answer(omega: Float[Tensor, " m"], time: Float[Tensor, "t 1"]) -> Float[Tensor, "t m"]:
    """R(t) of R'' + c R' + omega^2 R = 1 from rest [s^2], underdamped."""
    fast = torch.sqrt(omega**2 - DRAG**2 / 4)
    wave = torch.cos(fast * time) + DRAG / (2 * fast) * torch.sin(fast * time)
    return (1 - torch.exp(-DRAG * time / 2) * wave) / omega**2


def film(
    stem: Stem, look: Look, position: Float[Tensor, "t p 3"], deformation: Float[Tensor, "t p 3 3"]
) -> Float[Tensor, "t h w 3"]:
    """One Gaussian per cube, drawn by the project's renderer; differentiable in the motion."""
    at, blossom = stem.cubes_at()
    # light falls from above: the blossom is darker below
    shade = 0.85 + 0.15 * ((at[:, 2:] - stem.centre[2]) / (2 * stem.blossom * stem.flat * stem.edge)).clamp(-1, 1)
    color = torch.where(blossom[:, None], shade * torch.tensor(look.blossom), torch.tensor(look.stem)).float()
    opacity = torch.full((len(at),), 0.95)
    pictures = []
    for x, F in zip(position, deformation):
        covariance = (0.55 * stem.edge) ** 2 * F @ F.mT
        drawn = rasterize(x.float(), covariance.float(), opacity, color, look.camera, background=BACKGROUND)
        pictures.append(drawn.color)
    return torch.stack(pictures)


@dataclass(frozen=True, kw_only=True)
class Film:
    """One draw of everything."""

    stem: Stem
    poke: Poke
    look: Look

    @classmethod
    def draw(cls, form: Stem, rng: np.random.Generator) -> Self:
        E = MODE * float(np.exp(SPREAD * rng.normal()))
        return cls(stem=replace(form.draw_size(rng), youngs_modulus=E), poke=Poke.draw(rng), look=Look.draw(rng))


def films(
    number: int, count: int, *, seed: int, log: Log
) -> tuple[Float[Tensor, "n t h w 3"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """`count` films of the form of this number -> pictures in 0..1, E [Pa], lowest frequencies [Hz]."""
    rng = np.random.default_rng((seed, number))
    form = Stem.draw_form(rng)
    swaying = Swaying.of(form, log=log)
    pictures, moduli, frequencies = [], [], []
    for _ in range(count):
        drawn = Film.draw(form, rng)
        pictures.append(film(drawn.stem, drawn.look, *swaying.move(drawn.stem, drawn.poke)))
        E = drawn.stem.youngs_modulus
        moduli.append(E)
        frequencies.append(float(swaying.omega[0]) / (2 * math.pi) * math.sqrt(E / MODE) / drawn.stem.size)
    return torch.stack(pictures), torch.tensor(moduli), torch.tensor(frequencies)
