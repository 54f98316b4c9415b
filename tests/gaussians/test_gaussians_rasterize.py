"""The rasteriser agrees with its plain twin and finite differences, obeys what pictures obey, and survives hard input.

Tolerances: the kernels compute in float32, the twin in float64. Pixel coordinates of order 50 are exact to 4e-6 px, so
colours agree to about 1e-6; sums of thousands of terms of either sign in the gradients to about 1e-5 of the largest.
Where the kernels compute in float64 too, nothing but rounding is left.
"""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from physics3d.gaussians.cameras import Camera, look_at
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.rasterize import contribution, rasterize
from physics3d.gaussians.render import render
from physics3d.gaussians.splat import Numerics
from physics3d.gaussians.twin import rasterize_plainly
from physics3d.gaussians.with_gsplat import rasterize_with_gsplat

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=[pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
    ),
]
NAMES = ("mean", "covariance", "opacity", "color", "background", "pose")
BACKGROUND = torch.tensor([0.1, 0.5, 0.9])
EXACT = Numerics(precision="float64", tile=8)  # another tile than the usual one, which must not show


def camera(width=50, height=37, at=(2.0, 1.0, 0.7)) -> Camera:
    """Not square, the principal point off the middle, neither side a multiple of the tile.

    With 1.3 px off, a point on the axis of a picture 2 px wide lies just where the Jacobian stops changing, and has two
    one-sided derivatives.
    """
    M = look_at(torch.tensor(at), torch.zeros(3))
    return Camera(width=width, height=height, fx=60, fy=55, cx=width / 2 + 1.27, cy=height / 2 - 0.7, world_to_camera=M)


def cloud(n=150, size=0.1, spread=0.4, seed=0, opacity=None):
    g = torch.Generator().manual_seed(seed)
    A = torch.randn(n, 3, 3, generator=g, dtype=torch.float64) * size
    covariance = A @ A.mT + 1e-5 * torch.eye(3)
    mean = torch.randn(n, 3, generator=g, dtype=torch.float64) * spread
    o = torch.rand(n, generator=g, dtype=torch.float64)
    color = torch.rand(n, 3, generator=g, dtype=torch.float64)
    return mean, covariance, o if opacity is None else torch.full_like(o, opacity), color


def pancakes():
    """One axis a thousandth of the others; a third of them seen edge on."""
    mean, covariance, opacity, color = cloud()
    Q = torch.linalg.eigh(covariance).eigenvectors
    Q[:50] = torch.linalg.eigh(torch.diag(torch.tensor([0.0, 1.0, 2.0])).double()).eigenvectors
    sigma = torch.tensor([1e-4, 0.1, 0.1], dtype=torch.float64).expand(len(mean), 3)
    return mean, Q @ torch.diag_embed(sigma**2) @ Q.mT, opacity, color


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
    mean, covariance, opacity, color = cloud(3000, size=0.02, spread=0.003)
    return mean, covariance, opacity * 0.02 + 0.004, color


CASES = {
    "ordinary": cloud,
    "small": lambda: cloud(400, size=0.01),
    "needles": needles,
    "pancakes": pancakes,
    "huge": lambda: cloud(30, size=3.0, spread=0.3),
    "opaque": lambda: cloud(opacity=1.0),
    "invisible": some_are_invisible,
    "one pixel": one_pixel,
}


