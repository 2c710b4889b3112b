"""Features of labelled clips as tables, chunk by chunk in files, so that a training can be taken up again."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toile.atomic_file import written_atomically
from toile.diagnosis.learned.features import VERSION, clip_features
from toile.errors import InputError
from toile.generation.fast.clips import LabelledClip
from toile.generation.fast.noise import tracking_noise

Array = NDArray[np.float64]
Texts = NDArray[np.str_]

NOISE = 0.1, 1.2
"""Range of the tracking noise [% of the width]."""


@dataclass(frozen=True)
class Examples:
    """Labelled features.

    Attributes:
        names: of the k features.
        features: (n, k) float32.
        labels, effects, motions: (n,).
        sizes: (n,) [% of the width]; 0 for nulls.
        noises: (n,) [% of the width].
        fps: (n,).
        groups: (n,) scenes or sessions, which a split keeps together.
    """

    names: tuple[str, ...]
    features: NDArray[np.float32]
    labels: Texts
    effects: Texts
    motions: Texts
    sizes: Array
    noises: Array
    fps: Array
    groups: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.labels)

    def picked(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> Examples:
        """Some of the rows."""
        return Examples(self.names, *(getattr(self, name)[index] for name in _COLUMNS))


_COLUMNS = ("features", "labels", "effects", "motions", "sizes", "noises", "fps", "groups")


def examples_of(
    clips: Sequence[LabelledClip], seed: Sequence[int], noise: tuple[float, float] = NOISE
) -> Examples:
    """Features of clips with tracking noise, whose size is drawn log-uniformly from a range.

    Args:
        clips: at least one.
        seed: of the noise; a clip's own is drawn from it and its number among ``clips``.
        noise: lowest and highest deviation [% of the width].
    """
    rows, noises = [], []
    for i, clip in enumerate(clips):
        rng = np.random.default_rng([*seed, i])
        deviation = float(np.exp(rng.uniform(*np.log(noise))))
        width = 0.5 * sum(clip.cloth_size)
        F, H, W, _ = clip.positions.shape
        positions = clip.positions + tracking_noise(rng, (F, H, W), clip.fps, 0.01 * deviation * width)
        rows.append(clip_features(positions, clip.pinned, clip.fps, clip.gravity, clip.cloth_size))
        noises.append(deviation)
    return Examples(
        names=tuple(rows[0]),
        features=np.array([list(row.values()) for row in rows], np.float32),
        labels=np.array([c.label for c in clips]),
        effects=np.array([c.effect for c in clips]),
        motions=np.array([c.motion for c in clips]),
        sizes=np.array([c.size for c in clips]),
        noises=np.array(noises),
        fps=np.array([c.fps for c in clips]),
        groups=np.array([c.scene for c in clips]),
    )


def write_examples(path: Path, examples: Examples) -> None:
    """Write a chunk; the file is complete or not there."""
    with written_atomically(path) as temporary:
        np.savez_compressed(
            temporary,
            version=np.array(VERSION),
            names=np.array(json.dumps(examples.names)),
            **{name: getattr(examples, name) for name in _COLUMNS},
        )


def read_examples(paths: Iterable[Path]) -> Examples:
    """Read chunks into one table.

    Raises:
        InputError: no chunk, or one with other features.
    """
    parts: list[Examples] = []
    for path in paths:
        with np.load(path, allow_pickle=False) as file:
            version, names = int(file["version"]), tuple(json.loads(str(file["names"])))
            if version != VERSION or (parts and names != parts[0].names):
                raise InputError(
                    "A chunk has other features",
                    where=str(path),
                    expected=f"version {VERSION}",
                    got=f"version {version}; delete it, so that it is made again",
                )
            parts.append(Examples(names, *(file[name] for name in _COLUMNS)))
    if not parts:
        raise InputError("There are no clips", where="training set", expected="chunks", got="none")
    columns = (np.concatenate([getattr(p, name) for p in parts]) for name in _COLUMNS)
    return Examples(parts[0].names, *columns)
