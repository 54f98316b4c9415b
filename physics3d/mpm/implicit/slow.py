"""The slow modes that conjugate gradients have met, kept from solve to solve: what makes the next solves short.

With D the preconditioner of a solve and T the tridiagonal matrix of its coefficients (Lanczos), an eigenvector y of T
with the eigenvalue l gives w = sum_i (-1)^i y_i z_i/(r_i . z_i)^1/2, for which w . D w = 1 and w . A w = l: a motion of
the whole body that D thinks 1/l times too stiff. The next solves take

    D^-1 + sum_k w_k w_k^T/l_k

which moves the l_k to 1 + l_k and leaves the rest alone. A changes from step to step, and the sum stays a positive
preconditioner, though a worse one; once solves take as long as without it, it is forgotten.

Sources: Golub and Van Loan (2013) sec. 11.3; Stathopoulos and Orginos (2010) Computing and deflating eigenvalues while
solving multiple right-hand side linear systems.
"""

import math

import numpy as np
import torch
from scipy.linalg import eigh_tridiagonal
from torch import Tensor

SLOW = 0.3  # eigenvalues below are those of modes worth keeping; those of the blocks of the diagonal go from 0 to 8
LEAST = 20  # products: shorter solves teach nothing
MOST = 100  # modes that are kept
MEMORY = 2**28  # for the vectors of one solve [byte]


class Course:
    """What conjugate gradients did: directions and coefficients, iteration by iteration, as far as memory goes."""

    def __init__(self) -> None:
        self.z: list[Tensor] = []  # of length one in the preconditioner
        self.a: list[float] = []  # steps
        self.b: list[float] = []  # shares of the last direction in the next one

    def note(self, z: Tensor, rz: float) -> None:
        if (len(self.z) + 1) * z.numel() * z.element_size() <= MEMORY and rz > 0:
            self.z.append(z / math.sqrt(rz))


class SlowModes:
    """Of the body in its steps so far, as node velocities that no boundary changes."""

    def __init__(self) -> None:
        self.kick = 0.0  # of the steps that they are for [s]
        self.vectors: Tensor | None = None  # [k, 3 node]
        self.eigenvalues: Tensor | None = None  # [k]
        self.lowest: tuple[int, ...] = ()
        self.size: tuple[int, ...] = ()
        self.alone = 0.0  # products per digit of the solve that had none of them

    def follow(self, kick: float, lowest: tuple[int, ...], size: tuple[int, ...]) -> None:
        """To a step of another length, or on another window of nodes."""
        if kick != self.kick:
            self.forget()
            self.kick = kick
        if self.vectors is not None and (lowest, size) != (self.lowest, self.size):
            old = self.vectors.view(len(self.vectors), *self.size, 3)
            new = old.new_zeros((len(old), *size, 3))
            here, there = [slice(None)], [slice(None)]
            for a, n, b, m in zip(self.lowest, self.size, lowest, size):
                first, last = max(a, b), min(a + n, b + m)
                here.append(slice(first - a, max(last, first) - a))
                there.append(slice(first - b, max(last, first) - b))
            new[tuple(there)] = old[tuple(here)]
            self.vectors = new.view(len(old), -1)
        self.lowest, self.size = lowest, size

    def forget(self) -> None:
        self.vectors = self.eigenvalues = None

    def correction(self, r: Tensor) -> Tensor | float:
        """sum_k w_k (w_k . r)/l_k."""
        if self.vectors is None or self.eigenvalues is None:
            return 0.0
        return (self.vectors.T @ ((self.vectors @ r.flatten()) / self.eigenvalues)).view_as(r)

    def learn(self, course: Course, used: int, digits: float) -> None:
        """From a solve that took `used` products to make the residual smaller by so many `digits`."""
        if self.vectors is None:
            self.alone = used / digits
        elif used >= self.alone * digits:
            self.forget()
            return
        n = min(len(course.z), len(course.a))
        if used < LEAST or n < 2:
            return
        a, b = np.array(course.a[:n]), np.array(course.b[: n - 1])
        diagonal = 1 / a
        diagonal[1:] += b / a[:-1]
        values, y = eigh_tridiagonal(diagonal, np.sqrt(b) / a[:-1], select="v", select_range=(0.0, SLOW))
        keep = values > 0
        if not keep.any():
            return
        y = y[:, keep] * np.where(np.arange(n) % 2, -1.0, 1.0)[:, None]
        z = torch.stack([each.flatten() for each in course.z[:n]])
        new = torch.from_numpy(y.T).to(z) @ z
        found = torch.from_numpy(values[keep]).to(z)
        if self.vectors is not None and self.eigenvalues is not None:
            new, found = torch.cat([self.vectors, new]), torch.cat([self.eigenvalues, found])
        slowest = found.argsort()[:MOST]
        self.vectors, self.eigenvalues = new[slowest], found[slowest]
