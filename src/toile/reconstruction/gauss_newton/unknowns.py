"""The unknowns of a window in standardised coordinates: each is a Gaussian prior around its mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.effects.base import Effect
from toile.effects.jacobian import jacobian
from toile.effects.setting import Setting
from toile.geometry.horizontal import horizontal_axes
from toile.limits import NonNegative, Positive, Unit
from toile.physics.implicit.linearized import Perturbation
from toile.physics.material import Material
from toile.physics.simulator import Simulator
from toile.reconstruction.gauss_newton.conjugate_gradients import Vector
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.priors import SmoothField, SmoothSeries
from toile.reconstruction.problem import Reconstruction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Priors:
    """Standard deviations of the unknowns; None keeps an unknown fixed.

    Frames are counted, however far apart they are.

    Attributes:
        turbulence: of each component of the turbulent acceleration [m/s²].
        turbulence_time: frames over which turbulence is correlated.
        turbulence_space: vertices over which it is correlated.
        boundary_motion: of the pinned vertices' displacement [m].
        boundary_motion_time: frames over which that is correlated.
        stiffness: of the logarithm of Y, S and B around their start values.
        wind: of each horizontal component of the constant wind around zero [m/s²].
        walk: learn stiffness, wind and effects on the way: their deviations are then those of the change
            within one window, around the values that the window before has left.
        effects: of the coefficients of the effects around their start values, in units of each one's scale.
    """

    turbulence: Annotated[Positive, Unit("m/s²")] | None
    turbulence_time: Annotated[NonNegative, Unit("frames")]
    turbulence_space: Annotated[NonNegative, Unit("vertices")]
    boundary_motion: Annotated[Positive, Unit("m")] | None
    boundary_motion_time: Annotated[NonNegative, Unit("frames")]
    stiffness: Annotated[Positive, Unit("of the logarithm")] | None
    wind: Annotated[Positive, Unit("m/s²")] | None
    walk: bool
    effects: Annotated[Positive, Unit("of the scales")] | None = None


@dataclass(frozen=True)
class WindowInputs:
    """What a simulation of the window is given.

    Attributes:
        simulator: with the effects' terms, masses and time step.
        forces: (n, N, 3) [N].
        boundary: pinned positions (n + 1, n_pinned, 3) [m].
    """

    simulator: Simulator
    forces: Array
    boundary: Array


@dataclass(frozen=True)
class EffectSensitivities:
    """Change of a window's inputs per unit of each of the k coefficients of the effects.

    Attributes:
        forces: (k, n, N, 3) [N].
        boundary: (k, n + 1, n_pinned, 3) [m].
        inertia: relative change of masses over squared time step (k, N).
        masses: under the effects (N,) [kg].
    """

    forces: Array
    boundary: Array
    inertia: Array
    masses: Array


class WindowUnknowns:
    """Standardised coordinates of everything that is free between two frames.

    Args:
        reconstruction: holds the current parameters.
        priors: see Priors.
        start_stiffness: in network units at the start of the fit.
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
        self._stiffness_units = reconstruction.parameters.stiffness_units.numpy()
        gravity = reconstruction.gravity.numpy()
        # Only a free wind needs them, and where there is no gravity nothing is horizontal.
        self._horizontal = (
            np.zeros((2, 3)) if priors.wind is None else horizontal_axes(reconstruction.gravity).numpy()
        )
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
            if priors.boundary_motion is None or len(reconstruction.cloth.pinned) == 0
            else SmoothSeries(self.n + 1, priors.boundary_motion, priors.boundary_motion_time)
        )
        # Where the window starts the cloth is where it is, pinned vertices included.
        self._boundary_free = np.ones((self.n + 1, 1, 1))
        self._boundary_free[0] = 0.0
        self._read(reconstruction.parameters)
        self._mean_stiffness = self._stiffness if priors.walk else start_stiffness
        self._mean_wind = self._wind if priors.walk else np.zeros(3)
        self._effects = effects = reconstruction.effects
        self._values = effects.current().numpy().copy()
        free = priors.effects is not None and effects.names
        self._value_deviations = (priors.effects or 0.0) * effects.scales.numpy() if free else None
        self._mean_values = self._values if priors.walk else effects.start.numpy()
        self._terms = effects.in_step_terms.numpy()
        self._sensitivities: tuple[bytes, EffectSensitivities] | None = None
        self._slopes: tuple[Array, Array] | None = None
        if len(effects):
            with torch.no_grad():
                given = reconstruction.setting()
            self._window_start = given.boundary[first].numpy()
            self._acting_masses = given.cloth.masses.numpy()

    def _read(self, p: ClothParameters) -> None:
        self._stored = p.turbulence.detach().numpy()[self.first : self.last].copy()
        self._turbulence = self._stored / self._relative_mass
        self._boundary = p.boundary_motion.detach().numpy()[self.first : self.last + 1].copy()
        self._stiffness = p.stiffness().numpy()
        self._wind = p.wind.detach().numpy().copy()

    def start(self) -> Vector:
        """Standardised coordinates of the current parameters."""
        z: Vector = {}
        if self._field is not None:
            z["turbulence"] = self._field.standardise(self._turbulence.reshape(self.n, *self.grid, 3))
        if self._series is not None:
            z["boundary_motion"] = self._series.standardise(self._boundary)
        if self.priors.stiffness is not None:
            z["stiffness"] = np.log(self._stiffness / self._mean_stiffness) / self.priors.stiffness
        if self.priors.wind is not None:
            z["wind"] = self._horizontal @ (self._wind - self._mean_wind) / self.priors.wind
        if self._value_deviations is not None:
            z["effects"] = (self._values - self._mean_values) / self._value_deviations
        return z

    def turbulence(self, z: Vector) -> Array:
        """Turbulent acceleration (n, N, 3) [m/s²]."""
        if self._field is None:
            return self._turbulence
        return self._field.restored(z["turbulence"]).reshape(self.n, -1, 3)

    def boundary_motion(self, z: Vector) -> Array:
        """Displacement of the pinned vertices (n + 1, n_pinned, 3) [m]."""
        if self._series is None:
            return self._boundary
        motion = self._series.restored(z["boundary_motion"])
        return np.where(self._boundary_free > 0, motion, self._boundary)

    def stiffness(self, z: Vector) -> Array:
        """Stiffnesses in network units."""
        if self.priors.stiffness is None:
            return self._stiffness
        return self._mean_stiffness * np.exp(self.priors.stiffness * z["stiffness"])

    def wind(self, z: Vector) -> Array:
        """Constant wind (3,) [m/s²], orthogonal to gravity where it is free."""
        if self.priors.wind is None:
            return self._wind
        return self._mean_wind + self.priors.wind * z["wind"] @ self._horizontal

    def values(self, z: Vector) -> Array:
        """Numbers of the effects (k,), within their bounds."""
        if self._value_deviations is None:
            return self._values
        values = self._mean_values + self._value_deviations * z["effects"]
        return np.clip(values, self._effects.low.numpy(), self._effects.high.numpy())

    def within_bounds(self, z: Vector) -> Vector:
        """Standardised coordinates of the same values, none beyond the effects' bounds."""
        if self._value_deviations is None:
            return z
        return {**z, "effects": np.clip(z["effects"], *self._standardised_bounds())}

    def stopped(self, z: Vector, vector: Vector, gradient: Vector) -> Vector:
        """The vector, 0 where a coefficient is at a bound and a step down the gradient would leave it."""
        if self._value_deviations is None:
            return vector
        low, high = self._standardised_bounds()
        at, slope = z["effects"], gradient["effects"]
        outwards = ((at <= low) & (slope > 0)) | ((at >= high) & (slope < 0))
        return {**vector, "effects": np.where(outwards, 0.0, vector["effects"])}

    def _standardised_bounds(self) -> tuple[Array, Array]:
        low, high = self._effects.low.numpy(), self._effects.high.numpy()
        return (low - self._mean_values) / self._value_deviations, (
            high - self._mean_values
        ) / self._value_deviations

    def inputs(self, z: Vector, *, linearize: bool) -> WindowInputs:
        """What the simulation of the window is given.

        Args:
            z: standardised coordinates.
            linearize: prepare for LinearizedRollout.
        """
        r = self.reconstruction
        if not len(self._effects):
            boundary = r.template.numpy()[r.cloth.pinned.numpy()] + self.boundary_motion(z)
            return WindowInputs(r.simulator, self.forces(z), boundary)
        acting = self._effects.acting(torch.from_numpy(self.values(z)), as_leaves=linearize)
        with torch.no_grad():
            given = self._setting(z, acting)
            # Terms keep coefficients that require gradients; masses and time step must not.
            cloth = replace(given.cloth, masses=given.cloth.masses.detach())
            cloth = r.cloth if given.cloth is r.cloth else cloth
            given = replace(given, cloth=cloth, frame_interval=given.frame_interval.detach())
            forces = given.forces[self.first : self.last].numpy() + (
                self._interior_mass * self._stored_turbulence(z)
            )
        boundary = given.boundary[self.first : self.last + 1].numpy().copy()
        boundary[0] = self._window_start
        return WindowInputs(r.simulator_of(given), forces, boundary)

    def _setting(self, z: Vector, effects: Sequence[Effect]) -> Setting:
        motion = self.reconstruction.parameters.boundary_motion.detach().clone()
        motion[self.first : self.last + 1] = torch.from_numpy(self.boundary_motion(z))
        return self.reconstruction.setting(effects, motion, torch.from_numpy(self.wind(z)))

    def sensitivities(self, z: Vector) -> EffectSensitivities:
        """Derivatives of the window's inputs by the effects' coefficients; of those in step terms zero."""
        values = self.values(z)
        key = b"".join(a.tobytes() for a in (values, self.wind(z), self.boundary_motion(z)))
        if self._sensitivities is None or self._sensitivities[0] != key:
            self._sensitivities = key, self._differentiate(z, values)
        return self._sensitivities[1]

    def _differentiate(self, z: Vector, values: Array) -> EffectSensitivities:
        # Effects pass over coefficients that are 0 and require no gradients.
        with torch.enable_grad():
            at = torch.from_numpy(values).requires_grad_()
            given = self._setting(z, self._effects.acting(at))
            masses, interval = given.cloth.masses, given.frame_interval
            parts = (
                given.forces[self.first : self.last],
                given.boundary[self.first : self.last + 1],
                masses.log() - 2 * interval.log(),
            )
            forces, boundary, inertia = (jacobian(part, at).numpy() for part in parts)
        # The window starts where the cloth is.
        boundary[:, 0] = 0.0
        return EffectSensitivities(forces, boundary, inertia, masses.detach().numpy())

    def forces(self, z: Vector) -> Array:
        """External forces (n, N, 3) [N], rounded as ClothParameters.forces rounds the stored values.

        Without effects.
        """
        constant = self._masses * (self._gravity + self.wind(z))
        return constant + self._interior_mass * self._stored_turbulence(z)

    def _stored_turbulence(self, z: Vector) -> Array:
        """Turbulence as the parameters store it, per interior mass (n, N, 3) [m/s²]."""
        if self._field is None:
            return self._stored
        return self.turbulence(z) * self._relative_mass

    def si_stiffness(self, z: Vector) -> Array:
        """Stiffnesses in SI units."""
        return self.stiffness(z) * self._stiffness_units

    def material(self, z: Vector) -> Material:
        """The cloth's stiffnesses, batch of one."""
        return self.reconstruction.parameters.material_of(list(torch.from_numpy(self.si_stiffness(z))))

    def _coefficients_by_stiffness(self, z: Vector) -> Array:
        """Derivatives (C, 3) of the energies' coefficients by the stiffnesses in SI units."""
        at = self.si_stiffness(z)
        if self._slopes is None or not np.array_equal(self._slopes[0], at):
            p, energies = self.reconstruction.parameters, self.reconstruction.cloth.energies
            slopes = torch.autograd.functional.jacobian(
                lambda k: energies.coefficients(p.material_of(list(k)).values[0]), torch.from_numpy(at)
            )
            self._slopes = at, slopes.numpy()
        return self._slopes[1]

    def tangent(self, z: Vector, d: Vector) -> Perturbation:
        """Change of the rollout's inputs for a change d of the standardised coordinates at z."""
        n_vertices = self._masses.shape[0]
        acceleration = np.zeros((self.n, n_vertices, 3))
        if self._field is not None:
            acceleration += self._field.restored(d["turbulence"]).reshape(self.n, -1, 3)
        blown = np.zeros(3)
        if self.priors.wind is not None:
            blown = self.priors.wind * d["wind"] @ self._horizontal
        stiffness = np.zeros(self.reconstruction.cloth.energies.n_coefficients)
        if self.priors.stiffness is not None:
            change = self.si_stiffness(z) * self.priors.stiffness * d["stiffness"]
            stiffness = self._coefficients_by_stiffness(z) @ change
        boundary = np.zeros_like(self._boundary)
        if self._series is not None:
            boundary = self._series.restored(d["boundary_motion"]) * self._boundary_free
        rest = np.zeros((n_vertices, 3))
        if not len(self._effects):
            return Perturbation(self._masses * (acceleration + blown), stiffness, boundary, rest, rest)
        forces = self._masses * acceleration + self._masses_at(z)[:, None] * blown
        if self._value_deviations is None:
            return Perturbation(forces, stiffness, boundary, rest, rest)
        sensitivities = self.sensitivities(z)
        change = self._value_deviations * d["effects"]
        return Perturbation(
            forces + np.tensordot(change, sensitivities.forces, 1),
            stiffness,
            boundary + np.tensordot(change, sensitivities.boundary, 1),
            rest,
            rest,
            values=change[self._terms],
            inertia=change @ sensitivities.inertia if self._effects.change_inertia else np.zeros(0),
        )

    def adjoint(self, z: Vector, gradient: Perturbation) -> Vector:
        """Gradient by the standardised coordinates from one by the rollout's inputs."""
        acceleration = gradient.forces * self._masses
        out: Vector = {}
        if self._field is not None:
            out["turbulence"] = self._field.restored_adjoint(acceleration.reshape(self.n, *self.grid, 3))
        if self._series is not None:
            out["boundary_motion"] = self._series.restored_adjoint(gradient.boundary * self._boundary_free)
        if self.priors.stiffness is not None:
            slope = gradient.stiffness @ self._coefficients_by_stiffness(z)
            out["stiffness"] = slope * self.si_stiffness(z) * self.priors.stiffness
        if self.priors.wind is not None:
            out["wind"] = self.priors.wind * (self._horizontal @ acceleration.sum((0, 1)))
        if self._value_deviations is not None:
            sensitivities = self.sensitivities(z)
            slope = np.tensordot(sensitivities.forces, gradient.forces, 3)
            slope += np.tensordot(sensitivities.boundary, gradient.boundary, 3)
            slope[self._terms] += gradient.values
            if self._effects.change_inertia:
                slope += sensitivities.inertia @ gradient.inertia
            out["effects"] = self._value_deviations * slope
        if len(self._effects) and self.priors.wind is not None:
            pushed = (self._masses_at(z)[:, None] * gradient.forces).sum((0, 1))
            out["wind"] = self.priors.wind * (self._horizontal @ pushed)
        return out

    def _masses_at(self, z: Vector) -> Array:
        """Masses (N,) [kg] under the effects."""
        return self._acting_masses if self._value_deviations is None else self.sensitivities(z).masses

    def write(self, z: Vector) -> None:
        """Store the values in the reconstruction's parameters."""
        p = self.reconstruction.parameters
        drift = self._drift(z)
        with torch.no_grad():
            if self._field is not None:
                p.turbulence[self.first : self.last] = torch.from_numpy(
                    self.turbulence(z) * self._relative_mass
                )
            p.boundary_motion[self.first : self.last + 1] = torch.from_numpy(self.boundary_motion(z))
            p.set_stiffness(self.stiffness(z).tolist())
            # The frames before the window keep the forces that have brought the cloth to where it starts.
            p.turbulence[: self.first] += drift
            p.wind.copy_(torch.from_numpy(self.wind(z)))
            if self._effects.values is not None:
                self._effects.values.copy_(torch.from_numpy(self.values(z)))

    def _drift(self, z: Vector) -> Tensor:
        """What the steady forces lose before the window, as turbulence (first or 1, N, 3) [m/s²]."""
        if not len(self._effects):
            return torch.from_numpy(self._relative_mass * (self._wind - self.wind(z)))[None]
        return force_change(self.reconstruction, self.values(z), self.wind(z))[: self.first]


@torch.no_grad()
def force_change(reconstruction: Reconstruction, values: Array, wind: Array) -> Tensor:
    """External forces now minus those for other coefficients of the effects and wind, (F-1, N, 3).

    Args:
        reconstruction: with the coefficients and the wind of now.
        values: of the effects (k,).
        wind: (3,) [m/s²].

    Returns:
        Force over an interior vertex's mass [m/s²], as turbulence is stored.
    """
    acting = reconstruction.effects.acting(torch.from_numpy(values))
    other = reconstruction.setting(acting, wind=torch.from_numpy(wind)).forces
    return (reconstruction.setting().forces - other) / reconstruction.parameters.units.mass
