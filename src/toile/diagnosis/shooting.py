"""Multiple shooting: short simulations with starts, boundary and forces of their own, stiffness shared.

Long rollouts amplify every error, so the clip is cut into windows. Within one, the cloth moves by its own
equations; what may differ from them is a force field with few, smooth modes in space and time, whose size is
itself a question (Kennedy and O'Hagan 2001 call it the discrepancy). Gauss-Newton with an explicit Jacobian.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from toile.denormals import denormals_flushed
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.damping import Damping
from toile.diagnosis.force_modes import TOLERANCE, external_first, n_balanced
from toile.diagnosis.image_information import quadratic
from toile.diagnosis.sensitivities import (
    KnownMotion,
    LoadSensitivities,
    StepForces,
    TangentSettings,
    remember,
)
from toile.diagnosis.template_tension import RIDGE, TemplateTension
from toile.diagnosis.tracked import Tracked
from toile.effects.base import Effect, Surroundings
from toile.effects.setting import setting
from toile.limits import Count, CountOrZero, Fraction, NonNegative, Positive, Unit
from toile.physics.cloth import Cloth
from toile.physics.grid_lines import GridLines
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.material import Material
from toile.physics.rollout import rollout
from toile.physics.simulator import StepStatus
from toile.physics.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ShootingSettings:
    """Windows and priors.

    Attributes:
        window: frames of a window.
        modes: cosine modes along each side, for the state at a window's start and for the forces.
        force_knot: frames between knots of the force.
        boundary_knot: frames between knots of the boundary positions.
        start_position: deviation of each mode of the start's positions [m].
        start_velocity: of its velocities [m/s].
        jump_position: of each mode of what lies between the end of a window and the start of the next [m].
        jump_velocity: of its velocities [m/s].
        boundary: of the boundary positions at a knot [m].
        stiffness: of log Y, S, B.
        compression: of the logarithms of compression ratios, where the cloth's law has any.
        wind: of each horizontal component [m/s²].
        force: of each mode of the force per mass while the base is fitted [m/s²].
        external: of those among them that disturb the balance of torques [m/s²]; see force_modes.
        likelihood_weight: in the image term, whose errors are not independent from point to point; 1 if they
            were.
        holding: what a direction must have of the holders' forces not to count as free, see n_balanced.
        tension_ridge: of the tension that the template has already, see template_tension.
        newton_tolerance: out-of-balance force over the weight of a vertex that a simulated sub-step leaves:
            0.01 m/s², far below any discrepancy that is looked at.
        sweeps: ways through the clip, window by window.
        iterations: per window of a sweep.
        window_steps: lengths of such an iteration's step that are tried.
        window_shorter: factor from one of them to the next.
        window_stalled: share of a window's cost that an iteration gains, below which it is the last one.
        passes: over the whole clip at most.
        longest_stiffness: change of a logarithm of stiffness in one iteration or pass at most: a factor of 2.
        stalled: share of the cost that a pass gains, below which (with ``nothing``) it is the last one.
        nothing: log probability beside it.
        damping: of the steps of passes and refits.
        tangents: see TangentSettings.
    """

    window: Annotated[Count, Unit("frames")] = 8
    modes: Count = 6
    force_knot: Annotated[Count, Unit("frames")] = 4
    boundary_knot: Annotated[Count, Unit("frames")] = 2
    start_position: Annotated[Positive, Unit("m")] = 0.003
    start_velocity: Annotated[Positive, Unit("m/s")] = 0.06
    jump_position: Annotated[Positive, Unit("m")] = 0.0003
    jump_velocity: Annotated[Positive, Unit("m/s")] = 0.006
    boundary: Annotated[Positive, Unit("m")] = 0.003
    stiffness: Positive = 1.0
    compression: Positive = 1.0
    wind: Annotated[Positive, Unit("m/s²")] = 2.0
    force: Annotated[Positive, Unit("m/s²")] = 0.7
    external: Annotated[Positive, Unit("m/s²")] = 0.1
    likelihood_weight: Positive = 0.01
    holding: Positive = TOLERANCE
    tension_ridge: Positive = RIDGE
    newton_tolerance: Positive = 1e-3
    sweeps: Count = 1
    iterations: CountOrZero = 4
    window_steps: Count = 5
    window_shorter: Fraction = 0.35
    window_stalled: NonNegative = 0.05
    passes: CountOrZero = 16
    longest_stiffness: Positive = 0.7
    stalled: NonNegative = 0.002
    nothing: NonNegative = 0.5
    damping: Damping = field(default_factory=Damping)
    tangents: TangentSettings = field(default_factory=TangentSettings)


@dataclass(frozen=True)
class Base:
    """Shared unknowns: what the cloth's law depends on, and constant wind.

    Attributes:
        material: (P,) in SI units, in the order of the law's parameters: Y [N/m], S, B [N·m], and compression
            ratios where the law has any.
        wind: (2,) along the two horizontal directions [m/s²].
    """

    material: Array
    wind: Array

    def material_of(self, cloth: Cloth, n: int = 1) -> Material:
        """The material of a cloth of that law, batch of ``n``."""
        return Material(cloth.energies.parameters, torch.from_numpy(self.material).expand(n, -1))


@dataclass
class WindowMotion:
    """A window's unknowns and the motion they give.

    Attributes:
        first, last: frames.
        reference: state at ``first`` that the offsets refer to.
        standardised: local unknowns in units of their deviations (n_local,).
        positions: of all sub-steps [(last - first) substeps + 1, N, 3].
        start, end: states at ``first`` and ``last`` as simulated.
        converged: whether every step did.
        slower: true time between frames over the nominal one. The start's velocities are of the nominal
            time, as those of the reference, the end's of the true one.
    """

    first: int
    last: int
    reference: State
    standardised: Array
    positions: Array = field(default_factory=lambda: np.zeros(0))
    start: State | None = None
    end: State | None = None
    converged: bool = True
    slower: float = 1.0


def _stacked(states: Sequence[State]) -> State:
    """States of as many steps each as one batch."""
    return State(
        torch.cat([state.positions for state in states]),
        torch.cat([state.velocities for state in states]),
        torch.cat([state.past for state in states]),
        states[0].steps,
        torch.cat([state.began for state in states]),
    )


def _of_batch(state: State, b: int) -> State:
    """One of a batch, as a batch of one."""
    of_one = slice(b, b + 1)
    parts = (state.positions, state.velocities, state.past, state.began)
    positions, velocities, past, began = (part[of_one].clone() for part in parts)
    return State(positions, velocities, past, state.steps, began)


def cosine_modes(lines: GridLines, n: int) -> Array:
    """n² smooth modes (n², N) on a grid, the constant first; of unit mean square where it is even."""
    # Vertices in the middle of cells of their own: on an even grid the modes are orthogonal then.
    i, j = ((len(p) - 1) * p.numpy() / len(p) + 0.5 / len(p) for p in lines.places())
    scale = np.where(np.arange(n) > 0, np.sqrt(2), 1.0)
    a = scale[:, None] * np.cos(np.pi * np.arange(n)[:, None] * i)
    b = scale[:, None] * np.cos(np.pi * np.arange(n)[:, None] * j)
    return (a[:, None, :, None] * b[None, :, None, :]).reshape(n * n, -1)


def hats(times: NDArray[np.floating], spacing: float, n: int) -> Array:
    """Piecewise linear hat functions (T, n) with knots 0, spacing, 2 spacing, ... at times (T,)."""
    return np.clip(1 - np.abs(times[:, None] / spacing - np.arange(n)), 0, None)


class Shooting:
    """The problem of one clip.

    Args:
        simulator: cloth, sub-step and integrator.
        substeps: per frame.
        gravity: (3,) [m/s²].
        horizontal: (2, 3) unit vectors orthogonal to gravity.
        grid: (H, W).
        boundary: tracked pinned positions (F, n_pinned, 3) [m].
        tracked: see Tracked.
        settings: see ShootingSettings.
        forces: whether windows have forces beside what the model knows of.
    """

    def __init__(
        self,
        simulator: LinearizableSimulator,
        substeps: int,
        gravity: Array,
        horizontal: Array,
        grid: tuple[int, int],
        boundary: Array,
        tracked: Tracked,
        settings: ShootingSettings,
        *,
        forces: bool = True,
    ) -> None:
        self.simulator = simulator
        self.substeps = substeps
        self.gravity = gravity
        self.horizontal = horizontal
        self.grid = grid
        self.boundary = boundary
        self.tracked = tracked
        self.weight = settings.likelihood_weight
        self.settings = settings
        self.forces = forces
        self.tension = next((t for t in simulator.terms if isinstance(t, TemplateTension)), None)
        self.masses = simulator.cloth.masses.numpy()
        self.free = simulator.assembly.free
        modes = cosine_modes(simulator.cloth.lines, settings.modes)
        eye = np.eye(3)
        self.fields = (modes[:, None, :, None] * eye[None, :, None, :]).reshape(-1, len(self.masses), 3)
        self.fields = self.fields * self.free
        self.n_fields = len(self.fields)
        flat = self.fields.reshape(self.n_fields, -1)
        self._to_modes = np.linalg.solve(flat @ flat.T, flat)
        self._to_modes_single = self._to_modes.astype(np.float32)
        self.frames_once = False
        self.push = np.zeros(3)
        self.n_pinned = len(simulator.cloth.pinned)
        pinned = simulator.assembly.pinned
        size = float(np.linalg.norm(np.ptp(tracked.positions[0], axis=0)))
        self.n_external = n_balanced(tracked.positions[0][pinned], size, settings.holding)
        self._force_fields: dict[tuple[int, int], Array] = {}

    # The layout of a window's local unknowns: [start positions | start velocities | boundary positions |
    # forces].

    def n_knots(self, n_frames: int, spacing: int) -> int:
        """Knots that cover a window of n_frames intervals."""
        return -(-n_frames // spacing) + 1

    def layout(self, n_frames: int) -> tuple[int, int, int]:
        """Offsets of velocities... of boundary positions, forces, and the number of local unknowns."""
        boundary = 2 * self.n_fields
        forces = boundary + self.n_knots(n_frames, self.settings.boundary_knot) * self.n_pinned * 3
        return boundary, forces, forces + self.n_force_knots(n_frames) * self.n_fields

    def n_force_knots(self, n_frames: int) -> int:
        """Knots of the force in a window of n_frames intervals; 0 without forces."""
        return self.n_knots(n_frames, self.settings.force_knot) if self.forces else 0

    def without_forces(self) -> Shooting:
        """The same problem, its windows without forces of their own."""
        return Shooting(
            self.simulator,
            self.substeps,
            self.gravity,
            self.horizontal,
            self.grid,
            self.boundary,
            self.tracked,
            self.settings,
            forces=False,
        )

    def with_window(self, frames: int) -> Shooting:
        """The same problem with windows of so many frames."""
        other = copy.copy(self)
        other.settings = replace(self.settings, window=frames)
        return other

    def counting_frames_once(self) -> Shooting:
        """The same problem, in which a frame where two windows meet counts for the first of them alone.

        With short windows there are many such frames.
        """
        other = copy.copy(self)
        other.frames_once = True
        return other

    def pushed(self, field: Array) -> Shooting:
        """The same problem with a force per mass (N, 3) [m/s²] beside gravity."""
        other = copy.copy(self)
        other.push = self.push + field
        return other

    def external(self, n_frames: int) -> NDArray[np.bool_]:
        """Which local unknowns are forces that disturb the balance of torques (n_local,)."""
        _, forces, total = self.layout(n_frames)
        at = np.arange(total) - forces
        return np.asarray((at >= 0) & (at % self.n_fields < self.n_external))

    def force_fields(self, first: int, last: int) -> Array:
        """Force modes per mass (n_knots, n_fields, N, 3) of a window, external ones first at every knot."""
        if (first, last) not in self._force_fields:
            pinned = self.simulator.assembly.pinned
            spacing = self.settings.force_knot
            found = [np.zeros((0, *self.fields.shape))]
            for knot in range(self.n_force_knots(last - first)):
                x = self.tracked.positions[min(first + knot * spacing, last)]
                turned = external_first(self.fields, self.masses, x, x[pinned], self.n_external)
                found.append(np.tensordot(turned, self.fields, 1)[None])
            self._force_fields[first, last] = np.concatenate(found)
        return self._force_fields[first, last]

    def deviations(self, n_frames: int, force: float, external: float) -> Array:
        """Prior standard deviations of the local unknowns."""
        boundary, forces, total = self.layout(n_frames)
        out = np.empty(total)
        out[: self.n_fields] = self.settings.start_position
        out[self.n_fields : boundary] = self.settings.start_velocity
        out[boundary:forces] = self.settings.boundary
        out[forces:] = force
        out[self.external(n_frames)] = external
        return out

    def local(self, window: WindowMotion, standardised: Array) -> tuple[State, Array, Array]:
        """Start state, boundary (n + 1, n_pinned, 3) and force per mass (n, N, 3) of local unknowns."""
        n = window.last - window.first
        oa, of, _ = self.layout(n)
        values = standardised * self.deviations(n, self.settings.force, self.settings.external)
        x0 = np.tensordot(values[: self.n_fields], self.fields, 1)
        v0 = np.tensordot(values[self.n_fields : oa], self.fields, 1)
        knots = hats(
            np.arange(n + 1.0), self.settings.boundary_knot, self.n_knots(n, self.settings.boundary_knot)
        )
        moved = (knots @ values[oa:of].reshape(knots.shape[1], -1)).reshape(n + 1, -1, 3)
        boundary = self.boundary[window.first : window.last + 1] + moved
        knots = hats(np.arange(n) + 0.5, self.settings.force_knot, self.n_force_knots(n))
        at_knots = np.einsum(
            "qk,qknc->qnc",
            values[of:].reshape(knots.shape[1], self.n_fields),
            self.force_fields(window.first, window.last),
        )
        force = np.tensordot(knots, at_knots, 1)
        ref = window.reference
        h = self.simulator.time_step
        pinned = self.simulator.assembly.pinned
        positions = ref.positions[0].numpy() + x0
        positions[pinned] = boundary[0]
        past = ref.past[0].numpy().copy()
        for k in range(len(past)):
            past[k] += x0 - (k + 1) * h * v0
        state = State(
            torch.from_numpy(positions)[None],
            ref.velocities + torch.from_numpy(v0)[None],
            torch.from_numpy(past)[None],
            ref.steps,
            ref.began,
        )
        return state, boundary, force

    def simulate(
        self,
        window: WindowMotion,
        standardised: Array,
        base: Base,
        given: ChangedSimulation | None = None,
    ) -> WindowMotion:
        """The same window with other unknowns, simulated.

        Args:
            window: its frames, reference and last motion.
            standardised: local unknowns.
            base: stiffness and wind.
            given: the clip with effects, see ``with_effects``; None without any.
        """
        return self._simulate_alike([window], [standardised], base, given)[0]

    def simulate_all(
        self,
        windows: Sequence[WindowMotion],
        standardised: Sequence[Array],
        base: Base,
        given: ChangedSimulation | None = None,
    ) -> list[WindowMotion]:
        """The same as ``simulate`` of each, to the last digit; those of one length as one batch.

        Args:
            windows: in any order.
            standardised: local unknowns of each.
            base: see ``simulate``.
            given: see ``simulate``.
        """
        alike: dict[tuple[int, int, int], list[int]] = {}
        for k, window in enumerate(windows):
            kind = (window.last - window.first, window.reference.steps, len(window.positions))
            alike.setdefault(kind, []).append(k)
        found: dict[int, WindowMotion] = {}
        for members in alike.values():
            batch = [windows[k] for k in members]
            moved = self._simulate_alike(batch, [standardised[k] for k in members], base, given)
            found.update(zip(members, moved, strict=True))
        return [found[k] for k in range(len(windows))]

    def _simulate_alike(
        self,
        windows: Sequence[WindowMotion],
        standardised: Sequence[Array],
        base: Base,
        given: ChangedSimulation | None,
    ) -> list[WindowMotion]:
        """Windows of as many frames each, and of as long a last motion."""
        wind = base.wind @ self.horizontal
        simulator = self.simulator if given is None else given[0]
        states, every_force, every_pinned = [], [], []
        for window, own in zip(windows, standardised, strict=True):
            state, boundary, force = self.local(window, own)
            pinned = torch.from_numpy(boundary)
            if given is None:
                forces = torch.from_numpy(self.masses[:, None] * (self.gravity + wind + self.push + force))
            else:
                _, cloth, total, moved = given
                forces = total[window.first : window.last] + cloth.masses[:, None] * torch.from_numpy(
                    self.push + force
                )
                shift = moved - torch.from_numpy(self.boundary[: len(moved)])
                pinned = pinned + shift[window.first : window.last + 1]
            states.append(state)
            every_force.append(forces)
            every_pinned.append(pinned)
        warm = None
        if len(windows[0].positions):
            warm = torch.from_numpy(np.stack([window.positions for window in windows]))
        motion = rollout(
            simulator,
            _stacked(states),
            base.material_of(simulator.cloth, len(windows)),
            torch.stack(every_force),
            torch.stack(every_pinned),
            self.substeps,
            warm,
            throw=False,
        )
        positions, end = motion.all_positions.numpy(), motion.steps[-1].state
        return [
            replace(
                window,
                standardised=own,
                positions=positions[b].copy(),
                start=states[b],
                end=_of_batch(end, b),
                converged=all(step.status[b] is StepStatus.CONVERGED for step in motion.steps),
                slower=simulator.time_step / self.simulator.time_step,
            )
            for b, (window, own) in enumerate(zip(windows, standardised, strict=True))
        ]

    def with_effects(
        self, effects: Sequence[Effect], around: Surroundings | None, base: Base
    ) -> ChangedSimulation | None:
        """The clip with effects, for all of its windows; None without any.

        Args:
            effects: in the model.
            around: the whole clip; needed with effects.
            base: stiffness and wind.
        """
        if not effects:
            return None
        assert around is not None
        return changed_simulation(self, effects, around, torch.from_numpy(base.wind @ self.horizontal))

    def image_cost(self, window: WindowMotion) -> float:
        """Negative log-likelihood of a window's images, up to a constant."""
        frames = window.positions[:: self.substeps]
        counted = range(self._first_counted(window), len(frames))
        return self.weight * sum(self.tracked.cost(window.first + i, frames[i]) for i in counted)

    def _first_counted(self, window: WindowMotion) -> int:
        return 1 if self.frames_once and window.first > 0 else 0

    def cost(self, window: WindowMotion) -> float:
        """Negative log-posterior of a window's images and local unknowns, up to a constant."""
        return self.image_cost(window) + 0.5 * float(window.standardised @ window.standardised)

    def clip_cost(self, windows: Sequence[WindowMotion], size: Discrepancy | None = None) -> float:
        """Negative log-posterior of windows that follow one another, up to a constant.

        Args:
            windows: simulated.
            size: of the discrepancy; None for that of the base fit.
        """
        standardised = [self._standardised_at(window, size) for window in windows]
        total = self.image_cost(windows[0]) + 0.5 * float(standardised[0] @ standardised[0])
        for (before, window), local in zip(pairwise(windows), standardised[1:], strict=True):
            jump, own = self.jump(before, window), local[2 * self.n_fields :]
            total += self.image_cost(window) + 0.5 * float(jump @ jump + own @ own)
        return total

    def _standardised_at(self, window: WindowMotion, size: Discrepancy | None) -> Array:
        """Local unknowns in units of their deviations at a size of the discrepancy."""
        if size is None:
            return window.standardised
        s, n = self.settings, window.last - window.first
        return window.standardised * self.deviations(n, s.force, s.external) / self.deviations(n, *size)

    def jump(self, before: WindowMotion, window: WindowMotion) -> Array:
        """Modes of positions and velocities between an end and the next start, in deviations."""
        assert before.end is not None
        assert window.start is not None
        positions = (window.start.positions - before.end.positions)[0].numpy()
        velocities = (window.start.velocities - before.slower * before.end.velocities)[0].numpy()
        return self._in_jumps(positions.reshape(-1, 1), velocities.reshape(-1, 1))[:, 0]

    def jump_ratio(self) -> Array:
        """Derivative of a jump by the local unknowns of the start (2 n_fields,)."""
        s = self.settings
        return np.repeat(
            (s.start_position / s.jump_position, s.start_velocity / s.jump_velocity), self.n_fields
        )

    def _in_jumps(self, positions: NDArray[np.floating], velocities: NDArray[np.floating]) -> Array:
        """Modes of positions (3N, R) [m] and velocities [m/s], in deviations of a jump (2 n_fields, R)."""
        s = self.settings
        # In the precision of what is given: tangents are single.
        modes = self._to_modes_single if positions.dtype == np.float32 else self._to_modes
        return np.concatenate(
            (modes @ positions / s.jump_position, modes @ velocities / s.jump_velocity)
        ).astype(np.float64)

    def image_gradient(self, window: WindowMotion, motion: NDArray[np.float32]) -> Array:
        """Gradient of the image term for given tangents, by [shared | local] like that of ``normal``.

        Args:
            window: simulated.
            motion: change of the positions of every sub-step (S + 1, 3N, n) [m].
        """
        g = np.zeros(motion.shape[-1])
        frames = window.positions[:: self.substeps]
        for i in range(self._first_counted(window), len(frames)):
            J = motion[i * self.substeps]
            g += J.T @ self.tracked.slope(window.first + i, frames[i]).astype(np.float32)
        return self.weight * g

    def known(
        self, windows: Sequence[WindowMotion], base: Base, simulator: LinearizableSimulator | None = None
    ) -> list[KnownMotion]:
        """The motions of windows, with what their equations need.

        Args:
            windows: simulated.
            base: with which they were.
            simulator: with which they were, if not with that of the base model.
        """
        simulator = self.simulator if simulator is None else simulator
        found = []
        for window in windows:
            assert window.start is not None
            found.append(
                KnownMotion(
                    simulator,
                    window.positions,
                    base.material,
                    window.start.past[0].numpy(),
                    window.start.steps,
                    self.simulator.time_step,
                    self.settings.tangents,
                    float(window.start.began[0]),
                )
            )
        remember(found)
        return found

    @denormals_flushed()
    def normal(
        self,
        window: WindowMotion,
        motion: KnownMotion,
        shared: Callable[[StepForces], Array],
        seen: Callable[[int, Array], Array],
        n_shared: int,
        substep_changes: list[NDArray[np.float32]] | None = None,
    ) -> tuple[Array, Array, Array]:
        """Gauss-Newton matrix and gradient of the image term over [shared | local standardised at force=1].

        The third is the derivative of the end, in modes and deviations of a jump (2 n_fields, n).

        Args:
            window: simulated.
            motion: of it, see ``known``.
            shared: force sensitivities (n, N, 3) of a sub-step, the first n of the shared ones.
            seen: apparent displacements (m, N, 3) [m] in a frame at given positions, the last m of them.
            n_shared: n + m.
            substep_changes: is given the change of every position, from the start on (3N, n), if not None.
        """
        simulator = motion.simulator
        n = window.last - window.first
        oa, of, total = self.layout(n)
        sub = self.substeps
        R = n_shared + total
        unit = self.deviations(n, 1.0, 1.0)
        N = len(self.masses)
        start, speed = np.zeros((R, N, 3)), np.zeros((R, N, 3))
        a, b = n_shared, n_shared + self.n_fields
        start[a:b] = self.fields * unit[0]
        speed[b : b + self.n_fields] = self.fields * unit[self.n_fields]
        pinned = self.simulator.assembly.pinned
        boundary = np.eye(self.n_pinned * 3).reshape(-1, self.n_pinned, 3) * self.settings.boundary
        na = self.n_knots(n, self.settings.boundary_knot)
        nf = self.n_force_knots(n)
        start[n_shared + oa : n_shared + oa + self.n_pinned * 3, pinned] = boundary
        steps = np.arange(n * sub)
        boundary_hats = hats((steps + 1) / sub, self.settings.boundary_knot, na)
        force_hats = hats(steps // sub + 0.5, self.settings.force_knot, nf)
        weighted = self.force_fields(window.first, window.last) * simulator.cloth.masses.numpy()[:, None]

        def loads(step: StepForces) -> LoadSensitivities:
            f = np.zeros((R, N, 3))
            of_shared = shared(step)
            f[: len(of_shared)] = of_shared
            displaced = np.zeros((R, self.n_pinned, 3))
            for q in np.flatnonzero(boundary_hats[step.index]):
                o = n_shared + oa + q * self.n_pinned * 3
                displaced[o : o + self.n_pinned * 3] = boundary_hats[step.index, q] * boundary
            for q in np.flatnonzero(force_hats[step.index]):
                o = n_shared + of + q * self.n_fields
                f[o : o + self.n_fields] = force_hats[step.index, q] * weighted[q]
            return LoadSensitivities(f, displaced)

        G, g = np.zeros((R, R)), np.zeros(R)
        frames = window.positions[::sub]
        first = tuple(a.reshape(R, -1).T.astype(np.float32) for a in (start, speed))
        end = first
        if substep_changes is not None:
            substep_changes.append(first[0])
        of_frames = motion.tangents(0, n, sub, loads, start, speed, substep_changes)
        for i, end in enumerate(chain([first], of_frames)):
            if i < self._first_counted(window):
                continue
            moved = end[0]
            f = window.first + i
            apparent = seen(f, frames[i])
            J = moved
            if len(apparent):
                # The history of the motion is not changed by what is only seen.
                J = moved.copy()
                J[:, n_shared - len(apparent) : n_shared] += apparent.reshape(len(apparent), -1).T
            G += quadratic(self.tracked.information[f], J).astype(np.float64)
            g += J.T.astype(np.float64) @ self.tracked.slope(f, frames[i])
        positions, velocities = end
        slower = np.float32(simulator.time_step / self.simulator.time_step)
        return self.weight * G, self.weight * g, self._in_jumps(positions, slower * velocities)


class ChangedSimulation(NamedTuple):
    """What effects change about a clip.

    Attributes:
        simulator: with their step terms, masses and time step.
        cloth: with their masses.
        forces: (F-1, N, 3) [N].
        boundary: pinned positions (F, n_pinned, 3) [m].
    """

    simulator: ImplicitSimulator
    cloth: Cloth
    forces: torch.Tensor
    boundary: torch.Tensor


@torch.no_grad()
def changed_simulation(
    shooting: Shooting, effects: Sequence[Effect], around: Surroundings, wind: torch.Tensor
) -> ChangedSimulation:
    """A clip with effects.

    Args:
        shooting: the problem without them.
        effects: in the model.
        around: the whole clip.
        wind: beside gravity, (3,) or (F-1, N, 3) [m/s²].
    """
    boundary = torch.from_numpy(shooting.boundary[: around.n_frames])
    given = setting(effects, around, boundary, wind)
    nominal = shooting.simulator
    assert isinstance(nominal, ImplicitSimulator)
    step = float(given.frame_interval) / shooting.substeps
    simulator = ImplicitSimulator(given.cloth, step, BDF2(), nominal.newton, (*given.terms, *nominal.terms))
    return ChangedSimulation(simulator, given.cloth, given.forces, given.boundary)
