"""What a run leaves on disk, and how to read it back.

::

    run/
      config.yaml       the resolved configuration, as text
      git_revision      revision of the code
      metrics.json      numbers, with their protocols
      trajectory.npz    positions (F, H, W, 3) float64 [m], camera frame; fps; one array per parameter
      history.csv       one row per optimisation cycle
      chamfer.csv       Chamfer distance over the cycles, where there is ground truth
      tensorboard/      events for TensorBoard
      overlay.mp4       observed | rendered | difference | wireframe (overlay.gif where there is no encoder)
      figures/          PNG figures
      index.html        the result page
      failure.txt       why the run failed, where it did

Every file is written under a temporary name and then renamed, so a file that exists is complete.
"""

from __future__ import annotations

import json
import subprocess
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from toile.atomic_file import write_text, written_atomically
from toile.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

T = TypeVar("T")

RESERVED_ARRAYS = ("positions", "fps")


@dataclass(frozen=True)
class RunFolder:
    """Paths of the files of one run; see the module's text for what they hold."""

    path: Path

    @property
    def config(self) -> Path:
        """Resolved configuration (YAML text)."""
        return self.path / "config.yaml"

    @property
    def git_revision(self) -> Path:
        """Revision of the code."""
        return self.path / "git_revision"

    @property
    def metrics(self) -> Path:
        """Numbers with their protocols (JSON)."""
        return self.path / "metrics.json"

    @property
    def trajectory(self) -> Path:
        """Positions and parameters (NPZ)."""
        return self.path / "trajectory.npz"

    @property
    def history(self) -> Path:
        """One row per optimisation cycle (CSV)."""
        return self.path / "history.csv"

    @property
    def dashboard(self) -> Path:
        """Folder of TensorBoard's events."""
        return self.path / "tensorboard"

    @property
    def overlay_video(self) -> Path:
        """Overlay video (MP4)."""
        return self.path / "overlay.mp4"

    @property
    def overlay_gif(self) -> Path:
        """Overlay animation, where no video encoder was found (GIF)."""
        return self.path / "overlay.gif"

    @property
    def figures(self) -> Path:
        """Folder of the figures."""
        return self.path / "figures"

    @property
    def page(self) -> Path:
        """Result page (HTML)."""
        return self.path / "index.html"

    @property
    def failure(self) -> Path:
        """Why the run failed (text); absent where it did not."""
        return self.path / "failure.txt"


@dataclass(frozen=True)
class SavedTrajectory:
    """A trajectory as read from a run folder.

    Attributes:
        positions: (F, H, W, 3) float64 [m], camera frame.
        fps: frames per second.
        parameters: further arrays by name, e.g. stiffnesses, in SI units.
    """

    positions: npt.NDArray[np.float64]
    fps: float
    parameters: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)


def create_run_folder(path: Path) -> RunFolder:
    """Make a run folder (parents included); an existing folder is used as it is.

    Raises:
        InputError: the path is a file or cannot be made.
    """
    try:
        (path / "figures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            "Cannot make the run folder", where=str(path), expected="a writable folder", got=str(error)
        ) from error
    return RunFolder(path)


def open_run_folder(path: Path) -> RunFolder:
    """Open an existing run folder.

    Raises:
        InputError: there is no such folder, or it holds neither a trajectory nor a configuration.
    """
    run = RunFolder(path)
    if not path.is_dir() or not (run.trajectory.is_file() or run.config.is_file()):
        found = ", ".join(sorted(p.name for p in path.iterdir())[:8]) if path.is_dir() else "no such folder"
        raise InputError(
            "Not a run folder",
            where=str(path),
            expected="a folder with trajectory.npz or config.yaml, as written by a fit",
            got=found or "an empty folder",
        )
    return run


def write_config(run: RunFolder, text: str) -> Path:
    """Write the resolved configuration, given as YAML text."""
    return write_text(run.config, text)


def read_config(run: RunFolder) -> str:
    """Read the configuration text."""
    return _read(run.config, "YAML text", lambda path: path.read_text(encoding="utf-8"))


