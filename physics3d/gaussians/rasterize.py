"""Differentiable splatting of 3D Gaussians by EWA in tiles (Zwicker et al. 2001; Kerbl et al. 2023), CPU and CUDA.

    project   u = fx X/Z + cx, v = fy Y/Z + cy,   Sigma' = J R Sigma R^T J^T + 0.3 px^2 I          [px], [px^2]
    weigh     alpha_i = min(o_i exp(-1/2 d^T Sigma'^-1 d), 0.999),   0 where below 1/255
    blend     w_i = T_i alpha_i,  T_{i+1} = T_i (1 - alpha_i), front to back, until T < 1e-4
    give      color = sum w c + T_end background,   alpha = 1 - T_end,   depth = sum w z / sum w    [m]

A thread owns a square of pixels and walks the depth-ordered list of its tile: Gaussians outside, pixels inside. On a
CPU the square is the whole tile (a Warp kernel runs there on one thread, so each core gets a share of the tiles); on
CUDA it is one pixel. Blending's adjoint is written by hand: it walks the same list front to back once more and needs
only the remaining sum of what lies behind. The adjoint of the projection is Warp's. `twin.py` says the same in plain
torch, and the tests compare.
"""

# ruff: noqa: UP018, RUF046 (in a Warp kernel a literal is a constant, float(0.0) is a variable)

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physics3d.artifact import require_finite
from physics3d.gaussians.cameras import Camera
from physics3d.gaussians.model import Gaussians

TILE = 16  # side of a tile [px]
NEAR = 0.01  # nothing closer to the camera is drawn [m]
LOW_PASS = 0.3  # variance added to every splat, about one pixel wide [px^2]
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.999
STOP = 1e-4  # transmittance below which nothing behind is drawn
MARGIN = 0.15  # of the image's size, outside of which the Jacobian is held constant, as 3DGS does
SUMS = 10  # adjoints per Gaussian: u, v, conic A, B, C, opacity, r, g, b, z


@dataclass(frozen=True, kw_only=True)
class Rendered:
    color: Float[Tensor, "h w 3"]  # composited on the background
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]  # expected depth along the optical axis [m]; 0 where alpha is 0


def rasterize(
    mean: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    opacity: Float[Tensor, " n"],
    color: Float[Tensor, "n 3"],
    camera: Camera,
    *,
    background: Float[Tensor, " 3"] | tuple[float, float, float],
) -> Rendered:
    """Draw Gaussians with means [m], covariances [m^2], opacities and colours in 0..1. Computes in float32.

    Differentiable in the first four arguments and the background. Raises ValueError for wrong shapes or non-finite
    numbers.
    """
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
        require_finite(f"rasterize: {name}", value)
    blended, clear = _Splat.apply(mean.float(), covariance.float(), opacity.float(), color.float(), camera)
    alpha = 1 - clear
    seen = alpha > 0
    depth = torch.where(seen, blended[..., 3] / torch.where(seen, alpha, 1), 0)
    return Rendered(
        color=blended[..., :3] + clear[..., None] * torch.as_tensor(background).to(blended), alpha=alpha, depth=depth
    )


def contribution(gaussians: Gaussians, camera: Camera, masks: Float[Tensor, "m h w"]) -> Float[Tensor, "n m"]:
    """Sum over pixels of (blending weight of a Gaussian x mask): how much each Gaussian adds to each mask [px]."""
    if masks.shape[1:] != (camera.height, camera.width):
        raise ValueError(
            f"contribution: masks are {tuple(masks.shape[1:])} pixels, the camera {camera.height, camera.width}"
        )
    with torch.no_grad():
        g = gaussians.to(gaussians.mean.device, torch.float32)
        state = _project(g.mean, g.covariance(), g.opacity, torch.zeros_like(g.mean), camera)
        blended, clear = _blend(state)
        weight = []
        for some in masks.to(g.mean).split(
            3
        ):  # the adjoint of colour is the sum of weights times the adjoint of the image
            image_bar = torch.zeros_like(blended)
            image_bar[..., : len(some)] = some.permute(1, 2, 0)
            sums = _blend_adjoint(state, blended, clear, image_bar, torch.zeros_like(clear))
            weight.append(sums[:, 6 : 6 + len(some)])
    return torch.cat(weight, -1)


