"""Gaussians follow particles: affine motions exactly, smooth ones to third order; what is not tied stays."""

import math

import numpy as np
import pytest
import torch

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.carry import _Rotation, carry
from physics3d.gaussians.deform import Backdrop, render_deformed
from physics3d.gaussians.embedding import Embedding, embed
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.render import render


def lattice(spacing: float) -> torch.Tensor:
    """Particles of the unit cube around the origin, in float64."""
    line = torch.arange(-0.5 + spacing / 2, 0.5, spacing, dtype=torch.float64)
    return torch.cartesian_prod(line, line, line)


def some_gaussians(n=60, k=4, seed=0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)
    return Gaussians(
        mean=torch.rand(n, 3, generator=g, dtype=torch.float64) - 0.5,
        log_scale=normal(n, 3) * 0.3 - 3,
        quaternion=normal(n, 4),
        opacity_logit=normal(n) + 1,
        sh=normal(n, k, 3) * 0.4,
    )


def a_rotation(angle=0.7) -> torch.Tensor:
    axis = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), dim=0)
    K = torch.tensor([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(angle * K)


STRETCH = torch.tensor([[1.3, 0.4, 0.0], [-0.2, 0.7, 0.1], [0.3, 0.0, 1.9]], dtype=torch.float64)
MOTIONS = {"rest": torch.eye(3, dtype=torch.float64), "rotation": a_rotation(), "stretch and shear": STRETCH}
SHIFT = torch.tensor([0.3, -2.0, 0.1], dtype=torch.float64)


@pytest.mark.parametrize("particles", [1, 2, 5, 1000])
@pytest.mark.parametrize("motion", MOTIONS)
def test_an_affine_motion_is_carried_exactly(motion, particles):
    gaussians, A = some_gaussians(), MOTIONS[motion]
    X = lattice(0.1)[torch.randperm(1000, generator=torch.Generator().manual_seed(1))[:particles]]
    which = torch.arange(40)
    tied = embed(gaussians.mean[which], which, X, 0.1)
    mean, covariance, rotation = carry(gaussians, tied, X, X @ A.T + SHIFT, A.expand(len(X), 3, 3))
    # round-off of float64, times coordinates of order one
    torch.testing.assert_close(mean[which], gaussians.mean[which] @ A.T + SHIFT, rtol=0, atol=1e-13)
    torch.testing.assert_close(covariance[which], A @ gaussians.covariance()[which] @ A.T, rtol=0, atol=1e-13)
    R = torch.linalg.svd(A).U @ torch.linalg.svd(A).Vh
    torch.testing.assert_close(rotation[which], R.expand(40, 3, 3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("uneven", [0.0, 0.4])
@pytest.mark.parametrize("where", ["inside", "on the surface"])
def test_a_deformation_that_is_affine_in_the_place_is_carried_exactly(where, uneven):
    """x = X + A X + 1/2 X B X, F = I + A + B X, Gaussians on faces, edges and corners too."""
    generator = torch.Generator().manual_seed(2)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    spacing, n = 0.1, 1000
    X = lattice(spacing)
    low, high = X.amin(0) - spacing / 2, X.amax(0) + spacing / 2
    X = X + uneven * spacing * (draw(*X.shape) - 0.5)
    place = low + draw(n, 3) * (high - low)
    if where == "on the surface":
        side = torch.randint(0, 3, (n, 3), generator=generator)
        place = torch.where(side == 0, low, torch.where(side == 1, high, place))
    A, B = 0.4 * draw(3, 3) - 0.2, draw(3, 3, 3) - 0.5
    B = (B + B.transpose(1, 2)) / 2

    def F(X):
        return torch.eye(3, dtype=torch.float64) + A + torch.einsum("ijk,nk->nij", B, X)

    def x(X):
        return X + X @ A.T + torch.einsum("ijk,nj,nk->ni", B, X, X) / 2

    scale = torch.log(0.01 + 0.02 * draw(n, 3))
    gaussians = Gaussians(
        mean=place, log_scale=scale, quaternion=draw(n, 4), opacity_logit=torch.zeros(n), sh=torch.zeros(n, 1, 3)
    )
    mean, covariance, _ = carry(gaussians, embed(place, torch.arange(n), X, spacing), X, x(X), F(X))
    exact = F(place) @ gaussians.covariance() @ F(place).mT
    off = (covariance - exact).flatten(1).norm(dim=1) / exact.flatten(1).norm(dim=1)
    # round-off; the nearest eight alone, which may lie in one layer, leave up to 5e-2
    assert float(off.max()) < 1e-9
    assert float((mean - x(place)).norm(dim=1).max()) < 1e-9


def test_gaussians_that_are_not_tied_stay():
    gaussians, X = some_gaussians(), lattice(0.2)
    which = torch.arange(0, 60, 2)
    tied = embed(gaussians.mean[which], which, X, 0.2)
    mean, covariance, rotation = carry(gaussians, tied, X, X + 1, STRETCH.expand(len(X), 3, 3))
    assert torch.equal(mean[1::2], gaussians.mean[1::2])
    assert torch.equal(covariance[1::2], gaussians.covariance()[1::2])
    assert torch.equal(rotation[1::2], torch.eye(3, dtype=torch.float64).expand(30, 3, 3))


def bend(X: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """A beam bent onto a circle of radius 1, and its deformation gradient."""
    x, y, z = X.unbind(-1)
    c, s, zero, r = torch.cos(x), torch.sin(x), torch.zeros_like(x), 1 + z
    F = torch.stack([r * c, zero, s, zero, zero + 1, zero, -r * s, zero, c], -1).reshape(-1, 3, 3)
    return torch.stack([r * s, y, r * c - 1], -1), F


def test_a_smooth_motion_is_carried_to_third_order_and_covariances_to_second():
    gaussians, which = some_gaussians(200), torch.arange(200)
    true = bend(gaussians.mean)[1] @ gaussians.covariance() @ bend(gaussians.mean)[1].mT
    errors = []
    for spacing in (0.2, 0.1, 0.05):
        X = lattice(spacing)
        mean, covariance, _ = carry(gaussians, embed(gaussians.mean, which, X, spacing), X, *bend(X))
        shape = (covariance - true).flatten(1).norm(dim=1) / true.flatten(1).norm(dim=1)
        errors.append((float((mean - bend(gaussians.mean)[0]).norm(dim=-1).mean()), float(shape.mean())))
    slopes = np.diff(np.log(errors), axis=0) / math.log(0.5)
    # a few Gaussians near the surface lose half an order: they lie outside their particles
    assert (slopes > (2.7, 1.7)).all(), slopes
    assert errors[-1][0] < 0.05**3  # the curvature is 1/m


def halves(gap: float, spacing: float) -> torch.Tensor:
    """The unit cube, its right half moved away by `gap`."""
    X = lattice(spacing)
    return X + torch.where(X[:, :1] > 0, gap, 0.0) * torch.tensor([1.0, 0, 0], dtype=torch.float64)


@pytest.mark.parametrize("reason", ["gap", "part"])
def test_particles_beyond_a_gap_or_of_another_part_carry_nothing(reason):
    """The right half moves, the left one stays: Gaussians on the faces follow their own side as if alone."""
    spacing = 0.1
    X = halves(0.9 * spacing if reason == "gap" else 0.0, spacing)
    right = X[:, 0] > 0
    middle = 0.45 * spacing if reason == "gap" else 0.0
    gaussians = some_gaussians(40)
    mean = gaussians.mean.clone()
    mean[:, 0] = middle + torch.where(torch.arange(40) < 20, -0.3, 0.3) * spacing
    gaussians = Gaussians(**{**vars(gaussians), "mean": mean})
    parts = ((torch.arange(40) >= 20).int(), right.int()) if reason == "part" else None
    tied = embed(mean, torch.arange(40), X, spacing, parts=parts)
    x = torch.where(right[:, None], X @ STRETCH.T + SHIFT, X)
    F = torch.where(right[:, None, None], STRETCH, torch.eye(3, dtype=torch.float64))
    moved, covariance, _ = carry(gaussians, tied, X, x, F)
    torch.testing.assert_close(moved[:20], mean[:20], rtol=0, atol=1e-12)
    torch.testing.assert_close(moved[20:], mean[20:] @ STRETCH.T + SHIFT, rtol=0, atol=1e-12)
    torch.testing.assert_close(covariance[20:], STRETCH @ gaussians.covariance()[20:] @ STRETCH.T, rtol=0, atol=1e-12)


def test_a_part_without_particles_rides_on_what_there_is():
    X = lattice(0.25)
    parts = torch.tensor([7, 0]), torch.zeros(len(X), dtype=torch.int64)
    tied = embed(X[:2] + 0.01, torch.arange(2), X, 0.25, parts=parts)
    assert tied.weights.sum(1).tolist() == pytest.approx([1, 1])
    assert tied.neighbours[0, 0] == 0


def test_gradients_in_position_and_deformation_are_finite_differences():
    gaussians, X = some_gaussians(6), lattice(0.5)
    tied = embed(gaussians.mean, torch.arange(6), X, 0.5)
    g = torch.Generator().manual_seed(2)
    x = (X + 0.1 * torch.randn(X.shape, generator=g, dtype=torch.float64)).requires_grad_()
    noise = 0.3 * torch.randn(len(X), 3, 3, generator=g, dtype=torch.float64)
    F = (torch.eye(3, dtype=torch.float64) + noise).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, F: carry(gaussians, tied, X, x, F), (x, F))


def test_rotation_is_differentiable_at_the_identity_where_an_svd_is_not():
    F = torch.stack([torch.eye(3), 2 * torch.eye(3), torch.diag(torch.tensor([1.0, 1.0, 3.0])), a_rotation()]).double()
    assert torch.autograd.gradcheck(_Rotation.apply, F.requires_grad_())


def test_an_inverted_or_flattened_particle_gives_a_rotation_and_finite_gradients():
    I = torch.eye(3)
    F = torch.stack([torch.diag(torch.tensor([1.0, 1, -1])), torch.diag(torch.tensor([1.0, 0, 0])), 0 * I, -I]).double()
    R = _Rotation.apply(F.requires_grad_())
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(4, dtype=torch.float64))
    (R * torch.arange(9).reshape(3, 3)).sum().backward()
    assert torch.isfinite(F.grad).all()


def test_turning_body_and_camera_together_gives_the_same_picture():
    """Colours that depend on the viewing direction must turn with the body."""
    gaussians, X, which, R = some_gaussians(k=9), lattice(0.25), torch.arange(60), a_rotation(1.1)
    M = look_at(torch.tensor([2.0, 1.0, 0.7]), torch.zeros(3))
    still = Camera(width=48, height=40, fx=60, fy=60, cx=24, cy=20, world_to_camera=M)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = R.T
    turned = Camera(**{**vars(still), "world_to_camera": M @ turn})
    black = torch.zeros(3)
    before = render(gaussians, still, background=black).color
    tied = embed(gaussians.mean, which, X, 0.25)
    after = render_deformed(gaussians, tied, X, X @ R.T, R.expand(len(X), 3, 3), turned, background=black).color
    assert before.max() > 0.5
    # float32 kernels see differently rounded positions; pixels on the edge of 1/255 excepted
    assert (after - before).abs().flatten().quantile(0.99) < 2e-5
    unturned = render_deformed(
        gaussians, tied, X, X, torch.eye(3).double().expand(len(X), 3, 3), still, background=black
    )
    assert torch.equal(unturned.color, before)


def test_weights_sum_to_one_and_the_artifact_survives_storage(tmp_path):
    gaussians, X = some_gaussians(), lattice(0.1)
    tied = embed(gaussians.mean, torch.arange(60), X, 0.1)
    assert tied.neighbours.shape == (60, 8)
    tied.save(tmp_path / "embedding")
    again = Embedding.load(tmp_path / "embedding")
    assert torch.equal(again.weights, tied.weights) and torch.equal(again.neighbours, tied.neighbours)


def test_gaussians_far_from_every_particle_still_follow():
    """Weights must not underflow: a floater a thousand spacings away follows its nearest particles."""
    tied = embed(torch.full((1, 3), 100.0), torch.zeros(1, dtype=torch.long), lattice(0.1), 0.1)
    assert torch.isfinite(tied.weights).all() and tied.weights.sum() == pytest.approx(1)


def test_bad_arguments_are_refused_with_a_remedy(unchecked):
    X, which = lattice(0.5), torch.arange(2)
    with pytest.raises(ValueError, match="no particles"):
        embed(X[:2], which, X[:0], 0.5)
    with pytest.raises(ValueError, match="spacing is 0"):
        embed(X[:2], which, X, 0)
    with pytest.raises(ValueError, match="3 positions for 2"):
        embed(X[:3], which, X, 0.5)
    with pytest.raises(ValueError, match="position_of_gaussians holds 3 non-finite"):
        embed(torch.full((1, 3), float("nan")), which[:1], X, 0.5)


def test_a_backdrop_changes_no_pixel_and_no_gradient():
    """What is reused between frames is what would have been drawn again."""
    gaussians, X = some_gaussians().to("cpu", torch.float32), lattice(0.2).float()
    which = torch.arange(5, 9)
    tied = embed(gaussians.mean[which], which, X, 0.2)
    camera = Camera(
        width=100, height=70, fx=90, fy=90, cx=50, cy=35,
        world_to_camera=look_at(torch.tensor([0.0, -3.0, 0.5]), torch.zeros(3)),
    )  # fmt: skip
    background = (0.2, 0.4, 0.6)
    behind = Backdrop.of(gaussians, tied, camera, background=background)
    F = STRETCH.float().expand(len(X), 3, 3)
    weight = torch.rand(70, 100, 3, generator=torch.Generator().manual_seed(1))

    def frame(**more):
        x = (X @ STRETCH.T.float() * 0.5 + torch.tensor([0.1, 0.0, 0.1])).requires_grad_()
        drawn = render_deformed(gaussians, tied, X, x, F, camera, background=background, **more)
        return drawn, torch.autograd.grad((weight * drawn.color).sum(), x)[0]

    (plain, gradient), (reused, same) = frame(), frame(backdrop=behind)
    assert not torch.equal(behind.still.color, plain.color)
    for name in ("color", "alpha", "depth"):
        # colours of static Gaussians come from a viewing direction that is normalised once less: rounding
        torch.testing.assert_close(getattr(reused, name), getattr(plain, name), rtol=1e-6, atol=1e-6)
    # the adjoint sums over the tiles in shares of other sizes: rounding of single precision
    torch.testing.assert_close(same, gradient, rtol=1e-4, atol=1e-5 * float(gradient.abs().max()))


def test_without_anything_static_there_is_no_backdrop():
    gaussians, X = some_gaussians(), lattice(0.2)
    which = torch.arange(len(gaussians))
    camera = Camera(width=8, height=8, fx=8, fy=8, cx=4, cy=4, world_to_camera=torch.eye(4, dtype=torch.float64))
    assert Backdrop.of(gaussians, embed(gaussians.mean, which, X, 0.2), camera, background=(0, 0, 0)) is None
