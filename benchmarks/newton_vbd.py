"""Our implicit steps beside newton's vertex block descent on the CPU: `make newton NEWTON_PYTHON=<python>`.

The same problem for both: a skirt without bending and without body, whose waist is moved sideways, with the
same masses and the same stable neo-Hookean membrane (newton 1.8 has ours), by implicit Euler. Both minimise
the same potential, so error is the distance to our steps solved to rounding, and both can be compared at
equal error. One thread, seconds of the processor; newton computes in single precision. Newton is no
dependency: a Python that has it is asked for.

    python benchmarks/newton_vbd.py --python <python that has newton> [--output docs/results/newton_vbd.md]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from toile.atomic_file import write_text
from toile.capture.body.subject import load_subject
from toile.capture.garments import Garment
from toile.capture.garments.patterns import make_skirt
from toile.capture.layer.layer import GRAVITY
from toile.physics.cloth import mesh_cloth
from toile.physics.energies.membrane import lame_constants
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.state import State

SIZES = (500, 1000, 1500, 3000)
STEPS, STEP = 6, 1 / 120
ACCELERATION = 10.0
"""Of the waist, sideways [m/s²]."""
TOLERANCES = (10.0, 1.0, 0.1, 1e-2, 1e-3)
EXACT = 1e-8
ITERATIONS = (10, 20, 50, 100, 200, 500, 1000)


def ways(garment: Garment) -> Tensor:
    """Where the waist is after every step (S, A, 3) [m]."""
    times = STEP * torch.arange(1, STEPS + 1, dtype=torch.float64)
    aside = torch.zeros(STEPS, 1, 3, dtype=torch.float64)
    aside[:, 0, 0] = 0.5 * ACCELERATION * times**2
    return garment.rest_vertices[garment.attached] + aside


def ours(garment: Garment, tolerance: float) -> tuple[np.ndarray, float]:
    """Positions (N, 3) after the steps, and seconds of the processor for each."""
    m = garment.material
    held = tuple(garment.attached.tolist())
    cloth = mesh_cloth(garment.rest_vertices, garment.faces, m.density, held)
    simulator = ImplicitSimulator(cloth, STEP, BackwardEuler(), NewtonSettings(tolerance))
    material = cloth.material(young=m.young, poisson=m.poisson, bending=0.0)
    weight = torch.zeros_like(garment.rest_vertices)
    weight[:, 1] = -GRAVITY * cloth.masses
    x = garment.rest_vertices[None]
    with torch.no_grad():
        for warm in (True, False):
            state = State.start(x, torch.zeros_like(x), STEP, simulator.n_past)
            begin = time.process_time()
            for ends in ways(garment)[: 1 if warm else STEPS]:
                # Where the vertices would go by themselves, as newton begins as well.
                free = state.positions + STEP * state.velocities
                state = simulator.step(state, material, weight[None], ends[None], free).state
    return state.positions[0].numpy(), (time.process_time() - begin) / STEPS


def newtons(garment: Garment, python: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions (K, N, 3) after the steps for every number of iterations, and seconds (K,) for each step."""
    m = garment.material
    cloth = mesh_cloth(garment.rest_vertices, garment.faces, m.density, tuple(garment.attached.tolist()))
    lame, mu = lame_constants(torch.tensor(m.young), torch.tensor(m.poisson)).tolist()
    with tempfile.TemporaryDirectory() as scratch:
        problem, result = Path(scratch) / "problem.npz", Path(scratch) / "result.npz"
        np.savez(
            problem,
            vertices=garment.rest_vertices.numpy(),
            faces=garment.faces.numpy(),
            masses=cloth.masses.numpy(),
            attached=garment.attached.numpy(),
            ways=ways(garment).numpy(),
            time_step=STEP,
            gravity=GRAVITY,
            lame=lame,
            mu=mu,
            iterations=ITERATIONS,
        )
        script = Path(__file__).with_name("newton_steps.py")
        command = [python, str(script), str(problem), str(result)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        with np.load(result) as found:
            return found["positions"].astype(np.float64), found["seconds"]


def compared(vertices: int, python: str) -> list[dict]:
    """Rows of one size."""
    garment = make_skirt(load_subject("default"), vertices)
    free = np.setdiff1d(np.arange(len(garment.rest_vertices)), garment.attached.numpy())
    exact, _ = ours(garment, EXACT)

    def row(solver: str, setting: str, x: np.ndarray, seconds: float) -> dict:
        away = 1e3 * np.linalg.norm(x - exact, axis=1)[free]
        return {
            "vertices": len(exact),
            "solver": solver,
            "setting": setting,
            "error_rms_mm": float(np.sqrt(np.square(away).mean())),
            "error_max_mm": float(away.max()),
            "seconds_per_step": float(seconds),
        }

    rows = [row("ours", f"tolerance {t:g}", *ours(garment, t)) for t in TOLERANCES]
    found = zip(ITERATIONS, *newtons(garment, python), strict=True)
    return rows + [row("newton", f"{k} iterations", x, s) for k, x, s in found]


def at_equal_error(table: pd.DataFrame) -> pd.DataFrame:
    """The fastest of ours with no larger an error than newton's best, and that."""
    rows = []
    for vertices, part in table.groupby("vertices"):
        best = part[part.solver == "newton"].nsmallest(1, "error_rms_mm").iloc[0]
        good = part[(part.solver == "ours") & (part.error_rms_mm <= best.error_rms_mm)]
        mine = good.nsmallest(1, "seconds_per_step").iloc[0]
        rows.append(
            {
                "vertices": vertices,
                "newton": best.setting,
                "newton_error_rms_mm": best.error_rms_mm,
                "newton_seconds": best.seconds_per_step,
                "ours": mine.setting,
                "our_error_rms_mm": mine.error_rms_mm,
                "our_seconds": mine.seconds_per_step,
                "times_faster": best.seconds_per_step / mine.seconds_per_step,
            }
        )
    return pd.DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--python", default=sys.executable, help="a Python that has newton")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--output", type=Path, default=Path("docs/results/newton_vbd.md"))
    arguments = parser.parse_args()
    asked = [arguments.python, "-c", "import newton; print(newton.__version__)"]
    try:
        version = subprocess.run(asked, capture_output=True, text=True, check=False)
    except OSError as error:
        sys.exit(f"error: {arguments.python}: {error.strerror}")
    if version.returncode:
        print(
            f"skipped: {arguments.python} has no newton. Make an environment of its own for it (python -m "
            "venv newton; newton/bin/pip install newton) and say make newton NEWTON_PYTHON=newton/bin/python."
        )
        return
    torch.set_num_threads(1)
    table = pd.DataFrame([row for n in arguments.sizes for row in compared(n, arguments.python)])
    text = (
        "# Steps beside newton's vertex block descent (`make newton`)\n\n"
        f"newton {version.stdout.split()[-1]}, SolverVBD on the CPU, and ours: {STEPS} steps of 1/120 s of a "
        "skirt without bending and body whose waist is moved sideways, the same membrane, masses and start. "
        "Error after the steps against ours solved to rounding; seconds of the processor for a step, one "
        "thread, one run. Ours: largest out-of-balance force on a vertex as a share of its weight.\n\n"
        "## At newton's smallest error\n\n"
        + at_equal_error(table).to_markdown(index=False, floatfmt=".3g")
        + "\n\n## All\n\n"
        + table.to_markdown(index=False, floatfmt=".3g")
        + "\n"
    )
    print(text)
    write_text(arguments.output, text)


if __name__ == "__main__":
    main()
