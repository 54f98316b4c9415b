"""The linear problem: stiffness and mass, static response, modes of vibration with frequencies and loss factors.

    K = sum_q grad N^T C grad N w,    M = sum_q rho N^T N w,    K phi = omega^2 M phi,    phi^T M phi = 1

C = dP/dF at rest, read off the constitutive function itself: dt -> 0 gives the stiffness with all dash-pots stuck, a
long dt that of the springs that never relax. In between, kappa(t) = phi^T K(t) phi after a step of strain is the
relaxation of the mode, and its complex stiffness and loss factor are

    kappa*(omega) = kappa(inf) + i omega int_0^inf (kappa(t) - kappa(inf)) e^(-i omega t) dt,    omega^2 = Re kappa*,
    eta = Im kappa* / Re kappa*                              (an oscillation decays as e^(-eta omega t/2))
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import linalg, sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from physics3d.materials.base import AbstractMaterial
from physics3d.modes.stress import Points

STUCK, RELAXED = 1e-12, 1e12  # [s]
FAINT = 1e-10  # of the stiffness of a function full of matter


@dataclass(frozen=True, kw_only=True)
class Mode:
    """One mode of vibration."""

    frequency: float  # [Hz]
    loss_factor: float

    def __str__(self) -> str:
        return f"{self.frequency:.3g}" + (f" (loss {self.loss_factor:.2g})" if self.loss_factor > 1e-3 else "")


def stiffness(
    gradient: sparse.csr_matrix | np.ndarray, tangent: Float[np.ndarray, "9 n 3 3"]
) -> sparse.csr_matrix | np.ndarray:
    """sum_q grad N^T (dP/dF) grad N w, rows and columns 3 j + i for component i of function j; dense if the gradient
    [3 n, count] is."""
    n, count = len(tangent[0]), gradient.shape[1]
    # block (i, k): derivative of P_ia after H_kb, for the axes a, b
    D = tangent.reshape(3, 3, n, 3, 3)  # [a, i, n, b, k]
    if isinstance(gradient, np.ndarray):
        G = gradient.reshape(n, 3, count)
        K = np.empty((count, 3, count, 3))
        for i in range(3):
            for k in range(3):
                DG = np.einsum("anb,nbc->nac", D[:, i, :, :, k], G, optimize=True)
                K[:, i, :, k] = gradient.T @ DG.reshape(3 * n, count)
        return K.reshape(3 * count, 3 * count)
    blocks = []
    at = (np.arange(n), np.arange(n + 1))
    for i in range(3):
        row = []
        for k in range(3):
            middle = sparse.bsr_matrix((np.ascontiguousarray(D[:, i, :, :, k].transpose(1, 0, 2)), *at))
            row.append(gradient.T @ (middle.tocsr() @ gradient))
        blocks.append(row)
    K = sparse.bmat(blocks, format="csr")
    order = (np.arange(count)[:, None] + count * np.arange(3)).ravel()
    return K[order][:, order]


class Factor:
    """K, scaled to a unit diagonal and factored once."""

    def __init__(self, K: sparse.csr_matrix):
        diagonal = np.maximum(K.diagonal(), 1e-30 * K.diagonal().max())
        self.scale = 1 / np.sqrt(diagonal)
        S = sparse.diags(self.scale)
        scaled = (S @ K @ S).tocsc()
        self.lu: SuperLU = splu(
            scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def __call__(self, b: np.ndarray, transposed: bool = False) -> np.ndarray:
        """K^-1 b, or K^-T b, of one vector or of columns."""
        scale = self.scale if b.ndim == 1 else self.scale[:, None]
        return scale * self.lu.solve(scale * b, "T" if transposed else "N")


def modes(
    K: sparse.csr_matrix, M: sparse.csr_matrix, count: int, *, shift: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "n m"]]:
    """The lowest eigenvalues omega^2 [1/s^2] of (K, M) and their vectors, M-orthonormal; -shift is below them all."""
    count = min(count, K.shape[0] - 2)
    factor = Factor((K + shift * M).tocsr())
    start = np.cos(np.arange(K.shape[0]) * 1.0)  # any vector, the same at each call
    operator = LinearOperator(K.shape, matvec=factor, dtype=float)
    values, vectors = eigsh(K, k=count, M=M, sigma=-shift, OPinv=operator, v0=start, tol=1e-8)
    order = np.argsort(values)
    return values[order], vectors[:, order]


def dense_modes(
    K: Float[np.ndarray, "n n"], M: Float[np.ndarray, "n n"], count: int, *, shift: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "n m"]]:
    """As `modes`, of a few functions."""
    # the mass of some directions is next to nothing, so it is not the one that is factored
    count = min(count, len(K))
    K = (K + K.T) / 2 + shift * M
    inverse, vectors = linalg.eigh(
        M, K + 1e-10 * np.diag(K).mean() * np.eye(len(K)), subset_by_index=(len(K) - count, len(K) - 1)
    )
    inverse, vectors = inverse[::-1], vectors[:, ::-1]
    return 1 / inverse - shift, vectors / np.sqrt(inverse)


def relaxation(
    material: AbstractMaterial,
    coefficients: Float[np.ndarray, "k n"],
    weight: Float[np.ndarray, " n"],
    strain: Float[np.ndarray, "m n 3 3"],
) -> Callable[[float], Float[np.ndarray, " m"]]:
    """kappa(t) of fields of small strain [m, n, 3, 3] (transposed gradients): work per square of the amplitude, a time
    t after it was applied."""

    points, still = Points(material, coefficients, weight), np.zeros((len(weight), 3, 3))
    rest = points.state()
    points.stress(still, STUCK)
    points.keep()
    strained = points.state()

    def after(t: float) -> np.ndarray:
        points.set_state(strained)
        points.stress(still, t)  # held
        found, memories = np.zeros(len(strain)), []
        for m, own in enumerate(strain):
            pulled = points.pull(own, None, t)
            found[m] = np.vdot(pulled["H"] + pulled["H_0"], own)
            memories.append(pulled["memory"].copy())
        points.set_state(rest)
        points.stress(still, STUCK)  # applied
        for m, own in enumerate(strain):
            found[m] += np.vdot(points.pull(None, memories[m], STUCK)["H"], own)
        return found

    return after


def damped(kappa: Callable[[float], Float[np.ndarray, " m"]]) -> list[Mode]:
    """Frequencies and loss factors of modes of unit mass from their relaxation kappa(t) [1/s^2]."""
    stuck, relaxed = kappa(STUCK), kappa(RELAXED)
    if np.allclose(stuck, relaxed, rtol=1e-9):
        return [Mode(frequency=float(np.sqrt(max(k, 0.0)) / (2 * np.pi)), loss_factor=0.0) for k in stuck]
    slowest = float(np.sqrt(max(stuck[stuck > 1e-9 * stuck.max()].min(), 1e-30)))
    fastest = float(np.sqrt(stuck.max()))
    time = np.concatenate([[0.0], np.geomspace(1e-3 / fastest, 1e3 / slowest, 120)])
    curve = np.stack([stuck if t == 0 else kappa(t) for t in time]) - relaxed  # [t, m]
    found = []
    for m in range(len(stuck)):
        omega = np.sqrt(max(stuck[m], 1e-30))
        for _ in range(50):
            value = _complex(time, curve[:, m], omega) + relaxed[m]
            last, omega = omega, np.sqrt(max(value.real, 1e-30))
            if abs(omega - last) < 1e-9 * omega:
                break
        loss = value.imag / max(value.real, 1e-30)
        found.append(Mode(frequency=float(omega / (2 * np.pi)), loss_factor=float(loss)))
    return found


def _complex(time: np.ndarray, curve: np.ndarray, omega: float) -> complex:
    """i omega int curve e^(-i omega t) dt, the curve exponential between its samples."""
    top = np.maximum(curve, 1e-300)
    rate = np.log(top[:-1] / top[1:]) / np.diff(time)
    s = np.clip(rate, -1e12, 1e12) + 1j * omega
    step = -np.expm1(-s * np.diff(time)) / s
    return complex(1j * omega * (top[:-1] * np.exp(-1j * omega * time[:-1]) * step).sum())
