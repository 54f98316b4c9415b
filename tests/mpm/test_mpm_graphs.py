"""A run of substeps that is repeated as a graph is the run that was launched one kernel after the other, to the bit."""

import pytest
import torch
from test_mpm_fused import DX, STEPS, substeps

from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.mpm.adjoint import Adjoint

PATH = range(1, STEPS + 2)


@pytest.mark.parametrize("fast", [False, True])
def test_a_run_as_a_graph_is_the_run(fast):
    """Twice by one recording, over two windows of as many nodes, with other steps; pushed, turned, touching a floor."""
    (plain, clock), (recorded, _) = (substeps(Viscoelastic(), fast=fast, moved=True, recorded=r) for r in (False, True))
    here = [1] * (STEPS + 1)
    for lowest, share in (((-3, -3, -3), 1.0), ((-2, -3, -3), 0.5)):
        clock[:, :1] *= share
        for each in (plain, recorded):
            each.arrays.set_window(lowest, (9, 9, 9))
            assert each.run(clock, here) == 0
        assert torch.equal(plain.arrays.state(1).flat, recorded.arrays.state(1).flat)
    assert float(plain.arrays.state(1).u.abs().max()) > 1e-4 * DX, "nothing moves: nothing is tested"


def test_the_way_back_as_a_graph_is_the_way_back():
    found = []
    for recorded in (False, True):
        # by the separate kernels, as on a GPU
        forward, clock = substeps(Viscoelastic(), fast=False, moved=True, recorded=recorded)
        adjoint = Adjoint(forward)
        for _ in range(2):  # the second one is the recording again
            adjoint.clear()
            adjoint.states[0].u.fill_(1.0)
            adjoint.states[0].tau.fill_(1e-3)
            side = adjoint.reverse(clock, PATH, 0)
        coefficients, q, *_, selection = adjoint.gradients(adjoint.states[side])
        found.append((adjoint.states[side].flat.clone(), coefficients, q, selection))
    assert all(torch.equal(a, b) for a, b in zip(*found))
    assert all(bool(x.any()) for x in found[0])


def test_a_grid_that_grows_leaves_no_graph_behind():
    (plain, clock), (recorded, _) = (
        substeps(Viscoelastic(), fast=False, moved=True, recorded=r) for r in (False, True)
    )
    for size in (9, 14, 9):
        for each in (plain, recorded):
            each.arrays.set_window((-3, -3, -3), (size, size, size))
            assert each.run(clock, [1] * (STEPS + 1)) == 0
        assert torch.equal(plain.arrays.state(1).flat, recorded.arrays.state(1).flat)