def current_git_revision(folder: Path | None = None) -> str:
    """Revision of the repository around ``folder`` (default: this package), or "unknown".

    "-dirty" is appended where tracked files differ from it.
    """
    where = Path(__file__).parent if folder is None else folder
    command = ["git", "-C", str(where), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip() or "unknown"


def write_git_revision(run: RunFolder, revision: str | None = None) -> Path:
    """Write the revision of the code (default: the current one)."""
    return write_text(run.git_revision, (current_git_revision() if revision is None else revision) + "\n")


def read_git_revision(run: RunFolder) -> str:
    """Read the revision of the code."""
    return _read(run.git_revision, "one line of text", lambda path: path.read_text(encoding="utf-8").strip())


def write_metrics(run: RunFolder, metrics: Mapping[str, Any]) -> Path:
    """Write numbers as strict JSON; give ``EvaluationResult.to_dict()`` or any plain dictionary.

    Raises:
        InputError: a value is NaN, infinite or not plain data.
    """
    try:
        text = json.dumps(metrics, indent=2, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise InputError(
            "Metrics cannot be written as JSON",
            where=str(run.metrics),
            expected="finite numbers, text, lists and dictionaries (None for a missing number)",
            got=str(error),
        ) from error
    return write_text(run.metrics, text + "\n")


def read_metrics(run: RunFolder) -> dict[str, Any]:
    """Read the numbers."""

    def load(path: Path) -> dict[str, Any]:
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data, dict):
            raise ValueError(f"a {type(data).__name__} at the top level")
        return data

    return _read(run.metrics, "a JSON object", load)


def write_trajectory(
    run: RunFolder,
    positions: npt.ArrayLike,
    *,
    fps: float,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
) -> Path:
    """Write positions and parameters as plain arrays (compressed NPZ, no pickles).

    Args:
        run: where to write.
        positions: (F, H, W, 3) [m], camera frame; stored as float64.
        fps: frames per second.
        parameters: further arrays by name, in SI units; the names "positions" and "fps" are taken.

    Raises:
        InputError: wrong shape, a number that is not finite, or an array that is not numeric.
    """
    x = np.asarray(positions, dtype=np.float64)
    if x.ndim != 4 or x.shape[-1] != 3 or not np.isfinite(x).all():
        raise InputError(
            "Trajectory cannot be written",
            where=str(run.trajectory),
            expected="finite positions of shape (F, H, W, 3) in metres",
            got=f"shape {x.shape}, {int((~np.isfinite(x)).sum())} non-finite numbers",
        )
    arrays = {name: np.asarray(value) for name, value in (parameters or {}).items()}
    bad = [n for n, a in arrays.items() if n in RESERVED_ARRAYS or a.dtype.kind not in "biufU"]
    if bad:
        raise InputError(
            "Parameters cannot be written",
            where=str(run.trajectory),
            expected=f"numbers or text, under names other than {', '.join(RESERVED_ARRAYS)}",
            got=", ".join(f"{n} ({arrays[n].dtype})" for n in bad),
        )
    with written_atomically(run.trajectory) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, positions=x, fps=np.float64(fps), **arrays)
    return run.trajectory


def read_trajectory(run: RunFolder) -> SavedTrajectory:
    """Read positions and parameters; never unpickles."""

    def load(path: Path) -> SavedTrajectory:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        positions, fps = arrays.pop("positions"), float(arrays.pop("fps"))
        if positions.ndim != 4 or positions.shape[-1] != 3:
            raise ValueError(f"positions of shape {positions.shape}")
        return SavedTrajectory(np.asarray(positions, dtype=np.float64), fps, arrays)

    return _read(run.trajectory, "an NPZ file with positions (F, H, W, 3) and fps", load)


def write_history(run: RunFolder, history: pd.DataFrame) -> Path:
    """Write one row per optimisation cycle; numbers keep full precision."""
    with written_atomically(run.history) as temporary:
        history.to_csv(temporary, index=False)
    return run.history


def read_history(run: RunFolder) -> pd.DataFrame:
    """Read the history of the optimisation."""
    # Here, because most readers of a run have no use for it, and loading it takes half a second.
    import pandas as pd

    return _read(run.history, "a CSV table", pd.read_csv)


def _read(path: Path, expected: str, load: Callable[[Path], T]) -> T:
    if not path.is_file():
        raise InputError(
            "A file of the run is missing", where=str(path), expected=expected, got="no such file"
        )
    try:
        return load(path)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            "A file of the run cannot be read",
            where=str(path),
            expected=expected,
            got=f"{type(error).__name__}: {error}",
        ) from error