# -------------------------------------------------------------------------------------------------------- kernels


@wp.struct
class View:
    R: wp.mat33  # world to camera
    t: wp.vec3  # [m]
    fx: float  # [px]
    fy: float
    cx: float
    cy: float
    width: int  # [px]
    height: int


@wp.kernel
def project(
    # in
    mean: wp.array[wp.vec3],  # [m]
    covariance: wp.array[wp.mat33],  # [m^2]
    opacity: wp.array[float],
    view: View,
    # out
    center: wp.array[wp.vec3],  # u, v [px], depth [m]
    conic: wp.array[wp.vec3],  # A, B, C of the inverse of Sigma' [1/px^2]
    tiles: wp.array[wp.vec4i],  # first tile and one past the last, in x and y; empty where invisible
    count: wp.array[int],  # number of tiles touched
):
    i = wp.tid()
    X = view.R @ mean[i] + view.t
    if X[2] > NEAR and opacity[i] >= ALPHA_MIN:
        x = X[0] / X[2]
        y = X[1] / X[2]
        W = float(view.width)
        H = float(view.height)
        xj = wp.clamp(x, (-MARGIN * W - view.cx) / view.fx, ((1.0 + MARGIN) * W - view.cx) / view.fx)
        yj = wp.clamp(y, (-MARGIN * H - view.cy) / view.fy, ((1.0 + MARGIN) * H - view.cy) / view.fy)
        row_u = (view.fx / X[2]) * wp.vec3(1.0, 0.0, -xj) @ view.R
        row_v = (view.fy / X[2]) * wp.vec3(0.0, 1.0, -yj) @ view.R
        su = covariance[i] @ row_u
        sv = covariance[i] @ row_v
        a = wp.dot(row_u, su)
        c = wp.dot(row_v, sv)
        b = 0.5 * (wp.dot(row_u, sv) + wp.dot(row_v, su))
        # det(Sigma' + s I) = det Sigma' + s tr Sigma' + s^2, which rounding cannot make negative
        det = wp.max(a * c - b * b, 0.0) + LOW_PASS * (a + c) + LOW_PASS * LOW_PASS
        u = view.fx * x + view.cx
        v = view.fy * y + view.cy
        center[i] = wp.vec3(u, v, X[2])
        conic[i] = wp.vec3((c + LOW_PASS) / det, -b / det, (a + LOW_PASS) / det)
        # the ellipse alpha = 1/255 has half extents sqrt(2 ln(255 o) Sigma'_xx), and likewise in y
        reach = 2.0 * wp.log(opacity[i] / ALPHA_MIN)
        ru = wp.sqrt(reach * (a + LOW_PASS))
        rv = wp.sqrt(reach * (c + LOW_PASS))
        nx = float((view.width + TILE - 1) // TILE)
        ny = float((view.height + TILE - 1) // TILE)
        side = float(TILE)
        x0 = int(wp.clamp(wp.floor((u - ru) / side), 0.0, nx))
        x1 = int(wp.clamp(wp.floor((u + ru) / side) + 1.0, 0.0, nx))
        y0 = int(wp.clamp(wp.floor((v - rv) / side), 0.0, ny))
        y1 = int(wp.clamp(wp.floor((v + rv) / side) + 1.0, 0.0, ny))
        tiles[i] = wp.vec4i(x0, x1, y0, y1)
        count[i] = (x1 - x0) * (y1 - y0)


@wp.kernel(enable_backward=False)
def list_tiles(
    # in
    order: wp.array[wp.int64],  # Gaussians from near to far
    tiles: wp.array[wp.vec4i],
    last: wp.array[wp.int64],  # running sum of the tile counts in that order
    tiles_x: int,
    # out
    tile: wp.array[int],  # of every pair (tile, Gaussian)
    gaussian: wp.array[int],
):
    i = wp.tid()
    k = int(0)
    if i > 0:
        k = int(last[i - 1])
    g = int(order[i])
    r = tiles[g]
    for y in range(r[2], r[3]):
        for x in range(r[0], r[1]):
            tile[k] = y * tiles_x + x
            gaussian[k] = g
            k += 1


@wp.func
def square(i: int, side: int, tiles_x: int) -> wp.vec3i:
    """Left and top pixel of the i-th square of pixels, and the tile it lies in."""
    per_side = TILE // side
    tile = i // (per_side * per_side)
    s = i % (per_side * per_side)
    x = (tile % tiles_x) * TILE + (s % per_side) * side
    y = (tile // tiles_x) * TILE + (s // per_side) * side
    return wp.vec3i(x, y, tile)


@wp.func
def rows(v: float, q: wp.vec3, twice_limit: float, y0: int, y1: int) -> wp.vec2i:
    """Rows of pixels, of y0..y1, that the ellipse q(d) <= limit touches."""
    det = q[0] * q[2] - q[1] * q[1]
    half = wp.sqrt(twice_limit * q[0] / wp.max(det, 1e-12 * q[0] * q[2]))
    first = wp.clamp(wp.ceil(v - half - 0.5), float(y0), float(y1))
    last = wp.clamp(wp.floor(v + half - 0.5) + 1.0, float(y0), float(y1))
    return wp.vec2i(int(first), int(last))


@wp.func
def columns(u: float, dy: float, q: wp.vec3, twice_limit: float, x0: int, x1: int) -> wp.vec2i:
    """Columns of pixels, of x0..x1, where A dx^2 + 2 B dx dy + C dy^2 <= 2 limit."""
    det = q[0] * q[2] - q[1] * q[1]
    half = wp.sqrt(wp.max(q[0] * twice_limit - det * dy * dy, 0.0)) / q[0] + 0.01
    mid = u - q[1] * dy / q[0] - 0.5
    first = wp.clamp(wp.ceil(mid - half), float(x0), float(x1))
    last = wp.clamp(wp.floor(mid + half) + 1.0, float(x0), float(x1))
    return wp.vec2i(int(first), int(last))


@wp.kernel(enable_backward=False)
def blend(
    # in
    begin: int,  # first square of this launch
    side: int,  # of a square [px]
    start: wp.array[int],  # first pair of every tile, and one past the last
    gaussian: wp.array[int],
    center: wp.array[wp.vec3],
    conic: wp.array[wp.vec3],
    opacity: wp.array[float],
    color: wp.array[wp.vec3],
    view: View,
    # out
    blended: wp.array2d[wp.vec4],  # sum w (r, g, b, z)
    clear: wp.array2d[float],  # transmittance
):
    s = square(begin + wp.tid(), side, (view.width + TILE - 1) // TILE)
    x0 = s[0]
    y0 = s[1]
    tile = s[2]
    x1 = wp.min(x0 + side, view.width)
    y1 = wp.min(y0 + side, view.height)
    if x0 >= x1 or y0 >= y1:
        return
    for y in range(y0, y1):
        for x in range(x0, x1):
            clear[y, x] = 1.0
            blended[y, x] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    open = (x1 - x0) * (y1 - y0)  # pixels that still let light through
    k = start[tile]
    end = start[tile + 1]
    while k < end and open > 0:
        g = gaussian[k]
        k += 1
        m = center[g]
        q = conic[g]
        o = opacity[g]
        limit = wp.log(o / ALPHA_MIN)
        c = wp.vec4(color[g][0], color[g][1], color[g][2], m[2])
        span = rows(m[1], q, 2.0 * limit, y0, y1)
        for y in range(span[0], span[1]):
            dy = float(y) + 0.5 - m[1]
            across = columns(m[0], dy, q, 2.0 * limit, x0, x1)
            for x in range(across[0], across[1]):
                T = clear[y, x]
                if T >= STOP:
                    dx = float(x) + 0.5 - m[0]
                    e = 0.5 * (q[0] * dx * dx + q[2] * dy * dy) + q[1] * dx * dy
                    if e <= limit:
                        alpha = wp.min(o * wp.exp(-e), ALPHA_MAX)
                        blended[y, x] = blended[y, x] + (T * alpha) * c
                        T = T * (1.0 - alpha)
                        clear[y, x] = T
                        if T < STOP:
                            open -= 1


@wp.kernel(enable_backward=False)
def blend_adjoint(
    # in
    begin: int,
    side: int,
    part: int,  # which private block of sums this launch adds to
    start: wp.array[int],
    gaussian: wp.array[int],
    center: wp.array[wp.vec3],
    conic: wp.array[wp.vec3],
    opacity: wp.array[float],
    color: wp.array[wp.vec3],
    view: View,
    image_bar: wp.array2d[wp.vec4],  # adjoint of `blended`
    # in and out
    behind: wp.array2d[float],  # sum over what lies behind of image_bar . w c, plus the adjoint of `clear` times clear
    clear: wp.array2d[float],  # transmittance so far; 1 at the start
    # out
    sums: wp.array3d[float],  # [part, n, SUMS]
):
    s = square(begin + wp.tid(), side, (view.width + TILE - 1) // TILE)
    x0 = s[0]
    y0 = s[1]
    tile = s[2]
    x1 = wp.min(x0 + side, view.width)
    y1 = wp.min(y0 + side, view.height)
    if x0 >= x1 or y0 >= y1:
        return
    open = (x1 - x0) * (y1 - y0)
    k = start[tile]
    end = start[tile + 1]
    while k < end and open > 0:
        g = gaussian[k]
        k += 1
        m = center[g]
        q = conic[g]
        o = opacity[g]
        limit = wp.log(o / ALPHA_MIN)
        c = wp.vec4(color[g][0], color[g][1], color[g][2], m[2])
        c_bar = wp.vec4(0.0, 0.0, 0.0, 0.0)
        # moments of the adjoint of the exponent e over the pixels
        s0 = float(0.0)
        sx = float(0.0)
        sy = float(0.0)
        sxx = float(0.0)
        sxy = float(0.0)
        syy = float(0.0)
        hit = int(0)
        span = rows(m[1], q, 2.0 * limit, y0, y1)
        for y in range(span[0], span[1]):
            dy = float(y) + 0.5 - m[1]
            across = columns(m[0], dy, q, 2.0 * limit, x0, x1)
            for x in range(across[0], across[1]):
                T = clear[y, x]
                if T >= STOP:
                    dx = float(x) + 0.5 - m[0]
                    e = 0.5 * (q[0] * dx * dx + q[2] * dy * dy) + q[1] * dx * dy
                    if e <= limit:
                        hit = 1
                        full = o * wp.exp(-e)
                        alpha = wp.min(full, ALPHA_MAX)
                        bar = image_bar[y, x]
                        w = T * alpha
                        c_bar += w * bar
                        value = wp.dot(bar, c)
                        rest = behind[y, x] - w * value
                        behind[y, x] = rest
                        if full < ALPHA_MAX:
                            e_bar = -alpha * (T * value - rest / (1.0 - alpha))
                            s0 += e_bar
                            sx += e_bar * dx
                            sy += e_bar * dy
                            sxx += e_bar * dx * dx
                            sxy += e_bar * dx * dy
                            syy += e_bar * dy * dy
                        T = T * (1.0 - alpha)
                        clear[y, x] = T
                        if T < STOP:
                            open -= 1
        if hit == 1:
            wp.atomic_add(sums, part, g, 0, -(q[0] * sx + q[1] * sy))
            wp.atomic_add(sums, part, g, 1, -(q[1] * sx + q[2] * sy))
            wp.atomic_add(sums, part, g, 2, 0.5 * sxx)
            wp.atomic_add(sums, part, g, 3, sxy)
            wp.atomic_add(sums, part, g, 4, 0.5 * syy)
            wp.atomic_add(sums, part, g, 5, -s0 / o)
            for j in range(4):
                wp.atomic_add(sums, part, g, 6 + j, c_bar[j])


# -------------------------------------------------------------------------------------------------- torch <-> Warp


@dataclass(frozen=True)
class _State:
    """What forward leaves for backward."""

    mean: Tensor
    covariance: Tensor
    opacity: Tensor
    color: Tensor
    center: Tensor  # [n, 3]
    conic: Tensor  # [n, 3]
    tiles: Tensor  # int32 [n, 4]
    count: Tensor  # int32 [n]
    start: Tensor  # int32 [number of tiles + 1]
    gaussian: Tensor  # int32 [pairs]
    view: View

    @property
    def device(self):
        return wp.device_from_torch(self.mean.device)

    def splats(self) -> list[wp.array]:
        arrays = [_warp(self.start), _warp(self.gaussian), _warp(self.center, wp.vec3), _warp(self.conic, wp.vec3)]
        return [*arrays, _warp(self.opacity), _warp(self.color, wp.vec3)]


def _warp(tensor: Tensor, dtype=None) -> wp.array:
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def _project(mean: Tensor, covariance: Tensor, opacity: Tensor, color: Tensor, camera: Camera) -> _State:
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    n, device = len(mean), mean.device
    mean, covariance, opacity, color = (a.detach().contiguous() for a in (mean, covariance, opacity, color))
    view = View()
    M = camera.world_to_camera.tolist()
    view.R = wp.mat33(*[M[i][j] for i in range(3) for j in range(3)])
    view.t = wp.vec3(M[0][3], M[1][3], M[2][3])
    view.fx, view.fy, view.cx, view.cy = camera.fx, camera.fy, camera.cx, camera.cy
    view.width, view.height = camera.width, camera.height
    center, conic = torch.zeros(n, 3, device=device), torch.zeros(n, 3, device=device)
    tiles, count = torch.zeros(n, 4, device=device, dtype=torch.int32), torch.zeros(n, device=device, dtype=torch.int32)
    inputs = [_warp(mean, wp.vec3), _warp(covariance, wp.mat33), _warp(opacity), view]
    outputs = [_warp(center, wp.vec3), _warp(conic, wp.vec3), _warp(tiles, wp.vec4i), _warp(count)]
    wp.launch(project, n, inputs, outputs, device=wp.device_from_torch(device))

    # depth first, then a stable sort by tile: every tile's list runs from near to far, equal depths by index
    order = torch.argsort(center[:, 2], stable=True)
    last = torch.cumsum(count[order], 0)
    pairs = int(last[-1]) if n else 0
    tile, gaussian = (torch.empty(pairs, device=device, dtype=torch.int32) for _ in range(2))
    across, down = -(-camera.width // TILE), -(-camera.height // TILE)
    inputs = [_warp(order), _warp(tiles, wp.vec4i), _warp(last), across]
    wp.launch(list_tiles, n, inputs, [_warp(tile), _warp(gaussian)], device=wp.device_from_torch(device))
    tile, by_tile = torch.sort(tile, stable=True)
    edges = torch.arange(across * down + 1, device=device, dtype=torch.int32)
    start = torch.searchsorted(tile, edges, out_int32=True)
    return _State(mean, covariance, opacity, color, center, conic, tiles, count, start, gaussian[by_tile], view)


def _shares(state: _State) -> tuple[int, list[tuple[int, int]]]:
    """Side of a thread's square [px], and ranges of squares with about equal work, one per launch."""
    tiles = len(state.start) - 1
    if state.mean.is_cuda:
        return 1, [(0, tiles * TILE * TILE)]
    cores = min(len(os.sched_getaffinity(0)), tiles)
    work = state.start.long() + 8 * torch.arange(tiles + 1)
    cuts = torch.searchsorted(work, torch.arange(1, cores) * int(work[-1]) // cores).tolist()
    edges = [0, *cuts, tiles]
    return TILE, list(pairwise(edges))


def _launch(kernel, shares: list[tuple[int, int]], inputs, outputs, device) -> None:
    """Launch all shares; several at once from Python threads, because a launch on a CPU releases the GIL."""

    def one(part: int, begin: int, end: int) -> None:
        wp.launch(kernel, end - begin, inputs(part, begin), outputs, device=device)

    if len(shares) == 1:
        one(0, *shares[0])
        return
    with ThreadPoolExecutor(len(shares)) as pool:
        list(pool.map(one, range(len(shares)), *zip(*shares)))


def _blend(state: _State) -> tuple[Tensor, Tensor]:
    size = (state.view.height, state.view.width)
    blended, clear = torch.empty(*size, 4, device=state.mean.device), torch.empty(size, device=state.mean.device)
    side, shares = _shares(state)
    splats, outputs = state.splats(), [_warp(blended, wp.vec4), _warp(clear)]
    _launch(blend, shares, lambda part, begin: [begin, side, *splats, state.view], outputs, state.device)
    return blended, clear


def _blend_adjoint(state: _State, blended: Tensor, clear: Tensor, image_bar: Tensor, clear_bar: Tensor) -> Tensor:
    """Adjoints [n, SUMS] of what `blend` read of each Gaussian."""
    side, shares = _shares(state)
    sums = torch.zeros(len(shares), len(state.mean), SUMS, device=state.mean.device)
    image_bar = image_bar.contiguous()
    behind = (image_bar * blended).sum(-1) + clear_bar * clear
    splats, bar = state.splats(), _warp(image_bar, wp.vec4)
    outputs = [_warp(behind), _warp(torch.ones_like(clear)), _warp(sums)]
    _launch(
        blend_adjoint, shares, lambda part, begin: [begin, side, part, *splats, state.view, bar], outputs, state.device
    )
    return sums.sum(0) if len(shares) > 1 else sums[0]


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx, mean, covariance, opacity, color, camera):
        ctx.state = _project(mean, covariance, opacity, color, camera)
        blended, clear = _blend(ctx.state)
        ctx.save_for_backward(blended, clear)
        return blended, clear

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, image_bar, clear_bar):
        state = ctx.state
        sums = _blend_adjoint(state, *ctx.saved_tensors, image_bar, clear_bar)
        center_bar = torch.cat([sums[:, 0:2], sums[:, 9:10]], -1).contiguous()
        conic_bar = sums[:, 2:5].contiguous()
        mean_bar, covariance_bar = torch.zeros_like(state.mean), torch.zeros_like(state.covariance)
        opacity_bar = torch.zeros_like(state.opacity)
        wp.launch(
            project,
            len(state.mean),
            inputs=[_warp(state.mean, wp.vec3), _warp(state.covariance, wp.mat33), _warp(state.opacity), state.view],
            outputs=[
                _warp(state.center, wp.vec3),
                _warp(state.conic, wp.vec3),
                _warp(state.tiles, wp.vec4i),
                _warp(state.count),
            ],
            adj_inputs=[_warp(mean_bar, wp.vec3), _warp(covariance_bar, wp.mat33), _warp(opacity_bar), View()],
            adj_outputs=[_warp(center_bar, wp.vec3), _warp(conic_bar, wp.vec3), None, None],
            adjoint=True,
            device=state.device,
        )
        return mean_bar, covariance_bar, sums[:, 5], sums[:, 6:9], None
