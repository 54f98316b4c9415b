"""Sums over the 27 nodes around a particle: the inner loops of the transfers, each in two forms.

    gathered(v, ...)        rows sum w v, sum w v r_x, sum w v r_y, sum w v r_z                 r = x_i - x_p [cells]
    spread(grid, ...)       node += w (m v + A r, m)
    spread_vectors(grid, ...)  node += w (q + A r)                                      q = m v
    spread_adjoint(G, ...)  with (P, M) of a node: rows of `gathered` for (P, M), then sum grad w [P . (q + A r) + m M]
    gathered_adjoint(v, ...)  node += w (V + B r);  rows sum w v, sum grad w [v . (V + B r)]

Nodes along z are neighbours in memory: a column of three. The plain form is Warp and runs anywhere. The `fast` one is
the same loop in Clang's vectors of four, for the CPU: twice as fast, because Warp's code for a vector works on single
numbers and checks every index for its sign. A test holds them together. There `gathered` and `spread` compute weights
and sums in double precision whatever goes in and comes out: in single precision the weights do not add up to one, and
momenta that are added to a node lose what 1e-7 of the sum is, in every substep. The adjoints take a column at once, and
what lies beside it in memory with it: arrays need `SPARE` elements more than there are nodes.
"""

from functools import cache

import warp as wp

SPARE = 3  # elements of arrays on the nodes that are read, and written as they are, behind the last one


def _vector(real, n: int) -> type:
    return wp.types.vector(n, real)


def rows(real, n: int) -> type:
    """Matrix [n, 4] of `real`: what the sums return."""
    return wp.types.matrix((n, 4), real)


@cache
def gathered(real, fast: bool) -> wp.Function:
    """gathered(v: array[vec3], first node, ny, nz, f, w) -> [4, 4]; the last column is of no use."""
    vec3, mat33, mat44 = _vector(real, 3), wp.types.matrix((3, 3), real), rows(real, 4)

    if fast:

        @wp.func_native(
            _wide_head(real)
            + """
            const R* first = (const R*)v.data + 3 * (size_t)node;
            const T z0 = wz[0] * (0 - f[2]), z1 = wz[1] * (1 - f[2]), z2 = wz[2] * (2 - f[2]);
            V mean = {}, bx = {}, by = {}, bz = {};
            #pragma unroll
            for (int i = 0; i < 3; ++i) {
                V s = {}, sy = {}, sz = {};
                #pragma unroll
                for (int j = 0; j < 3; ++j) {
                    const R* column = first + 3 * (i * ny + j) * (long long)nz;
                    const V c0 = __builtin_convertvector(*(const Q*)column, V);
                    const V c1 = __builtin_convertvector(*(const Q*)(column + 3), V);
                    const V c2 = __builtin_convertvector(*(const Q*)(column + 6), V);
                    const V t = wy[j] * (wz[0] * c0 + wz[1] * c1 + wz[2] * c2);
                    s += t;
                    sy += (j - f[1]) * t;
                    sz += wy[j] * (z0 * c0 + z1 * c1 + z2 * c2);
                }
                mean += wx[i] * s;
                bx += (wx[i] * (i - f[0])) * s;
                by += wx[i] * sy;
                bz += wx[i] * sz;
            }
            wp::mat_t<4, 4, R> found;
            *(Q*)found.data[0] = __builtin_convertvector(mean, Q);
            *(Q*)found.data[1] = __builtin_convertvector(bx, Q);
            *(Q*)found.data[2] = __builtin_convertvector(by, Q);
            *(Q*)found.data[3] = __builtin_convertvector(bz, Q);
            return found;
            """
        )
        def native(v: wp.array(dtype=vec3), node: int, ny: int, nz: int, f: vec3, w: mat33) -> mat44: ...

        return native

    @wp.func
    def plain(v: wp.array(dtype=vec3), node: int, ny: int, nz: int, f: vec3, w: mat33):
        mean, bx, by, bz = vec3(), vec3(), vec3(), vec3()
        one, zero = real(1.0), real(0.0)
        rx = -f[0]
        for i in range(3):
            ry = -f[1]
            for j in range(3):
                s, sz = vec3(), vec3()  # sums along a column
                rz = -f[2]
                for k in range(3):
                    a = w[2, k] * v[node + (i * ny + j) * nz + k]
                    s = s + a
                    sz = sz + rz * a
                    rz = rz + one
                wij = w[0, i] * w[1, j]
                mean = mean + wij * s
                bx = bx + (wij * rx) * s
                by = by + (wij * ry) * s
                bz = bz + wij * sz
                ry = ry + one
            rx = rx + one
        return mat44(
            mean[0], mean[1], mean[2], zero, bx[0], bx[1], bx[2], zero,
            by[0], by[1], by[2], zero, bz[0], bz[1], bz[2], zero,
        )  # fmt: skip

    return plain


