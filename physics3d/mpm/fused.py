"""All that a substep does to a particle in one pass: gather, steer, advance, push, and the scatter of the next one.

What lies between these (velocity, its gradient, stress) never goes through memory, and a particle's numbers are read
once. Only the CPU takes it: the kernels of `transfer`, `push`, `steer` and `advance` are its twins and what CUDA runs,
and the adjoint is theirs. A test holds the two together. States may be the same (in place) or not.
"""

from functools import cache

import warp as wp

from physics3d.mpm import columns
from physics3d.mpm.hooks import KICK, Hook, columns_of
from physics3d.mpm.stencil import stencil
from physics3d.warp_types import matrix, vector, vector4


@cache
def particle_pass(
    real, material: wp.Function, pushes: tuple[Hook, ...], grips: tuple[Hook, ...], steers: tuple[Hook, ...]
) -> wp.Kernel:
    """Kernel: from the node velocities of substep `row` to the momentum of the next one."""
    vec3, vec4, mat33 = vector(real), vector4(wp.float64), matrix(real)
    first_node, local, weights, _ = stencil(real)
    gathered, spread = columns.gathered(real, fast=True), columns.spread(real, fast=True, sums=wp.float64)
    push, push_a, push_b, push_row = columns_of(pushes)
    grip, grip_a, grip_b, grip_row = columns_of(grips)
    steer = columns_of(steers)[0]
    push_count, grip_count = len(pushes), len(grips)

    @wp.kernel(module="unique", enable_backward=False)
    def particle_pass_kernel(
        # in
        first: int,  # particle of thread 0
        dx: real,  # [m]
        window: wp.array(dtype=int),  # [6] lowest node and number of nodes along each axis
        clock: wp.array2d(dtype=real),  # [substep, k] as in `arrays`
        row: wp.array(dtype=int),  # [1] the substep
        keep: int,  # 1: write velocities and stress too
        onward: int,  # 1: scatter for the next substep
        selection: wp.array2d(dtype=real),  # [boundary, p]
        rest: wp.array(dtype=vec3),  # [p] [m]
        q: wp.array(dtype=real),  # [k] parameters of the boundaries
        whole_mass: wp.array(dtype=real),  # [p] [kg]
        whole_volume: wp.array(dtype=real),  # [p] at rest [m^3]
        cell: wp.array(dtype=wp.vec3i),  # [p] of the rest position
        offset: wp.array(dtype=vec3),  # [p] of the rest position in its cell [cells]
        coefficients: wp.array2d(dtype=real),  # [k, p] of the material
        node_velocity: wp.array(dtype=vec3),  # [node] [m/s]
        u: wp.array(dtype=vec3),  # [p] displacement [m]
        H: wp.array(dtype=mat33),  # [p] F - I [1]
        memory: wp.array2d(dtype=real),  # [m, p] internal variables of the material
        # out
        u_next: wp.array(dtype=vec3),  # [p] [m]
        H_next: wp.array(dtype=mat33),  # [p] [1]
        memory_next: wp.array2d(dtype=real),  # [m, p]
        v_gathered: wp.array(dtype=vec3),  # [p] before steering [m/s]
        L_gathered: wp.array(dtype=mat33),  # [p] before steering [1/s]
        v_next: wp.array(dtype=vec3),  # [p] [m/s]
        L_next: wp.array(dtype=mat33),  # [p] [1/s]
        tau_next: wp.array(dtype=mat33),  # [p] Kirchhoff stress [Pa]
        grid: wp.array(dtype=vec4),  # [node] momentum [kg m/s], mass [kg], added to
        lost: wp.array(dtype=int),  # [1] added to
    ):
        p = wp.tid() + first
        r = row[0]
        dt = clock[r, 0]
        rate = real(4.0) / dx
        ny, nz = window[4], window[5]
        place = u[p]
        d = offset[p] + place / dx
        node = first_node(cell[p], d, window)
        if node >= 0:
            f = local(d)
            w = weights(f)
            S = gathered(node_velocity, node, ny, nz, f, w)
            v = vec3(S[0, 0], S[0, 1], S[0, 2])
            L = rate * mat33(S[1, 0], S[2, 0], S[3, 0], S[1, 1], S[2, 1], S[3, 1], S[1, 2], S[2, 2], S[3, 2])
            if wp.static(grip_count > 0):
                if keep == 1:
                    v_gathered[p] = v
                    L_gathered[p] = L
                x = rest[p] + place
                for i in range(wp.static(grip_count)):
                    weight = selection[wp.static(grip_row[i]), p]
                    held = wp.static(grip[i])(weight, q, wp.static(grip_a[i]), clock, r, wp.static(grip_b[i]))
                    if weight != real(0.0) and held >= real(1.0):
                        v, L = wp.static(steer[i])(x, q, wp.static(grip_a[i]), clock, r, wp.static(grip_b[i]))
            place = place + dt * v
            deformation, stress = material(p, dt, L, H[p], coefficients, memory, memory_next)
            u_next[p] = place
            H_next[p] = deformation
            if keep == 1:
                v_next[p] = v
                L_next[p] = L
                tau_next[p] = stress
            if onward == 1:
                r = r + 1
                kick = clock[r, wp.static(KICK)]
                if wp.static(push_count > 0):
                    x = rest[p] + place
                    pushed = v
                    for i in range(wp.static(push_count)):
                        weight = selection[wp.static(push_row[i]), p]
                        if weight != real(0.0):
                            pushed = pushed + kick * wp.static(push[i])(
                                weight, x, q, wp.static(push_a[i]), clock, r, wp.static(push_b[i])
                            )
                    v = pushed
                d = offset[p] + place / dx
                node = first_node(cell[p], d, window)
                if node >= 0:
                    f = local(d)
                    left = real(1.0)
                    for i in range(wp.static(grip_count)):
                        weight = selection[wp.static(grip_row[i]), p]
                        if weight != real(0.0):
                            left = left - wp.min(
                                left,
                                wp.static(grip[i])(weight, q, wp.static(grip_a[i]), clock, r, wp.static(grip_b[i])),
                            )
                    m = left * whole_mass[p]
                    A = (real(4.0) * m) * (L / rate) - (rate * kick * left * whole_volume[p]) * stress
                    spread(grid, node, ny, nz, f, weights(f), v, m, A)
                else:
                    wp.atomic_add(lost, 0, 1)
        else:
            wp.atomic_add(lost, 0, 1)

    return particle_pass_kernel
