"""Laws of held sections: their thickness is that of the body there, whatever way the body stands."""

import numpy as np
import pytest

from physics3d.filling.section import GRID, thinnest_section

H = 0.005  # [m]


def lattice(inside, size) -> tuple[np.ndarray, np.ndarray]:
    """Middles of the cells of a cubic lattice around the z axis that are inside, and their volumes."""
    count = np.ceil(np.array(size) / H).astype(int)
    x = (np.indices(count).reshape(3, -1).T + 0.5) * H - [count[0] * H / 2, count[1] * H / 2, 0]
    x = x[inside(x)]
    return x, np.full(len(x), H**3)


def everywhere(x):
    return np.ones(len(x), bool)


def turned(rng) -> np.ndarray:
    return np.linalg.qr(rng.normal(size=(3, 3)))[0]


@pytest.mark.parametrize("layers", [1, 2, 3, 6])
def test_a_bar_is_as_thick_as_its_thinner_side_however_it_stands(layers):
    x, volume = lattice(everywhere, (layers * H, 8 * H, 20 * H))
    held = x[:, 2] < 3 * H
    section = thinnest_section(x @ turned(np.random.default_rng(layers)).T, volume, held, H)
    assert section.thickness == pytest.approx(layers * H, rel=1e-6)  # a lattice has the moments of the bar exactly
    # the second moment of points at the middles of the layers, over that of the bar
    y = (np.arange(layers) + 0.5) / layers - 0.5
    assert section.stiffness == pytest.approx(12 * (y**2).mean(), abs=1e-6)
    assert section.cells(2 * H) == pytest.approx(layers / 2)


def test_a_round_stem_has_the_thickness_of_its_second_moment():
    radius = 6 * H
    x, volume = lattice(lambda x: np.hypot(x[:, 0], x[:, 1]) < radius, (2 * radius, 2 * radius, 0.2))
    section = thinnest_section(x, volume, x[:, 2] < 0.05, H)
    # pi r^4/4 over pi r^2 is r^2/4 = h^2/12; a lattice knows the radius to a fraction of a cell
    assert section.thickness == pytest.approx(np.sqrt(3) * radius, rel=0.03)


def test_of_two_feet_the_thinner_counts():
    wide, thin = lattice(everywhere, (8 * H, 8 * H, 12 * H)), lattice(everywhere, (3 * H, 3 * H, 12 * H))
    x = np.concatenate([wide[0], thin[0] + [20 * H, 0, 0]])
    volume = np.concatenate([wide[1], thin[1]])
    section = thinnest_section(x, volume, x[:, 2] < 2 * H, H)
    assert section.thickness == pytest.approx(3 * H, rel=1e-6)
    assert section.centre[0] == pytest.approx(20 * H, abs=1e-9)


def test_nothing_held_or_all_of_it_has_no_section():
    x, volume = lattice(everywhere, (4 * H, 4 * H, 8 * H))
    for held in (np.zeros(len(x), bool), np.ones(len(x), bool)):
        assert thinnest_section(x, volume, held, H) is None


def test_the_error_of_the_grid_falls_with_the_cells_across():
    x, volume = lattice(everywhere, (4 * H, 4 * H, 20 * H))
    section = thinnest_section(x, volume, x[:, 2] < 3 * H, H)
    for cells, error in GRID:
        assert section.grid_error(4 * H / cells) == pytest.approx(error, rel=1e-5)
    errors = [section.grid_error(dx) for dx in np.geomspace(4 * H / 16, 4 * H, 20)]
    assert (np.diff(errors) >= 0).all()
    assert "2.0 cells, whose error is 4.9 % in frequency, 9.8 % in E" in section.described(2 * H)
