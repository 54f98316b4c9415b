"""Who moves the body that a hand pulls at: one step at a time, of one length, by a force of the hand."""

import abc

import numpy as np
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import Values


class TooMuch(Exception):
    """The motion cannot be computed any further; the body has to be put to rest."""


class AbstractMover(abc.ABC):
    """A body from rest on. Its hand pulls at a fingertip's worth of particles, or at nothing."""

    dt: float  # of a step [s]
    still: float  # of the body's size per second: who moves less for a second has come to rest
    how: str  # it is moved, in a sentence for a person
    notes: tuple[str, ...]  # how that differs from the scene, for the file of a poke

    @property
    @abc.abstractmethod
    def time(self) -> float:
        """Since rest [s]."""

    @abc.abstractmethod
    def take(self, particle: int, weight: Float[np.ndarray, " p"]) -> str:
        """The hand takes hold of a particle, and of all with a weight above 0; "", or why it cannot."""

    @abc.abstractmethod
    def force(self, displacement: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Of the hand [N] when it is so far [m] from where it took hold."""

    @abc.abstractmethod
    def let_go(self) -> None: ...

    @abc.abstractmethod
    def step(self, force: Float[np.ndarray, "3"]) -> None:
        """`dt` onwards under a force of the hand [N]. Raises TooMuch."""

    @abc.abstractmethod
    def change(self, parameters: Values, *, damping: float) -> None:
        """Other parameters, and another rate at which velocities decay [1/s]; the motion goes on."""

    @abc.abstractmethod
    def rest(self) -> None:
        """Undeformed and still, as at the start, with the present parameters and nobody's hand on it."""

    @abc.abstractmethod
    def particles(self) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
        """Positions [m], deformation gradients and velocities [m/s] of the body's particles."""

    @abc.abstractmethod
    def speed(self) -> float:
        """Of the fastest part of the body [m/s]."""

    def stress(self) -> Float[np.ndarray, " p"] | None:
        """Von Mises stress of the body's particles [Pa]; None: it has to be asked of the material."""
        return None

    def unfelt(self, position: Float[Tensor, "p 3"]) -> str:
        """What the body reaches at `position` [m] and does not feel, in one line; "": nothing."""
        return ""