@cache
def spread(real, fast: bool, sums) -> wp.Function:
    """spread(grid: array[vec4 of `sums`], first node, ny, nz, f, w, v, m, A); `sums` of the fast form are double."""
    vec3, vec4, mat33 = _vector(real, 3), _vector(sums, 4), wp.types.matrix((3, 3), real)

    if fast:

        @wp.func_native(
            _wide_head(real)
            + _columns_of_A
            + """
            V* first = (V*)grid.data + node;
            V qi = T(m) * V{v[0], v[1], v[2], 1} - T(f[0]) * ax - T(f[1]) * ay - T(f[2]) * az;
            #pragma unroll
            for (int i = 0; i < 3; ++i) {
                V qj = qi;
                #pragma unroll
                for (int j = 0; j < 3; ++j) {
                    V* column = first + (i * ny + j) * (long long)nz;
                    const T weight = wx[i] * wy[j];
                    const V q1 = qj + az;
                    column[0] += (weight * wz[0]) * qj;
                    column[1] += (weight * wz[1]) * q1;
                    column[2] += (weight * wz[2]) * (q1 + az);
                    qj += ay;
                }
                qi += ax;
            }
            """
        )
        def native(
            grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, f: vec3, w: mat33, v: vec3, m: real, A: mat33
        ): ...

        return native

    @wp.func
    def plain(grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, f: vec3, w: mat33, v: vec3, m: real, A: mat33):
        ax = vec3(A[0, 0], A[1, 0], A[2, 0])
        ay = vec3(A[0, 1], A[1, 1], A[2, 1])
        az = vec3(A[0, 2], A[1, 2], A[2, 2])
        qi = m * v - A * f  # of the lowest node; built up by its increments from node to node
        for i in range(3):
            qij = qi
            for j in range(3):
                wij = w[0, i] * w[1, j]
                qijk = qij
                for k in range(3):
                    weight = wij * w[2, k]
                    value = vec4(
                        sums(weight * qijk[0]), sums(weight * qijk[1]), sums(weight * qijk[2]), sums(weight * m)
                    )
                    wp.atomic_add(grid, node + (i * ny + j) * nz + k, value)
                    qijk = qijk + az
                qij = qij + ay
            qi = qi + ax

    return plain


@cache
def spread_vectors(real) -> wp.Function:
    """spread_vectors(grid: array[vec3], first node, ny, nz, w, q, A): `spread` without mass, in the plain form only."""
    vec3, mat33 = _vector(real, 3), wp.types.matrix((3, 3), real)

    @wp.func
    def plain(grid: wp.array(dtype=vec3), node: int, ny: int, nz: int, w: mat33, q: vec3, A: mat33):
        ax = vec3(A[0, 0], A[1, 0], A[2, 0])
        ay = vec3(A[0, 1], A[1, 1], A[2, 1])
        az = vec3(A[0, 2], A[1, 2], A[2, 2])
        qi = q
        for i in range(3):
            qij = qi
            for j in range(3):
                wij = w[0, i] * w[1, j]
                qijk = qij
                for k in range(3):
                    wp.atomic_add(grid, node + (i * ny + j) * nz + k, (wij * w[2, k]) * qijk)
                    qijk = qijk + az
                qij = qij + ay
            qi = qi + ax

    return plain


