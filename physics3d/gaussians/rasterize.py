"""Differentiable splatting of 3D Gaussians by EWA in tiles (Zwicker et al. 2001; Kerbl et al. 2023), CPU and CUDA.

    project   u = fx X/Z + cx, v = fy Y/Z + cy,   Sigma' = J R Sigma R^T J^T,   S = Sigma' + 0.3 px^2 I   [px], [px^2]
    weigh     alpha_i = min(o_i exp(-1/2 d^T S^-1 d), 0.999),   0 where below 1/255
              antialiased (Yu et al. 2024): o_i sqrt(det Sigma' / det S) instead of o_i
    blend     w_i = T_i alpha_i,  T_{i+1} = T_i (1 - alpha_i), front to back, until T < 1e-4
    give      color = sum w c + T_end background,   alpha = 1 - T_end,   depth = sum w z / sum w    [m]
              median depth: z of the Gaussian at which T falls below 1/2

`splatting.py` has the kernels. A Warp kernel runs on one CPU thread, so each core gets a share of the tiles with about
the same number of pairs (tile, Gaussian). The adjoint of blending walks the same list front to back once more and needs
only the remaining sum of what lies behind. The pose needs no kernel: a picture depends on R m + t and R Sigma R^T only,

    dL/dt = R^-T sum m_bar,    dL/dR = R^-T sum (m_bar m^T + 2 Sigma_bar Sigma).

`twin.py` says the same in plain torch, and the tests compare; `with_gsplat.py` hands the same arguments to gsplat.
"""

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from physics3d.artifact import require_finite
from physics3d.cores import usable
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians
from physics3d.gaussians.splat import ENTRIES, Numerics
from physics3d.gaussians.splat import NEAR as NEAR
from physics3d.gaussians.splatting import Kernels, kernels
from physics3d.warp_start import start_warp

STANDARD = Numerics()
Tiles = tuple[int, int, int, int]  # first row of tiles, one past the last; first column, one past the last
FEW = 4096  # Gaussians below which a second thread costs more than it saves in the projection


@dataclass(frozen=True, kw_only=True)
class Rendered:
    color: Float[Tensor, "h w 3"]  # composited on the background
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]  # expected depth along the optical axis [m]; 0 where alpha is 0
    median: Float[Tensor, "h w"] | None = None  # median depth [m] if asked for; 0 where alpha is below 1/2
    at: Int[Tensor, "h w"] | None = None  # with it: index of the Gaussian whose depth that is, -1 where there is none


def rasterize(
    mean: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    opacity: Float[Tensor, " n"],
    color: Float[Tensor, "n 3"],
    camera: Camera,
    *,
    background: Float[Tensor, " 3"] | tuple[float, float, float],
    antialiased: bool = False,
    median: bool = False,
    numerics: Numerics = STANDARD,
    tiles: Tiles | None = None,
) -> Rendered:
    """Draw Gaussians with means [m], covariances [m^2], opacities and colours in 0..1. Computes in float32.

    With `tiles`, see `tiles_of`, only those are drawn, as they would be in the whole picture; the rest is background.
    Differentiable in the first four arguments, the background and the camera's pose. Raises ValueError for wrong shapes
    or non-finite numbers.
    """
    check(mean, covariance, opacity, color)
    real = getattr(torch, numerics.precision)
    mean, covariance, opacity, color = (a.to(real) for a in (mean, covariance, opacity, color))
    behind = torch.as_tensor(background).to(mean)
    pose = camera.world_to_camera
    options = (camera, antialiased, median, numerics, tiles)
    picture, alpha, depth, middle = _Splat.apply(mean, covariance, opacity, color, behind, pose, *options)
    rest = dict(median=_depth_of(middle, mean, pose), at=middle) if median else {}
    return Rendered(color=picture, alpha=alpha, depth=depth, **rest)


