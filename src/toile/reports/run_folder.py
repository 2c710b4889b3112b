"""What a run leaves on disk, and how to read it back.

::

    run/
      config.yaml       the resolved configuration, as text
      git_revision      revision of the code
      metrics.json      numbers, with their protocols
      overrides.yaml    what the run was started with, for resume=
      metrics_seed<k>.json  the same with another seed of the samples, where a table asked for it
      trajectory.npz    positions (F, H, W, 3) float64 [m], camera frame; times, faces, camera, gravity; one
                        array per parameter (see SavedTrajectory)
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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt
import yaml

from toile.atomic_file import write_text, written_atomically
from toile.errors import InputError
from toile.former_names import TRAJECTORY_ARRAYS, renamed
from toile.json_file import read_json_object

if TYPE_CHECKING:
    import pandas as pd

T = TypeVar("T")

TRAJECTORY_FORMAT = 3
"""1: positions, fps and parameters alone. 2: with times, faces, K, image_size and gravity. 3: the pinned
vertices and the motion of their boundary positions have these names."""

RESERVED_ARRAYS = ("format", "positions", "fps", "times", "faces", "K", "image_size", "gravity")


@dataclass(frozen=True)
class RunFolder:
    """Paths of the files of one run; see the module's text for what they hold."""

    path: Path

    @property
    def config(self) -> Path:
        """Resolved configuration (YAML text)."""
        return self.path / "config.yaml"

    @property
    def overrides(self) -> Path:
        """Overrides of the configuration that the run was started with (YAML list)."""
        return self.path / "overrides.yaml"

    @property
    def record(self) -> Path | None:
        """Overrides that the run was started with, as found; older runs have Hydra's own record only.

        Hydra writes its record before anybody can refuse what it was asked for, so it may belong to a later
        call.
        """
        records = (self.overrides, self.path / ".hydra" / "overrides.yaml")
        return next((record for record in records if record.is_file()), None)

    @property
    def git_revision(self) -> Path:
        """Revision of the code."""
        return self.path / "git_revision"

    @property
    def metrics(self) -> Path:
        """Numbers with their protocols (JSON)."""
        return self.path / "metrics.json"

    def metrics_of_seed(self, seed: int) -> Path:
        """Numbers with another seed of the samples (JSON)."""
        return self.path / f"metrics_seed{seed}.json"

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
        positions: (F, H, W, 3) float64 [m], OpenCV camera frame (x right, y down, z forward).
        fps: frames per second, on average.
        parameters: further arrays by name, e.g. stiffnesses, in SI units.
        times: of the frames (F,) [s], the first 0.
        faces: triangles (T, 3) of flattened vertex indices i * W + j; None in files of format 1.
        intrinsics: K (3, 3) [px] of the whole image, pixel = K (X / Z); None in files of format 1.
        image_size: (height, width) of that image [px]; None in files of format 1.
        gravity: (3,) [m/s²]; None in files of format 1.
    """

    positions: npt.NDArray[np.float64]
    fps: float
    parameters: Mapping[str, npt.NDArray[Any]]
    times: npt.NDArray[np.float64]
    faces: npt.NDArray[np.int64] | None = None
    intrinsics: npt.NDArray[np.float64] | None = None
    image_size: tuple[int, int] | None = None
    gravity: npt.NDArray[np.float64] | None = None

    @property
    def uneven_times(self) -> npt.NDArray[np.float64] | None:
        """The times where frames are unevenly spaced, else None."""
        even = np.array_equal(self.times, np.arange(len(self.times)) / self.fps)
        return None if even else self.times


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


def write_overrides(run: RunFolder, overrides: Sequence[str]) -> Path:
    """Write what the run was started with."""
    return write_text(run.overrides, yaml.safe_dump(list(overrides), allow_unicode=True))


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
    return _read(run.metrics, "a JSON object", read_json_object)


def write_trajectory(
    run: RunFolder,
    positions: npt.ArrayLike,
    *,
    fps: float,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    times: npt.ArrayLike | None = None,
    faces: npt.ArrayLike | None = None,
    intrinsics: npt.ArrayLike | None = None,
    image_size: tuple[int, int] | None = None,
    gravity: npt.ArrayLike | None = None,
) -> Path:
    """Write a trajectory as plain arrays (compressed NPZ, no pickles).

    Args:
        run: where to write.
        positions: (F, H, W, 3) [m], camera frame; stored as float64.
        fps: frames per second, on average.
        parameters: further arrays by name, in SI units; RESERVED_ARRAYS are taken.
        times: of the frames (F,) [s]; None for frames at equal distances.
        faces: see SavedTrajectory; None leaves it out, as for the three below.
        intrinsics: K (3, 3) [px].
        image_size: (height, width) [px].
        gravity: (3,) [m/s²].

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
    t = np.arange(len(x)) / fps if times is None else np.asarray(times, dtype=np.float64)
    if t.shape != (len(x),) or not (np.diff(t) > 0).all():
        raise InputError(
            "Times of the trajectory cannot be written",
            where=str(run.trajectory),
            expected=f"{len(x)} increasing numbers [s]",
            got=f"shape {t.shape}",
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
    around = {
        "faces": None if faces is None else np.asarray(faces, dtype=np.int64),
        "K": None if intrinsics is None else np.asarray(intrinsics, dtype=np.float64),
        "image_size": None if image_size is None else np.asarray(image_size, dtype=np.int64),
        "gravity": None if gravity is None else np.asarray(gravity, dtype=np.float64),
    }
    known = {name: array for name, array in around.items() if array is not None}
    with written_atomically(run.trajectory) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            format=np.int64(TRAJECTORY_FORMAT),
            positions=x,
            fps=np.float64(fps),
            times=t,
            **known,
            **arrays,
        )
    return run.trajectory


def read_trajectory(run: RunFolder) -> SavedTrajectory:
    """Read a trajectory of this format or an older one; never unpickles."""

    def load(path: Path) -> SavedTrajectory:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            arrays = renamed({name: data[name] for name in data.files}, TRAJECTORY_ARRAYS)
        version = int(arrays.pop("format", 1))
        if version > TRAJECTORY_FORMAT:
            raise ValueError(f"format {version}, of a later version of toile")
        positions, fps = arrays.pop("positions"), float(arrays.pop("fps"))
        if positions.ndim != 4 or positions.shape[-1] != 3:
            raise ValueError(f"positions of shape {positions.shape}")
        times = arrays.pop("times") if version > 1 else np.arange(len(positions)) / fps
        size = arrays.pop("image_size", None)
        return SavedTrajectory(
            np.asarray(positions, dtype=np.float64),
            fps,
            times=np.asarray(times, dtype=np.float64),
            faces=arrays.pop("faces", None),
            intrinsics=arrays.pop("K", None),
            image_size=None if size is None else (int(size[0]), int(size[1])),
            gravity=arrays.pop("gravity", None),
            parameters=arrays,
        )

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
