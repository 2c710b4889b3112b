"""Errors against the converged solver: of one step, and of a motion from rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from surrogate.cases import Case
from surrogate.contenders import FLOOR, SOLVER, Build
from surrogate.reference import perturbed, reference
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

ACCELERATION = "acceleration error of one step"
BALANCE = "out-of-balance force of one step"
MOTION = "vertex error [% of width]"
LAST = "vertex error of the last frame [% of width]"
# One step is measured from every so many states of the solver's motion.
STRIDE = 5


@torch.no_grad()
def accuracy(cases: list[Case], contenders: dict[str, Build], cache: Path) -> pd.DataFrame:
    """One row per case and contender.

    A case whose solver does not converge has one row, of the solver, that says so.
    """
    rows: list[dict[str, object]] = []
    for number, case in enumerate(cases, 1):
        about = {"seed": case.seed, "integrator": type(case.integrator).__name__, **case.numbers}
        truth = reference(case, cache)
        rows.append({**about, "contender": SOLVER, "failure": truth.failure})
        print(f"  {case.regime} {number}/{len(cases)} {truth.failure}", flush=True)
        if truth.positions is None:
            continue
        moved = reference(perturbed(case), cache)
        floor = {} if moved.positions is None else _motion_errors(moved.positions, truth.positions, case)
        rows.append({**about, "contender": FLOOR, "failure": moved.failure, **floor})
        for name, build in contenders.items():
            simulator = build(case.cloth, case.time_step, case.integrator)
            errors = _one_step(simulator, case, truth.positions)
            start = case.start(simulator.n_past)
            motion = rollout(simulator, start, case.material, case.forces, case.boundary, 1, throw=False)
            errors |= _motion_errors(motion.positions[0], truth.positions, case)
            finite = bool(np.isfinite(list(errors.values())).all())
            rows.append({**about, "contender": name, "failure": "" if finite else "not finite", **errors})
    return pd.DataFrame(rows)


def _motion_errors(positions: Tensor, truth: Tensor, case: Case) -> dict[str, float]:
    """Mean distance of the vertices (T + 1, N, 3) over the frames after the first, and in the last one."""
    distances = 100 * (positions - truth).norm(dim=-1).mean(-1)[1:] / case.width
    return {MOTION: float(distances.mean()), LAST: float(distances[-1])}


def _one_step(simulator: LinearizableSimulator, case: Case, truth: Tensor) -> dict[str, float]:
    """Relative errors of single steps from states of the solver, mean over the states."""
    accelerations, forces = [], []
    free = torch.ones(case.cloth.n_vertices, dtype=torch.bool)
    free[case.cloth.pinned] = False
    for n in range(0, case.n_steps, STRIDE):
        state = _state(truth, n, simulator.n_past, case)
        external = case.forces[:, n]
        x = simulator.step(state, case.material, external, case.boundary[:, n + 1]).state.positions[0]
        formula = case.integrator.formula(n)
        history = torch.cat((state.positions, state.past[0]))
        prediction = torch.tensordot(
            torch.tensor(formula.prediction, dtype=torch.float64), history[: len(formula.prediction)], 1
        )
        # Both accelerations are differences to the same prediction over the same (β h)².
        away = (x - truth[n + 1])[free].norm(dim=-1).mean()
        accelerations.append(float(away / (truth[n + 1] - prediction)[free].norm(dim=-1).mean()))
        residual = _out_of_balance(simulator, case, x, prediction, external[0], formula.effective_step)
        forces.append(float(residual[free].norm(dim=-1).mean() / external[0, free].norm(dim=-1).mean()))
    return {ACCELERATION: float(np.mean(accelerations)), BALANCE: float(np.mean(forces))}


def _state(truth: Tensor, n: int, n_past: int, case: Case) -> State:
    """The solver's motion (T + 1, N, 3) at step n as a state; before the start it was at rest."""
    past = torch.stack([truth[max(n - 1 - k, 0)] for k in range(n_past)])[None]
    velocities = (truth[n] - past[0, 0]) / case.time_step
    return State(truth[n][None], velocities[None], past, n, past.new_zeros(1))


def _out_of_balance(
    simulator: LinearizableSimulator, case: Case, x: Tensor, prediction: Tensor, force: Tensor, beta: float
) -> Tensor:
    """Eq. 13 in float64, (N, 3) [N]."""
    k = case.material.values[0]
    internal = torch.tensordot(k, torch.from_numpy(simulator.assembly.gradients(x.numpy())), 1)
    inertia = case.cloth.masses / (beta * case.time_step) ** 2
    return inertia[:, None] * (prediction - x) - internal + force
