"""The simulation layer S: from cloth and body at two times to the cloth at the next one.

Li et al., Deep Physics-aware Inference of Cloth Deformation for Monocular Human Performance Capture, 3DV
2021, section 3.2: implicit Euler as a minimisation, with adaptive regularisation and a back-tracking line
search, contact with the body, and their Eq. 1, which draws the silhouette to the rays of its pixels.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.capture.body.subject import Subject
from toile.capture.garments.garment import Garment, attached_targets
from toile.capture.layer.silhouette import Outline, SilhouettePotential, SilhouetteRays
from toile.errors import InputError
from toile.limits import Count, Fraction, Positive
from toile.physics.cloth import mesh_cloth
from toile.physics.contact.body import BodyContact, ContactSettings
from toile.physics.contact.own import OwnContactSettings
from toile.physics.energies.membrane import Membrane, NeoHookean
from toile.physics.implicit.integrators import BackwardEuler
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.renewed import RenewedPotential, RenewedSum, RenewingSimulator
from toile.physics.material import Material
from toile.physics.simulator import SimulationError, StepStatus
from toile.physics.state import State
from toile.physics.step_terms import StepTerm

Array = NDArray[np.float64]

GRAVITY = 9.81
"""Along -y [m/s²]."""

DEEPEST_START = 0.005
"""How deep in the body a garment may start a motion [m]: contact pushes it out, but not the sound way."""


@dataclass(frozen=True)
class LayerSettings:
    """Settings of the layer; see docs/capture.md for what they were chosen by.

    Attributes:
        tolerance: see NewtonSettings; of the last pass.
        loosely: that of the passes before as a multiple.
        max_iterations: Newton iterations of a pass.
        passes: solves per step, the contacts renewed in between; up to twice as many where the last one does
            not converge.
        contact: see ContactSettings.
        own_contact: of the garment with itself, see OwnContactSettings; None: it passes through itself.
        silhouette_weight: of one pixel in Eq. 1 [N/m].
        silhouette_along: share of it along the silhouette; 1 in Eq. 1, see SilhouettePotential.
        silhouette_reach: pixels farther than this from the cloth count for nothing [m].
    """

    tolerance: Positive = 1e-3
    loosely: Positive = 10.0
    max_iterations: Count = 60
    passes: Count = 3
    contact: ContactSettings = field(default_factory=ContactSettings)
    own_contact: OwnContactSettings | None = None
    silhouette_weight: Positive = 0.1
    silhouette_along: Fraction = 1.0
    silhouette_reach: Positive = 0.1


@dataclass(frozen=True)
class LayerStep:
    """Outcome of one step.

    Attributes:
        positions: x_{n+1} (N, 3) [m], a float64 tensor; differentiable if an input required gradients.
        velocities: (x_{n+1} - x_n) / h (N, 3) [m/s].
        converged: whether the last solve of the step reached the tolerance.
        newton_steps: Newton iterations of all passes together.
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
        velocities: at the last frame (N, 3) [m/s]; with its positions the motion goes on from there.
    """

    garment_positions: Array
    converged: NDArray[np.bool_]
    newton_steps: NDArray[np.int64]
    residuals: Array
    kinetic: Array
    elastic: Array
    gravitational: Array
    seconds: Array
    velocities: Array


class SimulationLayer:
    """A garment on a body whose motion is given.

    World frame: y up, floor at y = 0, metres, seconds, kilograms. Attached vertices go where the body takes
    them and collide with nothing.

    Args:
        garment: rest shape, attachment and material.
        body_faces: (T, 3) int64, counter-clockwise seen from outside.
        inactive: (V,) bool, body vertices that nothing collides with (the arms); none if None.
        settings: see LayerSettings.
        membrane: law of in-plane strain.
        terms: what acts within a step besides, e.g. air drag; see StepTerm.

    Attributes:
        cloth: the garment as a cloth.
        contact: finds its contacts.
    """

    def __init__(
        self,
        garment: Garment,
        body_faces: Tensor,
        inactive: Tensor | None = None,
        settings: LayerSettings | None = None,
        membrane: type[Membrane] = NeoHookean,
        terms: Sequence[StepTerm] = (),
    ) -> None:
        self.garment = garment
        self.settings = settings or LayerSettings()
        self._made_of = (garment, body_faces, inactive, settings, membrane, terms)
        self.body_faces = body_faces
        self._terms = tuple(terms)
        material = garment.material
        # With angles of their own at rest hinges have a jump of energy where they are folded completely,
        # which Newton's method can't pass.
        self.cloth = mesh_cloth(
            garment.rest_vertices,
            garment.faces,
            material.density,
            tuple(garment.attached.tolist()),
            membrane,
            flat=True,
        )
        self._n_body = int(body_faces.max()) + 1 if inactive is None else len(inactive)
        self.contact = BodyContact(
            self.cloth.topology,
            self.cloth.masses.numpy(),
            garment.attached.numpy(),
            body_faces.numpy(),
            np.zeros(self._n_body, np.bool_) if inactive is None else inactive.numpy(),
            self.settings.contact,
            self.settings.own_contact,
        )
        self._outline = Outline(self.cloth.topology, self.contact.body)
        self._simulators: dict[float, RenewingSimulator] = {}
        self._gravity = torch.zeros(self.cloth.n_vertices, 3, dtype=torch.float64)
        self._gravity[:, 1] = -GRAVITY * self.cloth.masses

    def __reduce__(self) -> tuple[object, ...]:
        # Trees of boxes live in this process; another one makes its own.
        return type(self), self._made_of

    @staticmethod
    def of(
        garment: Garment,
        subject: Subject,
        settings: LayerSettings | None = None,
        membrane: type[Membrane] = NeoHookean,
        terms: Sequence[StepTerm] = (),
    ) -> SimulationLayer:
        """The layer of a garment on a subject, whose arms collide with nothing (as in the paper)."""
        return SimulationLayer(garment, subject.faces, subject.parts["arms"], settings, membrane, terms)

    @property
    def material(self) -> Material:
        """Stiffnesses of the garment's material."""
        m = self.garment.material
        return self.cloth.material(young=m.young, poisson=m.poisson, bending=m.bending)

    def stored_energy(self, positions: Tensor) -> Tensor:
        """Elastic and gravitational energy (...) [J] at positions (..., N, 3) [m]; differentiable."""
        coefficients = self.cloth.energies.coefficients(self.material.values[0])
        weight = (self._gravity * positions).sum((-2, -1))
        return self.cloth.energies.energy(positions, coefficients) - weight

    def step(
        self,
        positions: Tensor,
        velocities: Tensor,
        body: Tensor,
        next_body: Tensor,
        time_step: float,
        *,
        material: Material | None = None,
        friction: float | Tensor | None = None,
        attached: Tensor | None = None,
        silhouettes: Sequence[SilhouetteRays] = (),
    ) -> LayerStep:
        """One step of implicit Euler.

        Differentiable by everything that is a tensor here, by the implicit function theorem pass by pass:
        planes and normal forces of the friction follow from body and cloth. Which face, edge or corner is
        nearest to what counts as given: where that changes there is no derivative.

        Args:
            positions: x_n (N, 3) [m], float64.
            velocities: v_n (N, 3) [m/s]; (x_n - x_{n-1}) / h of two given times.
            body: vertices of the body at the step's begin (V, 3) [m].
            next_body: and at its end (V, 3) [m].
            time_step: h [s].
            material: stiffnesses, a batch of one; the garment's if None.
            friction: μ; the garment's if None.
            attached: attached vertices at the end (A, 3) [m]; where the body takes them if None.
            silhouettes: of the step's end, one per view, for Eq. 1.

        Raises:
            InputError: gradients are asked for where the garment is in contact with itself.
        """
        if friction is None:
            friction = self.garment.material.friction
        begin = positions.detach().numpy()
        ahead = (positions + time_step * velocities).detach().numpy()
        if self.contact.own is not None:
            self._refuse_gradients(positions, velocities, body, next_body, material, friction, attached)
        contact = self.contact.begin(begin, body, next_body, friction, time_step, ahead)
        if attached is None:
            attached = attached_targets(self.garment, next_body, self.body_faces)
        simulator = self._simulator(time_step)
        state = State.start(positions[None], velocities[None], time_step, simulator.n_past)
        guess = contact.outside(ahead)
        potential: RenewedPotential = contact
        if silhouettes:
            drawn = SilhouettePotential(
                self._outline,
                silhouettes,
                self.settings.silhouette_weight,
                self.settings.silhouette_along,
                self.settings.silhouette_reach,
                guess,
            )
            potential = RenewedSum((contact, drawn))
        result = simulator.step_with(
            [potential],
            state,
            self.material if material is None else material,
            self._gravity[None],
            attached[None],
            torch.from_numpy(guess)[None],
        )
        found = result.state.positions[0]
        return LayerStep(
            positions=found,
            velocities=(found - positions) / time_step,
            converged=result.status[0] is StepStatus.CONVERGED,
            newton_steps=result.iterations[0],
            contacts=contact.pushing(found.detach().numpy()),
            residual=result.residual[0],
        )

    def simulate(
        self,
        body_positions: Tensor,
        fps: float,
        substeps: int = 4,
        start: Tensor | None = None,
        velocities: Tensor | None = None,
        silhouettes: Sequence[Sequence[SilhouetteRays]] | None = None,
    ) -> Motion:
        """Simulate F frames.

        Args:
            body_positions: (F, V, 3) [m]; linear in between.
            fps: frames per second.
            substeps: steps per frame.
            start: garment at frame 0 (N, 3) [m]; its rest shape if None.
            velocities: at frame 0 (N, 3) [m/s]; 0 if None.
            silhouettes: of every frame's views, for Eq. 1 in the step that ends there; none if None.

        Raises:
            InputError: the body has another number of vertices than the layer's, or the garment starts in it,
                or through itself where ``own_contact`` is asked for.
            SimulationError: positions are no longer finite.
        """
        body_positions = torch.as_tensor(body_positions, dtype=torch.float64)
        if body_positions.ndim != 3 or body_positions.shape[1] < self._n_body:
            raise InputError(
                "Body does not fit the layer",
                where="body_positions",
                expected=f"shape (F, {self._n_body}, 3)",
                got=str(tuple(body_positions.shape)),
            )
        x = self.garment.rest_vertices.clone() if start is None else start.clone()
        v = torch.zeros_like(x) if velocities is None else velocities
        self._check_start(x, body_positions[0])
        h = 1.0 / (fps * substeps)
        frames = [x]
        energies = [self._energies(x, v)]
        steps: list[list[LayerStep]] = []
        seconds = []
        body = body_positions[0]
        with torch.no_grad():
            for frame, (before, after) in enumerate(pairwise(body_positions), 1):
                begin = time.perf_counter()
                steps.append([])
                for sub in range(1, substeps + 1):
                    next_body = after if sub == substeps else torch.lerp(before, after, sub / substeps)
                    seen = silhouettes[frame] if silhouettes is not None and sub == substeps else ()
                    step = self.step(x, v, body, next_body, h, silhouettes=seen)
                    x, v, body = step.positions, step.velocities, next_body
                    steps[-1].append(step)
                    if not bool(torch.isfinite(x).all()):
                        raise SimulationError(
                            f"frame {frame}, sub-step {sub} of {substeps}: positions are not finite. Try "
                            "more sub-steps or a slower motion."
                        )
                seconds.append(time.perf_counter() - begin)
                frames.append(x)
                energies.append(self._energies(x, v))
        kinetic, elastic, gravitational = (np.array(column) for column in zip(*energies, strict=True))
        return Motion(
            garment_positions=torch.stack(frames).numpy(),
            converged=np.array([[s.converged for s in row] for row in steps], np.bool_),
            newton_steps=np.array([[s.newton_steps for s in row] for row in steps], np.int64),
            residuals=np.array([[s.residual for s in row] for row in steps]),
            kinetic=kinetic,
            elastic=elastic,
            gravitational=gravitational,
            seconds=np.array(seconds),
            velocities=v.numpy(),
        )

    def _refuse_gradients(self, *inputs: Tensor | Material | float | None) -> None:
        """Planes between parts of the cloth follow from too much: both sides, and what detection stopped."""
        tensors = [given.values if isinstance(given, Material) else given for given in inputs]
        asked = any(isinstance(given, Tensor) and given.requires_grad for given in tensors)
        if asked and torch.is_grad_enabled():
            raise InputError(
                "No gradients through contact of a garment with itself",
                where="own_contact",
                expected="none, or inputs that require no gradients",
                got="both",
            )

    def _check_start(self, x: Tensor, body: Tensor) -> None:
        self.contact.body.move(body.numpy())
        distances = self.contact.surface(x.numpy()[self.contact.loose], self.settings.contact.reach).distances
        deepest = -float(distances.min(initial=0.0))
        if deepest > DEEPEST_START:
            raise InputError(
                "Garment starts inside the body",
                where="frame 0",
                expected=f"every vertex at most {1e3 * DEEPEST_START:g} mm deep",
                got=f"{int((distances < -DEEPEST_START).sum())} deeper, the deepest {1e3 * deepest:.1f} mm",
            )
        own = self.contact.own
        if own is not None and (crossings := own.proximity.crossings(x.numpy())):
            raise InputError(
                "Garment starts through itself",
                where="frame 0",
                expected="no edge through a face",
                got=f"{crossings} of them",
            )

    def _energies(self, x: Tensor, v: Tensor) -> tuple[float, float, float]:
        coefficients = self.cloth.energies.coefficients(self.material.values[0])
        kinetic = 0.5 * float((self.cloth.masses[:, None] * v.square()).sum())
        return kinetic, float(self.cloth.energies.energy(x, coefficients)), -float((self._gravity * x).sum())

    def _simulator(self, time_step: float) -> RenewingSimulator:
        if time_step not in self._simulators:
            self._simulators[time_step] = RenewingSimulator(
                self.cloth,
                time_step,
                BackwardEuler(),
                NewtonSettings(self.settings.tolerance, self.settings.max_iterations),
                self.settings.passes,
                self.settings.loosely,
                self._terms,
            )
        return self._simulators[time_step]
