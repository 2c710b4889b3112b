"""Arrays that a diagnosis leaves beside its report: tracked motion, gap on the cloth, screening."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from toile.diagnosis.record import GapReport
from toile.errors import InputError
from toile.reports.cloth_fields import ClothField

TRACKED_FILE, SCREENING_FILE = "tracked.npz", "screening.npz"
FRAMES_FILE = "gap_frames_vertices.npy"


@dataclass(frozen=True)
class Screening:
    """How every candidate fared before anything was refitted.

    Attributes:
        log_evidence: against the base model, by effect.
        unknown: the same for forces that no effect supplies.
        discrepancy: sizes of the forces that the base model needs [m/s²]: those that leave the balance of
            torques about the holders alone, and the others.
        base: log ratios of Y, S, B to their start values, and wind along two directions [m/s²], (5,).
        costs: of the base fit, one per pass.
    """

    log_evidence: Mapping[str, float]
    unknown: float
    discrepancy: tuple[float, float]
    base: npt.NDArray[np.float64]
    costs: npt.NDArray[np.float64]


@dataclass(frozen=True)
class DiagnosisArrays:
    """What there is; None or empty where a file is missing.

    Attributes:
        vertices: mean gap on the model's grid (h, w) [m].
        frames_vertices: gap of every frame (F, h, w) [m].
        positions: tracked motion (F, N, 3) [m] on the scene's grid, camera frame.
        screening: see Screening.
        config: resolved configuration (YAML text).
        acts_on: how strongly the effect that is named acts (h, w), 1 where most.
    """

    vertices: npt.NDArray[np.float64] | None = None
    frames_vertices: npt.NDArray[np.float64] | None = None
    positions: npt.NDArray[np.float64] | None = None
    screening: Screening | None = None
    config: str = field(default="", repr=False)
    acts_on: npt.NDArray[np.float64] | None = None

    @staticmethod
    def read(folder: Path, report: GapReport) -> DiagnosisArrays:
        """What a run folder holds beside its ``diagnosis.json``.

        Raises:
            InputError: a file is there and cannot be read.
        """
        where = report.where
        vertices, acts_on = (
            None if name is None else _array(folder / name) for name in (where.vertices, where.acts_on)
        )
        tracked = _arrays(folder / TRACKED_FILE, ("positions",))
        config = folder / "config.yaml"
        return DiagnosisArrays(
            vertices,
            _array(folder / FRAMES_FILE),
            None if tracked is None else np.asarray(tracked["positions"], np.float64),
            _screening(folder / SCREENING_FILE),
            config.read_text(encoding="utf-8") if config.is_file() else "",
            acts_on,
        )


def gap_field(
    arrays: DiagnosisArrays, grid: tuple[int, int], without: tuple[int, ...] = ()
) -> ClothField | None:
    """Distance of base model and tracked cloth [mm] on a grid, linearly interpolated; None if not written.

    Args:
        arrays: with the gap on the model's grid.
        grid: (H, W).
        without: frames that were held out; they have no value where nothing was written for them.
    """
    gap = arrays.frames_vertices
    if gap is None or gap.ndim != 3:
        return None
    rows, columns = _between(gap.shape[1], grid[0]), _between(gap.shape[2], grid[1])
    values = 1e3 * np.einsum("Hh,fhw,Ww->fHW", rows, gap, columns)
    for frame in without:
        if frame < len(values) and not gap[frame].any():
            values[frame] = np.nan
    note = (
        "Distance between the tracked cloth and the base model, which starts from the tracked motion and is "
        "then left to itself for a few frames. Errors of tracking are part of it: it is never zero, whatever "
        "the answer. Frames that were held out have none."
    )
    return ClothField("gap", "Distance", "mm", note, values)


def _between(n: int, m: int) -> npt.NDArray[np.float64]:
    """Linear interpolation (m, n) of n evenly spaced values at m."""
    at = np.linspace(0, n - 1, m)[:, None]
    weights: npt.NDArray[np.float64] = np.clip(1 - np.abs(at - np.arange(n)), 0, None)
    return weights


def _array(path: Path) -> npt.NDArray[np.float64] | None:
    if not path.is_file():
        return None
    try:
        return np.asarray(np.load(path, allow_pickle=False), np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise _unreadable(path, "an array of numbers", error) from error


def _arrays(path: Path, keys: tuple[str, ...]) -> dict[str, npt.NDArray[np.float64]] | None:
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as stored:
            return {key: stored[key] for key in keys}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise _unreadable(path, ", ".join(keys), error) from error


def _pair(values: npt.NDArray[np.float64]) -> tuple[float, float]:
    internal, external = values.reshape(-1)
    return float(internal), float(external)


def _screening(path: Path) -> Screening | None:
    found = _arrays(path, ("names", "log_evidence", "unknown", "discrepancy", "base", "costs"))
    if found is None:
        return None
    names = [str(name) for name in found["names"]]
    return Screening(
        dict(zip(names, found["log_evidence"].tolist(), strict=True)),
        float(found["unknown"]),
        _pair(found["discrepancy"]),
        np.asarray(found["base"], np.float64),
        np.asarray(found["costs"], np.float64),
    )


def _unreadable(path: Path, expected: str, error: Exception) -> InputError:
    return InputError(
        "A file of the diagnosis cannot be read",
        where=str(path),
        expected=expected,
        got=f"{type(error).__name__}: {error}",
    )
