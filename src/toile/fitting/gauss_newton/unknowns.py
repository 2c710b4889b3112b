"""The unknowns of a window in white coordinates: each is a Gaussian prior around its mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toile.fitting.gauss_newton.conjugate_gradients import Vector
from toile.fitting.parameters import ClothParameters
from toile.fitting.priors import SmoothField, SmoothSeries
from toile.fitting.reconstruction import Reconstruction
from toile.simulators.implicit.linearized import Perturbation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Priors:
    """Standard deviations of the unknowns; None keeps an unknown fixed.

    Attributes:
        turbulence: of each component of the turbulent acceleration [m/s²].
        turbulence_time: frames over which turbulence is correlated.
        turbulence_space: vertices over which it is correlated.
        anchor_motion: of the held vertices' displacement [m].
        anchor_motion_time: frames over which that is correlated.
        stiffness: of the logarithm of Y, S and B around their start values.
        wind: of each horizontal component of the constant wind around zero [m/s²].
        walk: learn stiffness and wind on the way: their deviations are then those of the change within one
            window, around the values that the window before has left.
    """

    turbulence: float | None
    turbulence_time: float
    turbulence_space: float
    anchor_motion: float | None
    anchor_motion_time: float
    stiffness: float | None
    wind: float | None
    walk: bool


class WindowUnknowns:
    """White coordinates of everything that is free between two frames.

    Args:
        reconstruction: holds the current parameters.
        priors: see Priors.
        start_stiffness: (3,) Y, S, B in network units at the start of the fit.
        first, last: frames; the motion up to ``first`` is fixed.
    """

    def __init__(
        self, reconstruction: Reconstruction, priors: Priors, start_stiffness: Array, first: int, last: int
    ) -> None:
        self.reconstruction = reconstruction
        self.priors = priors
        self.first, self.last = first, last
        self.n = last - first
        self.grid = reconstruction.scene.grid
        masses = reconstruction.cloth.masses.numpy()
        self._masses = masses[:, None]
        self._relative_mass = masses[:, None] / reconstruction.parameters.units.mass
        units = reconstruction.parameters.units
        self._interior_mass = units.mass
        self._stiffness_units = np.array([units.stretching, units.energy, units.energy])
        gravity = reconstruction.gravity.numpy()
        self._horizontal = horizontal_basis(gravity)
        self._gravity = gravity
        self._field = (
            None
            if priors.turbulence is None
            else SmoothField(
                (self.n, *self.grid), priors.turbulence, priors.turbulence_time, priors.turbulence_space
            )
        )
        self._series = (
            None
            if priors.anchor_motion is None or len(reconstruction.cloth.held) == 0
            else SmoothSeries(self.n + 1, priors.anchor_motion, priors.anchor_motion_time)
        )
        # Where the window starts the cloth is where it is, held vertices included.
        self._anchor_free = np.ones((self.n + 1, 1, 1))
        self._anchor_free[0] = 0.0
        self._read(reconstruction.parameters)
        self._mean_stiffness = self._stiffness if priors.walk else start_stiffness
        self._mean_wind = self._wind if priors.walk else np.zeros(3)

    def _read(self, p: ClothParameters) -> None:
        self._stored = p.turbulence.detach().numpy()[self.first : self.last].copy()
        self._turbulence = self._stored / self._relative_mass
        self._anchors = p.anchor_motion.detach().numpy()[self.first : self.last + 1].copy()
        self._stiffness = np.array([p.get_parameter(name).item() for name in ClothParameters.STIFFNESSES])
        self._wind = p.wind.detach().numpy().copy()

    def start(self) -> Vector:
        """White coordinates of the current parameters."""
        z: Vector = {}
        if self._field is not None:
            z["turbulence"] = self._field.whiten(self._turbulence.reshape(self.n, *self.grid, 3))
        if self._series is not None:
            z["anchor_motion"] = self._series.whiten(self._anchors)
        if self.priors.stiffness is not None:
            z["stiffness"] = np.log(self._stiffness / self._mean_stiffness) / self.priors.stiffness
        if self.priors.wind is not None:
            z["wind"] = self._horizontal @ (self._wind - self._mean_wind) / self.priors.wind
        return z

    def turbulence(self, z: Vector) -> Array:
        """Turbulent acceleration (n, N, 3) [m/s²]."""
        if self._field is None:
            return self._turbulence
        return self._field.colour(z["turbulence"]).reshape(self.n, -1, 3)

    def anchor_motion(self, z: Vector) -> Array:
        """Displacement of the held vertices (n + 1, n_held, 3) [m]."""
        if self._series is None:
            return self._anchors
        motion = self._series.colour(z["anchor_motion"])
        return np.where(self._anchor_free > 0, motion, self._anchors)

    def stiffness(self, z: Vector) -> Array:
        """Y, S, B in network units."""
        if self.priors.stiffness is None:
            return self._stiffness
        return self._mean_stiffness * np.exp(self.priors.stiffness * z["stiffness"])

    def wind(self, z: Vector) -> Array:
        """Constant wind (3,) [m/s²], orthogonal to gravity where it is free."""
        if self.priors.wind is None:
            return self._wind
        return self._mean_wind + self.priors.wind * z["wind"] @ self._horizontal

    def forces(self, z: Vector) -> Array:
        """External forces (n, N, 3) [N], rounded as ClothParameters.forces rounds the stored values."""
        constant = self._masses * (self._gravity + self.wind(z))
        return constant + self._interior_mass * self._stored_turbulence(z)

    def _stored_turbulence(self, z: Vector) -> Array:
        """Turbulence as the parameters store it, per interior mass (n, N, 3) [m/s²]."""
        if self._field is None:
            return self._stored
        return self.turbulence(z) * self._relative_mass

    def si_stiffness(self, z: Vector) -> Array:
        """Y [N/m], S [N·m], B [N·m]."""
        return self.stiffness(z) * self._stiffness_units

    def tangent(self, z: Vector, d: Vector) -> Perturbation:
        """Change of the rollout's inputs for a change d of the white coordinates at z."""
        n_vertices = self._masses.shape[0]
        acceleration = np.zeros((self.n, n_vertices, 3))
        if self._field is not None:
            acceleration += self._field.colour(d["turbulence"]).reshape(self.n, -1, 3)
        if self.priors.wind is not None:
            acceleration += self.priors.wind * d["wind"] @ self._horizontal
        stiffness = np.zeros(3)
        if self.priors.stiffness is not None:
            stiffness = self.si_stiffness(z) * self.priors.stiffness * d["stiffness"]
        anchors = np.zeros_like(self._anchors)
        if self._series is not None:
            anchors = self._series.colour(d["anchor_motion"]) * self._anchor_free
        rest = np.zeros((n_vertices, 3))
        return Perturbation(self._masses * acceleration, stiffness, anchors, rest, rest)

    def adjoint(self, z: Vector, gradient: Perturbation) -> Vector:
        """Gradient with respect to the white coordinates from one with respect to the rollout's inputs."""
        acceleration = gradient.forces * self._masses
        out: Vector = {}
        if self._field is not None:
            out["turbulence"] = self._field.colour_adjoint(acceleration.reshape(self.n, *self.grid, 3))
        if self._series is not None:
            out["anchor_motion"] = self._series.colour_adjoint(gradient.anchors * self._anchor_free)
        if self.priors.stiffness is not None:
            out["stiffness"] = gradient.stiffness * self.si_stiffness(z) * self.priors.stiffness
        if self.priors.wind is not None:
            out["wind"] = self.priors.wind * (self._horizontal @ acceleration.sum((0, 1)))
        return out

    def write(self, z: Vector) -> None:
        """Store the values in the reconstruction's parameters."""
        p = self.reconstruction.parameters
        with torch.no_grad():
            if self._field is not None:
                p.turbulence[self.first : self.last] = torch.from_numpy(
                    self.turbulence(z) * self._relative_mass
                )
            p.anchor_motion[self.first : self.last + 1] = torch.from_numpy(self.anchor_motion(z))
            for name, value in zip(ClothParameters.STIFFNESSES, self.stiffness(z), strict=True):
                p.get_parameter(name).fill_(float(value))
            # The frames before the window keep the forces that have brought the cloth to where it starts.
            drift = torch.from_numpy(self._relative_mass * (self._wind - self.wind(z)))
            p.turbulence[: self.first] += drift
            p.wind.copy_(torch.from_numpy(self.wind(z)))


def horizontal_basis(gravity: Array) -> Array:
    """Two unit vectors orthogonal to gravity, (2, 3)."""
    down = gravity / np.linalg.norm(gravity)
    # The camera's x and z axes, made orthogonal to gravity: signs stay readable for upright cameras.
    right = np.array([1.0, 0.0, 0.0]) - down[0] * down
    right /= np.linalg.norm(right)
    forward = np.cross(right, down)
    return np.stack((right, forward))
