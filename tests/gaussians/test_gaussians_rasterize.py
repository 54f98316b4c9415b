"""The rasteriser agrees with its plain twin and finite differences, obeys what pictures obey, and survives hard input.

Tolerances: the kernels compute in float32, the twin in float64. Pixel coordinates of order 50 are exact to 4e-6 px, so
colours agree to about 1e-6; sums of thousands of terms of either sign in the gradients to about 1e-5 of the largest.
"""

import pytest
import torch

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import contribution, rasterize
from physics3d.gaussians.render import render
from physics3d.gaussians.twin import rasterize_plainly

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=[pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
    ),
]
NAMES = ("mean", "covariance", "opacity", "color")
BACKGROUND = torch.tensor([0.1, 0.5, 0.9])


def camera(width=50, height=37, at=(2.0, 1.0, 0.7)) -> Camera:
    """Not square, the principal point off the middle, neither side a multiple of the tile."""
    M = look_at(torch.tensor(at), torch.zeros(3))
    return Camera(width=width, height=height, fx=60, fy=55, cx=width / 2 + 1.3, cy=height / 2 - 0.7, world_to_camera=M)


def cloud(n=150, size=0.1, spread=0.4, seed=0, opacity=None):
    g = torch.Generator().manual_seed(seed)
    A = torch.randn(n, 3, 3, generator=g, dtype=torch.float64) * size
    covariance = A @ A.mT + 1e-5 * torch.eye(3)
    mean = torch.randn(n, 3, generator=g, dtype=torch.float64) * spread
    o = torch.rand(n, generator=g, dtype=torch.float64)
    color = torch.rand(n, 3, generator=g, dtype=torch.float64)
    return mean, covariance, o if opacity is None else torch.full_like(o, opacity), color


def needles():
    """Ratios of axes up to 1e4, in every direction."""
    mean, covariance, opacity, color = cloud()
    Q = torch.linalg.eigh(covariance).eigenvectors
    g = torch.Generator().manual_seed(3)
    sigma = 10 ** (torch.rand(len(mean), 3, generator=g, dtype=torch.float64) * 4 - 4.5)
    return mean, Q @ torch.diag_embed(sigma**2) @ Q.mT, opacity, color


def some_are_invisible():
    """Behind the camera, in its plane, beside the picture, transparent."""
    mean, covariance, opacity, color = cloud()
    mean = mean * 6
    opacity[:20] = 0
    return mean, covariance, opacity, color


def one_pixel():
    """Three thousand, nearly transparent, on the same pixel."""
    mean, covariance, opacity, color = cloud(3000, size=0.003, spread=0.003)
    return mean, covariance, opacity * 0.02 + 0.004, color


CASES = {
    "ordinary": cloud,
    "small": lambda: cloud(400, size=0.01),
    "needles": needles,
    "huge": lambda: cloud(30, size=3.0, spread=0.3),
    "opaque": lambda: cloud(opacity=1.0),
    "invisible": some_are_invisible,
    "one pixel": one_pixel,
}


def gradients(draw, arrays, where, device, dtype):
    """Outputs, and the gradient of a random weighting of all of them."""
    inputs = [a.to(device, dtype).requires_grad_() for a in arrays]
    out = draw(*inputs, where, background=BACKGROUND)
    g = torch.Generator().manual_seed(1)
    loss = 0
    for picture in (out.color, out.alpha, out.depth):
        loss = loss + (picture * torch.randn(picture.shape, generator=g).to(picture)).sum()
    loss.backward()
    return out, [a.grad.cpu().double() for a in inputs]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("case", CASES)
