"""The velocity gradient with which a body starts, from the velocities of its particles.

    L_p = sum_i w_ip v_i r_i^T ( sum_i w_ip r_i r_i^T )^-1,   r_i = x_i - sum_j w_jp x_j

over the nodes' mean velocities v_i and centres of mass x_i: exact for linear fields, zero across a sheet. A body that
starts to spin or to stretch needs it: with L = 0 the first scatter would take the part of the motion that lives below a
cell (a quarter of the angular momentum of a body three cells wide).
"""

import torch
from jaxtyping import Float
from torch import Tensor


def velocity_gradient(
    x: Float[Tensor, "p 3"], v: Float[Tensor, "p 3"], mass: Float[Tensor, " p"]
) -> Float[Tensor, "p 3 3"]:
    """Gradient, per unit of x, of a field of velocities at the particles; x in cells, float64, differentiable."""
    base = (x.detach() - 0.5).floor()
    f = x - base
    w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
    base = (base - base.amin(0)).long()
    size = base.amax(0) + 3
    nodes = []
    for step in torch.cartesian_prod(*[torch.arange(3, device=x.device)] * 3):
        i, j, k = (base + step).unbind(1)
        weight = w[step[0], :, 0] * w[step[1], :, 1] * w[step[2], :, 2]
        nodes.append(((i * size[1] + j) * size[2] + k, weight))
    sums = x.new_zeros(int(size.prod()), 7)  # mass times (1, velocity, position)
    for node, weight in nodes:
        sums = sums.index_add(0, node, (weight * mass)[:, None] * torch.cat([torch.ones_like(x[:, :1]), v, x], 1))
    mean = sums[:, 1:] / sums[:, :1].clamp(min=torch.finfo(x.dtype).tiny)
    at_particle = sum(weight[:, None] * mean[node] for node, weight in nodes)
    left, right = x.new_zeros(len(x), 3, 3), 1e-9 * torch.eye(3, dtype=x.dtype, device=x.device)
    for node, weight in nodes:
        dv, r = (mean[node] - at_particle).split(3, 1)
        left = left + (weight[:, None] * dv)[:, :, None] * r[:, None]
        right = right + (weight[:, None] * r)[:, :, None] * r[:, None]
    return left @ torch.linalg.inv(right)
