"""One look at the particles sees what torch sees."""

import pytest
import torch
import warp as wp

from physics3d.mpm.state import make_state
from physics3d.mpm.survey import survey
from physics3d.warp_start import start_warp
from physics3d.warp_types import vector


@pytest.mark.parametrize(
    "dtype, real, tolerance", [(torch.float32, wp.float32, 1e-5), (torch.float64, wp.float64, 1e-12)]
)
def test_survey_sees_what_torch_sees(dtype, real, tolerance):
    start_warp()
    n, dx, generator = 200, 0.1, torch.Generator().manual_seed(0)
    state = make_state(n, 0, steered=False, dtype=dtype, device="cpu")
    state.flat.copy_(torch.randn(state.flat.shape, generator=generator))
    state.tau.copy_(state.tau + state.tau.mT.clone())
    state.tau[:20] = torch.eye(3) * -4.0  # all principal stresses equal
    rest = torch.rand(n, 3, generator=generator).to(dtype)
    cell = (rest / dx).floor()
    offset = rest / dx - cell
    constant = {"rest": wp.from_torch(rest, dtype=vector(real)), "offset": wp.from_torch(offset, dtype=vector(real))}
    constant["cell"] = wp.from_torch(cell.int(), dtype=wp.vec3i)
    modulus = torch.rand(n, generator=generator)
    low, high = torch.tensor([-1.0, -1.5, -2.0]), torch.tensor([2.0, 1.5, 1.0])
    state.u[7, 1], state.tau[8, 0, 2], state.v[9] = float("nan"), float("inf"), float("nan")
    seen = survey(state, constant, modulus, dx, low, high)
    good = torch.ones(n, dtype=torch.bool)
    good[7:10] = False
    stress = torch.linalg.eigvalsh(state.tau[good].double()).abs().amax(1)
    assert seen.stiffness == pytest.approx(float((modulus[good] + 2 * stress).max()), rel=tolerance)
    assert seen.speed == pytest.approx(float(state.v[good].norm(dim=1).max()), rel=tolerance)
    cells = (cell + (offset + state.u / dx).floor())[good]
    assert seen.lowest == tuple(cells.amin(0).tolist()) and seen.highest == tuple(cells.amax(0).tolist())
    x = (rest + state.u)[good]
    assert seen.infinite == 3
    assert seen.outside == int(((x < low) | (x > high)).any(1).sum())
