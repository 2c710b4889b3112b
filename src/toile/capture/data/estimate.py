"""What a data set will take, told before it is made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Seconds of the processor for a step of the layer by the garment's vertices: docs/results/capture_layer.md,
# a quarter of the frame's (AMD EPYC, one thread). The law and the air of a truth cost little beside.
_VERTICES = (501, 971, 1465, 3029)
_STEP_SECONDS = (0.037, 0.081, 0.137, 0.53)
# Of an image with its two masks: drawing the meshes, and every pixel. Measured on the demo's skirt with
# images of 128, 256 and 512 px: 0.033, 0.075 and 0.141 s, 18, 56 and 163 kB.
_IMAGE_SECONDS, _PIXEL_SECONDS = 0.035, 4.2e-7
_IMAGE_BYTES, _PIXEL_BYTES = 8000, 0.6
# Of a frame of the truth, and of a vertex in it: positions in single precision hardly shrink.
_FRAME_SECONDS, _POSITION_BYTES = 0.03, 13


@dataclass(frozen=True)
class Estimate:
    """What a data set will be, and about what it will take.

    Attributes:
        clips: how many.
        frames: of a clip.
        views: cameras.
        side: of their images [px].
        substeps: steps of the truth's simulation per frame.
        body_vertices: V.
        garment_vertices: N of the model's garment.
        true_vertices: N of the garment that is simulated.
        simulated: whether our layer simulates; what Blender's solver takes is not known.
    """

    clips: int
    frames: int
    views: int
    side: int
    substeps: int
    body_vertices: int
    garment_vertices: int
    true_vertices: int
    simulated: bool = True

    @property
    def images(self) -> int:
        """Pictures of all cameras in all clips."""
        return self.clips * self.frames * self.views

    @property
    def seconds(self) -> float | None:
        """On one core of the machine of docs/results/capture_layer.md, or None where nobody knows [s]."""
        if not self.simulated:
            return None
        step = float(np.exp(np.interp(np.log(self.true_vertices), np.log(_VERTICES), np.log(_STEP_SECONDS))))
        if self.true_vertices > _VERTICES[-1]:
            # As between the last two.
            slope = np.log(_STEP_SECONDS[-1] / _STEP_SECONDS[-2]) / np.log(_VERTICES[-1] / _VERTICES[-2])
            step *= float((self.true_vertices / _VERTICES[-1]) ** slope)
        simulation = self.clips * self.frames * (self.substeps * step + _FRAME_SECONDS)
        return simulation + self.images * (_IMAGE_SECONDS + _PIXEL_SECONDS * self.side**2)

    @property
    def size(self) -> float:
        """On the disk [bytes]."""
        positions = self.body_vertices + self.garment_vertices + self.true_vertices
        truth = self.clips * self.frames * positions * _POSITION_BYTES
        return truth + self.images * (_IMAGE_BYTES + _PIXEL_BYTES * self.side**2)

    def lines(self) -> list[str]:
        """For people to read."""
        seconds = self.seconds
        return [
            f"{self.clips} clips of {self.frames} frames, {self.views} views of {self.side} px square, "
            f"{self.images:,} images",
            f"body {self.body_vertices:,} vertices; garment {self.garment_vertices:,}, "
            f"its truth {self.true_vertices:,}, {self.substeps} steps a frame",
            f"time: about {_hours(seconds)} on one core" if seconds else "time: not known for Blender",
            f"disk: about {self.size / 1e6:,.0f} MB",
        ]


def _hours(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
