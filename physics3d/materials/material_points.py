"""Many material points, one step, no grid: the constitutive functions of the solver as a differentiable torch function.

(dt, L, H, coefficients, memory) -> (H_next, tau [Pa], memory_next)
"""

import functools
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.materials.base import AbstractMaterial
from physics3d.warp_start import start_warp
from physics3d.warp_types import matrix

_REAL = {torch.float32: wp.float32, torch.float64: wp.float64}


def advance(
    material: AbstractMaterial,
    dt: float | Float[Tensor, " n"],
    L: Float[Tensor, "n 3 3"],
    H: Float[Tensor, "n 3 3"],
    coefficients: Float[Tensor, "k n"],
    memory: Float[Tensor, "m n"],
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3 3"], Float[Tensor, "m n"]]:
    """One step of n points over dt [s], one for all or each its own, with the velocity gradient L [1/s]: (H_next, tau
    [Pa], memory_next).

    All tensors are of one dtype; coefficients of one column are those of every point. Differentiable."""
    return _Advance.apply(material, dt, L, H, coefficients, memory)


@functools.cache
def _kernel(function: wp.Function, real: type) -> wp.Kernel:
    mat33 = matrix(real)

    @wp.kernel(module="unique")
    def material_points(
        # in
        dt: wp.array(dtype=real),  # [n] [s]
        L: wp.array(dtype=mat33),  # [n] velocity gradient [1/s]
        H: wp.array(dtype=mat33),  # [n] deformation minus identity [1]
        coefficients: wp.array2d(dtype=real),  # [k, n] of the material
        memory: wp.array2d(dtype=real),  # [m, n] internal variables
        # out
        H_next: wp.array(dtype=mat33),  # [n] [1]
        tau: wp.array(dtype=mat33),  # [n] Kirchhoff stress [Pa]
        memory_next: wp.array2d(dtype=real),  # [m, n]
    ):
        p = wp.tid()
        H_p, tau_p = function(p, dt[p], L[p], H[p], coefficients, memory, memory_next)
        H_next[p] = H_p
        tau[p] = tau_p

    return material_points


@dataclass(frozen=True, kw_only=True)
class _Inputs:
    """What the kernel reads beside dt, or the adjoint of it."""

    L: Float[Tensor, "n 3 3"]
    H: Float[Tensor, "n 3 3"]
    coefficients: Float[Tensor, "k n"]
    memory: Float[Tensor, "m n"]

    def arrays(self, real: type) -> list[wp.array]:
        L, H = (wp.from_torch(t.detach(), dtype=matrix(real)) for t in (self.L, self.H))
        return [L, H, *(wp.from_torch(t.detach(), dtype=real) for t in (self.coefficients, self.memory))]


@dataclass(frozen=True, kw_only=True)
class _Outputs:
    """What the kernel writes, or the adjoint of it."""

    H_next: Float[Tensor, "n 3 3"]
    tau: Float[Tensor, "n 3 3"]
    memory_next: Float[Tensor, "m n"]

    def arrays(self, real: type) -> list[wp.array]:
        H_next, tau = (wp.from_torch(t.detach(), dtype=matrix(real)) for t in (self.H_next, self.tau))
        return [H_next, tau, wp.from_torch(self.memory_next.detach(), dtype=real)]


class _Advance(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, material: AbstractMaterial, dt: float | Tensor, L: Tensor, H: Tensor, coefficients: Tensor, memory: Tensor
    ):
        start_warp()
        n, real = len(H), _REAL[H.dtype]
        L, H, columns, memory = (t.detach().contiguous() for t in (L, H, coefficients.expand(-1, n), memory))
        inputs = _Inputs(L=L, H=H, coefficients=columns, memory=memory)
        steps = torch.as_tensor(dt, dtype=H.dtype).detach().expand(n).contiguous()
        outputs = _Outputs(H_next=torch.zeros_like(H), tau=torch.zeros_like(H), memory_next=torch.zeros_like(memory))
        ctx.kernel, ctx.real = _kernel(material.advance(real), real), real
        ctx.one_column = coefficients.shape[1] == 1
        ctx.save_for_backward(steps, L, H, columns, memory, outputs.H_next, outputs.tau, outputs.memory_next)
        wp.launch(
            ctx.kernel,
            n,
            inputs=[wp.from_torch(steps, dtype=real), *inputs.arrays(real)],
            outputs=outputs.arrays(real),
            device=str(H.device),
        )
        return outputs.H_next, outputs.tau, outputs.memory_next

    @staticmethod
    def backward(ctx, adj_H_next: Tensor, adj_tau: Tensor, adj_memory_next: Tensor):
        steps, L, H, columns, memory, H_next, tau, memory_next = ctx.saved_tensors
        adjoint = _Inputs(
            L=torch.zeros_like(L),
            H=torch.zeros_like(H),
            coefficients=torch.zeros_like(columns),
            memory=torch.zeros_like(memory),
        )
        # Warp clears what it has read
        adj_H_next, adj_tau, adj_memory_next = (
            t.clone(memory_format=torch.contiguous_format) for t in (adj_H_next, adj_tau, adj_memory_next)
        )
        given = _Outputs(H_next=adj_H_next, tau=adj_tau, memory_next=adj_memory_next)
        real = ctx.real
        wp.launch(
            ctx.kernel,
            len(H),
            inputs=[
                wp.from_torch(steps, dtype=real),
                *_Inputs(L=L, H=H, coefficients=columns, memory=memory).arrays(real),
            ],
            outputs=_Outputs(H_next=H_next, tau=tau, memory_next=memory_next).arrays(real),
            adj_inputs=[None, *adjoint.arrays(real)],
            adj_outputs=given.arrays(real),
            adjoint=True,
            device=str(H.device),
        )
        coefficients = adjoint.coefficients.sum(1, keepdim=True) if ctx.one_column else adjoint.coefficients
        return None, None, adjoint.L, adjoint.H, coefficients, adjoint.memory
