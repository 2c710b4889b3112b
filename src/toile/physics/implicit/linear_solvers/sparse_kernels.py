"""Numeric phase of the multifrontal Cholesky factorisation, and the triangular solves.

Each is one kernel of one thread in C++, which Warp compiles, with BLAS and LAPACK called by their addresses.
The panel of a supernode lies column by column: the columns of L that it owns, from the diagonal down.
"""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="empty-body, misc, no-untyped-def, valid-type"

from __future__ import annotations

import warp as wp

_FACTORISE = """
typedef void (*potrf_t)(const char*, const int*, double*, const int*, int*);
typedef void (*trsm_t)(const char*, const char*, const char*, const char*, const int*, const int*,
    const double*, const double*, const int*, double*, const int*);
typedef void (*syrk_t)(const char*, const char*, const int*, const int*, const double*, const double*,
    const int*, const double*, double*, const int*);
const double one = 1.0, minus_one = -1.0;
const wp::int64* child = of.children.data;
for (int s = 0; s < of.n_supernodes; ++s) {
    const int width = of.widths[s];
    const int m = 3 * (of.row_starts[s + 1] - of.row_starts[s]), k = 3 * width, u = m - k;
    double* panel = values.data + of.panel_starts[s];
    double* update = work.data + of.work_starts[s];
    for (wp::int64 i = 0; i < wp::int64(m) * k; ++i) panel[i] = 0.0;
    for (wp::int64 i = 0; i < wp::int64(u) * u; ++i) update[i] = 0.0;
    for (wp::int64 b = of.block_starts[s]; b < of.block_starts[s + 1]; ++b) {
        const double* from = blocks.data + 9 * of.sources[b];
        double* to = panel + of.targets[b];
        const int across = of.transposed[b] ? 3 : 1, down = of.transposed[b] ? 1 : 3;
        for (int c = 0; c < 3; ++c)
            for (int r = 0; r < 3; ++r)
                to[wp::int64(c) * m + r] = from[r * down + c * across];
    }
    for (int v = 0; v < width; ++v) {
        const double added = diagonal[of.vertices[of.row_starts[s] + v]];
        for (int c = 3 * v; c < 3 * v + 3; ++c) panel[wp::int64(c) * m + c] += added;
    }
    for (; child < of.children.data + of.child_ends[s]; ++child) {
        const wp::int64 first = of.row_starts[*child] + of.widths[*child];
        const int rows = of.row_starts[*child + 1] - first, ld = 3 * rows;
        const wp::int64* place = of.places.data + first;
        const double* from = work.data + of.update_starts[*child];
        for (int j = 0; j < rows; ++j) {
            const int p = place[j];
            for (int c = 0; c < 3; ++c) {
                const double* column = from + wp::int64(3 * j + c) * ld;
                double* to = p < width ? panel + wp::int64(3 * p + c) * m
                                       : update + wp::int64(3 * (p - width) + c) * u - k;
                for (int i = j; i < rows; ++i) {
                    double* entry = to + 3 * place[i];
                    entry[0] += column[3 * i];
                    entry[1] += column[3 * i + 1];
                    entry[2] += column[3 * i + 2];
                }
            }
        }
    }
    int info = 0;
    ((potrf_t)of.potrf)("L", &k, panel, &m, &info);
    if (info != 0) return 0;
    // LAPACK lets NaN pass as positive; it reaches the diagonal wherever it was.
    for (int c = 0; c < k; ++c)
        if (!(panel[wp::int64(c) * m + c] <= 1.7976931348623157e308)) return 0;
    if (u > 0) {
        ((trsm_t)of.trsm)("R", "L", "T", "N", &u, &k, &one, panel, &m, panel + k, &m);
        ((syrk_t)of.syrk)("L", "N", &u, &k, &minus_one, panel + k, &m, &one, update, &u);
        double* kept = work.data + of.update_starts[s];
        if (kept != update)
            for (wp::int64 i = 0; i < wp::int64(u) * u; ++i) kept[i] = update[i];
    }
}
return 1;
"""

