"""One moment of a run, as the splats that the browser draws.

What is sent of a Gaussian is its centre (float32), its covariance (float16) and a colour without a direction (3 bytes),
so a picture's colours are those for one eye: spherical harmonics are evaluated here, in the direction that the body's
turning takes back (`gaussians/deform.py`). Lengths are multiplied by `scale`, for float16 knows no covariance
below 6e-8: the body is SIZE units large on the page.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from physics3d.gaussians.sh import sh_color
from physics3d.view import colors
from physics3d.view.quantities import speeds, stiffness, stresses
from physics3d.view.riders import UPPER, Riders
from physics3d.view.run import Run

SIZE = 10.0  # of the body on the page [units]
LARGEST = 6e4  # of a covariance in float16 [units^2]
ROUND = 0.4  # standard deviation of a particle as it is drawn [spacings]
OPACITY = 0.95  # of a particle
TOP = 99.5  # per cent of all particles and frames are below the end of the colours

Kind = Literal["picture", "stiffness", "speed", "stress", "part"]
UNITS = {"stiffness": "Pa", "speed": "m/s", "stress": "Pa"}


@dataclass(frozen=True, kw_only=True)
class Moment:
    """The particles at one time."""

    position: Float[Tensor, "p 3"]  # [m]
    deformation: Float[Tensor, "p 3 3"]  # F
    speed: Float[np.ndarray, " p"]  # [m/s]
    stress: Float[np.ndarray, " p"] | None  # [Pa]; None: the material keeps none


@dataclass(frozen=True, kw_only=True)
class Splats:
    """As viser takes them."""

    centers: Float[np.ndarray, "n 3"]  # [units]
    covariances: Float[np.ndarray, "n 3 3"]  # [units^2]; the upper triangle alone
    rgbs: UInt8[np.ndarray, "n 3"]
    opacities: Float[np.ndarray, "n 1"]


class Pictures:
    """Moments of a run as splats: what moves, its particles, what stands still."""

    def __init__(self, run: Run):
        body, gaussians, motion = run.body, run.gaussians, run.trajectory
        X = body.position.double().numpy()
        self.run, self.scale = run, SIZE / float(np.linalg.norm(np.ptp(X, axis=0)) or 1.0)
        self.riders = Riders(gaussians, body.embedding, motion.rest_position)
        self.moving = gaussians.select(body.embedding.which)
        mask = torch.ones(len(gaussians), dtype=torch.bool)
        mask[body.embedding.which] = False
        self.still = gaussians.select(mask)  # may be none
        self._part = body.part.long().numpy()
        self._part_of_gaussians = self._part[body.embedding.neighbours[:, 0].numpy()]
        self._nearest = torch.from_numpy(cKDTree(self.moving.mean.double().numpy()).query(X)[1])
        self._opacity = self.moving.opacity.numpy()[:, None].astype(np.float32)
        self.speeds = speeds(motion)
        self.stiffness = stiffness(run.world.material, run.values, len(X))
        self.no_stress = ""
        self.stresses = None
        try:
            self.stresses = stresses(run.world.material, run.values, motion)
        except ValueError as reason:
            self.no_stress = str(reason)
        self.ends = {"stiffness": (float(self.stiffness.min()), float(self.stiffness.max()))}
        for kind, curve in (("speed", self.speeds), ("stress", self.stresses)):
            if curve is not None:
                self.ends[kind] = (0.0, float(np.percentile(curve, TOP)))

    def moment(self, frame: int) -> Moment:
        """A frame of the run."""
        motion = self.run.trajectory
        stress = None if self.stresses is None else self.stresses[frame]
        return Moment(
            position=motion.position[frame],
            deformation=motion.deformation[frame],
            speed=self.speeds[frame],
            stress=stress,
        )

    def gaussians(self, moment: Moment, kind: Kind, eye: Float[np.ndarray, "3"]) -> Splats:
        """What moves, seen from `eye` [m]."""
        mean, upper, turn = self.riders.carry(moment.position, moment.deformation)
        if kind == "picture":
            way = (mean - eye).astype(np.float32)
            if turn is not None:  # back to where the Gaussian was at rest
                way = np.einsum("jig,gj->gi", turn, way)
            rgbs = _bytes(sh_color(self.moving.sh, torch.from_numpy(way)))
        elif kind == "part":
            rgbs = colors.of_parts(self._part_of_gaussians)
        else:
            rgbs = self._colored(kind, self.riders.blend(self._value(kind, moment)))
        return self._splats(mean, upper, rgbs, self._opacity)

    def particles(self, moment: Moment, kind: Kind) -> Splats:
        """The particles themselves, as small balls; in a picture, in the colour of the Gaussian next to each."""
        mean = moment.position.double().numpy()
        if kind == "picture":
            front = torch.zeros(len(self.moving), 3)
            rgbs = _bytes(sh_color(self.moving.sh[:, :1], front)[self._nearest])
        elif kind == "part":
            rgbs = colors.of_parts(self._part)
        else:
            rgbs = self._colored(kind, self._value(kind, moment))
        round_ = np.broadcast_to(np.array([i == j for i, j in UPPER], float), (len(mean), 6))
        opacity = np.full((len(mean), 1), OPACITY, np.float32)
        return self._splats(mean, (ROUND * self.run.body.spacing) ** 2 * round_, rgbs, opacity)

    def background(self, kind: Kind, eye: Float[np.ndarray, "3"]) -> Splats:
        """What stands still; pale, unless in a picture."""
        mean = self.still.mean.double()
        rgb = sh_color(self.still.sh, mean.to(self.still.sh) - torch.from_numpy(eye).to(self.still.sh))
        rgbs = _bytes(rgb) if kind == "picture" else colors.pale(rgb.numpy())
        covariance = self.still.covariance().double().numpy()
        upper = np.stack([covariance[:, i, j] for i, j in UPPER], 1)
        return self._splats(mean.numpy(), upper, rgbs, self.still.opacity.numpy()[:, None])

    def _value(self, kind: Kind, moment: Moment) -> np.ndarray:
        if kind == "stiffness":
            return self.stiffness
        value = moment.speed if kind == "speed" else moment.stress
        assert value is not None, "the page offers no stress where there is none"
        low, high = self.ends[kind]
        self.ends[kind] = low, max(high, float(np.percentile(value, TOP)))  # a poke may exceed what the run had
        return value

    def _colored(self, kind: Kind, value: np.ndarray) -> np.ndarray:
        return colors.of_values(value, *self.ends[kind])

    def _splats(self, mean: np.ndarray, upper: np.ndarray, rgbs: np.ndarray, opacities: np.ndarray) -> Splats:
        covariances = np.zeros((len(mean), 3, 3), np.float32)
        scaled = np.clip(upper * self.scale**2, -LARGEST, LARGEST)
        for k, (i, j) in enumerate(UPPER):
            covariances[:, i, j] = scaled[:, k]
        centers = (mean * self.scale).astype(np.float32)
        return Splats(centers=centers, covariances=covariances, rgbs=rgbs, opacities=opacities.astype(np.float32))


def _bytes(color: Float[Tensor, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    return (255 * color.clamp(0, 1) + 0.5).to(torch.uint8).numpy()
