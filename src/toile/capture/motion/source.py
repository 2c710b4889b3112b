"""Where the motions of a data set come from: formulas, or files of one's own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from toile.capture.body.poses import Poses
from toile.capture.body.subject import Subject
from toile.capture.motion.files import load_motion
from toile.capture.motion.procedural import MOTIONS, make_motion
from toile.errors import InputError


class MotionSource(ABC):
    """Motions by their names."""

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """Those that there are."""

    @abstractmethod
    def poses(self, subject: Subject, name: str, frames: int, fps: float, seed: int) -> Poses:
        """A motion of F frames that begins at rest.

        Args:
            subject: who moves.
            name: one of ``names``.
            frames: F.
            fps: frames a second.
            seed: of what is drawn at random in it, if anything is.

        Raises:
            InputError: no such motion for this subject, or it has fewer frames.
        """

    @abstractmethod
    def describe(self) -> Mapping[str, Any]:
        """What the motions follow from beside their names, as JSON values.

        Raises:
            InputError: a file is missing.
        """


class ProceduralMotions(MotionSource):
    """Those of ``motion.procedural``."""

    @property
    def names(self) -> Sequence[str]:
        """See MotionSource."""
        return tuple(MOTIONS)

    def poses(self, subject: Subject, name: str, frames: int, fps: float, seed: int) -> Poses:
        """See MotionSource."""
        return make_motion(subject, name, frames, fps, seed)

    def describe(self) -> Mapping[str, Any]:
        """See MotionSource."""
        return {}


class MotionFiles(MotionSource):
    """Motions from files, see ``motion.files.load_motion``; nothing in them is random.

    Args:
        path: a .bvh, .glb or .gltf file, or several.

    Raises:
        InputError: no file, or two of the same name.
    """

    def __init__(self, path: str | Sequence[str]) -> None:
        files = [Path(path)] if isinstance(path, str) else [Path(one) for one in path]
        self._files = dict(zip(names_of_files(path), files, strict=True))
        if not files or len(self._files) < len(files):
            raise InputError(
                "Motions have no names of their own",
                where="motion.path",
                expected="files whose names differ",
                got=", ".join(map(str, files)) or "none",
            )

    @property
    def names(self) -> Sequence[str]:
        """See MotionSource: those of the files, without suffix."""
        return tuple(self._files)

    def poses(self, subject: Subject, name: str, frames: int, fps: float, seed: int) -> Poses:
        """See MotionSource: the first frames of the file."""
        return load_motion(subject, self._files[name], fps, frames)

    def describe(self) -> Mapping[str, Any]:
        """See MotionSource: what is in the files."""
        missing = [str(file) for file in self._files.values() if not file.is_file()]
        if missing:
            raise InputError(
                "Motion is missing",
                where="motion.path",
                expected="a .bvh, .glb or .gltf file",
                got=f"no file {', '.join(missing)}",
            )
        digests = {name: sha256(file.read_bytes()).hexdigest() for name, file in self._files.items()}
        return {"motion_files": digests}


def names_of_files(path: str | Sequence[str]) -> list[str]:
    """What the motions of files are called."""
    return [Path(str(one)).stem for one in ([path] if isinstance(path, str) else path)]
