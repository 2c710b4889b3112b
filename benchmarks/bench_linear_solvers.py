"""Linear solvers for Newton's method, on the actual Hessian of a hanging cloth.

``python benchmarks/bench_linear_solvers.py [--grid 32] [--threads 1] [--csv table.csv]`` prints a Markdown
table of times and residuals: LAPACK's banded Cholesky (the one in use), sparse LU, dense Cholesky and
conjugate gradients.
"""

from __future__ import annotations

import argparse
from pathlib import Path

# Sets the number of BLAS threads before NumPy is loaded.
from bench_solver import hanging_cloth, machine, milliseconds, show

# isort: split
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.linalg import cho_factor, cho_solve
from toile.physics.implicit.banded import BandedCholesky

from toile.physics.implicit.integrators import BDF2

HEADER = ["solver", "factorise [ms]", "solve [ms]", "total [ms]", "relative residual", "note"]


def sparse_of(band: np.ndarray) -> sp.csc_array:
    """Symmetric sparse matrix of a lower band (n, b + 1)."""
    n, width = band.shape
    lower = sp.diags_array(
        [band[: n - k, k] for k in range(width)], offsets=[-k for k in range(width)], shape=(n, n)
    )
    full = (lower + sp.tril(lower, -1).T).tocsc()
    full.eliminate_zeros()
    return full


def rows(grid: int, substeps: int, repeats: int, dense: bool) -> list[list[object]]:
    """One row per solver, on the Hessian of one BDF2 step at the state after half a second."""
    simulator, motion, material = hanging_cloth(grid, substeps, BDF2(), frames=16)
    assembly = simulator.assembly
    x = motion.positions[0, -1].numpy()
    _, band, _ = assembly.hessian(x, material, convex=False)
    assembly.add_diagonal(band, simulator.inertia)
    if BandedCholesky.factorise(band.copy()) is None:
        raise RuntimeError("the Hessian is not positive definite at the state of the benchmark")
    matrix = sparse_of(band)
    right = np.random.default_rng(0).normal(size=band.shape[0])

    def residual(solution: np.ndarray) -> str:
        return f"{np.linalg.norm(matrix @ solution - right) / np.linalg.norm(right):.0e}"

    table: list[list[object]] = []

    def direct(name: str, factorise, solve, note: str, count: int = repeats) -> None:  # type: ignore[no-untyped-def]
        first, spread = milliseconds(factorise, count)
        factor = factorise()
        second, _ = milliseconds(lambda: solve(factor), count)
        table.append(
            [
                name,
                f"{first:.2f} ± {spread:.2f}",
                f"{second:.3f}",
                f"{first + second:.2f}",
                residual(solve(factor)),
                note,
            ]
        )

    work = band.copy()

    def banded() -> BandedCholesky:
        np.copyto(work, band)
        factor = BandedCholesky.factorise(work)
        assert factor is not None
        return factor

    direct(
        "banded Cholesky (in use)", banded, lambda f: f.solve(right), f"half bandwidth {band.shape[1] - 1}"
    )
    for ordering in ("COLAMD", "MMD_AT_PLUS_A"):
        symmetric = {"SymmetricMode": True} if ordering == "MMD_AT_PLUS_A" else {}
        fill = spla.splu(matrix, permc_spec=ordering, options=symmetric)
        direct(
            f"sparse LU, {ordering}",
            lambda o=ordering, s=symmetric: spla.splu(matrix, permc_spec=o, options=s),
            lambda f: f.solve(right),
            f"{(fill.L.nnz + fill.U.nnz) / 1e6:.2f} M entries",
            max(3, repeats // 5),
        )
    if dense:
        full = matrix.toarray()
        direct(
            "dense Cholesky",
            lambda: cho_factor(full, lower=True, check_finite=False),
            lambda f: cho_solve(f, right, check_finite=False),
            f"{full.nbytes / 1e6:.0f} MB",
            3,
        )
    inverse_diagonal = 1 / matrix.diagonal()
    jacobi = spla.LinearOperator(matrix.shape, matvec=lambda v: inverse_diagonal * v, dtype=np.float64)
    rows_first = matrix.tocsr()
    for tolerance in (1e-4, 1e-10):
        steps = [0]

        def count(_: object, steps: list[int] = steps) -> None:
            steps[0] += 1

        solution, info = spla.cg(rows_first, right, rtol=tolerance, M=jacobi, maxiter=20000, callback=count)
        median, spread = milliseconds(
            lambda t=tolerance: spla.cg(rows_first, right, rtol=t, M=jacobi, maxiter=20000), 5
        )
        note = f"{steps[0]} iterations" + ("" if info == 0 else ", not converged")
        table.append(
            [
                f"conjugate gradients, Jacobi, {tolerance:.0e}",
                "0",
                f"{median:.1f} ± {spread:.1f}",
                f"{median:.1f}",
                residual(solution),
                note,
            ]
        )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grid", type=int, default=32, help="vertices per side")
    parser.add_argument("--substeps", type=int, default=2, help="sub-steps per frame at 30 Hz")
    parser.add_argument("--repeats", type=int, default=25)
    parser.add_argument("--threads", type=int, default=1, help="threads of LAPACK")
    parser.add_argument("--no-dense", action="store_true", help="leave out the dense factorisation")
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    table = rows(arguments.grid, arguments.substeps, arguments.repeats, not arguments.no_dense)
    print(f"{machine()}, {arguments.threads} LAPACK thread(s); {arguments.grid}×{arguments.grid} vertices\n")
    show(HEADER, table, arguments.csv)


if __name__ == "__main__":
    main()
