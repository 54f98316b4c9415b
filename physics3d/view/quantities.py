"""What a particle's colour may say: how stiff it is, how fast, under how much stress, and to which part it belongs.

    stiffness   rho c^2 of the fastest wave, lam + 2 mu with all branches stiff                            [Pa]
    speed       |v|; where a trajectory holds no velocity, central differences of its positions            [m/s]
    stress      sqrt(3/2 dev sigma : dev sigma), von Mises; sigma = tau/J of the material's own function    [Pa]

The stress of a material with a memory depends on the way: it is asked frame by frame, each deformation a step after the
last (`modes/stress.py`), as exact as the material is over steps of that length. A material that flows keeps no total
deformation that the function could be asked with, so there is no stress to show.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial, Values
from physics3d.modes.stress import Points
from physics3d.trajectory import Trajectory


def stiffness(material: AbstractMaterial, parameters: Values, count: int) -> Float[np.ndarray, " p"]:
    """[Pa] of each of `count` particles."""
    found = material.wave_modulus(_coefficients(material, parameters, count))
    return found.detach().cpu().double().numpy()


def speeds(trajectory: Trajectory) -> Float[np.ndarray, "t p"]:
    """[m/s] in every frame."""
    return np.linalg.norm(trajectory.velocity.numpy(), axis=2)


class Stress:
    """The stress of all particles along a motion that is told step by step, from the undeformed state on."""

    def __init__(self, material: AbstractMaterial, parameters: Values, count: int):
        """Raises ValueError for a material that flows."""
        if not material.recovers:
            raise ValueError(f"the material ({type(material).__name__}) may flow: no stress is kept of it")
        self._material, self._count = material, count
        coefficients = _coefficients(material, parameters, count).detach().cpu().numpy()
        self._points = Points(material, coefficients, np.ones(count))

    def change(self, parameters: Values) -> None:
        """Other parameters from now on; the history stays."""
        coefficients = _coefficients(self._material, parameters, self._count)
        self._points.data["coefficients"][:] = coefficients.detach().cpu().numpy()

    def after(self, F: Float[Tensor, "p 3 3"], dt: float) -> Float[np.ndarray, " p"]:
        """Von Mises stress [Pa] at a deformation, `dt` [s] after the last one."""
        F_ = F.double().numpy()
        Pt = self._points.stress(F_.swapaxes(1, 2) - np.eye(3), dt)
        self._points.keep()
        return von_mises(Pt.swapaxes(1, 2), F_)


def stresses(material: AbstractMaterial, parameters: Values, trajectory: Trajectory) -> Float[np.ndarray, "t p"]:
    """[Pa] in every frame. Raises ValueError for a material that flows."""
    found = Stress(material, parameters, len(trajectory.rest_position))
    return np.stack([found.after(F, 1 / trajectory.fps) for F in trajectory.deformation])


def von_mises(P: Float[np.ndarray, "n 3 3"], F: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Of the first Piola-Kirchhoff stress P [Pa]: sigma = P F^T / det F. What is turned inside out has none."""
    return von_mises_of_kirchhoff(np.einsum("nik,njk->nij", P, F), F)


def von_mises_of_kirchhoff(tau: Float[np.ndarray, "n 3 3"], F: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Of the Kirchhoff stress [Pa]: sigma = tau / det F. What is turned inside out has none."""
    J = np.linalg.det(F)
    sigma = tau / np.where(J > 0, J, np.inf)[:, None, None]
    deviator = sigma - np.trace(sigma, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return np.sqrt(1.5 * np.einsum("nij,nij->n", deviator, deviator))


def _coefficients(material: AbstractMaterial, parameters: Values, count: int) -> Tensor:
    values = {name: torch.as_tensor(value).double() for name, value in parameters.items()}
    return material.coefficients(values).expand(-1, count)
