"""Speed of the implicit solver: its parts, Newton steps cold and warm, adjoints and tangents.

``python benchmarks/bench_solver.py [--grid 32] [--substeps 1 2 4] [--threads 1] [--csv table.csv]`` prints a
Markdown table. The scene: a cloth of 0.55 m side pinned at two corners that sway and come closer, released
from a smooth bend, 16 frames at 30 Hz, BDF2.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

# The number of BLAS threads is read when NumPy is loaded; toile.cli sets it where it is not set.
_THREADS = sys.argv[sys.argv.index("--threads") + 1] if "--threads" in sys.argv[:-1] else "1"
os.environ["OPENBLAS_NUM_THREADS"] = _THREADS

import toile.cli  # noqa: E402, F401

# isort: split
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
import torch  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from toile.physics.cloth import grid_cloth, grid_material  # noqa: E402
from toile.physics.implicit.integrators import BDF2, Integrator  # noqa: E402
from toile.physics.implicit.linear_solvers.base import Factor  # noqa: E402
from toile.physics.implicit.linearized import LinearizedRollout, Perturbation  # noqa: E402
from toile.physics.implicit.newton import NewtonSettings  # noqa: E402
from toile.physics.implicit.simulator import ImplicitSimulator  # noqa: E402
from toile.physics.rollout import Rollout, rollout  # noqa: E402
from toile.physics.state import State  # noqa: E402

FRAME_RATE = 30.0
SIDE = 0.55  # [m]
STIFFNESS = np.array([100.0, 2e-4, 1e-5])  # Y [N/m], S and B [N·m] at 32×32 vertices
HEADER = ["what", "sub-steps", "median [ms]", "spread [ms]", "note"]


def machine() -> str:
    """Processor, cores and versions, for the caption of a table."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} CPUs, {platform.system()}, Python {platform.python_version()}"


