"""The simulation layer S: from cloth and body at two times to the cloth at the next one.

Li et al., Deep Physics-aware Inference of Cloth Deformation for Monocular Human Performance Capture, 3DV 2021,
section 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

if TYPE_CHECKING:
    from toile.capture.body.subject import Subject
    from toile.capture.garments import Garment

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LayerSettings:
    """Settings of the layer; see docs/capture.md for what they were chosen by."""


@dataclass(frozen=True)
class LayerStep:
    """Outcome of one step.

    Attributes:
        positions: x_{n+1} (N, 3) [m], a float64 tensor; differentiable if an input required gradients.
        velocities: (x_{n+1} - x_n) / h (N, 3) [m/s].
        converged: whether every solve of the step reached the tolerance.
        newton_steps: factorisations of all outer passes together.
        contacts: number of contacts that push at the end, cloth vertices and body vertices.
        residual: largest out-of-balance force on a vertex [N].
    """

    positions: Tensor
    velocities: Tensor
    converged: bool
    newton_steps: int
    contacts: int
    residual: float


@dataclass(frozen=True)
class Motion:
    """A simulated motion of the garment.

    Attributes:
        garment_positions: (F, N, 3) [m], frame 0 is the start.
        converged: (F - 1, substeps) bool.
        newton_steps: (F - 1, substeps).
        residuals: largest out-of-balance force (F - 1, substeps) [N].
        kinetic, elastic, gravitational: energies at the frames (F,) [J].
        seconds: wall time (F - 1,) [s] of each frame.
    """

    garment_positions: Array
    converged: NDArray[np.bool_]
    newton_steps: NDArray[np.int64]
    residuals: Array
    kinetic: Array
    elastic: Array
    gravitational: Array
    seconds: Array


class SimulationLayer:
    """A garment on a body whose motion is given.

    World frame: y up, floor at y = 0, metres, seconds, kilograms.

    Args:
        garment: rest shape, attachment and material.
        body_faces: (T, 3) int64, counter-clockwise seen from outside.
        inactive: (V,) bool, body vertices that nothing collides with (the arms); none if None.
        settings: see LayerSettings.
    """

    def __init__(
        self,
        garment: Garment,
        body_faces: NDArray[np.int64],
        inactive: NDArray[np.bool_] | None = None,
        settings: LayerSettings | None = None,
    ) -> None:
        raise NotImplementedError

    @staticmethod
    def of(garment: Garment, subject: Subject, settings: LayerSettings | None = None) -> SimulationLayer:
        """The layer of a garment on a subject, whose arms collide with nothing."""
        raise NotImplementedError

    def step(
        self,
        positions: Tensor,
        velocities: Tensor,
        body: Array,
        next_body: Array,
        time_step: float,
        silhouettes: Sequence[object] = (),
    ) -> LayerStep:
        """One step of implicit Euler.

        Args:
            positions: x_n (N, 3) [m], float64.
            velocities: v_n (N, 3) [m/s]; (x_n - x_{n-1}) / h of two given times.
            body: vertices of the body at the step's begin (V, 3) [m].
            next_body: and at its end (V, 3) [m].
            time_step: h [s].
            silhouettes: of Eq. 1, one per view; see SilhouetteRays.
        """
        raise NotImplementedError

    def simulate(
        self,
        body_positions: Array,
        fps: float,
        substeps: int = 4,
        start: Array | None = None,
        velocities: Array | None = None,
    ) -> Motion:
        """Simulate F frames from rest.

        Args:
            body_positions: (F, V, 3) [m]; linear in between.
            fps: frames per second.
            substeps: steps per frame.
            start: garment at frame 0 (N, 3) [m]; its rest shape if None.
            velocities: at frame 0 (N, 3) [m/s]; 0 if None.
        """
        raise NotImplementedError