_SOLVE = """
typedef void (*trsm_t)(const char*, const char*, const char*, const char*, const int*, const int*,
    const double*, const double*, const int*, double*, const int*);
typedef void (*gemm_t)(const char*, const char*, const int*, const int*, const int*, const double*,
    const double*, const int*, const double*, const int*, const double*, double*, const int*);
typedef void (*trsv_t)(const char*, const char*, const char*, const int*, const double*, const int*, double*,
    const int*);
typedef void (*gemv_t)(const char*, const int*, const int*, const double*, const double*, const int*,
    const double*, const int*, const double*, double*, const int*);
const double one = 1.0, minus_one = -1.0, zero = 0.0;
const int unit = 1, n = of.n;
double* x = right.data;
double* below = work.data;
for (int backward = 0; backward < 2; ++backward) {
    const char* transpose = backward ? "T" : "N";
    for (int step = 0; step < of.n_supernodes; ++step) {
        const int s = backward ? of.n_supernodes - 1 - step : step;
        const int m = 3 * (of.row_starts[s + 1] - of.row_starts[s]), k = 3 * of.widths[s], u = m - k;
        const double* panel = values.data + of.panel_starts[s];
        const wp::int64* row = of.rows.data + of.row_starts[s] + of.widths[s];
        double* own = x + 3 * of.rows[of.row_starts[s]];
        if (backward && u > 0) {
            for (int j = 0; j < n_right; ++j)
                for (int i = 0; i < u / 3; ++i)
                    for (int c = 0; c < 3; ++c)
                        below[wp::int64(j) * u + 3 * i + c] = x[wp::int64(j) * n + 3 * row[i] + c];
            if (n_right == 1)
                ((gemv_t)of.gemv)("T", &u, &k, &minus_one, panel + k, &m, below, &unit, &one, own, &unit);
            else
                ((gemm_t)of.gemm)("T", "N", &k, &n_right, &u, &minus_one, panel + k, &m, below, &u, &one,
                    own, &n);
        }
        if (n_right == 1)
            ((trsv_t)of.trsv)("L", transpose, "N", &k, panel, &m, own, &unit);
        else
            ((trsm_t)of.trsm)("L", "L", transpose, "N", &k, &n_right, &one, panel, &m, own, &n);
        if (!backward && u > 0) {
            if (n_right == 1)
                ((gemv_t)of.gemv)("N", &u, &k, &one, panel + k, &m, own, &unit, &zero, below, &unit);
            else
                ((gemm_t)of.gemm)("N", "N", &u, &n_right, &k, &one, panel + k, &m, own, &n, &zero,
                    below, &u);
            for (int j = 0; j < n_right; ++j)
                for (int i = 0; i < u / 3; ++i)
                    for (int c = 0; c < 3; ++c)
                        x[wp::int64(j) * n + 3 * row[i] + c] -= below[wp::int64(j) * u + 3 * i + c];
        }
    }
}
"""


@wp.struct
class Supernodes:
    """What the kernels know of a pattern; S supernodes in the order of elimination, starts as usual (S + 1,).

    Rows of a supernode are the vertices of its columns, then those below that its columns reach.

    Attributes:
        n_supernodes: S.
        n: unknowns.
        widths: (S,) vertices that each owns.
        row_starts: into rows, vertices and places.
        rows: places in the order of elimination.
        vertices: the same in the caller's numbering.
        places: number of the row among those of the parent; of rows below only.
        panel_starts: into the values of L.
        work_starts, update_starts: where its update matrix is made, and where it waits for the parent.
        child_ends: into children.
        children: supernodes, parent by parent.
        block_starts: into the blocks of the matrix that it owns.
        sources, targets, transposed: place of the block, where in the panel it goes, whether turned over.
        potrf, trsm, syrk, gemm, trsv, gemv: addresses.
    """

    n_supernodes: wp.int32
    n: wp.int32
    widths: wp.array(dtype=wp.int64)
    row_starts: wp.array(dtype=wp.int64)
    rows: wp.array(dtype=wp.int64)
    vertices: wp.array(dtype=wp.int64)
    places: wp.array(dtype=wp.int64)
    panel_starts: wp.array(dtype=wp.int64)
    work_starts: wp.array(dtype=wp.int64)
    update_starts: wp.array(dtype=wp.int64)
    child_ends: wp.array(dtype=wp.int64)
    children: wp.array(dtype=wp.int64)
    block_starts: wp.array(dtype=wp.int64)
    sources: wp.array(dtype=wp.int64)
    targets: wp.array(dtype=wp.int64)
    transposed: wp.array(dtype=wp.int64)
    potrf: wp.uint64
    trsm: wp.uint64
    syrk: wp.uint64
    gemm: wp.uint64
    trsv: wp.uint64
    gemv: wp.uint64


@wp.func_native(_FACTORISE)
def _factorise(
    of: Supernodes,
    blocks: wp.array(dtype=wp.float64),
    diagonal: wp.array(dtype=wp.float64),
    values: wp.array(dtype=wp.float64),
    work: wp.array(dtype=wp.float64),
) -> int: ...


@wp.func_native(_SOLVE)
def _solve(
    of: Supernodes,
    n_right: int,
    values: wp.array(dtype=wp.float64),
    right: wp.array(dtype=wp.float64),
    work: wp.array(dtype=wp.float64),
): ...


@wp.kernel(enable_backward=False)
def factorise(
    of: Supernodes,
    blocks: wp.array(dtype=wp.float64),
    diagonal: wp.array(dtype=wp.float64),
    values: wp.array(dtype=wp.float64),
    work: wp.array(dtype=wp.float64),
    definite: wp.array(dtype=wp.int32),
):
    """Values of L; definite is 0 where the matrix is not positive definite or not finite, else 1."""
    definite[0] = _factorise(of, blocks, diagonal, values, work)


@wp.kernel(enable_backward=False)
def solve(
    of: Supernodes,
    n_right: int,
    values: wp.array(dtype=wp.float64),
    right: wp.array(dtype=wp.float64),
    work: wp.array(dtype=wp.float64),
):
    """Overwrite right-hand sides, one after the other in the order of elimination, with the solutions."""
    _solve(of, n_right, values, right, work)
