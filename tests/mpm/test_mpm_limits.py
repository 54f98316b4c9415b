"""Substeps are as long as waves and viscosity allow, and no longer."""

import math

import pytest
from mpm_bodies import small_rollout, soft_world

from physics3d.materials.newtonian import Newtonian


def test_a_substep_above_the_limit_is_refused_and_the_limit_is_named():
    # c = sqrt(1.35 * 1e4/1000) = 3.67 m/s: a wave crosses 0.1 m in 0.027 s, a lone particle needs 0.0157 s
    with pytest.raises(
        ValueError, match=r"substep_dt is 0.02 s, waves cross a cell in 0.0272.* s .*take world.dt < 0.0157"
    ):
        small_rollout(soft_world(dt=0.02))
    assert small_rollout(soft_world(dt=0.0156)).substeps == 2


def test_automatic_substep_follows_the_speed_of_sound():
    counts = [
        small_rollout(soft_world(start=dict(youngs_modulus=E, poissons_ratio=0.3)), frames=2, frame_dt=0.1).substeps
        for E in (1e4, 1e6, 1e8)
    ]
    # ten times the speed, ten times the substeps, up to rounding up
    assert counts[1] == pytest.approx(10 * counts[0], rel=0.1) and counts[2] == pytest.approx(10 * counts[1], rel=0.02)


@pytest.mark.parametrize(
    "changes, says",
    [
        (dict(start=dict(youngs_modulus=1e12, poissons_ratio=0.3)), "waves cross a cell .* take a softer material"),
        (dict(dt=1e-6), "take world.dt > 0.0002, or a larger max_substeps"),
    ],
    ids=["stiff", "dt"],
)
def test_more_substeps_than_a_frame_may_have_are_refused_before_they_start(changes, says):
    with pytest.raises(ValueError, match=rf"frame 1 would need \d+ substeps .* world.max_substeps = 100: .*{says}"):
        small_rollout(soft_world(max_substeps=100, scheme="explicit", **changes))


def test_viscosity_shortens_the_automatic_substep():
    """Waves alone ask for 0.95 a, with b = rho dx^2/(6 eta) both for 0.95 a [(1 + x^2)^(1/2) - x], x = a/(2 b)."""
    counts = {}
    for eta in (0.0, 1e3, 1e4, 1e5):
        start = dict(bulk_modulus=1e5, viscosity=eta, power_index=1.0)
        world = soft_world(material=Newtonian(), start=start, scheme="explicit")
        counts[eta] = small_rollout(world, frames=2, frame_dt=0.1).substeps
    a, b = 0.1 / math.sqrt(3 * 1e5 / 1000), {eta: 1000 * 0.01 / (6 * eta) for eta in (1e3, 1e4, 1e5)}
    assert counts[0.0] == math.ceil(0.1 / min(0.5 * 0.1 / 10, 0.95 * a))
    for eta, viscous in b.items():
        x = a / (2 * viscous)
        limit = 0.95 * a * (math.sqrt(1 + x * x) - x)
        assert counts[eta] == math.ceil(0.1 / min(0.5 * 0.1 / 10, limit))
    # ten times the viscosity, ten times the substeps
    assert counts[1e5] == pytest.approx(10 * counts[1e4], rel=0.02)
