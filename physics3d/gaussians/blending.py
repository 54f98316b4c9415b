"""Kernels: ellipses from near to far -> colour, alpha, depth of every pixel; the adjoint; the Gaussian in the middle.

    w_i = T_i alpha_i,   T_{i+1} = T_i (1 - alpha_i)

A thread owns a square of pixels and walks the list of its tile from near to far: Gaussians outside, rows inside, and in
the innermost loop the pixels of one row as a Warp vector, which a CPU's compiler turns into wide instructions. On a CPU
the square is the tile, on CUDA one pixel (vectors of length one).
"""

# To a type checker, Warp kernels are another language.
# mypy: ignore-errors
# ruff: noqa: UP018, RUF046, SIM102 (in a kernel a literal is a constant, int(0) a variable; `and` evaluates both sides)

from functools import cache

import warp as wp

from physics3d.gaussians.splat import ALPHA_MAX, entry_type, view_type

LOOK = 8  # Gaussians between two looks at whether a tile still lets light through


@cache
def blending(real, tile: int, side: int):
    entry, View, row = entry_type(real), view_type(real), wp.types.vector(side, real)
    integers = wp.types.vector(side, wp.int32)
    SIDE, TILE, MOST = side, tile, real(ALPHA_MAX)
    # loops over pixels stay loops, which the compiler turns into wide instructions
    options = {
        "max_unroll": 1,
        "cpu_compiler_flags": "-march=native -mprefer-vector-width=512 -mllvm=-inline-threshold=9000",
    }

    if real is wp.float32:
        # 2^t = 2^n 2^f with |f| <= 1/2 by its series, error 1e-7: a call to exp could not be made wide
        L, K = wp.float32(-1.4426950408889634), wp.float32(-120.0)
        a1, a2, a3 = wp.float32(0.6931471805599453), wp.float32(0.2402265069591007), wp.float32(0.05550410866482158)
        a4, a5, a6 = (
            wp.float32(0.009618129107628477),
            wp.float32(0.0013333558146428443),
            wp.float32(0.00015403530393381608),
        )

        @wp.func
        def decay(e: real) -> real:
            """exp(-e) for e >= 0."""
            t = wp.max(L * e, K)
            n = int(t - real(0.5))
            f = t - real(n)
            series = real(1.0) + f * (a1 + f * (a2 + f * (a3 + f * (a4 + f * (a5 + f * a6)))))
            return series * wp.cast((n + 127) << 23, wp.float32)

    else:

        @wp.func
        def decay(e: real) -> real:
            return wp.exp(-e)

    @wp.func
    def square(i: int, width: int) -> wp.vec3i:
        """Left and top pixel of the i-th square of pixels, and the tile it lies in."""
        per_side = TILE // SIDE
        tiles_x = (width + TILE - 1) // TILE
        tile = i // (per_side * per_side)
        s = i % (per_side * per_side)
        return wp.vec3i(
            (tile % tiles_x) * TILE + (s % per_side) * SIDE, (tile // tiles_x) * TILE + (s // per_side) * SIDE, tile
        )

    @wp.func
    def rows(s: entry, cutoff: real, y0: int, y1: int) -> wp.vec2i:
        """Rows of pixels, of y0..y1, that the ellipse alpha = cutoff touches."""
        reach = wp.sqrt(real(2.0) * wp.log(s[6] / cutoff) / s[5])
        first = wp.clamp(wp.ceil(s[1] - reach - real(0.5)), real(y0), real(y1))
        last = wp.clamp(wp.floor(s[1] + reach - real(0.5)) + real(1.0), real(y0), real(y1))
        return wp.vec2i(int(first), int(last))

    @wp.func
    def light(T: row, stop: real) -> int:
        """1 if any pixel of the row still lets light through."""
        most = real(0.0)
        for x in range(SIDE):
            most = wp.max(most, T[x])
        return wp.where(most >= stop, 1, 0)

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def blend(
        # in
        begin: int,  # first square of this launch
        start: wp.array(dtype=int),  # [tile + 1] first pair of every tile, and one past the last
        gaussian: wp.array(dtype=int),  # [pair] index of the Gaussian
        splat: wp.array(dtype=entry),  # [n] what is drawn of a Gaussian
        background: wp.array(dtype=real),  # [3]
        view: View,  # camera and what of its picture is drawn
        # out
        color: wp.array3d(dtype=real),  # [h, w, 3]
        alpha: wp.array2d(dtype=real),  # [h, w]
        depth: wp.array2d(dtype=real),  # [h, w] [m]
        clear: wp.array2d(dtype=real),  # [h, w] transmittance
    ):
        width = view.width
        height = view.height
        cutoff = view.cutoff
        stop = view.stop
        corner = square(begin + wp.tid(), width)
        x0 = corner[0]
        y0 = corner[1]
        if x0 >= width or y0 >= height:
            return
        y1 = wp.min(y0 + SIDE, height)
        nx = wp.min(SIDE, width - x0)
        rays = wp.zeros(shape=(5, SIDE), dtype=row)  # transmittance, sum w r, w g, w b, w z
        for y in range(y1 - y0):
            T = row()
            for x in range(nx):
                T[x] = real(1.0)
            rays[0, y] = T
        k = start[corner[2]]
        end = start[corner[2] + 1]
        open = int(1)
        while k < end and open == 1:
            s = splat[gaussian[k]]
            k += 1
            u = s[0] - real(x0) - real(0.5)
            span = rows(s, cutoff, y0, y1)
            for y in range(span[0], span[1]):
                dy = real(y) + real(0.5) - s[1]
                mid = u + s[4] * dy
                e0 = real(0.5) * s[5] * dy * dy
                e2 = real(0.5) * s[3]
                T = rays[0, y - y0]
                r = rays[1, y - y0]
                g = rays[2, y - y0]
                b = rays[3, y - y0]
                z = rays[4, y - y0]
                for x in range(SIDE):
                    dx = real(x) - mid
                    a = wp.min(s[6] * decay(e2 * dx * dx + e0), MOST)
                    t = T[x]
                    w = t * a
                    w = wp.where(a >= cutoff, w, real(0.0))
                    w = wp.where(t >= stop, w, real(0.0))
                    T[x] = t - w
                    r[x] = r[x] + w * s[7]
                    g[x] = g[x] + w * s[8]
                    b[x] = b[x] + w * s[9]
                    z[x] = z[x] + w * s[2]
                rays[0, y - y0] = T
                rays[1, y - y0] = r
                rays[2, y - y0] = g
                rays[3, y - y0] = b
                rays[4, y - y0] = z
            if k % wp.static(LOOK) == 0:
                open = int(0)
                for y in range(y1 - y0):
                    open = wp.max(open, light(rays[0, y], stop))
        for y in range(y1 - y0):
            T = rays[0, y]
            r = rays[1, y]
            g = rays[2, y]
            b = rays[3, y]
            z = rays[4, y]
            for x in range(nx):
                t = T[x]
                color[y0 + y, x0 + x, 0] = r[x] + t * background[0]
                color[y0 + y, x0 + x, 1] = g[x] + t * background[1]
                color[y0 + y, x0 + x, 2] = b[x] + t * background[2]
                alpha[y0 + y, x0 + x] = real(1.0) - t
                depth[y0 + y, x0 + x] = wp.where(t < real(1.0), z[x] / wp.max(real(1.0) - t, real(1e-9)), real(0.0))
                clear[y0 + y, x0 + x] = t

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def blend_adjoint(
        # in
        begin: int,  # first square of this launch
        part: int,  # which private block of sums this launch adds to
        start: wp.array(dtype=int),  # [tile + 1] first pair of every tile, and one past the last
        gaussian: wp.array(dtype=int),  # [pair] index of the Gaussian
        splat: wp.array(dtype=entry),  # [n] what is drawn of a Gaussian
        view: View,  # camera and what of its picture is drawn
        color: wp.array3d(dtype=real),  # [h, w, 3]
        alpha: wp.array2d(dtype=real),  # [h, w]
        depth: wp.array2d(dtype=real),  # [h, w] [m]
        clear: wp.array2d(dtype=real),  # [h, w] transmittance
        color_bar: wp.array3d(dtype=real),  # [h, w, 3] adjoints; empty ones are zero
        alpha_bar: wp.array2d(dtype=real),  # [h, w]
        depth_bar: wp.array2d(dtype=real),  # [h, w]
        # out
        sums: wp.array2d(dtype=entry),  # [part, n] adjoint of `splat`, added to
    ):
        width = view.width
        height = view.height
        cutoff = view.cutoff
        stop = view.stop
        corner = square(begin + wp.tid(), width)
        x0 = corner[0]
        y0 = corner[1]
        if x0 >= width or y0 >= height:
            return
        y1 = wp.min(y0 + SIDE, height)
        nx = wp.min(SIDE, width - x0)
        # transmittance; what lies behind: sum of w (adjoint of the pixel . colour and depth); adjoints of the four sums
        rays = wp.zeros(shape=(6, SIDE), dtype=row)
        for y in range(y1 - y0):
            T = row()
            rest = row()
            r = row()
            g = row()
            b = row()
            z = row()
            for x in range(nx):
                T[x] = real(1.0)
                i = y0 + y
                j = x0 + x
                if color_bar.shape[0] > 0:
                    r[x] = color_bar[i, j, 0]
                    g[x] = color_bar[i, j, 1]
                    b[x] = color_bar[i, j, 2]
                    rest[x] = r[x] * color[i, j, 0] + g[x] * color[i, j, 1] + b[x] * color[i, j, 2]
                if alpha_bar.shape[0] > 0:
                    rest[x] = rest[x] - alpha_bar[i, j] * clear[i, j]
                if depth_bar.shape[0] > 0:
                    if alpha[i, j] > real(0.0):
                        z[x] = depth_bar[i, j] / alpha[i, j]
                        rest[x] = rest[x] + z[x] * depth[i, j]
            rays[0, y] = T
            rays[1, y] = rest
            rays[2, y] = r
            rays[3, y] = g
            rays[4, y] = b
            rays[5, y] = z
        k = start[corner[2]]
        end = start[corner[2] + 1]
        open = int(1)
        while k < end and open == 1:
            i = gaussian[k]
            s = splat[i]
            k += 1
            u = s[0] - real(x0) - real(0.5)
            span = rows(s, cutoff, y0, y1)
            # sums over pixels, of e_bar, the adjoint of the exponent, its moments, and of w times the pixels' adjoints
            m0 = row()
            m1 = row()
            m2 = row()
            my = row()
            mxy = row()
            myy = row()
            cr = row()
            cg = row()
            cb = row()
            cz = row()
            for y in range(span[0], span[1]):
                dy = real(y) + real(0.5) - s[1]
                mid = u + s[4] * dy
                e0 = real(0.5) * s[5] * dy * dy
                e2 = real(0.5) * s[3]
                T = rays[0, y - y0]
                rest = rays[1, y - y0]
                r = rays[2, y - y0]
                g = rays[3, y - y0]
                b = rays[4, y - y0]
                z = rays[5, y - y0]
                for x in range(SIDE):
                    dx = real(x) - mid
                    a = wp.min(s[6] * decay(e2 * dx * dx + e0), MOST)
                    t = T[x]
                    a = wp.where(a >= cutoff, a, real(0.0))
                    a = wp.where(t >= stop, a, real(0.0))
                    w = t * a
                    T[x] = t - w
                    value = r[x] * s[7] + g[x] * s[8] + b[x] * s[9] + z[x] * s[2]
                    behind = rest[x] - w * value
                    rest[x] = behind
                    cr[x] = cr[x] + w * r[x]
                    cg[x] = cg[x] + w * g[x]
                    cb[x] = cb[x] + w * b[x]
                    cz[x] = cz[x] + w * z[x]
                    e_bar = a * behind / (real(1.0) - a) - w * value
                    e_bar = wp.where(a < MOST, e_bar, real(0.0))
                    ex = e_bar * dx
                    m0[x] = m0[x] + e_bar
                    m1[x] = m1[x] + ex
                    m2[x] = m2[x] + ex * dx
                    my[x] = my[x] + e_bar * dy
                    mxy[x] = mxy[x] + ex * dy
                    myy[x] = myy[x] + e_bar * dy * dy
                rays[0, y - y0] = T
                rays[1, y - y0] = rest
            if span[0] < span[1]:
                bar = entry()
                tx = real(0.0)
                ty = real(0.0)
                txy = real(0.0)
                for x in range(SIDE):
                    tx += m1[x]
                    ty += my[x]
                    txy += mxy[x]
                    bar[2] = bar[2] + cz[x]
                    bar[3] = bar[3] + real(0.5) * m2[x]
                    bar[5] = bar[5] + real(0.5) * myy[x]
                    bar[6] = bar[6] - m0[x]
                    bar[7] = bar[7] + cr[x]
                    bar[8] = bar[8] + cg[x]
                    bar[9] = bar[9] + cb[x]
                bar[0] = -s[3] * tx
                bar[1] = s[3] * s[4] * tx - s[5] * ty
                bar[4] = -s[3] * txy
                bar[6] = bar[6] / s[6]
                wp.atomic_add(sums, part, i, bar)
            if k % wp.static(LOOK) == 0:
                open = int(0)
                for y in range(y1 - y0):
                    open = wp.max(open, light(rays[0, y], stop))

    @wp.kernel(module="unique", enable_backward=False, module_options=options)
    def find_middle(
        # in
        begin: int,  # first square of this launch
        start: wp.array(dtype=int),  # [tile + 1] first pair of every tile, and one past the last
        gaussian: wp.array(dtype=int),  # [pair] index of the Gaussian
        splat: wp.array(dtype=entry),  # [n] what is drawn of a Gaussian
        view: View,  # camera and what of its picture is drawn
        # out
        middle: wp.array2d(dtype=int),  # [h, w] Gaussian at which the transmittance falls below 1/2; -1: it does not
    ):
        width = view.width
        height = view.height
        cutoff = view.cutoff
        stop = view.stop
        corner = square(begin + wp.tid(), width)
        x0 = corner[0]
        y0 = corner[1]
        if x0 >= width or y0 >= height:
            return
        y1 = wp.min(y0 + SIDE, height)
        nx = wp.min(SIDE, width - x0)
        clear = wp.zeros(shape=(SIDE,), dtype=row)
        found = wp.zeros(shape=(SIDE,), dtype=integers)
        for y in range(y1 - y0):
            T = row()
            for x in range(nx):
                T[x] = real(1.0)
            clear[y] = T
            found[y] = integers(-1)
        k = start[corner[2]]
        end = start[corner[2] + 1]
        open = int(1)
        while k < end and open == 1:
            i = gaussian[k]
            s = splat[i]
            k += 1
            u = s[0] - real(x0) - real(0.5)
            span = rows(s, cutoff, y0, y1)
            for y in range(span[0], span[1]):
                dy = real(y) + real(0.5) - s[1]
                mid = u + s[4] * dy
                e0 = real(0.5) * s[5] * dy * dy
                e2 = real(0.5) * s[3]
                T = clear[y - y0]
                at = found[y - y0]
                for x in range(SIDE):
                    dx = real(x) - mid
                    a = wp.min(s[6] * decay(e2 * dx * dx + e0), MOST)
                    t = T[x]
                    w = t * wp.where(a >= cutoff, a, real(0.0))
                    w = wp.where(t >= stop, w, real(0.0))
                    T[x] = t - w
                    at[x] = wp.where(t >= real(0.5) and t - w < real(0.5), i, at[x])
                clear[y - y0] = T
                found[y - y0] = at
            if k % wp.static(LOOK) == 0:
                open = int(0)
                for y in range(y1 - y0):
                    open = wp.max(open, light(clear[y], stop))
        for y in range(y1 - y0):
            at = found[y]
            for x in range(nx):
                middle[y0 + y, x0 + x] = at[x]

    return blend, blend_adjoint, find_middle
