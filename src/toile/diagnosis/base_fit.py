"""Fit of the base model: stiffness and wind for the clip, starts, boundary and smooth forces by window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from toile.diagnosis.continuity import Discrepancy, Link, WindowSystem
from toile.diagnosis.evidence import Evidence
from toile.diagnosis.positive import positive_factor
from toile.diagnosis.sensitivities import StepForces
from toile.diagnosis.shooting import Base, ChangedSimulation, Shooting, WindowMotion
from toile.effects.base import Effect, Surroundings
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.state import State
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]

N_WIND = 2
"""Directions of the wind."""

_SIDE_BY_SIDE = 10
"""Windows that are simulated as one batch: enough to share what a step costs beside its numbers, few enough
for several processes to share a clip."""


@dataclass(frozen=True)
class BaseFit:
    """The base model at its best.

    Attributes:
        windows: simulated.
        start_material: (P,) that the logarithms refer to.
        values: (P + 2,) log ratios of the material's numbers, and wind.
        cost: negative log-posterior.
        history: cost after every pass.
    """

    windows: list[WindowMotion]
    start_material: Array
    values: Array
    cost: float
    history: tuple[float, ...]

    @property
    def base(self) -> Base:
        """Stiffness and wind."""
        return base_of(self.start_material, self.values)


def base_of(start: Array, values: Array) -> Base:
    """Material and wind from log ratios and wind components (P + 2,)."""
    n = len(start)
    return Base(start * np.exp(values[:n]), values[n : n + N_WIND].copy())


def n_base(shooting: Shooting) -> int:
    """Shared unknowns of the base, P + 2: logarithms of the material's numbers, wind along two directions."""
    return len(shooting.simulator.cloth.energies.parameters) + N_WIND


def base_deviations(shooting: Shooting) -> Array:
    """Prior standard deviations (P + 2,)."""
    s, parameters = shooting.settings, shooting.simulator.cloth.energies.parameters
    return np.array([s.stiffness if p.unit else s.compression for p in parameters] + [s.wind] * N_WIND)


def longest_step(shooting: Shooting, wind: float) -> Array:
    """By how much one step may change the base values (P + 2,), the wind by ``wind`` [m/s²]."""
    n = n_base(shooting) - N_WIND
    return np.array([shooting.settings.longest_stiffness] * n + [wind] * N_WIND)


def base_sensitivities(
    shooting: Shooting, base: Base, masses: Array | None = None
) -> Callable[[StepForces], Array]:
    """Force sensitivities (P + 2, N, 3) of the base's values; masses (N,) [kg] if not the base model's.

    Stiffer threads do not pull more where they are as long as in the template, see template_tension.
    """
    masses = shooting.masses if masses is None else masses
    wind = np.stack([masses[:, None] * axis for axis in shooting.horizontal])
    energies, material = shooting.simulator.cloth.energies, torch.from_numpy(base.material)
    slopes = torch.autograd.functional.jacobian(energies.coefficients, material) * material

    def sensitivities(step: StepForces) -> Array:
        stiffer = -np.tensordot(slopes.numpy().T, step.unit_gradients, 1)
        if shooting.tension is not None:
            stiffer[0] -= shooting.tension.force(step.positions, shooting.simulator.cloth)
        return np.concatenate((stiffer, wind))

    return sensitivities


def nothing_seen(frame: int, positions: Array) -> Array:
    """No apparent displacement."""
    return np.zeros((0, *positions.shape))


def window_bounds(n_frames: int, window: int) -> list[tuple[int, int]]:
    """(first, last) frames of windows that share their ends; a short rest joins the one before."""
    bounds = [(a, min(a + window, n_frames - 1)) for a in range(0, n_frames - 1, window)]
    if len(bounds) > 1 and bounds[-1][1] - bounds[-1][0] < window // 2:
        bounds[-2:] = [(bounds[-2][0], bounds[-1][1])]
    return bounds


def local_scales(shooting: Shooting, n: int) -> Array:
    """What turns the local unknowns of Shooting.normal into standardised ones (n_local,)."""
    settings = shooting.settings
    return shooting.deviations(n, settings.force, settings.external) / shooting.deviations(n, 1.0, 1.0)


def fit_base(
    shooting: Shooting,
    start_positions: Array,
    material: Array,
    n_frames: int,
    report: Callable[[str, float], None],
    coarser: BaseFit | None = None,
    passes: int | None = None,
    workers: Workers = ALONE,
) -> BaseFit:
    """Window by window for a first motion, then all of them with stiffness and wind.

    Args:
        shooting: see Shooting.
        start_positions: frame 0 (N, 3) [m], at rest.
        material: start values (P,) in SI units.
        n_frames: frames used.
        report: called with a message and the cost.
        coarser: fit on a coarser grid to start from.
        passes: over the whole clip at most, None for those of the settings; a fit with a number of its own is
            a first one, and goes through the clip once.
        workers: share the windows of a pass; those of a sweep come one after the other.
    """
    values = np.zeros(n_base(shooting)) if coarser is None else coarser.values
    windows: list[WindowMotion] = [] if coarser is None else coarser.windows
    for _ in range(shooting.settings.sweeps if coarser is None and passes is None else 1):
        windows, values = _sweep(shooting, start_positions, material, values, windows, n_frames, report)
    # What was learnt on the way holds for the windows before as well.
    base = base_of(material, values)
    standardised = [window.standardised for window in windows]
    windows = simulated_windows(shooting, windows, standardised, base, workers=workers)
    return improved(shooting, windows, material, values, report, passes, workers)


