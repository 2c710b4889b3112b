"""Linear solvers on real cloths: one factorisation and solve, and what simulation and derivatives cost.

``make linear-solvers`` writes docs/results/linear_solvers.md and two tables as CSV. The scene: a skirt, a
truncated cone of cotton whose waist is pinned and swings, neo-Hookean membrane and dihedral bending, four
frames at 30 Hz, one step each, backward Euler; and grids as fits have them. Libraries outside the project
(cholespy, pypardiso, qdldl) are measured where they are installed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

# Sets the number of BLAS threads before NumPy is loaded.
from bench_solver import STIFFNESS, Scene, machine, markdown, write_csv

# isort: split
import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from torch import Tensor

from toile.physics.cloth import mesh_cloth
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.linear_solvers.analysis import forget_analyses
from toile.physics.implicit.linear_solvers.banded import BandedSolver
from toile.physics.implicit.linear_solvers.choice import banded_seconds, sparse_seconds
from toile.physics.implicit.linear_solvers.sparse import SparseSolver
from toile.physics.implicit.linearized import LinearizedRollout, Perturbation
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import Rollout, rollout
from toile.physics.state import State

FRAMES, RATE = 4, 30.0
COTTON = {"young": 300.0, "poisson": 0.3, "bending": 3e-5}
SOLVES = [
    "cloth",
    "unknowns",
    "solver",
    "analyse [ms]",
    "factorise [ms]",
    "solve [ms]",
    "solve 8 at once [ms]",
    "predicted [ms]",
    "residual",
    "note",
]
STEPS = ["vertices", "solver", "step [ms]", "Newton iterations per step", "tangent [ms]", "adjoint [ms]"]
PAGE = """\
# Linear solvers (`make linear-solvers`)

{machine}, 1 thread. Milliseconds of processor time, minimum / median: waiting for other programs is left out,
but caches and memory are shared with them.

## One linear system

The Hessian of one step without its indefinite parts, over the free vertices. *Chosen* is what a simulator
of that cloth takes; *predicted* is what the choice is made by: a factorisation and three solves (grids need
a gain of 2.5, so that published results keep their last digits). *Analyse* is work done once for a mesh;
libraries that cannot keep it have it within *factorise*. Residuals are relative to the right-hand side,
largest entry against largest entry.

{solves}

## Simulation and derivatives

Per step. *Step* is a Newton solve to 10⁻⁴ of a vertex's weight. Tangent and adjoint need one solve each with
the factors that a rollout with derivatives leaves behind; the rest is the coupling to the pinned vertices (a
whole waist here), which is a dense matrix.

{steps}
"""


def skirt(n_vertices: int) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """A cone from a waist of 0.7 m to a hem of 1.6 m, 0.6 m long: vertices (N, 3), faces, the waist.

    Rows are turned against each other and vertices moved a little, so that no two triangles are the same.
    """
    around = round((n_vertices * 2) ** 0.5)
    rows = round(n_vertices / around)
    i, j = np.meshgrid(np.arange(rows), np.arange(around), indexing="ij")
    rng = np.random.default_rng(0)
    inside = (i > 0) & (i < rows - 1)
    u = (i + inside * rng.uniform(-0.2, 0.2, i.shape)) / (rows - 1)
    angle = 2 * np.pi * (j + 0.5 * (i % 2) + rng.uniform(-0.2, 0.2, i.shape)) / around
    radius = (0.7 + 0.9 * u) / (2 * np.pi)
    height = np.sqrt(0.6**2 - (0.9 / (2 * np.pi)) ** 2)
    vertices = np.stack((radius * np.cos(angle), u * height, radius * np.sin(angle)), -1).reshape(-1, 3)
    faces = []
    for r in range(rows - 1):
        a, b = r * around + np.arange(around), r * around + (np.arange(around) + 1) % around
        c, d = a + around, b + around
        if r % 2 == 0:
            faces += [np.stack((a, b, c), 1), np.stack((b, d, c), 1)]
        else:
            faces += [np.stack((a, b, d), 1), np.stack((a, d, c), 1)]
    return (
        torch.from_numpy(vertices),
        torch.from_numpy(np.concatenate(faces).astype(np.int64)),
        tuple(range(around)),
    )


def swing(x: Tensor, simulator: ImplicitSimulator, *, linearize: bool = False) -> Rollout:
    """The skirt while its waist swings sideways and turns."""
    cloth = simulator.cloth
    t = torch.arange(FRAMES, dtype=torch.float64) / RATE
    waist = x[cloth.pinned]
    boundary = waist.repeat(FRAMES, 1, 1)
    angle = 0.3 * (1 - torch.cos(8 * t))[:, None]
    boundary[..., 0] = (
        waist[:, 0] * angle.cos() + waist[:, 2] * angle.sin() + 0.05 * torch.sin(6 * t)[:, None]
    )
    boundary[..., 2] = waist[:, 2] * angle.cos() - waist[:, 0] * angle.sin()
    gravity = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
    forces = (cloth.masses[:, None] * gravity).expand(1, FRAMES - 1, -1, 3)
    state = State.start(x[None], torch.zeros_like(x)[None], 1 / RATE, simulator.n_past)
    return rollout(simulator, state, cloth.material(**COTTON), forces, boundary[None], 1, linearize=linearize)


def milliseconds(call: Callable[[], object], repeats: int) -> str:
    """Minimum and median of the processor time."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        call()
        times.append(1e3 * (time.process_time() - begin))
    return f"{min(times):.3g} / {np.median(times):.3g}"


