"""What a fitting recipe is: a number of cycles, each of which improves the parameters in place."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from toile.reconstruction.problem import Reconstruction


@dataclass(frozen=True)
class CycleReport:
    """What happened in one cycle.

    Attributes:
        losses: named loss terms of the frames in the window.
        n_frames: frames covered so far.
        positions: (n_frames, N, 3) [m], the motion after (or during) the cycle.
        notes: plain messages for the log.
        frames_in_loss: frames that the objective is a sum over; 1 where it is a mean.
    """

    losses: dict[str, float]
    n_frames: int
    positions: Tensor
    notes: tuple[str, ...] = field(default_factory=tuple)
    frames_in_loss: int = 1


class Recipe(ABC):
    """A strategy for fitting; its state must survive a checkpoint bit for bit."""

    @abstractmethod
    def n_cycles(self, reconstruction: Reconstruction) -> int:
        """Number of cycles for this scene."""

    @abstractmethod
    def start(self, reconstruction: Reconstruction) -> None:
        """Prepare for a scene (features, optimiser); called once, before the first cycle or a resume."""

    @abstractmethod
    def cycle(self, reconstruction: Reconstruction, index: int) -> CycleReport:
        """Run cycle ``index`` and change reconstruction.parameters in place."""

    @abstractmethod
    def substep_positions(self) -> Tensor | None:
        """Positions of every sub-step of the last motion (1, n + 1, N, 3) [m], as in Rollout.all_positions.

        A step of a buckling cloth can have several equilibria; this says which one the fit has followed.
        """

    def with_heavier_silhouette(self, factor: float) -> Recipe | None:
        """The same recipe for a second try whose first stage follows the outline more; None: there is none.

        Args:
            factor: on the silhouette's weight there.
        """
        return None

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything beyond the parameters that the next cycle depends on, as tensors and plain values."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of state_dict, called after start."""
