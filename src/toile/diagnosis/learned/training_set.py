"""The training set of the learned decision: chunks of features in a folder, made where they are missing."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toile.atomic_file import write_text
from toile.diagnosis.learned.examples import Examples, examples_of, read_examples, write_examples
from toile.diagnosis.learned.features import VERSION
from toile.errors import InputError
from toile.generation.fast.clips import GENERATION, draw_batch, draw_sessions

_CLIPS_PER_BATCH = 17
_SESSIONS_PER_BATCH = 7

Report = Callable[[str, int, int], None]
"""Called with what is made, how many chunks are there and how many there will be."""


@dataclass(frozen=True)
class TrainingSet:
    """Where a training set is, and how large it shall be.

    Attributes:
        folder: of the chunks.
        clips: about so many.
        sessions: about so many, of three clips each, of cloths that no clip shares.
        seed: of everything random.
    """

    folder: Path
    clips: int = 10_050
    sessions: int = 98
    seed: int = 20

    @property
    def clip_chunks(self) -> list[Path]:
        """Files of single clips."""
        n = -(-self.clips // _CLIPS_PER_BATCH)
        return [self.folder / f"features_{i:05d}.npz" for i in range(n)]

    @property
    def session_chunks(self) -> list[Path]:
        """Files of sessions."""
        n = -(-self.sessions // _SESSIONS_PER_BATCH)
        return [self.folder / f"sessions_{i:05d}.npz" for i in range(n)]

    def make(self, report: Report) -> None:
        """Make the chunks that are not there; after an interruption it goes on where it was.

        Raises:
            InputError: the folder holds chunks of another seed or of other features.
        """
        self._describe()
        for kind, paths in (("clips", self.clip_chunks), ("sessions", self.session_chunks)):
            for i, path in enumerate(paths):
                if not path.is_file():
                    clips = self.draw_clips(i) if kind == "clips" else self.draw_session_clips(i)
                    write_examples(path, clips)
                report(kind, i + 1, len(paths))

    def draw_clips(self, batch: int) -> Examples:
        """One chunk of single clips."""
        return examples_of(draw_batch(self.seed, batch), (self.seed, batch))

    def draw_session_clips(self, batch: int) -> Examples:
        """One chunk of sessions, clip after clip; a session is a group."""
        clips = [clip for session in draw_sessions(self.seed + 1, batch) for clip in session]
        return examples_of(clips, (self.seed + 1, batch))

    def read(self) -> tuple[Examples, list[Examples]]:
        """Single clips, and sessions one by one."""
        singles = read_examples(self.clip_chunks)
        if not self.sessions:
            return singles, []
        clips = read_examples(self.session_chunks)
        return singles, [clips.picked(clips.groups == g) for g in np.unique(clips.groups)]

    def _describe(self) -> None:
        path = self.folder / "set.json"
        values = {"seed": self.seed, "features": VERSION, "clips": GENERATION}
        if not path.is_file():
            write_text(path, json.dumps(values) + "\n")
        elif json.loads(path.read_text()) != values:
            raise InputError(
                "The folder holds another training set",
                where=str(path),
                expected=json.dumps(values),
                got=path.read_text().strip(),
            )


def split(examples: Examples, shares: tuple[float, ...], seed: int) -> list[Examples]:
    """Parts of a table whose groups are apart, with these shares of the groups."""
    groups = np.unique(examples.groups)
    np.random.default_rng(seed).shuffle(groups)
    ends = np.round(np.cumsum(shares) / sum(shares) * len(groups)).astype(int)
    parts = np.split(groups, ends[:-1])
    return [examples.picked(np.isin(examples.groups, part)) for part in parts]