class System:
    """One matrix, as blocks and as a sparse matrix over the free unknowns.

    Args:
        name: of the cloth.
        simulator: of the cloth.
        x: positions (N, 3) [m].
        stiffness: coefficients of the energies.
    """

    def __init__(
        self, name: str, simulator: ImplicitSimulator, x: NDArray[np.float64], stiffness: object
    ) -> None:
        self.name, assembly = name, simulator.assembly
        self.pattern, self.pinned = assembly.pattern, assembly.pinned
        _, self.blocks = assembly.hessian(x, np.asarray(stiffness, np.float64), convex=True)
        self.diagonal, self.chosen = simulator.inertia, type(simulator.solver)
        rows, columns = self.pattern.rows, self.pattern.columns
        i = np.broadcast_to(3 * rows[:, None, None] + np.arange(3)[:, None], self.blocks.shape)
        j = np.broadcast_to(3 * columns[:, None, None] + np.arange(3), self.blocks.shape)
        n = 3 * self.pattern.n_vertices
        lower = sp.tril(sp.coo_array((self.blocks.ravel(), (i.ravel(), j.ravel())), shape=(n, n)))
        full = lower + sp.tril(lower, -1).T + sp.diags_array(np.repeat(self.diagonal, 3))
        free = np.flatnonzero(assembly.free.reshape(-1))
        self.matrix = sp.csc_array(full.tocsr()[free][:, free])
        self.free = free
        self.right = np.random.default_rng(0).normal(size=(8, self.pattern.n_vertices, 3))

    def row(
        self,
        solver: str,
        analyse: str,
        factorise: Callable[[], Callable[[NDArray[np.float64]], NDArray[np.float64]]],
        repeats: int,
        predicted: str = "",
        note: str = "",
    ) -> list[object]:
        """Measure; what ``factorise`` returns solves for (..., n_free)."""
        solve = factorise()
        one, eight = self.right[0].reshape(-1)[self.free], self.right.reshape(8, -1)[:, self.free]
        residual = np.abs(self.matrix @ solve(one) - one).max() / np.abs(one).max()
        print(self.name, solver, flush=True)
        return [
            self.name,
            self.matrix.shape[0],
            solver,
            analyse,
            milliseconds(factorise, repeats),
            milliseconds(lambda: solve(one), 3 * repeats),
            milliseconds(lambda: solve(eight), repeats),
            predicted,
            f"{residual:.0e}",
            note,
        ]

    def own(self, kind: type[BandedSolver] | type[SparseSolver], repeats: int) -> list[object]:
        """A row for a solver of the project."""
        forget_analyses()
        begin = time.process_time()
        solver = kind(self.pattern, self.pinned)
        analyse = f"{1e3 * (time.process_time() - begin):.3g}"

        def factorise() -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
            factor = solver.factorise(self.blocks, self.diagonal)
            assert factor is not None

            def solve(right: NDArray[np.float64]) -> NDArray[np.float64]:
                whole = np.zeros((*right.shape[:-1], 3 * self.pattern.n_vertices))
                whole[..., self.free] = right
                found = factor.solve(whole.reshape(*right.shape[:-1], -1, 3))
                return found.reshape(whole.shape)[..., self.free]

            return solve

        if isinstance(solver, BandedSolver):
            name, seconds, note = "banded", banded_seconds(solver), f"half bandwidth {solver.half_bandwidth}"
        else:
            analysis = solver.analysis
            name, seconds = "sparse", sparse_seconds(analysis)
            note = f"{analysis.n_values / 1e6:.2f} M entries, {analysis.flops / 1e6:.0f} Mflop"
        if self.chosen is kind:
            name += ", chosen"
        return self.row(name, analyse, factorise, repeats, f"{1e3 * seconds:.3g}", note)

    def library(self, name: str, repeats: int) -> list[object]:
        """A row for another library."""
        matrix = self.matrix
        n = matrix.shape[0]
        if name == "SuperLU":
            options = {"SymmetricMode": True}

            def superlu() -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
                factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
                return lambda right: factor.solve(right.T).T

            return self.row("SuperLU (scipy)", "", superlu, repeats, note="minimum degree, no pivoting")
        if name == "cholespy":
            import cholespy

            entries = matrix.tocoo()
            where = entries.row.astype(np.int32), entries.col.astype(np.int32)

            def cholmod() -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
                factor = cholespy.CholeskySolverD(n, *where, entries.data, cholespy.MatrixType.COO)

                def solve(right: NDArray[np.float64]) -> NDArray[np.float64]:
                    found = np.zeros_like(right.T, order="C")
                    factor.solve(np.ascontiguousarray(right.T), found)
                    return found.T

                return solve

            return self.row("CHOLMOD (cholespy)", "", cholmod, repeats, note="analyses anew every time")
        upper = sp.triu(matrix)
        if name == "qdldl":
            import qdldl

            first = sp.csc_matrix(upper)
            begin = time.process_time()
            factor = qdldl.Solver(first, upper=True)
            analyse = f"{1e3 * (time.process_time() - begin):.3g}"

            def simplicial() -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
                factor.update(first, upper=True)
                return lambda right: np.array([factor.solve(b) for b in np.atleast_2d(right)]).reshape(
                    right.shape
                )

            return self.row(
                "QDLDL", analyse, simplicial, repeats, note="analyse with the first factorisation"
            )
        import pypardiso

        rows = sp.csr_matrix(upper)
        rows.sort_indices()
        pardiso = pypardiso.PyPardisoSolver(mtype=2)
        empty = np.zeros((n, 1))
        pardiso.set_phase(11)
        begin = time.process_time()
        pardiso._call_pardiso(rows, empty)
        analyse = f"{1e3 * (time.process_time() - begin):.3g}"

        def mkl() -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
            pardiso.set_phase(22)
            pardiso._call_pardiso(rows, empty)
            pardiso.set_phase(33)
            return lambda right: pardiso._call_pardiso(
                rows, np.asfortranarray(np.atleast_2d(right).T)
            ).T.reshape(right.shape)

        return self.row("PARDISO (MKL)", analyse, mkl, repeats, note="holds one factor at a time")


