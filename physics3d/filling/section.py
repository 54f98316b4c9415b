"""How thick a body is where it leaves what holds it: there it bends, and there it must be resolved.

A section is what is free within two layers of what is held, seen along the way from one to the other. Its thickness is
that of the rectangle of the same least second moment, h = sqrt(12 lambda), lambda the least eigenvalue of the second
moments across that way [m^2]; of a round stem it is 0.87 diameters. Two things make it too soft or too stiff:

    particles   n across stand at the middles of their layers, which have 1 - 1/n^2 of the bending stiffness
    grid        cells across a clamped beam: GRID is the error of its first frequency; that of a fitted E is twice that
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from physics3d.clusters import clusters

REACH = 1.8  # [spacings] from what is held: a particle in the next layer is 1 away, or 1.73 along a diagonal
FEW = 4  # particles of a section, fewer of which are a stray
GRID = ((1, 0.139), (2, 0.049), (3, 0.029), (4, 0.022))  # cells across -> relative error of the frequency, measured
COARSE = 2.0  # cells across, below which E is off by more than a tenth


@dataclass(frozen=True)
class Section:
    centre: np.ndarray  # [3] [m]
    thickness: float  # [m]
    spacing: float  # of its particles [m]

    @property
    def particles(self) -> float:
        """Across it, at least 1."""
        return max(1.0, self.thickness / self.spacing)

    @property
    def stiffness(self) -> float:
        """Share of the bending stiffness that particles at the middles of their layers have."""
        return 1 - 1 / self.particles**2

    def cells(self, dx: float) -> float:
        """Across it, of a grid of dx [m]."""
        return self.thickness / dx

    def grid_error(self, dx: float) -> float:
        """Of the first frequency, relative: by GRID, and in proportion beyond its last entry."""
        cells = self.cells(dx)
        count, error = zip(*GRID)
        if cells >= count[-1]:
            return error[-1] * count[-1] / cells
        return float(np.exp(np.interp(np.log(max(cells, 1e-9)), np.log(count), np.log(error))))

    def described(self, dx: float | None = None) -> str:
        """One line for a person; with the grid's dx [m] also what it does to a fitted modulus."""
        at = ", ".join(f"{v:.3f}" for v in self.centre)
        text = (
            f"thinnest held section, at ({at}) m: {1e3 * self.thickness:.3g} mm, {self.particles:.1f} particles "
            f"across, which see {100 * self.stiffness:.0f} % of the bending stiffness"
        )
        if dx is None:
            return text
        cells, error = self.cells(dx), 100 * self.grid_error(dx)
        least = "at least " if cells < 0.99 * GRID[0][0] else ""
        return f"{text}; {cells:.1f} cells, whose error is {least}{error:.2g} % in frequency, {2 * error:.2g} % in E"


def thinnest_section(position: np.ndarray, volume: np.ndarray, held: np.ndarray, spacing: float) -> Section | None:
    """Of the particles [p, 3] [m] with volumes [p] [m^3] of which `held` bool [p] do not move; None if nothing is held,
    or nothing free is beside it."""
    if not held.any() or held.all():
        return None
    free = np.flatnonzero(~held)
    distance, nearest = cKDTree(position[held]).query(position[free], distance_upper_bound=REACH * spacing)
    beside = np.isfinite(distance)
    free, away = free[beside], position[free[beside]] - position[held][nearest[beside]]
    if not len(free):
        return None
    found = []
    patch = clusters(position[free], 2 * spacing)
    for k in range(int(patch.max()) + 1):
        own = patch == k
        if own.sum() >= FEW:
            x, v = position[free[own]], volume[free[own]]
            found.append(Section(np.average(x, axis=0, weights=v), _thickness(x, v, away[own]), spacing))
    return min(found, key=lambda section: section.thickness, default=None)


def _thickness(x: np.ndarray, volume: np.ndarray, away: np.ndarray) -> float:
    """sqrt(12 lambda) [m] of cubes of these volumes, across the mean of the directions `away`."""
    offset = x - np.average(x, axis=0, weights=volume)
    moments = np.einsum("k,ki,kj->ij", volume, offset, offset) / volume.sum()
    along = (away / np.linalg.norm(away, axis=1, keepdims=True)).mean(0)
    if np.linalg.norm(along) < 0.3:  # held from all sides: the section is as flat as it can be seen
        along = np.linalg.eigh(moments)[1][:, 0]
    across = np.linalg.svd(along[None])[2][1:]
    own = np.average(np.cbrt(volume) ** 2, weights=volume) / 12
    return float(np.sqrt(12 * (np.linalg.eigvalsh(across @ moments @ across.T)[0] + own)))
