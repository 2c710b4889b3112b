"""Gradients through motions, against those of the converged solver."""

from __future__ import annotations

import pandas as pd
import torch
from torch import Tensor

from surrogate.cases import FIRST_SEED, Case, fits_case
from surrogate.contenders import Build, solver
from surrogate.saddles import Saddles
from toile.physics.cloth import grid_material
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

LAST_FRAMES = 10
TARGET = 0.02  # deviation of the target from the solver's motion, of the width
GROUPS = ("stretching", "shearing", "bending", "log stiffnesses", "forces", "boundary", "initial velocity")
# Not the cloths of the accuracy tables.
_FIRST_SEED = FIRST_SEED["fits"] + 500_000


def gradients(contenders: dict[str, Build], seeds: int, grid: tuple[int, int], n_steps: int) -> pd.DataFrame:
    """One row per seed, contender and group of parameters: cosine and ratio of norms.

    "saddles" are steps at whose positions the Hessian is not positive definite: no implicit derivative there.
    """
    rows: list[dict[str, object]] = []
    for seed in range(_FIRST_SEED, _FIRST_SEED + seeds):
        case = fits_case(seed, grid, n_steps)
        exact = solver(case.cloth, case.time_step, case.integrator)
        with torch.no_grad():
            motion = _motion(exact, case, _parameters(case))
        target = motion + _deviation(case, len(motion))
        with Saddles():
            truth, _ = _gradients(exact, case, target)
        for name, build in contenders.items():
            simulator = build(case.cloth, case.time_step, case.integrator)
            saddles = Saddles()
            try:
                with saddles:
                    found, positions = _gradients(simulator, case, target)
            except FloatingPointError as error:
                rows.append({"seed": seed, "contender": name, "failure": str(error)})
                continue
            error_percent = 100 * float((positions - motion).norm(dim=-1).mean()) / case.width
            for group in GROUPS:
                a, b = found[group].reshape(-1), truth[group].reshape(-1)
                rows.append(
                    {
                        "seed": seed,
                        "contender": name,
                        "group": group,
                        "cosine": float(a @ b / (a.norm() * b.norm())),
                        "ratio": float(a.norm() / b.norm()),
                        "vertex error [% of width]": error_percent,
                        "saddles": saddles.count,
                        "failure": "",
                    }
                )
        print(f"  seed {seed} done", flush=True)
    return pd.DataFrame(rows)


def _parameters(case: Case) -> dict[str, Tensor]:
    """Leaves of the computation."""
    material = case.material
    given = {
        "stretching": material["stretching"],
        "shearing": material["shearing"],
        "bending": material["bending"],
        "forces": case.forces,
        "boundary": case.boundary,
        "initial velocity": torch.zeros_like(case.positions),
    }
    return {name: value.clone().requires_grad_() for name, value in given.items()}


def _motion(simulator: LinearizableSimulator, case: Case, parameters: dict[str, Tensor]) -> Tensor:
    """The last frames, (F, N, 3) [m]."""
    state = State.start(case.positions, parameters["initial velocity"], case.time_step, simulator.n_past)
    material = grid_material(*(parameters[name] for name in ("stretching", "shearing", "bending")))
    motion = rollout(simulator, state, material, parameters["forces"], parameters["boundary"], 1, throw=False)
    return motion.positions[0, -LAST_FRAMES:]


def _gradients(
    simulator: LinearizableSimulator, case: Case, target: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """Of the summed squared distance to the target, and the last frames."""
    parameters = _parameters(case)
    positions = _motion(simulator, case, parameters)
    (positions - target).square().sum().backward()  # type: ignore[no-untyped-call]
    found = {name: p.grad for name, p in parameters.items() if p.grad is not None}
    # With respect to logarithms, the only scale on which the three can stand in one vector.
    logs = [found[name] * parameters[name].detach() for name in ("stretching", "shearing", "bending")]
    return found | {"log stiffnesses": torch.cat(logs)}, positions.detach()


def _deviation(case: Case, n_frames: int) -> Tensor:
    """A smooth random displacement of the vertices, the same in all frames, (F, N, 3) [m]."""
    assert case.cloth.grid is not None
    generator = torch.Generator().manual_seed(case.seed)
    coarse = torch.randn((1, 3, 4, 4), generator=generator, dtype=torch.float64)
    fine = torch.nn.functional.interpolate(coarse, case.cloth.grid, mode="bicubic", align_corners=True)
    return TARGET * case.width * fine[0].permute(1, 2, 0).reshape(1, -1, 3).expand(n_frames, -1, -1)
