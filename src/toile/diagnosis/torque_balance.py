"""Balance of torques: what only a cause from outside can disturb, whatever the cloth's law is.

Forces within a cloth have no torque, and what holds it at two corners has none about the line through them.
So inertia, gravity and what acts from outside must balance about that line, for every law of stretching,
bending and damping: there, and only there, the error of the law is nothing. Every cause from outside says
what torque it adds, by the same hook that acts in simulations; which of them fills the gap is a linear
regression with Gaussian priors (MacKay 1992, Bayesian interpolation).

What is uncertain is the motion. An error e(t) of where the cloth hangs about that line disturbs the balance
as the angle of a pendulum would, by I ë + m g l e: slow errors little, jitter from frame to frame much. It is
a Matérn process of order 3/2 with white jitter (Rasmussen and Williams 2006, section 4.2), whose sizes are
averaged over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular
from scipy.special import logsumexp

from toile.diagnosis.effect_evidence import SIZES
from toile.diagnosis.effect_sensitivities import Instant, force_sensitivities
from toile.diagnosis.force_modes import balanced_directions
from toile.diagnosis.hem import border_strip
from toile.diagnosis.joint_fit import DRAUGHT
from toile.diagnosis.sensitivities import StepForces
from toile.effects.base import Effect, Scope, Surroundings
from toile.effects.catalogue import OUTSIDE
from toile.limits import Positive, Unit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BalanceSettings:
    """What the balance of torques may be wrong by.

    Attributes:
        error: of where the cloth hangs, at its radius of gyration; centre of a log-normal prior [m].
        lasting: time over which that error lasts; centre of a log-normal prior [s].
        jitter: error from frame to frame; centre of a log-normal prior [m].
        spread: deviations of the logarithms of these three.
        rest: what the balance is wrong by beside: lumped masses, the slope between frames [m/s²].
        wind: deviation of the wind that every clip has [m/s²].
        hem: deviation of the width of a strip that the border has more than thought, or less: every cloth has
            some hem, and where a mesh puts the mass of its outermost half cells differs [m].
    """

    error: Annotated[Positive, Unit("m")] = 0.002
    lasting: Annotated[Positive, Unit("s")] = 0.5
    jitter: Annotated[Positive, Unit("m")] = 0.00003
    spread: tuple[Positive, Positive, Positive] = (1.0, 0.7, 2.0)
    rest: Annotated[Positive, Unit("m/s²")] = 0.01
    wind: Annotated[Positive, Unit("m/s²")] = 1.0
    hem: Annotated[Positive, Unit("m")] = 0.003


DEFAULT = BalanceSettings()


@dataclass(frozen=True)
class MovingCloth:
    """The motion of one clip.

    Attributes:
        positions: (F, N, 3) [m].
        around: the clip, on the same grid; frames are evenly spaced.
        horizontal: two axes along which wind blows (2, 3).
        device: that filmed it, from 0.
    """

    positions: Array
    around: Surroundings
    horizontal: Array
    device: int = 0


def torque_evidence(
    clips: Sequence[MovingCloth], effects: Sequence[Effect], settings: BalanceSettings = DEFAULT
) -> dict[str, float] | None:
    """Log evidence of every cause from outside, against none of them.

    Args:
        clips: of one cloth.
        effects: candidates; those that act within the cloth are left out.
        settings: see BalanceSettings.

    Returns:
        By name [nats]; None where holders take up every torque, or clips are too short.
    """
    outside = [effect for effect in effects if effect.NAME in OUTSIDE]
    balances = [_balance(clip, outside, settings) for clip in clips]
    if not outside or any(one is None for one in balances):
        return None
    known = [one for one in balances if one is not None]
    parts = {effect.NAME: _of_cause(known, effect, clips) for effect in outside}
    gap, nuisance = _gap(known)
    columns = np.concatenate((gap[None], nuisance, *parts.values())).T
    at, first = {}, 1 + len(nuisance)
    for name, part in parts.items():
        at[name] = np.arange(first, first + len(part))
        first += len(part)
    logs: dict[str, list[float]] = {name: [] for name in ("", *parts)}
    for sizes, prior in _sizes(settings):
        white, determinant = _whitened(columns, known, clips, sizes, settings)
        gram = white.T @ white
        for name, own in logs.items():
            own.append(prior - determinant + _likelihood(gram, len(nuisance), at.get(name)))
    whole = {name: float(logsumexp(each)) for name, each in logs.items()}
    return {name: whole[name] - whole[""] for name in parts}


@dataclass(frozen=True)
class _Balance:
    """The balance of one clip, n directions in F - 2 frames, per mass and over the cloth's size [m/s²].

    Attributes:
        gap: what inertia and gravity leave (n, F - 2).
        nuisance: what wind and hem add, in deviations (k, n, F - 2).
        causes: what every cause adds, per prior deviation of its coefficients, by name (c, n, F - 2).
        disturb: (F - 2, F), from an error of where the cloth hangs to the balance [1/s²].
    """

    gap: Array
    nuisance: Array
    causes: dict[str, Array]
    disturb: Array


def _balance(clip: MovingCloth, effects: Sequence[Effect], settings: BalanceSettings) -> _Balance | None:
    x, around = clip.positions, clip.around
    F, dt = len(x), 1.0 / around.fps
    if F < 8 or around.times is not None:
        return None
    cloth, masses = around.cloth, around.cloth.masses.numpy()
    gravity, size = around.gravity.numpy(), max(around.cloth_size)
    pinned = cloth.pinned.numpy()
    inside = x[1:-1]
    directions = _directions(inside[:, pinned], size)
    if directions is None:
        return None
    v, a = (x[2:] - x[:-2]) / (2 * dt), (x[2:] - 2 * inside + x[:-2]) / dt**2
    about = inside[:, pinned].mean(1)
    arms = (inside - about[:, None]) / size

    def felt(forces: Array) -> Array:
        """Of forces (..., F - 2, N, 3) [N], (..., n, F - 2)."""
        wrench = np.concatenate((forces.sum(-2), np.cross(arms, forces).sum(-2)), -1)
        return np.einsum("fnw,...fw->...nf", directions, wrench) / masses.sum()

    inertia = masses[:, None] * a
    weight = masses[:, None] * gravity
    gap = felt(inertia - weight)
    wind = masses[:, None] * clip.horizontal[:, None, None] * np.ones((1, F - 2, 1, 1))
    of_wind = (DRAUGHT if around.still_air else settings.wind) * felt(wind)
    nuisance = np.concatenate(
        (of_wind, settings.hem * felt(border_strip(around)[:, None] * (gravity - a))[None])
    )
    # Coefficients are those of no effect: at zero the balance is what is written above.
    at = [_instant(f, clip, v, inertia, dt) for f in range(F - 2)]
    causes = {}
    for effect in effects:
        each = np.stack([force_sensitivities(effect, one, around) for one in at], 1)
        causes[effect.NAME] = felt(each)
    radius = float(np.sqrt((masses[:, None] * (arms * size) ** 2).sum((-2, -1)).mean() / masses.sum()))
    centre = float(np.linalg.norm((masses[:, None] * arms).sum(-2), axis=-1).mean() / masses.sum()) * size
    frames = np.arange(F - 2)
    disturb = np.zeros((F - 2, F))
    for k, weighs in ((0, 1.0), (1, -2.0), (2, 1.0)):
        disturb[frames, frames + k] = weighs * radius / dt**2 / size
    disturb[frames, frames + 1] += np.linalg.norm(gravity) * centre / radius / size
    return _Balance(gap, nuisance, causes, disturb)


def _directions(pinned: Array, size: float) -> Array | None:
    """Of resultants and torques that holders leave alone, in every frame (F, n, 6), turning with them."""
    found: list[Array] = []
    for held in pinned:
        now = balanced_directions(held, size)
        if not len(now) or (found and len(now) != len(found[-1])):
            return None
        if found:
            # A null space has no directions of its own: those nearest to the frame before (Schönemann 1966).
            u, _, vt = np.linalg.svd(found[-1] @ now.T)
            now = u @ vt @ now
        found.append(now)
    return np.stack(found)


def _instant(f: int, clip: MovingCloth, v: Array, inertia: Array, dt: float) -> Instant:
    """Frame f + 1, as a step that begins and ends there: velocities are central, and nothing is behind."""
    x, around = clip.positions[f + 1], clip.around
    forces = StepForces(f, x, x - dt * v[f], v[f], np.zeros((0, *x.shape)), inertia[f])
    cloth = around.cloth
    material = np.ones(len(cloth.energies.parameters))
    gravity = around.gravity.numpy()
    return Instant(forces, (f + 1) * dt, dt, material, gravity, x[cloth.pinned.numpy()])


def _sizes(settings: BalanceSettings) -> list[tuple[Array, float]]:
    """Sizes of the noise [error, lasting, jitter] that are averaged over, and their logarithmic weights."""
    steps = (np.linspace(-2.0, 3.0, 9), np.linspace(-2.0, 2.0, 5), np.linspace(-2.0, 2.0, 7))
    centres = np.array([settings.error, settings.lasting, settings.jitter])
    every = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
    return [(centres * np.exp(one * settings.spread), -0.5 * float(one @ one)) for one in every]


def _whitened(
    columns: Array,
    balances: Sequence[_Balance],
    clips: Sequence[MovingCloth],
    sizes: Array,
    settings: BalanceSettings,
) -> tuple[Array, float]:
    """Columns (T, c) in units of the noise, and the log determinant of its root."""
    white, determinant, begin = [], 0.0, 0
    error, lasting, jitter = sizes
    for balance, clip in zip(balances, clips, strict=True):
        times = np.arange(balance.disturb.shape[1]) / clip.around.fps
        apart = np.abs(times[:, None] - times) / lasting
        hangs = error**2 * (1 + apart) * np.exp(-apart) + jitter**2 * np.eye(len(times))
        one = balance.disturb @ hangs @ balance.disturb.T + settings.rest**2 * np.eye(len(balance.disturb))
        root = np.linalg.cholesky(one)
        # Directions err independently.
        for _ in balance.gap:
            white.append(solve_triangular(root, columns[begin : begin + len(root)], lower=True))
            determinant += float(np.log(np.diag(root)).sum())
            begin += len(root)
    return np.concatenate(white), determinant


def _likelihood(gram: Array, n_nuisance: int, cause: NDArray[np.intp] | None) -> float:
    """Log marginal likelihood, nuisances and coefficients integrated out, but for the noise's determinant.

    Args:
        gram: inner products of [gap | nuisances | causes] in units of the noise.
        n_nuisance: nuisances, with unit prior deviations.
        cause: columns of the cause in question; None for none.
    """
    own = np.arange(1, 1 + n_nuisance)
    factor = np.linalg.cholesky(np.eye(n_nuisance) + gram[np.ix_(own, own)])
    rest = np.array([0, *([] if cause is None else cause)])
    half = solve_triangular(factor, gram[np.ix_(own, rest)], lower=True)
    left = gram[np.ix_(rest, rest)] - half.T @ half
    value = -0.5 * float(left[0, 0]) - float(np.log(np.diag(factor)).sum())
    if cause is None:
        return value
    values, axes = np.linalg.eigh(left[1:, 1:])
    values, slopes = np.clip(values, 0.0, None), axes.T @ left[1:, 0]
    # The size of the coefficients is averaged over, as in EffectEvidence.
    of_sizes = [
        0.5 * float((slopes**2 / (values + s**-2)).sum() - np.log1p(s**2 * values).sum()) for s in SIZES
    ]
    return value + float(logsumexp(of_sizes)) - float(np.log(len(SIZES)))


def _gap(balances: Sequence[_Balance]) -> tuple[Array, Array]:
    """Gap (T,) and nuisances (k, T) of all clips: each has its wind, the hem is the cloth's."""
    gap = np.concatenate([one.gap.reshape(-1) for one in balances])
    winds = block_diag(*(one.nuisance[:-1].reshape(len(one.nuisance) - 1, -1) for one in balances))
    hem = np.concatenate([one.nuisance[-1].reshape(-1) for one in balances])
    return gap, np.concatenate((winds, hem[None]))


def _of_cause(balances: Sequence[_Balance], effect: Effect, clips: Sequence[MovingCloth]) -> Array:
    """What a cause adds in all clips (c, T); clips share its coefficients as its Scope says."""
    flat = [one.causes[effect.NAME] for one in balances]
    flat = [columns.reshape(len(columns), -1) for columns in flat]
    if effect.SCOPE is Scope.CLIP:
        return np.asarray(block_diag(*flat))
    groups = [0 if effect.SCOPE is Scope.CLOTH else clip.device for clip in clips]
    rows = [
        np.concatenate([p if g == group else np.zeros_like(p) for g, p in zip(groups, flat, strict=True)], 1)
        for group in dict.fromkeys(groups)
    ]
    return np.concatenate(rows)
