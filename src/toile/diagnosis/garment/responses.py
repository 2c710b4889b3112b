"""How the masks of a clip answer to every effect: differences of roll-outs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toile.capture.arrays import read_arrays, write_arrays
from toile.diagnosis.garment.effects import EFFECTS
from toile.diagnosis.garment.masks import SmoothedAreas
from toile.diagnosis.garment.rollout import Seen
from toile.diagnosis.garment.scene import Scene
from toile.progress import Report, silent

Floats = NDArray[np.float64]

_BASE = "base"


@dataclass(frozen=True)
class Responses:
    """The model's smoothed masks, and their change with a coefficient of 1 of every effect.

    Attributes:
        base: (C, 2, F, h, w).
        answers: the same shape, by name of the effect.
    """

    base: Floats
    answers: Mapping[str, Floats]

    def matrix(self, cameras: int, frames: slice) -> Floats:
        """Answers of all effects as columns (n, E), in the order of ``EFFECTS``."""
        return np.stack([self.answers[name][:cameras, :, frames].ravel() for name in EFFECTS], 1)

    def save(self, path: Path) -> Path:
        """Write an .npz."""
        return write_arrays(path, {_BASE: self.base, **self.answers})

    @classmethod
    def load(cls, path: Path) -> Responses:
        """Read what ``save`` wrote.

        Raises:
            InputError: missing, or not all effects are there.
        """
        arrays = read_arrays(path, "Responses", (_BASE, *EFFECTS))
        return cls(arrays[_BASE], {name: arrays[name] for name in EFFECTS})


def measure_responses(
    look: Callable[[Scene], Seen], scene: Scene, form: SmoothedAreas, report: Report = silent
) -> Responses:
    """By two roll-outs for every effect, at the ends of its chord.

    Args:
        look: rolls out.
        scene: around which.
        form: in which masks are compared.
        report: progress.
    """
    report("responses", 0, len(EFFECTS))
    base = form(look(scene).masks)
    answers = {}
    for done, (name, effect) in enumerate(EFFECTS.items(), 1):
        low, high = effect.chord
        less, more = (form(look(effect.changed(scene, at)).masks) for at in (low, high))
        answers[name] = (more - less) / (high - low)
        report("responses", done, len(EFFECTS))
    return Responses(base, answers)
