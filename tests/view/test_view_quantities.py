"""What colours say: speeds, stiffness and stress against closed forms."""

import math

import numpy as np
import pytest
import torch
from looked_at import run
from scipy.stats import ortho_group

from physics3d.materials.neo_hookean import NeoHookean
from physics3d.materials.viscoelastic import Viscoelastic
from physics3d.materials.von_mises import VonMises
from physics3d.view.quantities import Stress, speeds, stiffness, stresses

E, NU = 1e4, 0.3
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
ELASTIC = {"youngs_modulus": torch.tensor(E), "poissons_ratio": torch.tensor(NU)}


def test_the_speed_is_that_of_the_motion():
    """A run of 30 frames against central differences of its places; one frame alone, from rest, stands still."""
    motion = run(frames=30).trajectory
    x = motion.position.double().numpy()
    found, size = speeds(motion)[1:-1], np.linalg.norm(x[2:] - x[:-2], axis=2) * motion.fps / 2
    # differences over two frames smooth what swings within them
    assert np.abs(found - size).max() < 0.2 * max(size.max(), found.max())
    assert not speeds(run(frames=1).trajectory).any()


def test_the_stiffness_is_that_of_a_pressure_wave():
    np.testing.assert_allclose(stiffness(NeoHookean(), ELASTIC, 3), LAM + 2 * MU, rtol=1e-6)  # parameters in float32
    per_particle = ELASTIC | {"youngs_modulus": torch.tensor([E, 2 * E])}
    np.testing.assert_allclose(stiffness(NeoHookean(), per_particle, 2), (LAM + 2 * MU) * np.array([1, 2]), rtol=1e-6)


def test_the_stress_of_a_stretched_neo_hookean_solid(rng):
    """sigma = (mu (F F^T - I) + lam ln J I)/J: von Mises' stress of a stretch (a, b, b) is mu |a^2 - b^2|/(a b^2)."""
    a, b = rng.uniform(0.7, 1.5, (2, 20))
    turns = ortho_group.rvs(3, 40, random_state=0)
    F = turns[:20] @ (np.stack([a, b, b], 1)[:, :, None] * turns[20:])
    F *= np.sign(np.linalg.det(F))[:, None, None]
    found = Stress(NeoHookean(), ELASTIC, 20).after(torch.from_numpy(F), 1.0)
    np.testing.assert_allclose(found, MU * np.abs(a**2 - b**2) / (a * b**2), rtol=1e-5)  # parameters in float32


def test_a_branch_relaxes_as_its_dash_pot_says():
    """Held at a small shear, the stress of the branch decays as exp(-k_d t); the elastic one stays."""
    mu_N, time, shear, dt = 4e3, 0.2, 1e-3, 0.01
    values = ELASTIC | {
        name: torch.tensor(value)
        for name, value in zip(
            ("branch_shear_modulus", "branch_bulk_modulus", "shear_relaxation_time", "bulk_relaxation_time"),
            (mu_N, mu_N, time, time),
        )
    }
    F = torch.eye(3, dtype=torch.float64)[None].clone()
    F[0, 0, 1] = shear
    stress = Stress(Viscoelastic(), values, 1)
    stress.after(F, 1e-9)
    for k in range(1, 30):
        expected = math.sqrt(3) * shear * (MU + mu_N * math.exp(-k * dt / time))
        assert stress.after(F, dt)[0] == pytest.approx(expected, rel=2 * shear)  # of second order in the shear


def test_what_flows_has_no_stress_to_show():
    with pytest.raises(ValueError, match="may flow"):
        Stress(VonMises(), {}, 1)


def test_a_bent_bar_is_stressed_at_its_foot():
    looked = run()
    found = stresses(looked.world.material, looked.values, looked.trajectory)
    z = looked.body.position[:, 2].numpy()
    assert not found[0].any() and found[8][(z > 0.08) & (z < 0.15)].mean() > 3 * found[8][z > 0.35].mean()
