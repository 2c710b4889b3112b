"""Speed of the implicit solver on triangle meshes: step, tangent and adjoint at 1k, 3k and 10k vertices.

``python benchmarks/bench_mesh_solver.py [--vertices 1000 3000 10000] [--threads 1] [--csv table.csv]`` prints
a Markdown table. The scene: a skirt, a truncated cone of cotton whose waist is pinned and swings, neo-Hookean
membrane and dihedral bending, five frames at 30 Hz, one step each, backward Euler.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

# Sets the number of BLAS threads before NumPy is loaded.
from bench_solver import machine, show

# isort: split
import numpy as np
import torch
from torch import Tensor

from toile.physics.cloth import Cloth, mesh_cloth
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.implicit.linearized import LinearizedRollout, Perturbation
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import Rollout, rollout
from toile.physics.state import State

FRAMES, RATE = 5, 30.0
COTTON = {"young": 300.0, "poisson": 0.3, "bending": 3e-5}
HEADER = [
    "vertices",
    "solver",
    "refactorise + solve [ms]",
    "assemble Hessian [ms]",
    "step [ms]",
    "Newton iterations per step",
    "tangent, per step [ms]",
    "adjoint, per step [ms]",
]


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


def swing(cloth: Cloth, x: Tensor, simulator: ImplicitSimulator, *, linearize: bool = False) -> Rollout:
    """The skirt while its waist swings sideways and turns."""
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


def seconds(call: Callable[[], object], repeats: int) -> float:
    """Median [s]."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def row(n_vertices: int, repeats: int) -> list[object]:
    """Measure one size."""
    x, faces, waist = skirt(n_vertices)
    cloth = mesh_cloth(x, faces, 0.15, waist, flat=False)
    simulator = ImplicitSimulator(cloth, 1 / RATE, BackwardEuler(), NewtonSettings(1e-4))
    swing(cloth, x, simulator)  # compiles the kernels
    begin = time.perf_counter()
    motion = swing(cloth, x, simulator)
    step = (time.perf_counter() - begin) / (FRAMES - 1)
    at = motion.positions[0, -1].numpy()
    k = cloth.energies.coefficients(cloth.material(**COTTON).values)[0].numpy()
    assembly, solver = simulator.assembly, simulator.solver
    _, blocks = assembly.hessian(at, k, convex=True)
    right = np.random.default_rng(0).normal(size=at.shape)

    def refactorise_and_solve() -> None:
        factor = solver.factorise(blocks, simulator.inertia)
        assert factor is not None
        factor.solve(right)

    linear = LinearizedRollout(simulator, swing(cloth, x, simulator, linearize=True))
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
    linear_solve = seconds(refactorise_and_solve, repeats)
    assemble = seconds(lambda: assembly.hessian(at, k, convex=True), repeats)
    tangent = seconds(lambda: linear.tangent(change), 3) / (FRAMES - 1)
    adjoint = seconds(lambda: linear.adjoint(gradient), 3) / (FRAMES - 1)
    return [
        cloth.n_vertices,
        type(solver).__name__,
        f"{1e3 * linear_solve:.1f}",
        f"{1e3 * assemble:.1f}",
        f"{1e3 * step:.0f}",
        f"{motion.newton_iterations / (FRAMES - 1):.1f}",
        f"{1e3 * tangent:.1f}",
        f"{1e3 * adjoint:.1f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vertices", type=int, nargs="+", default=[1000, 3000, 10000])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1, help="threads of LAPACK")
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table = [row(n, arguments.repeats) for n in arguments.vertices]
    print(f"{machine()}, {arguments.threads} thread(s); medians\n")
    show(HEADER, table, arguments.csv)


if __name__ == "__main__":
    main()