def simulator_of(n_vertices: int) -> tuple[Tensor, ImplicitSimulator]:
    """The skirt at rest (N, 3) [m] and its simulator."""
    x, faces, waist = skirt(n_vertices)
    cloth = mesh_cloth(x, faces, 0.15, waist, flat=False)
    return x, ImplicitSimulator(cloth, 1 / RATE, BackwardEuler(), NewtonSettings(1e-4))


def systems(vertices: Sequence[int], grids: Sequence[int]) -> list[System]:
    found = []
    for g in grids:
        scene = Scene(g, 1, BDF2(), 2)
        found.append(System(f"grid {g}×{g}", scene.simulator, scene.start[0].numpy(), STIFFNESS))
    for n in vertices:
        x, simulator = simulator_of(n)
        cloth = simulator.cloth
        k = cloth.energies.coefficients(cloth.material(**COTTON).values)[0].numpy()
        found.append(System(f"skirt of {cloth.n_vertices}", simulator, 1.01 * x.numpy(), k))
    return found


def steps(n_vertices: int, kind: type[BandedSolver] | type[SparseSolver], repeats: int) -> list[object]:
    """Measure the rollout of one size with one solver."""
    x, simulator = simulator_of(n_vertices)
    simulator.solver = kind(simulator.assembly.pattern, simulator.assembly.pinned)
    cloth, per_step = simulator.cloth, FRAMES - 1
    linear = LinearizedRollout(simulator, motion := swing(x, simulator, linearize=True))
    rng = np.random.default_rng(1)
    n, pinned = cloth.n_vertices, len(cloth.pinned)
    change = Perturbation(
        rng.normal(size=(FRAMES - 1, n, 3)),
        rng.normal(size=cloth.energies.n_coefficients),
        rng.normal(size=(FRAMES, pinned, 3)),
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 3)),
    )
    gradient = rng.normal(size=(FRAMES, n, 3))

    def each(call: Callable[[], object], count: int) -> str:
        return " / ".join(f"{float(t) / per_step:.3g}" for t in milliseconds(call, count).split(" / "))

    print(n, kind.__name__, flush=True)
    return [
        n,
        kind.__name__.removesuffix("Solver").lower(),
        each(lambda: swing(x, simulator), repeats),
        f"{motion.newton_iterations / per_step:.1f}",
        each(lambda: linear.tangent(change), 3 * repeats),
        each(lambda: linear.adjoint(gradient), 3 * repeats),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vertices", type=int, nargs="+", default=[1000, 3000, 10000])
    parser.add_argument("--grids", type=int, nargs="*", default=[32, 63])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--output", type=Path, default=Path("docs/results/linear_solvers.md"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    libraries = ["SuperLU", *(name for name in ("cholespy", "pypardiso", "qdldl") if find_spec(name))]
    solves = []
    for system in systems(arguments.vertices, arguments.grids):
        solves += [system.own(kind, arguments.repeats) for kind in (BandedSolver, SparseSolver)]
        solves += [system.library(name, 3) for name in libraries]
    table = [steps(n, kind, 3) for n in arguments.vertices for kind in (BandedSolver, SparseSolver)]
    page = PAGE.format(machine=machine(), solves=markdown(SOLVES, solves), steps=markdown(STEPS, table))
    arguments.output.write_text(page)
    write_csv(arguments.output.with_suffix(".csv"), SOLVES, solves)
    write_csv(arguments.output.with_name(arguments.output.stem + "_steps.csv"), STEPS, table)


if __name__ == "__main__":
    main()