@cache
def spread_adjoint(real, fast: bool) -> wp.Function:
    """spread_adjoint(G: array[vec4], first node, ny, nz, f, w, w', q, m, A) -> [5, 4]; q as in `spread`."""
    vec3, vec4, mat33 = _vector(real, 3), _vector(real, 4), wp.types.matrix((3, 3), real)
    mat54 = rows(real, 5)

    if fast:

        @wp.func_native(
            _head(real)
            + _slopes
            + _columns_of_A
            + _whole_columns
            + """
            const V* first = (const V*)grid.data + node;
            const C ay_all = column_of(ay, ay, ay);
            C mean = {}, bx = {}, by = {}, power = {}, ex = {}, ey = {};  // sums over columns, node by node
            V qi = {q[0], q[1], q[2], m};
            #pragma unroll
            for (int i = 0; i < 3; ++i) {
                C qij = column_of(qi, qi + az, qi + (az + az)), s = {}, sy = {}, e = {}, ey_i = {};
                #pragma unroll
                for (int j = 0; j < 3; ++j) {
                    const C a = *(const C*)(first + (i * ny + j) * (long long)nz), p = a * qij;
                    s += wy[j] * a;
                    sy += (wy[j] * (j - f[1])) * a;
                    e += wy[j] * p;
                    ey_i += gy[j] * p;
                    qij += ay_all;
                }
                mean += wx[i] * s;
                bx += (wx[i] * (i - f[0])) * s;
                by += wx[i] * sy;
                power += wx[i] * e;
                ex += gx[i] * e;
                ey += wx[i] * ey_i;
                qi += ax;
            }
            wp::mat_t<5, 4, T> found;
            *(V*)found.data[0] = sum(mean, wz[0], wz[1], wz[2]);
            *(V*)found.data[1] = sum(bx, wz[0], wz[1], wz[2]);
            *(V*)found.data[2] = sum(by, wz[0], wz[1], wz[2]);
            *(V*)found.data[3] = sum(mean, wz[0] * (0 - f[2]), wz[1] * (1 - f[2]), wz[2] * (2 - f[2]));
            const V x = sum(ex, wz[0], wz[1], wz[2]), y = sum(ey, wz[0], wz[1], wz[2]);
            const V z = sum(power, gz[0], gz[1], gz[2]);
            *(V*)found.data[4] = V{x[0] + x[1] + x[2] + x[3], y[0] + y[1] + y[2] + y[3], z[0] + z[1] + z[2] + z[3], 0};
            return found;
            """
        )
        def native(
            grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, f: vec3, w: mat33, g: mat33, q: vec3, m: real,
            A: mat33,
        ) -> mat54: ...  # fmt: skip

        return native

    @wp.func
    def plain(
        grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, f: vec3, w: mat33, g: mat33, q: vec3, m: real, A: mat33
    ):
        ax = vec3(A[0, 0], A[1, 0], A[2, 0])
        ay = vec3(A[0, 1], A[1, 1], A[2, 1])
        az = vec3(A[0, 2], A[1, 2], A[2, 2])
        zero, one = real(0.0), real(1.0)
        mean, bx, by, bz, slope, mass = vec3(), vec3(), vec3(), vec3(), vec3(), zero
        qi = q
        rx = -f[0]
        for i in range(3):
            qij = qi
            ry = -f[1]
            for j in range(3):
                s, sz, sm = vec3(), vec3(), zero  # along a column: sum w P, sum w r_z P, sum w M,
                e, ez = zero, zero  # sum w [P . q + m M], sum w' [P . q + m M]
                qijk = qij
                rz = -f[2]
                for k in range(3):
                    value = grid[node + (i * ny + j) * nz + k]
                    P = vec3(value[0], value[1], value[2])
                    power = wp.dot(P, qijk) + m * value[3]
                    a = w[2, k] * P
                    s = s + a
                    sz = sz + rz * a
                    sm = sm + w[2, k] * value[3]
                    e = e + w[2, k] * power
                    ez = ez + g[2, k] * power
                    qijk = qijk + az
                    rz = rz + one
                wij = w[0, i] * w[1, j]
                mean = mean + wij * s
                mass = mass + wij * sm
                bx = bx + (wij * rx) * s
                by = by + (wij * ry) * s
                bz = bz + wij * sz
                slope = slope + vec3(g[0, i] * w[1, j] * e, w[0, i] * g[1, j] * e, wij * ez)
                qij = qij + ay
                ry = ry + one
            qi = qi + ax
            rx = rx + one
        return mat54(
            mean[0], mean[1], mean[2], mass, bx[0], bx[1], bx[2], zero, by[0], by[1], by[2], zero,
            bz[0], bz[1], bz[2], zero, slope[0], slope[1], slope[2], zero,
        )  # fmt: skip

    return plain