def tiles_of(
    mean: Float[Tensor, "n 3"], covariance: Float[Tensor, "n 3 3"], opacity: Float[Tensor, " n"], camera: Camera
) -> Tiles:
    """The smallest rectangle of tiles outside of which these Gaussians draw nothing; (0, 0, 0, 0): nothing at all."""
    arguments = (a.detach().float() for a in (mean, covariance, opacity, torch.zeros_like(mean)))
    state = _project(*arguments, camera, False, STANDARD, None)
    across = -(-camera.width // STANDARD.tile)
    found = torch.nonzero(state.start.diff() > 0)[:, 0]
    if len(found) == 0:
        return (0, 0, 0, 0)
    rows, columns = found // across, found % across
    return int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1


def window(tiles: Tiles) -> tuple[slice, slice]:
    """Rows and columns of pixels of a rectangle of tiles."""
    first_row, end_row, first_column, end_column = (STANDARD.tile * i for i in tiles)
    return slice(first_row, end_row), slice(first_column, end_column)


def contribution(
    gaussians: Gaussians, camera: Camera, masks: Float[Tensor, "m h w"], *, antialiased: bool = False
) -> Float[Tensor, "n m"]:
    """Sum over pixels of (blending weight of a Gaussian x mask): how much each Gaussian adds to each mask [px]."""
    if masks.shape[1:] != (camera.height, camera.width):
        raise ValueError(
            f"contribution: masks are {tuple(masks.shape[1:])} pixels, the camera {camera.height, camera.width}"
        )
    with torch.no_grad():
        g = gaussians.to(gaussians.mean.device, torch.float32)
        state = _project(
            g.mean, g.covariance(), g.opacity, torch.zeros_like(g.mean), camera, antialiased, STANDARD, None
        )
        flat = torch.zeros(camera.height, camera.width, device=g.mean.device)
        outputs = [torch.zeros(*flat.shape, 3, device=flat.device), flat, flat, flat]
        weight = []
        # the adjoint of colour is the sum of weights times the adjoint of the image
        for some in masks.to(g.mean).split(3):
            image_bar = torch.zeros_like(outputs[0])
            image_bar[..., : len(some)] = some.permute(1, 2, 0)
            sums = _blend_adjoint(state, outputs, [image_bar, None, None]).sum(0)
            weight.append(sums[:, 7 : 7 + len(some)])
    return torch.cat(weight, -1)


def check(mean: Tensor, covariance: Tensor, opacity: Tensor, color: Tensor) -> None:
    """Raise ValueError naming the argument of `rasterize` that has a wrong shape or holds non-finite numbers."""
    n = len(mean)
    shapes = {
        "mean": (mean, (n, 3)),
        "covariance": (covariance, (n, 3, 3)),
        "opacity": (opacity, (n,)),
        "color": (color, (n, 3)),
    }
    for name, (value, shape) in shapes.items():
        if tuple(value.shape) != shape:
            raise ValueError(f"rasterize: {name} has shape {tuple(value.shape)}, expected {shape}")
        if not math.isfinite(value.detach().sum()):  # one quick pass; large finite numbers may overflow in it
            require_finite(f"rasterize: {name}", value)


# -------------------------------------------------------------------------------------------------- torch <-> Warp


@dataclass(frozen=True)
class _State:
    """What forward leaves for backward."""

    mean: Tensor
    covariance: Tensor
    opacity: Tensor
    splat: Tensor  # [n, ENTRIES]
    count: Tensor  # int32 [n]
    start: Tensor  # int32 [number of tiles + 1]
    gaussian: Tensor  # int32 [pairs]
    view: Any
    kernels: Kernels
    tile: int

    def lists(self) -> list[wp.array]:
        return [_warp(self.start), _warp(self.gaussian), _warp(self.splat, self.kernels.entry)]


def _warp(tensor: Tensor, dtype=None) -> wp.array:
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def _rows(tensor: Tensor, *shape: int) -> wp.array:
    """A tensor [n, *shape] as an array of Warp vectors or matrices."""
    real = wp.dtype_from_torch(tensor.dtype)
    return _warp(tensor, wp.types.vector(shape[0], real) if len(shape) == 1 else wp.types.matrix(shape, real))


def _project(
    mean, covariance, opacity, color, camera: Camera, antialiased: bool, numerics: Numerics, drawn: Tiles | None
) -> _State:
    start_warp()
    n, device = len(mean), mean.device
    mean, covariance, opacity, color = (a.detach().contiguous() for a in (mean, covariance, opacity, color))
    side = 1 if device.type == "cuda" else numerics.tile
    made = kernels(numerics.precision, numerics.tile, side)
    view = _view(made, camera, antialiased, numerics, drawn)
    splat = torch.empty(n, ENTRIES, device=device, dtype=mean.dtype)
    depth = torch.empty(2 * n, device=device)  # the second halves are room to sort
    order, count = (torch.empty(m, device=device, dtype=torch.int32) for m in (2 * n, n))
    inputs = [_rows(mean, 3), _rows(covariance, 3, 3), _warp(opacity), _rows(color, 3), view]
    outputs = [_rows(splat, ENTRIES), _warp(depth), _warp(order), _warp(count)]
    shares = _equal_shares(n, device)
    _launch(made.project, shares, lambda part, begin: [begin, *inputs], outputs, device)

    # depth first, then a stable sort by tile: every tile's list runs from near to far, equal depths by index
    wp.utils.radix_sort_pairs(outputs[1], outputs[2], n)
    last = torch.cumsum(count[order[:n]], 0, dtype=torch.int32)
    pairs = int(last[-1]) if n else 0
    tile, gaussian = (torch.empty(2 * pairs, device=device, dtype=torch.int32) for _ in range(2))
    inputs = [outputs[2], _warp(last), outputs[3], outputs[0], view]
    outputs = [_warp(tile), _warp(gaussian)]
    _launch(made.list_tiles, shares, lambda part, begin: [begin, *inputs], outputs, device)
    tiles = -(-camera.width // numerics.tile) * -(-camera.height // numerics.tile)
    wp.utils.radix_sort_pairs(*outputs, pairs, end_bit=max(1, tiles.bit_length()))
    edges = torch.arange(tiles + 1, device=device, dtype=torch.int32)
    start = torch.searchsorted(tile[:pairs], edges, out_int32=True)
    return _State(mean, covariance, opacity, splat, count, start, gaussian, view, made, numerics.tile)


def _view(made: Kernels, camera: Camera, antialiased: bool, numerics: Numerics, drawn: Tiles | None):
    view = made.View()
    M = camera.world_to_camera.detach().cpu().tolist()
    view.R = [M[i][:3] for i in range(3)]
    view.t = [M[i][3] for i in range(3)]
    view.fx, view.fy, view.cx, view.cy = camera.fx, camera.fy, camera.cx, camera.cy
    view.width, view.height, view.antialiased = camera.width, camera.height, int(antialiased)
    view.cutoff, view.stop = numerics.cutoff, numerics.stop
    whole = (0, -(-camera.height // numerics.tile), 0, -(-camera.width // numerics.tile))
    view.first_row, view.end_row, view.first_column, view.end_column = drawn or whole
    return view


def _equal_shares(n: int, device: torch.device) -> list[tuple[int, int]]:
    if device.type == "cuda" or n < FEW:
        return [(0, n)]
    cores = usable()
    return list(pairwise(n * i // cores for i in range(cores + 1)))


def _tile_shares(state: _State) -> list[tuple[int, int]]:
    """Ranges of squares with about equal work, one per launch."""
    tiles = len(state.start) - 1
    if state.mean.is_cuda:
        return [(0, tiles * state.tile**2)]
    cores = min(usable(), tiles)
    work = state.start + 8 * torch.arange(tiles + 1)
    cuts = torch.searchsorted(work, torch.arange(1, cores) * int(work[-1]) // cores).tolist()
    return list(pairwise([0, *cuts, tiles]))


def _launch(kernel, shares: list[tuple[int, int]], inputs: Callable, outputs: list, device: torch.device) -> None:
    """Launch all shares; several at once from Python threads, because a launch on a CPU releases the GIL."""
    where = _loaded(kernel, str(device))

    def one(part: int, begin: int, end: int) -> None:
        wp.launch(kernel, end - begin, inputs(part, begin), outputs, device=where)

    if len(shares) == 1:
        one(0, *shares[0])
    else:
        list(_pool(os.getpid()).map(one, range(len(shares)), *zip(*shares, strict=True)))


@cache
def _loaded(kernel: wp.Kernel, device: str):
    """The device; compiles before threads could do so twice."""
    where = wp.device_from_torch(torch.device(device))
    kernel.module.load(where)
    return where


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Threads of this process (a forked one has none of its parent's)."""
    return ThreadPoolExecutor(usable(), thread_name_prefix="splat")


def _blend(state: _State, background: Tensor) -> list[Tensor]:
    """Colour, alpha, depth, transmittance."""
    size, like = (state.view.height, state.view.width), {"device": state.mean.device, "dtype": state.mean.dtype}
    pictures = [torch.empty(*size, 3, **like), *(torch.empty(size, **like) for _ in range(3))]
    inputs, outputs = [*state.lists(), _warp(background.contiguous()), state.view], [_warp(p) for p in pictures]
    _launch(state.kernels.blend, _tile_shares(state), lambda part, begin: [begin, *inputs], outputs, state.mean.device)
    return pictures


def _blend_adjoint(state: _State, pictures: list[Tensor], bars: list[Tensor | None]) -> Tensor:
    """Adjoint [parts, n, ENTRIES], to be summed over parts, of what `blend` read of each Gaussian."""
    shares = _tile_shares(state)
    sums = torch.zeros(len(shares), len(state.mean), ENTRIES, device=state.mean.device, dtype=state.mean.dtype)
    given = [
        _warp(picture[:0] if bar is None else bar.contiguous()) for picture, bar in zip(pictures, bars, strict=False)
    ]
    inputs = [*state.lists(), state.view, *(_warp(p) for p in pictures), *given]
    outputs = [_rows(sums, ENTRIES)]
    kernel = state.kernels.blend_adjoint
    _launch(kernel, shares, lambda part, begin: [begin, part, *inputs], outputs, state.mean.device)
    return sums


def _middle(state: _State) -> Tensor:
    middle = torch.empty(state.view.height, state.view.width, device=state.mean.device, dtype=torch.int32)
    inputs = [*state.lists(), state.view]
    _launch(
        state.kernels.middle, _tile_shares(state), lambda part, begin: [begin, *inputs], [_warp(middle)], middle.device
    )
    return middle


def _depth_of(index: Tensor, mean: Tensor, pose: Tensor) -> Tensor:
    """Depth [h, w] of the Gaussian that each pixel names, 0 where it names none."""
    axis = pose[2].to(mean)
    z = torch.cat([mean @ axis[:3] + axis[3], torch.zeros(1).to(mean)])  # index -1 is the last
    return z[index.long()]


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx, mean, covariance, opacity, color, background, pose, camera, antialiased, median, numerics, tiles):
        ctx.state = state = _project(mean, covariance, opacity, color, camera, antialiased, numerics, tiles)
        pictures = _blend(state, background)
        ctx.save_for_backward(*pictures)
        ctx.set_materialize_grads(False)
        middle = _middle(state) if median else torch.empty(0, dtype=torch.int32)
        ctx.mark_non_differentiable(middle)
        return *pictures[:3], middle

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, color_bar, alpha_bar, depth_bar, _):
        state, pictures = ctx.state, ctx.saved_tensors
        sums = _blend_adjoint(state, pictures, [color_bar, alpha_bar, depth_bar])
        like = (state.mean, state.covariance, state.opacity, state.mean)
        bars = mean_bar, covariance_bar, opacity_bar, splat_color_bar = [torch.empty_like(a) for a in like]
        inputs = [
            _rows(state.mean, 3), _rows(state.covariance, 3, 3), _warp(state.opacity), _warp(state.count), state.view,
            _rows(sums, ENTRIES),
        ]  # fmt: skip
        outputs = [_rows(mean_bar, 3), _rows(covariance_bar, 3, 3), _warp(opacity_bar), _rows(splat_color_bar, 3)]
        shares = _equal_shares(len(state.mean), state.mean.device)
        _launch(state.kernels.project_adjoint, shares, lambda part, begin: [begin, *inputs], outputs, state.mean.device)
        background_bar = pose_bar = None
        if ctx.needs_input_grad[4] and color_bar is not None:
            background_bar = torch.einsum("hwc,hw->c", color_bar, pictures[3])
        if ctx.needs_input_grad[5]:
            pose_bar = _pose_adjoint(state, mean_bar.double(), covariance_bar.double())
        return *bars, background_bar, pose_bar, None, None, None, None, None


def _pose_adjoint(state: _State, mean_bar: Tensor, covariance_bar: Tensor) -> Tensor:
    R = torch.tensor([list(row) for row in state.view.R], dtype=torch.float64, device=mean_bar.device)
    symmetric = (state.covariance + state.covariance.mT).double()
    turned = mean_bar.T @ state.mean.double() + torch.einsum("nij,njk->ik", covariance_bar, symmetric)
    pose_bar = torch.zeros(4, 4).to(R)
    pose_bar[:3] = torch.linalg.solve(R.T, torch.cat([turned, mean_bar.sum(0)[:, None]], 1))
    return pose_bar
