"""The arrays that stand beside the report of a diagnosis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toile.atomic_file import written_atomically
from toile.diagnosis.answer import Weighed
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.results import StageResults

Array = NDArray[np.float64]

VERTICES_FILE = "gap_vertices.npy"
ACTS_ON_FILE = "acts_on_vertices.npy"
FRAMES_FILE = "gap_frames_vertices.npy"
SCREENING_FILE = "screening.npz"
HELD_OUT_FILE = "held_out.npz"
"""Predicted positions of the held-out frames on the scene's grid, by what was in the model."""


def write_arrays(problem: DiagnosisProblem, found: StageResults, judged: Weighed, folder: Path) -> None:
    """Write what pages and measurements of a diagnosis read beside its report.

    Args:
        problem: the clip.
        found: by the stages.
        judged: what speaks for every hypothesis.
        folder: of the run.
    """
    findings, fit = judged.findings, found.base.fit
    screened, predictions = found.converged.screening.findings, found.predictions
    prolong = problem.levels(found.tracked)[-1][0].prolong
    _write_several(
        folder / HELD_OUT_FILE,
        {"frames": np.array(found.held_out.frames, int)}
        | {name: np.einsum("vn,fnc->fvc", prolong, x) for name, x in found.held_out.positions.items()},
    )
    _write(folder / VERTICES_FILE, found.maps.vertices)
    _write(folder / FRAMES_FILE, found.maps.distances.astype(np.float32))
    _write_several(
        folder / SCREENING_FILE,
        {
            "names": np.array(list(judged.evidence)),
            "log_evidence": np.array(list(judged.evidence.values())),
            "first_order": np.array(
                [screened[n].log_evidence if n in screened else np.nan for n in findings]
            ),
            "in_sample": np.array([f.log_evidence for f in findings.values()]),
            "prediction_gain": np.array([predictions.gains.get(name, np.nan) for name in findings]),
            "size": np.array([predictions.sizes.get(name, np.nan) for name in findings]),  # over the width
            "unknown": np.array(found.race.beyond),
            "left": np.array(judged.left),
            "discrepancy": np.array(found.race.discrepancy),  # internal, external
            "base": fit.values,
            "time_step_error": np.array(found.step_error.distance),
            "width": np.array(problem.mechanics(found.tracked, found.base).width),
            "costs": np.array(fit.history),
        },
    )


def _write_several(path: Path, arrays: dict[str, Array]) -> None:
    with written_atomically(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]


def _write(path: Path, array: NDArray[np.floating]) -> None:
    with written_atomically(path) as temporary:
        np.save(temporary, array)
