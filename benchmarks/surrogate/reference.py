"""Motions by the converged solver, kept in a folder: they are what takes long."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surrogate.cases import Case
from surrogate.contenders import CONVERGED, solver
from toile.atomic_file import written_atomically
from toile.physics.rollout import rollout
from toile.physics.simulator import SimulationError

PERTURBATION = 1e-4  # edge lengths


@dataclass(frozen=True)
class Reference:
    """A motion by the solver.

    Attributes:
        positions: (T + 1, N, 3) [m]; None where a step did not converge.
        failure: why, "" otherwise.
    """

    positions: Tensor | None
    failure: str


def reference(case: Case, folder: Path) -> Reference:
    """The motion of a case, computed once."""
    path = folder / f"{case.regime}_{case.seed}_{_key(case)}.npz"
    if path.exists():
        with np.load(path) as stored:
            failure = str(stored["failure"])
            return Reference(None if failure else torch.from_numpy(stored["positions"]), failure)
    simulator = solver(case.cloth, case.time_step, case.integrator)
    failure, positions = "", torch.zeros(0)
    try:
        motion = rollout(
            simulator, case.start(simulator.n_past), case.material, case.forces, case.boundary, 1
        )
        positions = motion.positions[0]
    except SimulationError as error:
        failure = str(error).partition(" (")[0]
    with written_atomically(path) as temporary:
        np.savez(temporary, positions=positions.numpy(), failure=failure)
    return Reference(None if failure else positions, failure)


def perturbed(case: Case) -> Case:
    """The same with every free vertex of the start moved once; no simulator can foresee more than this."""
    generator = torch.Generator().manual_seed(case.seed)
    noise = torch.randn(case.positions.shape, generator=generator, dtype=torch.float64)
    noise[:, case.cloth.pinned] = 0
    return replace(case, positions=case.positions + PERTURBATION * case.edge * noise)


def _key(case: Case) -> str:
    """Changes with anything that the motion depends on."""
    digest = hashlib.sha256()
    material = (case.material["stretching"], case.material["shearing"], case.material["bending"])
    for tensor in (case.positions, *material, case.forces, case.boundary, case.cloth.rest_lengths):
        digest.update(tensor.contiguous().numpy().tobytes())
    names = (type(case.integrator).__name__, case.time_step, case.cloth.pinned.tolist(), asdict(CONVERGED))
    digest.update(repr(names).encode())
    return digest.hexdigest()[:16]