def gradients(draw, arrays, where, device, dtype):
    """Outputs, and the gradients of a random weighting of all of them, the median depth where it is drawn included."""
    inputs = [a.to(device, dtype, copy=True).requires_grad_() for a in (*arrays, BACKGROUND)]
    pose = where.world_to_camera.clone().requires_grad_()
    out = draw(*inputs[:4], replace(where, world_to_camera=pose), background=inputs[4])
    g = torch.Generator().manual_seed(1)
    loss = 0
    for picture in (out.color, out.alpha, out.depth, out.median):
        if picture is not None:
            loss = loss + (picture * torch.randn(picture.shape, generator=g).to(picture)).sum()
    loss.backward()
    return out, [torch.zeros_like(a) if a.grad is None else a.grad.cpu().double() for a in (*inputs, pose)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("antialiased", [False, True], ids=["", "antialiased"])
@pytest.mark.parametrize("case", CASES)
def test_kernels_agree_with_the_twin_forward_and_backward(case, antialiased, device):
    # the twin sees the same rounded inputs; a Gaussian on the edge of 1/255 may fall on either side in a few pixels,
    # which is worth 1/255 there, hence the quantile; depth, relative, is compared where something is seen. Antialiased,
    # the ratio of determinants loses digits where a pancake or needle is seen edge on: a thousandth of its opacity
    arrays = [a.float().double() for a in CASES[case]()]
    draw, plainly = (partial(f, antialiased=antialiased) for f in (rasterize, rasterize_plainly))
    fast, fast_bar = gradients(draw, arrays, camera(), device, torch.float32)
    plain, plain_bar = gradients(plainly, arrays, camera(), "cpu", torch.float64)
    seen = plain.alpha > 0.01
    assert seen.any()
    digits = 1e-3 if antialiased and case in ("needles", "pancakes") else 1e-5
    for name in ("color", "alpha", "depth"):
        a, b = getattr(fast, name).cpu().double(), getattr(plain, name)
        error = ((a - b).abs() / b)[seen] if name == "depth" else (a - b).abs()
        assert error.flatten().quantile(0.995) < digits and error.max() < 0.03, (name, error.max())
    for name, a, b in zip(NAMES, fast_bar, plain_bar):
        assert torch.isfinite(a).all()
        error = (a - b).abs().flatten(1) if a.ndim > 1 else (a - b).abs()[:, None]
        scale = b.abs().max()
        assert scale > 0
        if name in ("background", "pose"):  # a few sums over everything
            assert error.max() < max(1e-2, 20 * digits) * scale, (name, error.max() / scale)
        else:
            assert error.max(1).values.quantile(0.97) < 20 * digits * scale and error.max() < 0.05 * scale, (
                name,
                error.max() / scale,
            )


@st.composite
def hard_scenes(draw):
    """Up to nine Gaussians of any shape, size and opacity, anywhere, in a picture of any size."""
    n = draw(st.integers(0, 9))
    g = torch.Generator().manual_seed(draw(st.integers(0, 10**6)))
    normal = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64)
    mean = normal(n, 3) * draw(st.sampled_from([0.0, 0.3, 3.0]))
    spread = draw(st.sampled_from([0.0, 0.5, 1.5]))  # of the logarithms: round to needles and pancakes
    sigma = 10 ** (draw(st.floats(-4, 1)) + spread * normal(n, 3).clamp(-2, 2))
    Q = torch.linalg.qr(normal(n, 3, 3)).Q
    covariance = Q @ torch.diag_embed(sigma**2) @ Q.mT
    opacity = torch.rand(n, generator=g, dtype=torch.float64) * draw(st.sampled_from([0.0, 0.01, 1.0]))
    if draw(st.booleans()):
        opacity = opacity.ceil()
    where = camera(
        draw(st.integers(1, 40)),
        draw(st.integers(1, 40)),
        at=draw(st.sampled_from([(2.0, 1.0, 0.7), (0.02, 0.01, 0.0)])),
    )
    return (
        (mean, (covariance + covariance.mT) / 2, opacity, torch.rand(n, 3, generator=g).double()),
        where,
        draw(st.booleans()),
    )