def improved(
    shooting: Shooting,
    windows: list[WindowMotion],
    material: Array,
    values: Array,
    report: Callable[[str, float], None],
    passes: int | None = None,
    workers: Workers = ALONE,
) -> BaseFit:
    """All windows at once with stiffness and wind, pass by pass.

    Args:
        shooting: the problem.
        windows: simulated with the values.
        material: that the logarithms refer to (P,).
        values: log ratios of the material's numbers, and wind (P + 2,).
        report: called with a message and the cost.
        passes: at most, None for those of the settings.
        workers: share the windows.
    """
    s, deviation = shooting.settings, base_deviations(shooting)
    longest = longest_step(shooting, np.inf)
    cost = shooting.clip_cost(windows)
    history = [cost]
    damping = 0.0
    little: list[bool] = []
    for _ in range(s.passes if passes is None else passes):
        base = base_of(material, values)
        shared = [base_sensitivities(shooting, base)] * len(windows)
        systems = window_systems(shooting, windows, base, shared, nothing_seen, len(values), workers=workers)
        evidence = Evidence(systems, values, deviation)
        before = cost + 0.5 * float(((values / deviation) ** 2).sum())
        for _ in range(s.damping.tried):
            # All together: shared unknowns that hold back while local ones go all the way may get stuck.
            trial, _, changes = evidence.towards((), fitted_discrepancy(shooting), damping, longest)
            moved = changed_windows(shooting, windows, changes, base_of(material, trial), workers=workers)
            trial_cost = shooting.clip_cost(moved)
            after = trial_cost + 0.5 * float(((trial / deviation) ** 2).sum())
            if after < before and all(w.converged for w in moved):
                break
            damping = s.damping.more(damping)
        else:
            break
        windows, values, cost = moved, trial, trial_cost
        history.append(cost)
        report("base", cost)
        # One short step is no sign of having arrived, two are.
        little.append(before - after < s.stalled * abs(before) + s.nothing)
        if little[-1] and (damping == 0 or all(little[-2:])):
            break
        damping = s.damping.less(damping)
    return BaseFit(windows, material, values, cost, tuple(history))


def fitted_discrepancy(shooting: Shooting) -> Discrepancy:
    """Deviations of the forces in the base fit."""
    return Discrepancy(shooting.settings.force, shooting.settings.external)


def window_systems(
    shooting: Shooting,
    windows: Sequence[WindowMotion],
    base: Base,
    shared: Sequence[Callable[[StepForces], Array]],
    seen: Callable[[int, Array], Array],
    n_shared: int,
    simulator: LinearizableSimulator | None = None,
    workers: Workers = ALONE,
    *,
    motion: bool = False,
) -> list[WindowSystem]:
    """Gauss-Newton systems of all windows; each start hangs on the end before it.

    Args:
        shooting: the problem.
        windows: simulated.
        base: with which they were.
        shared: force sensitivities of every window, see Shooting.normal.
        seen: apparent displacements, see there.
        n_shared: unknowns of both.
        simulator: with which they were, if not with that of the base model.
        workers: share the windows.
        motion: whether systems keep how every sub-step changes.
    """
    systems: list[WindowSystem] = []
    end: Array | None = None

    def of_some(places: range) -> list[tuple[Array, Array, Array, NDArray[np.float32] | None]]:
        found = []
        known = shooting.known([windows[k] for k in places], base, simulator)
        for k, around in zip(places, known, strict=True):
            steps: list[NDArray[np.float32]] | None = [] if motion else None
            system = shooting.normal(windows[k], around, shared[k], seen, n_shared, steps)
            found.append((*system, None if steps is None else np.stack(steps)))
        return found

    of_windows = chain.from_iterable(workers.map(of_some, _pieces(len(windows))))
    for k, (G, g, next_end, changes) in enumerate(of_windows):
        window, link = windows[k], None
        if end is not None:
            link = Link(shooting.jump(windows[k - 1], window), shooting.jump_ratio(), end)
        end = next_end
        n = window.last - window.first
        external = shooting.external(n)
        pushed = np.arange(len(external)) >= shooting.layout(n)[1]
        systems.append(
            WindowSystem(
                G,
                g,
                window.standardised,
                pushed & ~external,
                external,
                fitted_discrepancy(shooting),
                link,
                changes,
            )
        )
    return systems


