"""Gaussians on particles, quickly: the same as `carry.py`, which is the plain twin."""

import numpy as np
import pytest
import torch
from looked_at import run
from scipy.linalg import polar

from physics3d.gaussians.carry import carry
from physics3d.view.picture import Moment, Pictures
from physics3d.view.riders import UPPER, Riders, rotation

UP = tuple(zip(*UPPER))


@pytest.fixture(scope="module")
def looked():
    return run(degree=2)


def moved(X: torch.Tensor, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A large bend and a turn that varies over the body."""
    generator = torch.Generator().manual_seed(seed)
    A = torch.eye(3) + 0.2 * torch.randn(3, 3, generator=generator)
    B = 0.3 * torch.randn(3, 3, 3, generator=generator)
    x = X @ A.T + torch.einsum("ijk,pj,pk->pi", B, X, X)
    return x, A + torch.einsum("ijk,pk->pij", B + B.transpose(1, 2), X)


@pytest.mark.parametrize("seed", range(4))
def test_they_go_where_the_plain_rule_puts_them(looked, seed):
    gaussians, body = looked.gaussians, looked.body
    X = looked.trajectory.rest_position
    x, F = moved(X, seed)
    mean, upper, R = Riders(gaussians, body.embedding, X).carry(x, F)
    plain = carry(gaussians.to("cpu", torch.float64), body.embedding, X.double(), x.double(), F.double())
    which = body.embedding.which
    # float32, of positions below 1 m and covariances of the same Gaussian
    np.testing.assert_allclose(mean, plain[0][which], atol=1e-6)
    size = plain[1][which].abs().amax((1, 2)).numpy()[:, None]
    np.testing.assert_allclose(upper / size, plain[1][which].numpy()[:, UP[0], UP[1]] / size, atol=1e-5)
    sound = torch.linalg.det(torch.einsum("gk,gkij->gij", body.embedding.weights.float(), F[body.embedding.neighbours]))
    turned = (sound > 0.05).numpy()  # elsewhere a Gaussian is next to inside out
    assert turned.sum() > 100
    np.testing.assert_allclose(R.transpose(2, 0, 1)[turned], plain[2][which].numpy()[turned], atol=2e-3)


def test_the_rotation_is_that_of_the_polar_decomposition(rng):
    F = np.eye(3) + 0.5 * rng.normal(size=(200, 3, 3))
    F = F[np.linalg.det(F) > 0.05]
    found = rotation(F.transpose(1, 2, 0))
    # Newton's iteration ends at 1e-3 and squares its error once more
    np.testing.assert_allclose(found.transpose(2, 0, 1), [polar(f)[0] for f in F], atol=1e-3)


def test_a_body_that_is_turned_looks_from_the_turned_eye_as_before(looked, rng):
    """Colours belong to directions of the body: turned together with the eye, nothing changes but the places."""
    pictures, X = Pictures(looked), looked.trajectory.rest_position
    a = 0.8
    Q = torch.tensor([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]], dtype=torch.float32)
    nothing = np.zeros(len(X))
    at = lambda R: Moment(position=X @ R.T, deformation=R.expand(len(X), 3, 3), speed=nothing, stress=None)
    eye = np.array([0.3, -1.0, 0.4])
    before = pictures.gaussians(at(torch.eye(3)), "picture", eye)
    after = pictures.gaussians(at(Q), "picture", Q.numpy() @ eye)
    same = pictures.gaussians(at(Q), "picture", eye)
    # a byte of rounding
    assert np.abs(before.rgbs.astype(int) - after.rgbs).max() <= 1
    assert np.abs(before.rgbs.astype(int) - same.rgbs).max() > 20  # it does depend on the direction
    np.testing.assert_allclose(after.centers, before.centers @ Q.numpy().T, atol=1e-5)  # float32 of up to 10 units


def test_covariances_survive_the_half_precision_of_the_page(looked):
    """What is sent are float16: the smallest axis of a small scene's Gaussians would be lost in metres."""
    pictures = Pictures(looked)
    sent = pictures.gaussians(pictures.moment(0), "picture", np.array([0.0, -1.0, 0.3])).covariances
    diagonal = sent[:, (0, 1, 2), (0, 1, 2)]
    half = diagonal.astype(np.float16)
    # float16 has 11 bits where its numbers are normal
    np.testing.assert_allclose(half.astype(float), diagonal, rtol=2**-11)
    assert (half > 6.2e-5).all()