def test_kernels_agree_with_the_twin_forward_and_backward(case, device):
    # the twin sees the same rounded inputs; a Gaussian on the edge of 1/255 may fall on either side in a few pixels,
    # which is worth 1/255 there, hence the quantile; depth, relative, is compared where something is seen
    arrays = [a.float().double() for a in CASES[case]()]
    fast, fast_bar = gradients(rasterize, arrays, camera(), device, torch.float32)
    plain, plain_bar = gradients(rasterize_plainly, arrays, camera(), "cpu", torch.float64)
    seen = plain.alpha > 0.01
    for name in ("color", "alpha", "depth"):
        a, b = getattr(fast, name).cpu().double(), getattr(plain, name)
        error = ((a - b).abs() / b)[seen] if name == "depth" else (a - b).abs()
        assert error.flatten().quantile(0.995) < 1e-5 and error.max() < 0.03, (name, error.max())
    for name, a, b in zip(NAMES, fast_bar, plain_bar):
        assert torch.isfinite(a).all()
        error = (a - b).abs().flatten(1) if a.ndim > 1 else (a - b).abs()[:, None]
        scale = b.abs().max()
        assert scale > 0
        assert error.max(1).values.quantile(0.97) < 2e-4 * scale and error.max() < 0.05 * scale, (
            name,
            error.max() / scale,
        )


@pytest.mark.parametrize("device", DEVICES)
def test_gradients_are_finite_differences(device):
    """Along random directions, central differences of the kernels themselves, not of the twin.

    Few Gaussians that overlap little, all well above 1/255 at the pixels that are weighed, so that nothing crosses a
    threshold; a step of 1 % leaves float32 four digits of the difference and an error of second order near 1e-4.
    """
    mean, covariance, opacity, color = cloud(6, size=0.25, spread=0.1)
    arrays = [mean, covariance + 0.03 * torch.eye(3), 0.3 + 0.4 * opacity, color]
    weight = torch.zeros(37, 50, 3, dtype=torch.float64)
    weight[14:23, 20:30] = torch.randn(9, 10, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def loss(*values):
        out = rasterize(*[v.to(device) for v in values], camera(), background=BACKGROUND)
        return (out.color.cpu().double() * weight).sum() + (out.depth.cpu().double() * weight[..., 0]).sum()

    inputs = [a.clone().requires_grad_() for a in arrays]
    loss(*inputs).backward()
    for i, name in enumerate(NAMES):
        g = torch.Generator().manual_seed(i)
        direction = torch.randn(arrays[i].shape, generator=g, dtype=torch.float64)
        if name == "covariance":  # it stays symmetric
            direction = direction + direction.mT
        h = 1e-2 * arrays[i].abs().mean() / direction.abs().mean()
        moved = [[*arrays[:i], arrays[i] + s * h * direction, *arrays[i + 1 :]] for s in (1, -1)]
        difference = float(loss(*moved[0]) - loss(*moved[1])) / float(2 * h)
        assert difference == pytest.approx(float((inputs[i].grad * direction).sum()), rel=5e-3), name


@pytest.mark.parametrize("device", DEVICES)
def test_order_of_the_list_does_not_matter(device):
    arrays = [a.to(device) for a in cloud()]
    mixed = torch.randperm(len(arrays[0]), generator=torch.Generator().manual_seed(2))
    a = rasterize(*arrays, camera(), background=BACKGROUND)
    b = rasterize(*[v[mixed.to(device)] for v in arrays], camera(), background=BACKGROUND)
    assert torch.equal(a.color, b.color)  # depths are distinct: the same operations in the same order


@pytest.mark.parametrize("device", DEVICES)
def test_moving_everything_together_changes_nothing(device):
    mean, covariance, opacity, color = (a.to(device) for a in cloud())
    shift = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    moved = camera()
    M = moved.world_to_camera.clone()
    M[:3, 3] -= M[:3, :3] @ shift
    moved = Camera(**{**vars(moved), "world_to_camera": M})
    a = rasterize(mean, covariance, opacity, color, camera(), background=BACKGROUND)
    b = rasterize(mean + shift.to(mean), covariance, opacity, color, moved, background=BACKGROUND)
    # positions are rounded differently: 1e-7 m is 3e-6 px; the few pixels on the edge of 1/255 excepted
    assert (a.color - b.color).abs().flatten().quantile(0.995) < 2e-5


@pytest.mark.parametrize("device", DEVICES)
def test_shifting_by_whole_pixels_shifts_the_picture(device):
    arrays = [a.to(device) for a in cloud(spread=0.2)]
    there = camera()
    here = Camera(**{**vars(there), "cx": there.cx + 7, "cy": there.cy + 3})
    a = rasterize(*arrays, there, background=BACKGROUND).color
    b = rasterize(*arrays, here, background=BACKGROUND).color
    # cloud in the middle, because far outside the picture the Jacobian is held constant
    assert (a[:-3, :-7] - b[3:, 7:]).abs().flatten().quantile(0.99) < 2e-5


@pytest.mark.parametrize("device", DEVICES)
def test_an_opaque_gaussian_hides_what_is_behind(device):
    toward = torch.tensor([[2.0, 1.0, 0.7]], dtype=torch.float64)
    mean = torch.cat([toward * 0.3, toward * 0, toward * -0.3])
    covariance = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1) * torch.tensor([4.0, 0.01, 0.01])[:, None, None]
    color = torch.eye(3, dtype=torch.float64)
    arrays = [a.to(device) for a in (mean, covariance, torch.tensor([1.0, 0.9, 0.9]), color)]
    out = rasterize(*arrays, camera(), background=BACKGROUND)
    middle = out.color[18, 26].cpu()
    # one Gaussian stops at an opacity of 0.999, so a thousandth of what is behind shines through
    assert middle[0] > 0.99 and middle[1] < 2e-3 and middle[2] < 2e-3
    assert out.depth[18, 26].cpu() == pytest.approx(0.7 * float(toward.norm()), rel=1e-2)