def changed_windows(
    shooting: Shooting,
    windows: Sequence[WindowMotion],
    changes: Sequence[Array],
    base: Base,
    effects: Sequence[Effect] = (),
    around: Surroundings | None = None,
    workers: Workers = ALONE,
) -> list[WindowMotion]:
    """The windows with changed local unknowns, simulated.

    Args:
        shooting: the problem.
        windows: as they are.
        changes: of the local unknowns of each, see Shooting.normal.
        base: stiffness and wind.
        effects: in the model.
        around: the whole clip; needed with effects.
        workers: share the windows.
    """
    given = shooting.with_effects(effects, around, base)
    standardised = [
        window.standardised + change / local_scales(shooting, window.last - window.first)
        for window, change in zip(windows, changes, strict=True)
    ]
    return simulated_windows(shooting, windows, standardised, base, given, workers)


def simulated_windows(
    shooting: Shooting,
    windows: Sequence[WindowMotion],
    standardised: Sequence[Array],
    base: Base,
    given: ChangedSimulation | None = None,
    workers: Workers = ALONE,
) -> list[WindowMotion]:
    """Windows with these local unknowns, simulated side by side.

    So what a step costs beside its numbers is shared.

    Args:
        shooting: the problem.
        windows: see Shooting.simulate_all.
        standardised: see there.
        base: see there.
        given: see there.
        workers: share them.
    """

    def of_some(places: range) -> list[WindowMotion]:
        some = slice(places.start, places.stop)
        return shooting.simulate_all(windows[some], standardised[some], base, given)

    return list(chain.from_iterable(workers.map(of_some, _pieces(len(windows)))))


def _pieces(n: int) -> list[range]:
    """Windows that are taken side by side, whoever shares them."""
    return [range(k, min(k + _SIDE_BY_SIDE, n)) for k in range(0, n, _SIDE_BY_SIDE)]


def _at_rest(shooting: Shooting, positions: Array) -> State:
    simulator = shooting.simulator
    return State.start(
        torch.from_numpy(positions.copy())[None],
        torch.from_numpy(np.zeros_like(positions))[None],
        simulator.time_step,
        simulator.n_past,
    )


def _sweep(
    shooting: Shooting,
    start_positions: Array,
    material: Array,
    values: Array,
    before: list[WindowMotion],
    n_frames: int,
    report: Callable[[str, float], None],
) -> tuple[list[WindowMotion], Array]:
    """One window after the other, each from where the one before has ended; what is learnt is passed on."""
    s, state = shooting.settings, _at_rest(shooting, start_positions)
    deviation = base_deviations(shooting)
    precision = np.diag(deviation**-2)
    nb = len(values)
    mean = np.zeros(nb)
    windows: list[WindowMotion] = []
    for index, (first, last) in enumerate(window_bounds(n_frames, s.window)):
        n = last - first
        scales = local_scales(shooting, n)
        standardised = before[index].standardised.copy() if before else np.zeros(shooting.layout(n)[2])
        # Where the window starts has been learnt by the window before.
        standardised[: 2 * shooting.n_fields] = 0.0
        window = WindowMotion(first, last, state, standardised)
        window = shooting.simulate(window, standardised, base_of(material, values))
        prior = precision.copy()
        about = mean.copy()

        def total(w: WindowMotion, v: Array, p: Array = prior, m: Array = about) -> float:
            return shooting.cost(w) + 0.5 * float((v - m) @ p @ (v - m))

        cost = total(window, values)
        information = np.zeros_like(prior)
        for _ in range(s.iterations):
            base = base_of(material, values)
            (known,) = shooting.known([window], base)
            G, g, _ = shooting.normal(window, known, base_sensitivities(shooting, base), nothing_seen, nb)
            L = np.concatenate((np.ones(nb), scales))
            H = L[:, None] * G * L
            right = -L * g
            H[nb:, nb:] += np.eye(len(scales))
            right[nb:] -= window.standardised
            inner = positive_factor(H[nb:, nb:])
            information = H[:nb, :nb] - H[:nb, nb:] @ cho_solve(inner, H[nb:, :nb])
            H[:nb, :nb] += prior
            right[:nb] -= prior @ (values - about)
            step = cho_solve(positive_factor(H), right)
            length = min(1.0, s.longest_stiffness / max(float(np.abs(step[: nb - N_WIND]).max()), 1e-9))
            for _ in range(s.window_steps):
                trial_values = values + length * step[:nb]
                trial = shooting.simulate(
                    window, window.standardised + length * step[nb:], base_of(material, trial_values)
                )
                trial_cost = total(trial, trial_values)
                if trial.converged and trial_cost < cost:
                    break
                length *= s.window_shorter
            else:
                break
            small = cost - trial_cost < s.window_stalled * abs(cost)
            window, values, cost = trial, trial_values, trial_cost
            if small:
                break
        precision = prior + information
        mean = values.copy()
        windows.append(window)
        report("window", cost)
        assert window.end is not None
        state = window.end
    return windows, values
