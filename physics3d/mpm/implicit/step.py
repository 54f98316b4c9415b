"""One implicit substep of MLS-MPM, backward Euler: for waves that are too fast to follow.

The unknowns are the node velocities v at the end of the step; weights and places are those of its start:

    v_i = B_i(u_i),   u_i = e^(-c dt) [ (p_i + dt f_i(v))/m_i + dt g ]            B: walls, held regions, colliders
    f_i = -(4/dx^2) sum_p V_p w_ip T_p (x_i - x_p)                                                          [N]
    T_p = tau(L_p) (I + dt L_p)^-T,   L_p(v) as in the gather, tau from the material as it is              [Pa]

T_p = P F_n^T, so dt f is minus the gradient by v of the potential sum V_p psi((I + dt L_p) F_n): its Jacobian K is
symmetric for every material that has a potential, and f has no torque about the places at the end of the step.

`system` holds these equations, `newton` solves them with the linearised forces of `tangent` and boundaries of
`constraints`, by the methods of `krylov`; `adjoint` goes back.

Source: Jiang et al. (2016) The material point method for simulating continuum materials, sec. 10.
"""

import numpy as np
from torch import Tensor

from physics3d.mpm.adjoint import Adjoint
from physics3d.mpm.implicit.adjoint import reverse
from physics3d.mpm.implicit.launches import StepLaunches
from physics3d.mpm.implicit.newton import Step, solve
from physics3d.mpm.implicit.system import System
from physics3d.mpm.substep import Substeps


class ImplicitSubsteps:
    """Implicit substeps between the numbered states of explicit ones, on their grid, window and threads."""

    def __init__(self, substeps: Substeps, *, bounded: bool):
        """`bounded`: a boundary acts on the nodes."""
        self.bounded = bounded
        self.launches = StepLaunches(substeps)

    def step(self, clock: np.ndarray, i: int, j: int) -> Step:
        """State j from state i by the first row of the clock. Raises NotConverged."""
        self.launches.between(i, j)
        return solve(System(self.launches, clock, i, j), bounded=self.bounded)

    def reverse(self, adjoint: Adjoint, clock: np.ndarray, i: int, j: int, side: int, node_velocity: Tensor) -> int:
        """See `adjoint.reverse`."""
        return reverse(self.launches, adjoint, clock, i, j, side, node_velocity, bounded=self.bounded)
