"""The pass that does all of a substep at once does what the separate kernels do, in place or not."""

import numpy as np
import pytest
import torch
from mpm_bodies import block, every_material, tensors

from physics3d.boundaries.base import Setting
from physics3d.boundaries.enforced_rotation import EnforcedRotation
from physics3d.boundaries.half_space import HalfSpace
from physics3d.boundaries.impulse import Impulse
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.arrays import Arrays
from physics3d.mpm.hooks import hooks_of
from physics3d.mpm.substep import Substeps
from physics3d.warp_start import start_warp

DX, STEPS = 0.1, 5


def substeps(
    material, *, fast: bool, moved: bool = False, threads: int = 1, recorded: bool = False, floor: bool = True
) -> tuple[Substeps, np.ndarray]:
    """A block of 3 x 3 x 3 cells in motion, pushed, turned and, with a `floor`, touching that, if `moved`; and the
    clock of some substeps."""
    import warp as wp

    start_warp()
    real = wp.float64
    position, volume = block((3, 3, 3), DX)
    n = len(position)
    mass = 1000 * volume
    setting = Setting(position=position, mass=mass, volume=volume, lower=(0.0, 0.0, 0.0), upper=(0.3, 0.3, 0.3), dx=DX)
    push = Impulse(force=(30.0, 5.0, -4.0), centre=(0.2, 0.2, 0.2), radius=0.12, start=0.0, duration=1.0)
    turn = EnforcedRotation(
        point=(0.15, 0.15, 0.05), axis=(0.0, 0.1, 1.0), radius=0.12, half_height=0.06, angular_velocity=5.0,
        start=0.0, duration=1.0,
    )  # fmt: skip
    ground = HalfSpace(point=(0.0, 0.0, 0.01), normal=(0.0, 0.0, 1.0), kind="separate")
    boundaries = [push, turn, *([ground] if floor else [])] if moved else []
    coefficients = material.coefficients(tensors(material.example)).expand(-1, n).contiguous()
    dt = 0.1 * DX * (1000.0 / float(material.wave_modulus(coefficients).max())) ** 0.5
    signals = [boundary.signals(0.0, dt) for boundary in boundaries]
    q = [boundary.parameters(setting) for boundary in boundaries]
    selection = [boundary.selection(setting) for boundary in boundaries]
    cells = position / DX
    hooks = hooks_of(boundaries, [len(k) for k in q], real)
    arrays = Arrays(
        dx=DX,
        origin=(0.0, 0.0, 0.0),
        gravity=(0.0, 0.0, -9.81),
        mass=mass,
        volume=volume,
        rest=position,
        cell=cells.floor().int(),
        offset=cells - cells.floor(),
        coefficients=coefficients,
        q=torch.cat(q) if q else torch.zeros(0),
        selection=torch.stack(selection) if selection else torch.zeros(0, 0),
        hooks=hooks,
        walls=None,
        memory_rows=material.memory_rows,
        longest_run=STEPS,
        threads=threads,
        fast=fast,
        recorded=recorded,
    )
    arrays.set_window((-3, -3, -3), (9, 9, 9))
    first = arrays.state(0)
    first.v_gathered.copy_(torch.randn(n, 3, generator=torch.Generator().manual_seed(0)) * 0.01 * DX / dt)
    first.memory.copy_(material.initial_memory(n, torch.float64))
    clock = np.array([[dt, 0.99, 0.9 * dt, *(x for s in signals for x in s)]] * STEPS)
    found = Substeps(arrays, hooks, material.advance(real))
    found.start(np.array([[0.0, 1.0, 0.0, *clock[0, 3:]]]), 0, 1)
    return found, clock


def compare(material, *, moved: bool, threads: int) -> None:
    plain, clock = substeps(material, fast=False, moved=moved)
    path = range(1, STEPS + 2)
    assert plain.run(clock, path) == 0
    fused, _ = substeps(material, fast=True, moved=moved, threads=threads)
    assert fused.run(clock, path) == 0
    for i in path[1:]:
        for name in ("u", "v", "L", "tau", "H", "memory", "v_gathered", "L_gathered"):
            a, b = getattr(plain.arrays.state(i), name), getattr(fused.arrays.state(i), name)
            # double precision, another order of the sums
            torch.testing.assert_close(a, b, rtol=0, atol=1e-10 * max(float(a.abs().sum()), 1e-30))
    here, _ = substeps(material, fast=True, moved=moved, threads=threads)
    assert here.run(clock, [1] * (STEPS + 1)) == 0
    assert torch.equal(here.arrays.state(1).flat, fused.arrays.state(STEPS + 1).flat)


@pytest.mark.parametrize("material", every_material(), ids=repr)
def test_one_pass_equals_separate_kernels_for_every_material(material):
    compare(material, moved=False, threads=1)


def test_one_pass_equals_separate_kernels_where_particles_are_pushed_and_steered():
    compare(Viscoelastic(), moved=True, threads=2)