@cache
def gathered_adjoint(real, fast: bool) -> wp.Function:
    """gathered_adjoint(v: array[vec3], grid, first node, ny, nz, w, w', q, B) -> [2, 4]; q is V + B r at the lowest
    node, grid an array of 4-vectors in the fast form, of 3-vectors in the plain one."""
    vec3, vec4, mat33 = _vector(real, 3), _vector(real, 4), wp.types.matrix((3, 3), real)
    mat24 = rows(real, 2)

    if fast:

        @wp.func_native(
            _head(real)
            + _slopes
            + _columns_of_A
            + _whole_columns
            + """
            const T* first = (const T*)v.data + 3 * (size_t)node;
            V* first_out = (V*)grid.data + node;
            const C ay_all = column_of(ay, ay, ay), wz_all = {
                wz[0], wz[0], wz[0], wz[0], wz[1], wz[1], wz[1], wz[1], wz[2], wz[2], wz[2], wz[2], 0, 0, 0, 0
            };
            C mean = {}, power = {}, ex = {}, ey = {};  // sums over columns, node by node
            V qi = {q[0], q[1], q[2], 0};
            #pragma unroll
            for (int i = 0; i < 3; ++i) {
                C qij = column_of(qi, qi + az, qi + (az + az)), s = {}, e = {}, ey_i = {};
                #pragma unroll
                for (int j = 0; j < 3; ++j) {
                    const long long at = (i * ny + j) * (long long)nz;
                    const C three = *(const C*)(first + 3 * at);
                    const C a = __builtin_shufflevector(three, three, 0, 1, 2, 3, 3, 4, 5, 6, 6, 7, 8, 9, 9, 9, 9, 9);
                    const C p = a * qij;
                    s += wy[j] * a;
                    e += wy[j] * p;
                    ey_i += gy[j] * p;
                    *(C*)(first_out + at) += (wx[i] * wy[j]) * (wz_all * qij);
                    qij += ay_all;
                }
                mean += wx[i] * s;
                power += wx[i] * e;
                ex += gx[i] * e;
                ey += wx[i] * ey_i;
                qi += ax;
            }
            wp::mat_t<2, 4, T> found;
            *(V*)found.data[0] = sum(mean, wz[0], wz[1], wz[2]);
            const V x = sum(ex, wz[0], wz[1], wz[2]), y = sum(ey, wz[0], wz[1], wz[2]);
            const V z = sum(power, gz[0], gz[1], gz[2]);
            *(V*)found.data[1] = V{x[0] + x[1] + x[2], y[0] + y[1] + y[2], z[0] + z[1] + z[2], 0};
            return found;
            """
        )
        def native(
            v: wp.array(dtype=vec3), grid: wp.array(dtype=vec4), node: int, ny: int, nz: int, w: mat33, g: mat33,
            q: vec3, A: mat33,
        ) -> mat24: ...  # fmt: skip

        return native

    @wp.func
    def plain(
        v: wp.array(dtype=vec3), grid: wp.array(dtype=vec3), node: int, ny: int, nz: int, w: mat33, g: mat33, q: vec3,
        A: mat33,
    ):  # fmt: skip
        ax = vec3(A[0, 0], A[1, 0], A[2, 0])
        ay = vec3(A[0, 1], A[1, 1], A[2, 1])
        az = vec3(A[0, 2], A[1, 2], A[2, 2])
        zero = real(0.0)
        mean, slope = vec3(), vec3()
        qi = q
        for i in range(3):
            qij = qi
            for j in range(3):
                s, e, ez = vec3(), zero, zero  # along a column: sum w v, sum w v . q, sum w' v . q
                qijk = qij
                wij = w[0, i] * w[1, j]
                for k in range(3):
                    n = node + (i * ny + j) * nz + k
                    velocity = v[n]
                    power = wp.dot(velocity, qijk)
                    s = s + w[2, k] * velocity
                    e = e + w[2, k] * power
                    ez = ez + g[2, k] * power
                    wp.atomic_add(grid, n, (wij * w[2, k]) * qijk)
                    qijk = qijk + az
                mean = mean + wij * s
                slope = slope + vec3(g[0, i] * w[1, j] * e, w[0, i] * g[1, j] * e, wij * ez)
                qij = qij + ay
            qi = qi + ax
        return mat24(mean[0], mean[1], mean[2], zero, slope[0], slope[1], slope[2], zero)

    return plain


