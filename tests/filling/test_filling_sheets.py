"""Laws of thin parts: one particle per spacing^2, which weighs area times thickness."""

import numpy as np
import pytest
from analytic_bodies import discs, sheet
from fillings import SPACING, filled


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_a_thin_sheet_stays_thin_and_weighs_area_times_thickness(rng):
    gaussians = discs(*sheet(4000, 0.1, rng), rng)
    body = filled(gaussians, sheet_thickness=0.002)
    assert not bool(body.interior.any())
    assert float(body.position[:, 2].abs().max()) < 1e-3
    # samples end up to half a sample distance before the edge: 4 * 1.5 mm / 100 mm
    assert float(body.volume.double().sum()) == pytest.approx(0.01 * 0.002, rel=0.07)
    # one particle for every spacing^2, within the scatter of random packing
    assert len(body.position) == pytest.approx(0.01 / SPACING**2, rel=0.15)


def test_thickness_is_taken_from_the_gaussians(rng):
    gaussians = discs(*sheet(4000, 0.1, rng), rng, thickness=0.0004)
    body = filled(gaussians)
    assert float(body.volume.double().sum()) == pytest.approx(0.01 * 12**0.5 * 0.0004, rel=0.07)