@pytest.mark.parametrize("device", DEVICES)
def test_nothing_to_see_gives_the_background(device):
    mean, covariance, opacity, color = (a.to(device) for a in cloud())
    for arrays in (
        (mean, covariance, opacity * 0, color),
        (mean + 100, covariance, opacity, color),
        [a[:0] for a in (mean, covariance, opacity, color)],
    ):
        out = rasterize(*arrays, camera(), background=BACKGROUND)
        assert torch.equal(out.color.cpu(), BACKGROUND.expand(37, 50, 3))
        assert not out.alpha.any() and not out.depth.any()


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_input_is_refused_by_name(index, bad):
    arrays = list(cloud(5))
    arrays[index] = arrays[index].clone()
    arrays[index].view(-1)[0] = bad
    with pytest.raises(ValueError, match=f"{NAMES[index]} holds 1 non-finite"):
        rasterize(*arrays, camera(), background=BACKGROUND)


def test_a_wrong_shape_is_refused_by_name():
    mean, covariance, opacity, color = cloud(5)
    with pytest.raises(ValueError, match="opacity has shape"):
        rasterize(mean, covariance, opacity[:, None], color, camera(), background=BACKGROUND)


def model(n=200, degree=2) -> Gaussians:
    g = torch.Generator().manual_seed(4)
    normal = lambda *shape: torch.randn(*shape, generator=g)
    return Gaussians(
        mean=0.4 * normal(n, 3), log_scale=normal(n, 3) * 0.5 - 2.5, quaternion=normal(n, 4), opacity_logit=normal(n),
        sh=normal(n, (degree + 1) ** 2, 3) * 0.3,
    )  # fmt: skip


@pytest.mark.parametrize("device", DEVICES)
def test_contributions_sum_to_alpha(device):
    gaussians, view = model().to(device), camera()
    g = torch.Generator().manual_seed(6)
    masks = torch.rand(5, 37, 50, generator=g).to(device)
    weight = contribution(gaussians, view, masks)
    alpha = render(gaussians, view, background=BACKGROUND).alpha
    assert weight.shape == (len(gaussians), 5) and (weight >= 0).all()
    # sums over 1850 pixels in float32
    torch.testing.assert_close(weight.sum(0), (masks * alpha).sum((1, 2)), rtol=1e-5, atol=1e-3)


def test_contributions_of_a_wrong_size_are_refused():
    with pytest.raises(ValueError, match="masks are"):
        contribution(model(), camera(), torch.ones(1, 50, 37))


@pytest.mark.parametrize("device", DEVICES)
def test_rendering_is_differentiable_in_every_field(device):
    gaussians = model().to(device)
    fields = {k: v.clone().requires_grad_() for k, v in vars(gaussians).items()}
    render(Gaussians(**fields), camera(), background=BACKGROUND).color.square().sum().backward()
    for name, value in fields.items():
        assert torch.isfinite(value.grad).all() and value.grad.any(), name
