"""The stiffness K of a step, linearised at its last forces: products with it, and its diagonal for a preconditioner.

C_p = dT/dL, 9 x 9 per particle, comes from nine launches of the adjoint that the material has anyway. K is never
assembled.
"""

import torch
import warp as wp
from torch import Tensor

from physics3d.mpm.implicit.launches import total
from physics3d.mpm.implicit.system import System


class Tangent:
    """C and the diagonal blocks of M + K. Making another one changes C, which all share: the last one is true."""

    def __init__(self, system: System, *, symmetric: bool, again: bool = False):
        """`symmetric`: take the symmetric part of C; `again`: take that of the step before, if it was as long."""
        self.system = system
        launches = system.launches
        C = wp.to_torch(launches.C)
        again = again and symmetric and launches.kick == system.kick
        self.fresh: bool = not again  # of the forces that the system made last
        self.symmetric: bool = symmetric or again
        if not again:
            self._differentiate(C)
        self.norm: Tensor = C.norm(dim=1)  # [p] Pa s
        self.inverse_blocks: Tensor = self._inverse_blocks(C)  # [node, 3, 3] 1/kg

    def _differentiate(self, C: Tensor) -> None:
        launches = self.system.launches
        n, E = launches.arrays.n, wp.to_torch(launches.E)
        steered = launches.arrays.steered
        adjoint_L = wp.to_torch(launches.own["L_gathered" if steered else "L"])
        for k in range(9):
            E.zero_()
            E.view(n, 9)[:, k] = 1
            if steered:
                adjoint_L.zero_()
                wp.to_torch(launches.own["v"]).zero_()
            launches.on_particles("stress_adjoint", "advance_adjoint", "steer_adjoint")
            C.view(n, 9, 9)[:, :, k] = adjoint_L.view(n, 9)
        square = C.view(n, 9, 9)
        launches.kick = self.system.kick if self.symmetric else None
        if self.symmetric:
            square.copy_(0.5 * (square + square.mT))
        else:
            self.symmetric = bool((square - square.mT).abs().max() <= 1e-5 * square.abs().max())

    def stiff(self, x: Tensor, *, transposed: bool = False) -> Tensor:
        """K x or K^T x [kg x]."""
        launches, count = self.system.launches, self.system.count
        wp.to_torch(launches.w)[:count] = x
        product = wp.to_torch(launches.Kw)[:, :count]
        product.zero_()
        square = wp.to_torch(launches.C).view(-1, 9, 9)
        turned = transposed and not self.symmetric
        if turned:
            square.copy_(square.mT.clone())
        launches.on_particles("stiffness")
        if turned:
            square.copy_(square.mT.clone())
        return total(product)[:, :3].to(x.dtype, copy=True)

    def block(self, x: Tensor) -> Tensor:
        """D^-1 x, D the diagonal blocks of M + K."""
        return torch.bmm(self.inverse_blocks, x[:, :, None])[:, :, 0]

    def _inverse_blocks(self, C: Tensor) -> Tensor:
        system, n = self.system, len(C)
        c = C.view(n, 3, 3, 3, 3)
        trace = torch.einsum("nabab->n", c)
        both = (torch.einsum("naabb->n", c) + trace + torch.einsum("nabba->n", c)) / 15
        c2 = (3 * both - trace / 3) / 2
        moduli = wp.to_torch(system.launches.moduli)
        moduli[:, 0] = (both - c2).clamp(min=0)
        moduli[:, 1] = torch.maximum(c2, -moduli[:, 0])
        blocks = wp.to_torch(system.launches.blocks)[:, : system.count]
        blocks.zero_()
        system.launches.on_particles("diagonal")
        eye = torch.eye(3, dtype=c.dtype, device=c.device)
        inertia = torch.where(system.present > 0, system.mass, 1.0)
        whole = total(blocks) + inertia[:, :, None] * eye
        inverse, singular = torch.linalg.inv_ex(whole)
        # a light node may lose its mass to rounding against one stiff particle; the preconditioner need not be exact
        spare = eye / whole.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        return torch.where((singular > 0)[:, None, None], spare, inverse)