def milliseconds(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median and half the interquartile range of the time of a call, after one to warm up [ms]."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    low, median, high = np.percentile(times, [25, 50, 75])
    return float(median), float(high - low) / 2


def show(header: Sequence[str], rows: Sequence[Sequence[object]], path: Path | None) -> None:
    """Print the table in Markdown, and write it as CSV with the machine in a last column."""
    table = pd.DataFrame(rows, columns=list(header))
    print(table.to_markdown(index=False, disable_numparse=True))
    if path is not None:
        table.assign(machine=machine()).to_csv(path, index=False)


class Scene:
    """Inputs of the benchmark's rollout."""

    def __init__(self, grid: int, substeps: int, integrator: Integrator, frames: int) -> None:
        self.substeps, self.frames = substeps, frames
        self.cloth = grid_cloth((grid, grid), (SIDE, SIDE), 0.2, (0, grid - 1))
        h = 1 / FRAME_RATE / substeps
        self.simulator = ImplicitSimulator(self.cloth, h, integrator, NewtonSettings())
        side = torch.linspace(0, SIDE, grid, dtype=torch.float64)
        i, j = torch.meshgrid(side, side, indexing="ij")
        # A roll of constant arc length along j, so that the bend does not stretch the cloth.
        angle = 0.5 * torch.sin(2 * torch.pi * j / SIDE + 0.8 * i / SIDE)
        step = SIDE / (grid - 1)
        across, depth = step * torch.cos(angle).cumsum(1), step * torch.sin(angle).cumsum(1)
        self.start = torch.stack((across - SIDE / 2, i, 1.2 + depth), -1).reshape(1, -1, 3)
        t = torch.arange(frames, dtype=torch.float64) / FRAME_RATE
        self.boundary = self.start[:, None, self.cloth.pinned].repeat(1, frames, 1, 1)
        self.boundary[..., 2] += 0.05 * (1 - torch.cos(6 * t))[None, :, None]
        self.boundary[:, :, 0, 0] += 0.02 * (1 - torch.cos(4 * t))
        gravity = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
        self.forces = (self.cloth.masses[:, None] * gravity).expand(1, frames - 1, -1, 3).contiguous()
        self.material = grid_material(*torch.from_numpy(STIFFNESS)[:, None].unbind(0))

    def run(self, scale: float = 1.0, warm_start: torch.Tensor | None = None, **more: bool) -> Rollout:
        """The rollout, with the material scaled by a factor."""
        state = State.start(
            self.start, torch.zeros_like(self.start), self.simulator.time_step, self.simulator.n_past
        )
        m = self.material
        material = grid_material(m["stretching"] * scale, m["shearing"] * scale, m["bending"] * scale)
        return rollout(
            self.simulator, state, material, self.forces, self.boundary, self.substeps, warm_start, **more
        )


def hanging_cloth(
    grid: int, substeps: int, integrator: Integrator, frames: int
) -> tuple[ImplicitSimulator, Rollout, NDArray[np.float64]]:
    """The simulator, a rollout of the scene and the stiffnesses."""
    scene = Scene(grid, substeps, integrator, frames)
    return scene.simulator, scene.run(), STIFFNESS


def parts(grid: int, repeats: int) -> list[list[object]]:
    """Assembly, factorisation and solve at a state in motion."""
    simulator, motion, k = hanging_cloth(grid, 2, BDF2(), 16)
    assembly, x = simulator.assembly, motion.positions[0, -1].numpy()
    _, blocks = assembly.hessian(x, k, convex=False)

    def factorise() -> Factor | None:
        return simulator.solver.factorise(blocks, simulator.inertia)

    factor = factorise()
    if factor is None:
        raise RuntimeError("the Hessian is not positive definite at the state of the benchmark")
    right = np.random.default_rng(0).normal(size=x.shape)
    calls: dict[str, Callable[[], object]] = {
        "energies": lambda: assembly.energies(x),
        "gradients": lambda: assembly.gradients(x),
        "Hessian, gradients": lambda: assembly.hessian(x, k, convex=False),
        "factorisation": factorise,
        "solve": lambda: factor.solve(right),
    }
    rows: list[list[object]] = []
    for name, call in calls.items():
        median, spread = milliseconds(call, repeats)
        rows.append([name, "", f"{median:.2f}", f"{spread:.2f}", ""])
    return rows


def steps(grid: int, substeps: int, repeats: int) -> list[list[object]]:
    """Whole steps with a number of sub-steps per frame; times per step."""
    scene = Scene(grid, substeps, BDF2(), 16)
    n = 15 * substeps
    earlier = scene.run()
    linearized = scene.run(linearize=True)
    linear = LinearizedRollout(scene.simulator, linearized)
    rng = np.random.default_rng(0)
    vertices = grid * grid
    change = Perturbation(
        rng.normal(size=(15, vertices, 3)),
        rng.normal(size=3),
        rng.normal(size=(16, 2, 3)),
        rng.normal(size=(vertices, 3)),
        rng.normal(size=(vertices, 3)),
    )
    gradient = rng.normal(size=(16, vertices, 3))
    warm = scene.run(1.02, earlier.all_positions)
    far = scene.run(1.5, earlier.all_positions)

    def iterations(motion: Rollout) -> str:
        return f"{motion.newton_iterations / n:.2f} Newton iterations per step"

    start = earlier.all_positions
    calls: list[tuple[str, Callable[[], object], str]] = [
        ("step, cold", scene.run, iterations(earlier)),
        ("step, warm, stiffness +2 %", lambda: scene.run(1.02, start), iterations(warm)),
        ("step, warm, stiffness +50 %", lambda: scene.run(1.5, start), iterations(far)),
        ("step, warm, +2 %, linearised", lambda: scene.run(1.02, start, linearize=True), iterations(warm)),
        ("tangent", lambda: linear.tangent(change), "per step"),
        ("adjoint", lambda: linear.adjoint(gradient), "per step"),
    ]
    rows: list[list[object]] = []
    for name, call, note in calls:
        median, spread = milliseconds(call, repeats)
        rows.append([name, substeps, f"{median / n:.2f}", f"{spread / n:.2f}", note])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grid", type=int, default=32, help="vertices per side")
    parser.add_argument("--substeps", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--repeats", type=int, default=25, help="of single calls; rollouts a fifth of that")
    parser.add_argument("--threads", type=int, default=1, help="threads of LAPACK")
    parser.add_argument("--csv", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table = parts(arguments.grid, arguments.repeats)
    for substeps in arguments.substeps:
        table += steps(arguments.grid, substeps, max(3, arguments.repeats // 5))
    print(f"{machine()}, {arguments.threads} LAPACK thread(s); {arguments.grid}×{arguments.grid} vertices\n")
    show(HEADER, table, arguments.csv)
    print("\nMedian and half the interquartile range; rollouts of 16 frames, times per sub-step.")


if __name__ == "__main__":
    main()
