"""Kernels: Gaussians -> their ellipses in the picture (`splat.py`) and the tiles that these touch; and the adjoint."""

# To a type checker, Warp kernels are another language.
# mypy: ignore-errors
# ruff: noqa: UP018, RUF046 (in a kernel a literal is a constant, int(0) a variable; `and` evaluates both sides)

from functools import cache

import warp as wp

from physics3d.gaussians.splat import LOW_PASS, MARGIN, NEAR, entry_type, view_type


@cache
def projection(real, tile: int):
    vec3, mat33 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    entry, View = entry_type(real), view_type(real)
    TILE, STEP = tile, real(tile)
    PASS, CLOSE, SIDEWAYS = real(LOW_PASS), real(NEAR), real(MARGIN)

    @wp.func
    def held(x: real, f: real, c: real, size: int) -> real:
        """The ray's slope, held constant outside the picture."""
        n = real(size)
        return wp.clamp(x, (-SIDEWAYS * n - c) / f, ((real(1.0) + SIDEWAYS) * n - c) / f)

    @wp.func
    def tile_rows(s: entry, view: View) -> wp.vec2i:
        """First row of tiles that the ellipse alpha = cutoff touches, and one past the last."""
        reach = wp.sqrt(real(2.0) * wp.log(s[6] / view.cutoff) / s[5]) / STEP
        first, end = real(view.first_row), real(view.end_row)
        v = s[1] / STEP
        return wp.vec2i(
            int(wp.clamp(wp.floor(v - reach), first, end)),
            int(wp.clamp(wp.floor(v + reach) + real(1.0), first, end)),
        )

    @wp.func
    def tile_columns(s: entry, row: int, view: View) -> wp.vec2i:
        """The same for the tiles of one row: where the ellipse, inside that band of pixels, is widest."""
        limit = real(2.0) * wp.log(s[6] / view.cutoff)
        d0 = real(row * TILE) - s[1]
        d1 = d0 + STEP
        # the ellipse is widest to the right at dy = top, to the left at dy = -top
        slope = s[3] * s[4]  # A s;  Sigma'_uu = 1/A + s^2/p
        top = slope / s[5] * wp.sqrt(limit / (s[3] + slope * slope / s[5]))
        right = wp.clamp(top, d0, d1)
        left = wp.clamp(-top, d0, d1)
        far = s[0] + s[4] * right + wp.sqrt(wp.max(limit - s[5] * right * right, real(0.0)) / s[3])
        near = s[0] + s[4] * left - wp.sqrt(wp.max(limit - s[5] * left * left, real(0.0)) / s[3])
        first, end = real(view.first_column), real(view.end_column)
        # a little wider, so that rounding loses no pixel
        return wp.vec2i(
            int(wp.clamp(wp.floor((near - real(0.01)) / STEP), first, end)),
            int(wp.clamp(wp.floor((far + real(0.01)) / STEP) + real(1.0), first, end)),
        )

    @wp.kernel(module="unique", enable_backward=False)
    def project(
        # in
        begin: int,  # first Gaussian of this launch
        mean: wp.array(dtype=vec3),  # [n] [m]
        covariance: wp.array(dtype=mat33),  # [n] [m^2]
        opacity: wp.array(dtype=real),  # [n] 0..1
        color: wp.array(dtype=vec3),  # [n] 0..1
        view: View,  # camera and what of its picture is drawn
        # out
        splat: wp.array(dtype=entry),  # [n] opacity 0 where invisible
        depth: wp.array(dtype=wp.float32),  # [n] [m], to sort by
        index: wp.array(dtype=int),  # [n] 0, 1, 2, ...
        count: wp.array(dtype=int),  # [n] number of tiles touched
    ):
        i = begin + wp.tid()
        X = view.R @ mean[i] + view.t
        depth[i] = wp.float32(X[2])
        index[i] = i
        touched = int(0)
        out = entry()
        if X[2] > CLOSE and opacity[i] >= view.cutoff:
            x = X[0] / X[2]
            y = X[1] / X[2]
            ju = (view.fx / X[2]) * vec3(real(1.0), real(0.0), -held(x, view.fx, view.cx, view.width))
            jv = (view.fy / X[2]) * vec3(real(0.0), real(1.0), -held(y, view.fy, view.cy, view.height))
            ru = ju @ view.R
            rv = jv @ view.R
            S = real(0.5) * (covariance[i] + wp.transpose(covariance[i]))
            sv = S @ rv
            a = wp.dot(ru, S @ ru)
            b = wp.dot(ru, sv)
            c = wp.dot(rv, sv)
            # det(Sigma' + s I) = det Sigma' + s tr Sigma' + s^2, which rounding cannot make negative
            bare = wp.max(a * c - b * b, real(0.0))
            det = bare + PASS * (a + c) + PASS * PASS
            o = opacity[i]
            if view.antialiased == 1:
                o = o * wp.sqrt(bare / det)
            if o >= view.cutoff:
                q = color[i]
                out = entry(
                    view.fx * x + view.cx, view.fy * y + view.cy, X[2],
                    (c + PASS) / det, b / (c + PASS), real(1.0) / (c + PASS), o, q[0], q[1], q[2],
                )  # fmt: skip
                rows = tile_rows(out, view)
                for row in range(rows[0], rows[1]):
                    columns = tile_columns(out, row, view)
                    touched += wp.max(columns[1] - columns[0], 0)
        splat[i] = out
        count[i] = touched

    @wp.kernel(module="unique", enable_backward=False)
    def list_tiles(
        # in
        begin: int,  # first Gaussian of this launch
        order: wp.array(dtype=int),  # [n] Gaussians from near to far
        last: wp.array(dtype=int),  # [n] running sum of the tile counts in that order
        count: wp.array(dtype=int),  # [n] number of tiles touched
        splat: wp.array(dtype=entry),  # [n] what is drawn of a Gaussian
        view: View,  # camera and what of its picture is drawn
        # out
        tile: wp.array(dtype=int),  # [pair] of every pair (tile, Gaussian)
        gaussian: wp.array(dtype=int),  # [pair] index of the Gaussian
    ):
        i = begin + wp.tid()
        g = order[i]
        if count[g] > 0:
            k = last[i] - count[g]
            s = splat[g]
            rows = tile_rows(s, view)
            for row in range(rows[0], rows[1]):
                columns = tile_columns(s, row, view)
                for column in range(columns[0], columns[1]):
                    tile[k] = row * ((view.width + TILE - 1) // TILE) + column
                    gaussian[k] = g
                    k += 1

    @wp.kernel(module="unique", enable_backward=False)
    def project_adjoint(
        # in
        begin: int,  # first Gaussian of this launch
        mean: wp.array(dtype=vec3),  # [n] [m]
        covariance: wp.array(dtype=mat33),  # [n] [m^2]
        opacity: wp.array(dtype=real),  # [n] 0..1
        count: wp.array(dtype=int),  # [n] number of tiles touched
        view: View,  # camera and what of its picture is drawn
        sums: wp.array2d(dtype=entry),  # [part, n] adjoint of `splat`
        # out
        mean_bar: wp.array(dtype=vec3),  # [n]
        covariance_bar: wp.array(dtype=mat33),  # [n]
        opacity_bar: wp.array(dtype=real),  # [n]
        color_bar: wp.array(dtype=vec3),  # [n]
    ):
        i = begin + wp.tid()
        X_bar = vec3()
        S_bar = mat33()
        o_bar = real(0.0)
        q_bar = vec3()
        if count[i] > 0:
            bar = entry()
            for part in range(sums.shape[0]):
                bar += sums[part, i]
            q_bar = vec3(bar[7], bar[8], bar[9])
            X = view.R @ mean[i] + view.t
            x = X[0] / X[2]
            y = X[1] / X[2]
            xj = held(x, view.fx, view.cx, view.width)
            yj = held(y, view.fy, view.cy, view.height)
            fu = view.fx / X[2]
            fv = view.fy / X[2]
            ru = fu * vec3(real(1.0), real(0.0), -xj) @ view.R
            rv = fv * vec3(real(0.0), real(1.0), -yj) @ view.R
            S = real(0.5) * (covariance[i] + wp.transpose(covariance[i]))
            su = S @ ru
            sv = S @ rv
            a = wp.dot(ru, su)
            b = wp.dot(ru, sv)
            c = wp.dot(rv, sv)
            bare = wp.max(a * c - b * b, real(0.0))
            det = bare + PASS * (a + c) + PASS * PASS
            p = real(1.0) / (c + PASS)
            s = b * p
            # A = (c + PASS) / det, s = b p, p = 1 / (c + PASS)
            c_bar = bar[3] / det - (bar[4] * s + bar[5] * p) * p
            b_bar = bar[4] * p
            det_bar = -bar[3] / (p * det * det)
            bare_bar = real(0.0)
            o_bar = bar[6]
            if view.antialiased == 1:
                rho = wp.sqrt(bare / det)
                o_bar = bar[6] * rho
                ratio_bar = bar[6] * opacity[i] / (real(2.0) * rho)
                bare_bar = ratio_bar / det
                det_bar -= ratio_bar * bare / (det * det)
            # det = bare + PASS (a + c) + PASS^2, bare = a c - b^2
            bare_bar += det_bar
            a_bar = det_bar * PASS + bare_bar * c
            c_bar += det_bar * PASS + bare_bar * a
            b_bar -= real(2.0) * b * bare_bar
            cross = real(0.5) * b_bar * wp.outer(ru, rv)
            S_bar = a_bar * wp.outer(ru, ru) + c_bar * wp.outer(rv, rv) + cross + wp.transpose(cross)
            ju_bar = view.R @ (real(2.0) * a_bar * su + b_bar * sv)
            jv_bar = view.R @ (real(2.0) * c_bar * sv + b_bar * su)
            x_bar = bar[0] * view.fx
            y_bar = bar[1] * view.fy
            if x == xj:
                x_bar -= fu * ju_bar[2]
            if y == yj:
                y_bar -= fv * jv_bar[2]
            shrink = fu * (ju_bar[0] - xj * ju_bar[2]) + fv * (jv_bar[1] - yj * jv_bar[2]) + x_bar * x + y_bar * y
            X_bar = vec3(x_bar / X[2], y_bar / X[2], bar[2] - shrink / X[2])
        mean_bar[i] = X_bar @ view.R
        covariance_bar[i] = S_bar
        opacity_bar[i] = o_bar
        color_bar[i] = q_bar

    return project, project_adjoint, list_tiles