def _head(real) -> str:
    """A number, four of them anywhere in memory, and the weights along each axis."""
    return f"""
            typedef {_NAME[real]} T;
            typedef T V __attribute__((vector_size(4 * sizeof(T)), aligned(sizeof(T)), may_alias));
            const T *wx = w.data[0], *wy = w.data[1], *wz = w.data[2];
            """


def _wide_head(real) -> str:
    """Sums and the weights at f in double precision (T, V), beside the numbers that go in (R, Q)."""
    weights = "".join(
        f"""
            const T a{k} = T(1.5) - f[{k}], b{k} = f[{k}] - T(1), c{k} = f[{k}] - T(0.5);
            const T w{axis}[3] = {{T(0.5) * a{k} * a{k}, T(0.75) - b{k} * b{k}, T(0.5) * c{k} * c{k}}};
            """
        for k, axis in enumerate("xyz")
    )
    return f"""
            typedef {_NAME[real]} R;
            typedef R Q __attribute__((vector_size(4 * sizeof(R)), aligned(sizeof(R)), may_alias));
            typedef double T;
            typedef T V __attribute__((vector_size(4 * sizeof(T)), aligned(sizeof(T)), may_alias));
            {weights}
            """


_NAME = {wp.float32: "float", wp.float64: "double"}
_slopes = """
            const T *gx = g.data[0], *gy = g.data[1], *gz = g.data[2];
            """
_columns_of_A = """
            const V ax = {A.data[0][0], A.data[1][0], A.data[2][0], 0};
            const V ay = {A.data[0][1], A.data[1][1], A.data[2][1], 0};
            const V az = {A.data[0][2], A.data[1][2], A.data[2][2], 0};
            """
_whole_columns = """
            // a column of three nodes, and room for a fourth one that is never asked for
            typedef T C __attribute__((vector_size(16 * sizeof(T)), aligned(sizeof(T)), may_alias));
            const auto column_of = [](const V a, const V b, const V c) -> C {
                return __builtin_shufflevector(
                    __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7),
                    __builtin_shufflevector(c, c, 0, 1, 2, 3, 0, 1, 2, 3),
                    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15
                );
            };
            const auto sum = [](const C c, const T a0, const T a1, const T a2) -> V {
                return a0 * __builtin_shufflevector(c, c, 0, 1, 2, 3)
                    + a1 * __builtin_shufflevector(c, c, 4, 5, 6, 7)
                    + a2 * __builtin_shufflevector(c, c, 8, 9, 10, 11);
            };
"""
