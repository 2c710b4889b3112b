"""A smooth moving surface at the points of quadrature: tangents, normals, curvatures and their rates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.learned.motion import Motion, basis, used_frames

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fields:
    """Fields (F, Q, 3) or (F, Q) of a motion, frames at both ends left out.

    Attributes:
        motion: the clip.
        frames: the frames that are used.
    """

    motion: Motion

    @cached_property
    def frames(self) -> slice:
        """See used_frames."""
        used = used_frames(len(self.motion.raw), self.motion.window)
        return slice(used.start, used.stop, used.step)

    @property
    def stride(self) -> int:
        """Frames between two that are used."""
        return int(self.frames.step)

    @property
    def interval(self) -> float:
        """Time between the frames that are used."""
        return self.stride * self.motion.interval

    @property
    def correlated(self) -> float:
        """Used frames that tell the same, about."""
        return max(1.0, 0.6 * self.motion.window / self.stride)

    @cached_property
    def _order(self) -> tuple[Array, Array, Array]:
        c0, c1, c2 = (self.motion.coefficients(k)[self.frames] for k in range(3))
        return c0, c1, c2

    def _field(self, matrix: Array, order: int) -> Array:
        return np.matmul(matrix, self._order[order])

    @cached_property
    def x(self) -> Array:
        """Positions."""
        return self._field(basis().values, 0)

    @cached_property
    def v(self) -> Array:
        """Velocities."""
        return self._field(basis().values, 1)

    @cached_property
    def a(self) -> Array:
        """Accelerations."""
        return self._field(basis().values, 2)

    @cached_property
    def tu(self) -> Array:
        """Tangents along axis 1, of length 1 + strain."""
        return self._field(basis().du, 0) / self.motion.sides[0]

    @cached_property
    def tv(self) -> Array:
        """Tangents along axis 0."""
        return self._field(basis().dv, 0) / self.motion.sides[1]

    @cached_property
    def vu(self) -> Array:
        """Rate of the tangent along axis 1."""
        return self._field(basis().du, 1) / self.motion.sides[0]

    @cached_property
    def vv(self) -> Array:
        """Rate of the tangent along axis 0."""
        return self._field(basis().dv, 1) / self.motion.sides[1]

    @cached_property
    def n(self) -> Array:
        """Unit normals."""
        n = np.cross(self.tu, self.tv)
        result: Array = n / np.linalg.norm(n, axis=-1, keepdims=True)
        return result

    @cached_property
    def kuu(self) -> Array:
        """Curvature along axis 1."""
        return _dot(self._field(basis().duu, 0), self.n) / self.motion.sides[0] ** 2

    @cached_property
    def kvv(self) -> Array:
        """Curvature along axis 0."""
        return _dot(self._field(basis().dvv, 0), self.n) / self.motion.sides[1] ** 2

    @cached_property
    def kuv(self) -> Array:
        """Twist."""
        return _dot(self._field(basis().duv, 0), self.n) / (self.motion.sides[0] * self.motion.sides[1])

    @cached_property
    def ruu(self) -> Array:
        """Rate of curvature along axis 1, the turning of the normal left out."""
        return _dot(self._field(basis().duu, 1), self.n) / self.motion.sides[0] ** 2

    @cached_property
    def rvv(self) -> Array:
        """Rate of curvature along axis 0."""
        return _dot(self._field(basis().dvv, 1), self.n) / self.motion.sides[1] ** 2

    @cached_property
    def euu(self) -> Array:
        """Strain along axis 1."""
        return 0.5 * (_dot(self.tu, self.tu) - 1)

    @cached_property
    def evv(self) -> Array:
        """Strain along axis 0."""
        return 0.5 * (_dot(self.tv, self.tv) - 1)

    @cached_property
    def shear(self) -> Array:
        """Shear."""
        return _dot(self.tu, self.tv)

    @cached_property
    def shear_rate(self) -> Array:
        """Rate of shear."""
        return _dot(self.vu, self.tv) + _dot(self.tu, self.vv)

    @cached_property
    def time(self) -> Array:
        """Fraction of the clip (F,)."""
        F = len(self.motion.raw)
        return np.arange(F)[self.frames] / (F - 1)


def _dot(a: Array, b: Array) -> Array:
    result: Array = np.einsum("...c,...c->...", a, b)
    return result


def dot(a: Array, b: Array) -> Array:
    """Inner products (...,) of vectors (..., 3)."""
    return _dot(a, b)


def mean(field: Array) -> Array:
    """Mean over the cloth (F, ...) of a field (F, Q, ...)."""
    result: Array = np.einsum("q,fq...->f...", basis().weights, field)
    return result