@settings(max_examples=60, deadline=None, derandomize=True)
@given(hard_scenes())
def test_in_float64_kernels_and_twin_differ_by_rounding_alone(scene):
    """Median depth, pose and all. What the covariance of a needle of aspect 1e5 loses to rounding is 1e-6 of it."""
    arrays, where, antialiased = scene
    options = dict(antialiased=antialiased, median=True, numerics=EXACT)
    fast, fast_bar = gradients(partial(rasterize, **options), arrays, where, "cpu", torch.float64)
    plain, plain_bar = gradients(partial(rasterize_plainly, **options), arrays, where, "cpu", torch.float64)
    for name, a in vars(fast).items():
        torch.testing.assert_close(a, getattr(plain, name), rtol=1e-5, atol=1e-6, msg=lambda m, n=name: f"{n}: {m}")
    for name, a, b in zip(NAMES, fast_bar, plain_bar):
        scale = max(1e-6, float(b.abs().max())) if b.numel() else 1.0
        torch.testing.assert_close(a / scale, b / scale, rtol=0, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.parametrize("antialiased", [False, True], ids=["", "antialiased"])
@pytest.mark.parametrize("draw", [rasterize, rasterize_plainly], ids=["kernels", "twin"])
def test_gradients_are_finite_differences(draw, antialiased):
    """Along random directions, central differences of each implementation itself, in float64.

    Few Gaussians that overlap little, all well above 1/255 at the pixels that are weighed, so that nothing crosses a
    threshold; a step of 1e-4 leaves an error of second order near 1e-8 and eleven digits of the difference.
    """
    mean, covariance, opacity, color = cloud(6, size=0.25, spread=0.1)
    covariance, opacity = covariance + 0.03 * torch.eye(3), 0.3 + 0.4 * opacity
    values = [mean, covariance, opacity, color, BACKGROUND.double(), camera().world_to_camera]
    weight = torch.zeros(37, 50, 3, dtype=torch.float64)
    weight[14:23, 20:30] = torch.randn(9, 10, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def loss(*values):
        where = replace(camera(), world_to_camera=values[5])
        out = draw(*values[:4], where, background=values[4], antialiased=antialiased, median=True, numerics=EXACT)
        depths = (out.depth + out.median) * weight[..., 0] + out.alpha * weight[..., 1]
        return (out.color * weight).sum() + depths.sum()

    inputs = [a.clone().requires_grad_() for a in values]
    loss(*inputs).backward()
    for i, name in enumerate(NAMES):
        g = torch.Generator().manual_seed(i)
        direction = torch.randn(values[i].shape, generator=g, dtype=torch.float64)
        if name == "covariance":  # it stays symmetric
            direction = direction + direction.mT
        h = float(1e-4 * values[i].abs().mean() / direction.abs().mean())
        moved = [[*values[:i], values[i] + s * h * direction, *values[i + 1 :]] for s in (1, -1)]
        difference = float(loss(*moved[0]) - loss(*moved[1])) / (2 * h)
        assert difference == pytest.approx(float((inputs[i].grad * direction).sum()), rel=1e-5), name


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
def test_the_median_depth_is_that_of_the_gaussian_at_which_half_the_light_is_gone(device):
    toward = torch.tensor([[2.0, 1.0, 0.7]], dtype=torch.float64)
    mean = torch.cat([toward * 0.3, toward * 0, toward * -0.3])
    covariance = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1) * 0.04
    for opacity, which in (([0.9, 0.9, 0.9], 0), ([0.4, 0.4, 0.9], 1), ([0.2, 0.2, 0.9], 2), ([0.1, 0.1, 0.1], None)):
        arrays = [a.to(device) for a in (mean, covariance, torch.tensor(opacity), torch.ones(3, 3))]
        out = rasterize(*arrays, camera(), background=BACKGROUND, median=True)
        z = 0.0 if which is None else (0.7, 1.0, 1.3)[which] * float(toward.norm())
        assert out.median[18, 26].cpu() == pytest.approx(z, rel=1e-5)  # float32
        assert out.median[0, 0] == 0  # nothing there
    assert rasterize(*arrays, camera(), background=BACKGROUND).median is None


@pytest.mark.parametrize("device", DEVICES)
def test_antialiased_the_light_of_a_small_gaussian_falls_with_its_area(device):
    """Sum of alpha = o 2 pi sqrt(det Sigma') [px^2], from twenty pixels wide to a fifth of one. Without it, the low
    pass makes the small ones too bright. The cutoff costs a percent."""
    arrays = [torch.zeros(1, 3), 0.01 * torch.eye(3)[None], torch.full((1,), 0.5), torch.ones(1, 3)]
    at = camera(301, 301)
    distance = float(at.centre.norm())
    for focal in (500.0, 20.0, 5.0):
        where = replace(at, fx=focal, fy=focal, cx=150.5, cy=150.5)
        exact = 0.5 * 2 * math.pi * (0.1 * focal / distance) ** 2
        sums = [
            float(
                rasterize(*[a.to(device) for a in arrays], where, background=BACKGROUND, antialiased=choice).alpha.sum()
            )
            for choice in (True, False)
        ]
        if focal > 5:  # below, opacity times the ratio of areas approaches the cutoff
            assert sums[0] == pytest.approx(exact, rel=0.03)
        assert sums[1] > (1.2 if focal <= 20 else 0.97) * exact


@pytest.mark.cuda
@pytest.mark.parametrize("antialiased", [False, True], ids=["", "antialiased"])
@pytest.mark.parametrize("case", ["ordinary", "small", "huge", "opaque", "invisible"])
def test_gsplat_draws_the_same_picture(case, antialiased):
    """To float32, to 1e-4 of a colour where blending stops, to 1/255 in the few pixels at the edge of the cutoff."""
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    if not torch.cuda.is_available():
        pytest.skip("gsplat needs a CUDA device")
    arrays = [a.float() for a in CASES[case]()]
    draws = [partial(f, antialiased=antialiased) for f in (rasterize, rasterize_with_gsplat)]
    (ours, ours_bar), (theirs, theirs_bar) = (gradients(f, arrays, camera(), "cuda", torch.float32) for f in draws)
    seen = ours.alpha > 0.01
    for name in ("color", "alpha", "depth"):
        a, b = getattr(ours, name), getattr(theirs, name)
        error = ((a - b).abs() / a)[seen] if name == "depth" else (a - b).abs()
        assert error.flatten().quantile(0.99) < 1e-3 and error.max() < 0.03, (name, error.max())
    for name, a, b in zip(NAMES, ours_bar, theirs_bar):
        error, scale = (a - b).abs().flatten(), a.abs().max()
        assert error.quantile(0.97) < 1e-2 * scale, (name, error.max() / scale)


def test_gsplat_is_refused_by_name_where_it_cannot_draw():
    arrays = cloud(5)
    with pytest.raises(ValueError, match="CUDA"):
        rasterize_with_gsplat(*arrays, camera(), background=BACKGROUND)
    with pytest.raises(ValueError, match="median"):
        rasterize_with_gsplat(*arrays, camera(), background=BACKGROUND, median=True)


@pytest.mark.parametrize("device", DEVICES)
def test_nothing_to_see_gives_the_background(device):
    mean, covariance, opacity, color = (a.to(device) for a in cloud())
    for arrays in (
        (mean, covariance, opacity * 0, color),
        (mean + 100, covariance, opacity, color),
        [a[:0] for a in (mean, covariance, opacity, color)],
    ):
        out = rasterize(*arrays, camera(), background=BACKGROUND, median=True)
        assert torch.equal(out.color.cpu(), BACKGROUND.expand(37, 50, 3))
        assert not out.alpha.any() and not out.depth.any() and not out.median.any()


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_input_is_refused_by_name(index, bad):
    arrays = list(cloud(5))
    arrays[index] = arrays[index].clone()
    arrays[index].view(-1)[0] = bad
    with pytest.raises(ValueError, match=f"{NAMES[index]} holds 1 non-finite"):
        rasterize(*arrays, camera(), background=BACKGROUND)


def test_a_wrong_shape_is_refused_by_name(unchecked):
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


@pytest.mark.parametrize("antialiased", [False, True], ids=["", "antialiased"])
@pytest.mark.parametrize("device", DEVICES)
def test_contributions_sum_to_alpha(device, antialiased):
    gaussians, view = model().to(device), camera()
    g = torch.Generator().manual_seed(6)
    masks = torch.rand(5, 37, 50, generator=g).to(device)
    weight = contribution(gaussians, view, masks, antialiased=antialiased)
    alpha = render(gaussians, view, background=BACKGROUND, antialiased=antialiased).alpha
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


def test_the_pose_moves_the_picture_and_its_harmonics():
    """Central differences of a whole render, colours of degree 3 included, along a random change of the pose."""
    gaussians, weight = model(20, degree=3).to("cpu", torch.float64), torch.zeros(37, 50, 3, dtype=torch.float64)
    gaussians = replace(gaussians, log_scale=gaussians.log_scale + 1, opacity_logit=gaussians.opacity_logit * 0 - 2)
    weight[14:23, 20:30] = torch.randn(9, 10, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    exact = partial(rasterize, numerics=Numerics(precision="float64", tile=8))

    def loss(pose):
        where = replace(camera(), world_to_camera=pose)
        return (render(gaussians, where, background=BACKGROUND, draw=exact).color * weight).sum()

    pose = camera().world_to_camera.requires_grad_()
    loss(pose).backward()
    direction = torch.zeros(4, 4, dtype=torch.float64)
    direction[:3] = torch.randn(3, 4, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    with torch.no_grad():
        # a twenty-thousandth, so that hardly a Gaussian crosses the cutoff in the window
        h = 5e-6
        difference = float(loss(pose + h * direction) - loss(pose - h * direction)) / (2 * h)
    assert difference == pytest.approx(float((pose.grad * direction).sum()), rel=1e-4)
