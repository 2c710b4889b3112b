"""Matrices by which the forces of a step hang on the motion before it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import sparray

Single = NDArray[np.float32]
Step = TypeVar("Step")
Found = TypeVar("Found")

_AT_ONCE = 32
"""Steps that are differentiated side by side: more take no less time each."""


def some_at_once(of_some: Callable[[Sequence[Step]], list[Found]], steps: Sequence[Step]) -> list[Found]:
    """What is found of every step, asked for as many at once as is worth it."""
    pieces = (steps[k : k + _AT_ONCE] for k in range(0, len(steps), _AT_ONCE))
    return list(chain.from_iterable(map(of_some, pieces)))


@dataclass(frozen=True)
class PastProducts:
    """Derivatives in one step, in two factors: of a motion that changes none of the numbers between them the
    forces stay exactly as they are.

    Attributes:
        after: of the forces by numbers that hang on the past (3N, n); None for the forces themselves.
        by_position, by_velocity, by_normals: of the numbers by the past, normals at the vertices as if they
            were given (n, 3N); None where none hangs on it.
    """

    after: sparray | None = None
    by_position: sparray | None = None
    by_velocity: sparray | None = None
    by_normals: sparray | None = None

    @property
    def nothing(self) -> bool:
        """Whether nothing of the past shows in this step."""
        return self.by_position is None and self.by_velocity is None and self.by_normals is None

    def change(self, moved: Single, speed: Single, turned: Single | None) -> Single:
        """Change of the forces (3N, R) [N] for changes of positions, velocities and normals (3N, R).

        Args:
            moved: [m].
            speed: [m/s].
            turned: None where ``by_normals`` is.
        """
        pairs = ((self.by_position, moved), (self.by_velocity, speed), (self.by_normals, turned))
        found = [matrix @ by for matrix, by in pairs if matrix is not None]
        numbers = sum(found[1:], found[0])
        return np.asarray(numbers if self.after is None else self.after @ numbers)
