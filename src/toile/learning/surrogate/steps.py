"""The steps of a training run, as a data loader."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from toile.learning.surrogate.module import SurrogateTraining


class Steps:
    """Indices of the remaining steps; Lightning runs one training step for each.

    The batches come from the pool. A DataLoader would warn about missing worker processes; Lightning takes
    any iterable with a length.

    Args:
        module: tells how many steps are done already when the loop starts.
    """

    def __init__(self, module: SurrogateTraining) -> None:
        self._module = module

    def __len__(self) -> int:
        return self._module.settings.n_steps

    def __iter__(self) -> Iterator[int]:
        return iter(range(self._module.steps_done, self._module.settings.n_steps))
