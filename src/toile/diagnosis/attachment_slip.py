"""A pinned vertex that slips through its attachment, from where the pinned vertices were tracked.

Pinned vertices are mostly pinned by one body, so what they do relative to each other is small or slow: a
share of their common motion, slow sway of two hands, and errors of tracking, which drift and are far larger
along the rays of the camera than across. A slip is a relative displacement that comes within a short time and
stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cho_factor, cho_solve
from scipy.special import log_ndtr, logsumexp

from toile.effects.anchor_slip import AnchorSlip
from toile.errors import InputError
from toile.limits import Count, CountOrZero, NonNegative, Positive, Unit

Array = NDArray[np.float64]

_COUNTED_AT = 25.0
"""Frames per second of the clips whose frames the settings count."""


@dataclass(frozen=True)
class SlipSettings:
    """What pinned vertices do without slipping, errors of their tracking among it, and how slips look.

    Lists are tried side by side and averaged over.

    Attributes:
        first_frames: first frames that say nothing, at 25 fps: tracking is still leaving the template there.
        stays: frames after a ramp in which the displacement is seen to stay, at 25 fps.
        durations: of ramps [s].
        across: deviations of the errors of tracking across the rays [m].
        memory: times over which those last [s].
        along: by which factor errors along the rays are larger.
        independent: errors that every frame makes on its own, across the rays [m].
        jump: deviations of its errors by which the tracker jumps; 0: positions do not jump.
        well_tracked: error [m] from which on jumps grow with its square, as a tracker that follows badly
            loses its hold altogether.
        farthest: jumps at most [m].
        sway: deviations of the relative motion of two hands [m].
        slow: time in which that changes [s].
        share: relative motion in proportion to the common one, beside the sway. The common motion has its
            part of a slip, so a wide share would explain slips away.
        offset: what remains of leaving the template, across the rays [m].
        odds: how many times less probable a vertex may be than the likeliest one, and still be the one that
            slips by its own path.
    """

    first_frames: CountOrZero = 3
    stays: Count = 3
    durations: Annotated[tuple[Positive, ...], Field(min_length=1), Unit("s")] = (0.06, 0.12, 0.24, 0.4)
    across: Annotated[tuple[Positive, ...], Field(min_length=1), Unit("m")] = (0.0015, 0.003, 0.006, 0.012)
    memory: Annotated[tuple[Positive, ...], Field(min_length=1), Unit("s")] = (0.1, 0.5)
    along: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 5.0
    independent: Annotated[Positive, Unit("m")] = 0.0005
    jump: NonNegative = 2.5
    well_tracked: Annotated[Positive, Unit("m")] = 0.0015
    farthest: Annotated[Positive, Unit("m")] = 0.04
    sway: Annotated[tuple[NonNegative, ...], Field(min_length=1), Unit("m")] = (0.0, 0.006, 0.02, 0.04)
    slow: Annotated[Positive, Unit("s")] = 0.2
    share: NonNegative = 0.1
    offset: Annotated[NonNegative, Unit("m")] = 0.01
    odds: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 20.0

    def at(self, fps: float) -> SlipSettings:
        """The same times in the frames of a clip of so many frames per second."""
        first, stays = (round(frames * fps / _COUNTED_AT) for frames in (self.first_frames, self.stays))
        return replace(self, first_frames=first, stays=max(1, stays))


DEFAULT = SlipSettings()


@dataclass(frozen=True)
class RefinedSlipSettings(SlipSettings):
    """The same in a motion that a model of the cloth has refined.

    Errors are small and of every frame anew, and positions do not jump.
    """

    across: Annotated[tuple[Positive, ...], Field(min_length=1), Unit("m")] = (0.0005, 0.001, 0.002, 0.004)
    memory: Annotated[tuple[Positive, ...], Field(min_length=1), Unit("s")] = (0.02, 0.1)
    jump: NonNegative = 0.0
    offset: Annotated[NonNegative, Unit("m")] = 0.004


@dataclass(frozen=True)
class SlipFit:
    """How well a slip explains the paths of the pinned vertices.

    Attributes:
        log_evidence: against pinned vertices that do not slip.
        mean, covariance: of the displacement, (3,) and (3, 3), in units of its prior deviations.
        vertex: which pinned vertex it is that slips, from 0.
        start, duration: of the most probable ramp [s].
    """

    log_evidence: float
    mean: Array
    covariance: Array
    vertex: int
    start: float
    duration: float

    @staticmethod
    def nothing_known() -> SlipFit:
        """What is known before anything is seen."""
        return SlipFit(0.0, np.zeros(3), np.eye(3), 0, 0.0, 0.1)


def slip_evidence(
    effect: AnchorSlip,
    positions: Array,
    fps: float,
    pull: Array | None = None,
    settings: SlipSettings = DEFAULT,
) -> SlipFit:
    """Evidence that one of the pinned vertices slips.

    Every vertex is judged by its displacement relative to the mean of the others, so what all do together
    does not matter. All unknowns but the sizes are Gaussian; sizes of errors and of sway, vertex, start and
    duration are averaged over, so trying them is penalised for. With two pinned vertices their relative
    motion alone does not tell which one slips; the pull and the one that departs more from its own path
    decide.

    Args:
        effect: gives the prior deviations of the displacement; its vertex, start and duration do not matter.
        positions: of the pinned vertices as they were found (F, n_pinned, 3) [m] in the camera's frame.
        fps: frames per second.
        pull: direction (n_pinned, 3) in which the cloth pulls at each of them; an attachment only gives way
            to it. None if unknown.
        settings: see SlipSettings.

    Returns:
        See SlipFit; without evidence (0) if fewer than two vertices are pinned or the clip is too short.

    Raises:
        InputError: positions or pull do not have these shapes, or are not finite.
    """
    positions = np.asarray(positions, np.float64)
    if positions.ndim != 3 or positions.shape[2] != 3 or not np.isfinite(positions).all() or not fps > 0:
        raise InputError(
            "pinned positions cannot be judged",
            where="positions",
            expected="(F, n_pinned, 3) finite, fps > 0",
            got=f"{positions.shape}, fps {fps:g}",
        )
    F, n = positions.shape[:2]
    if pull is not None and np.shape(pull) != (n, 3):
        raise InputError(
            "pull has another shape", where="pull", expected=f"({n}, 3)", got=str(np.shape(pull))
        )
    settings = settings.at(fps)
    ramps = _ramps(F, fps, settings)
    if n < 2 or not ramps:
        return SlipFit.nothing_known()
    scales = effect.scales.numpy()
    shapes = np.stack([_ramp(F, fps, *ramp)[settings.first_frames :] for ramp in ramps])
    solved = [_solved(positions, i, fps, shapes, settings) for i in range(n if n > 2 else 1)]
    if n == 2:
        solved.append(solved[0].mirrored())
    found = [_judged(one, scales, None if pull is None else pull[i]) for i, one in enumerate(solved)]
    table = np.stack([values for values, _, _ in found])
    total = float(logsumexp(table) - np.log(table.size))
    vertex = _which(table, positions, shapes, settings)
    values, means, covariances = found[vertex]
    w = np.exp(values - logsumexp(values))
    mean = w @ means
    away = means - mean
    covariance = np.einsum("k,kab->ab", w, covariances) + np.einsum("k,ka,kb->ab", w, away, away)
    best = int(np.argmax(values))
    return SlipFit(total, mean, covariance, vertex, *ramps[best])


def _ramps(n_frames: int, fps: float, settings: SlipSettings) -> list[tuple[float, float]]:
    """Starts and durations [s] that are tried."""
    last = (n_frames - 1 - settings.stays) / fps
    starts = np.arange(settings.first_frames, n_frames) / fps
    return [(float(t), d) for d, t in product(settings.durations, starts) if t + d <= last]


def _ramp(n_frames: int, fps: float, start: float, duration: float) -> Array:
    """The effect's ramp (F,)."""
    s = np.clip((np.arange(n_frames) / fps - start) / duration, 0, 1)
    return np.asarray(s * s * (3 - 2 * s), np.float64)


@dataclass(frozen=True)
class _Solved:
    """What the path of one vertex says for every size of errors h and ramp k, before any prior.

    Attributes:
        null: log-likelihood without a ramp (h,).
        slope: of the log-likelihood by the displacement (h, k, 3) [1/m].
        information: about it (h, k, 3, 3) [1/m²].
        jumps: covariance of the tracker's own jumps (h, 3, 3) [m²]; None where it has none.
    """

    null: Array
    slope: Array
    information: Array
    jumps: Array | None

    def mirrored(self) -> _Solved:
        """The same for the other of two vertices."""
        return _Solved(self.null, -self.slope, self.information, self.jumps)


def _solved(positions: Array, vertex: int, fps: float, shapes: Array, settings: SlipSettings) -> _Solved:
    s, n = settings, positions.shape[1]
    others = [i for i in range(n) if i != vertex]
    moved = positions - positions[s.first_frames]
    relative = (moved[:, vertex] - moved[:, others].mean(1))[s.first_frames :].reshape(-1)
    common = moved.mean(1)[s.first_frames :]
    rays = positions[0] / np.linalg.norm(positions[0], axis=-1, keepdims=True)
    # Errors of a vertex and of a mean of others, each along its own ray.
    along = np.einsum("na,nb->nab", rays, rays)
    along = along[vertex] + along[others].mean(0) / len(others)
    errors = (1 + 1 / len(others)) * np.eye(3) + (s.along**2 - 1) * along
    T, K = len(common), len(shapes)
    lag = np.abs(np.subtract.outer(np.arange(T), np.arange(T))) / fps
    sensitivities: Array = np.einsum("kt,ab->takb", shapes, np.eye(3)).reshape(3 * T, -1)
    share = s.share**2 * np.einsum("ta,ub,ab->taub", common, common, np.eye(3)).reshape(3 * T, -1)
    null, slope, information, jumps = [], [], [], []
    for across, memory, sway in product(s.across, s.memory, s.sway):
        drift = across**2 * np.exp(-lag / memory) + s.offset**2 + s.independent**2 * np.eye(T)
        C = np.kron(drift, errors) + share
        C += np.kron(sway**2 * np.exp(-0.5 * (lag / s.slow) ** 2), 2 * np.eye(3))
        factor = cho_factor(C, lower=True)
        weighted = cho_solve(factor, np.column_stack((relative, sensitivities)))
        log_det = 2 * float(np.log(np.diag(factor[0])).sum())
        null.append(-0.5 * float(relative @ weighted[:, 0]) - 0.5 * log_det)
        slope.append((sensitivities.T @ weighted[:, 0]).reshape(K, 3))
        blocks, solved = sensitivities.reshape(3 * T, K, 3), weighted[:, 1:].reshape(3 * T, K, 3)
        information.append(np.einsum("ska,skb->kab", blocks, solved))
        jump = min(s.jump * across * max(1.0, across / s.well_tracked), s.farthest)
        jumps.append(jump**2 * errors)
    own = np.array(jumps) if s.jump else None
    return _Solved(np.array(null), np.array(slope), np.array(information), own)


def _gains(solved: _Solved, roots: Array) -> tuple[Array, Array, Array]:
    """Log evidence (h, k), mean, covariance of standardised displacements; roots (h, 3, 3) make metres."""
    b = np.einsum("hba,hkb->hka", roots, solved.slope)
    H = np.eye(3) + np.einsum("hba,hkbc,hcd->hkad", roots, solved.information, roots)
    V = np.linalg.inv(H)
    m = np.einsum("hkab,hkb->hka", V, b)
    return 0.5 * (b * m).sum(-1) - 0.5 * np.linalg.slogdet(H)[1], m, V


def _judged(solved: _Solved, scales: Array, pull: Array | None) -> tuple[Array, Array, Array]:
    """Of every ramp: log evidence (k,), mean (k, 3), covariance (k, 3, 3) of the displacement in scales."""
    n_sizes, n_ramps = solved.slope.shape[:2]
    null = solved.null
    if solved.jumps is not None:
        jumped, _, _ = _gains(solved, np.asarray(np.linalg.cholesky(solved.jumps), np.float64))
        jumped = logsumexp(jumped, axis=1) - np.log(n_ramps)
        null = null + np.logaddexp(0.0, jumped) - np.log(2)
    gain, m, V = _gains(solved, np.broadcast_to(np.diag(scales), (n_sizes, 3, 3)))
    if pull is not None:
        # Half of all directions are open to an attachment that gives way.
        u = pull * scales
        gain = gain + np.log(2) + log_ndtr((m @ u) / np.sqrt(np.einsum("a,hkab,b->hk", u, V, u)))
    values = solved.null[:, None] + gain
    total = logsumexp(values, axis=0)
    w = np.exp(values - total)
    mean = np.einsum("hk,hka->ka", w, m)
    away = m - mean
    covariance = np.einsum("hk,hkab->kab", w, V) + np.einsum("hk,hka,hkb->kab", w, away, away)
    return np.asarray(total - logsumexp(null)), mean, covariance


def _which(table: Array, positions: Array, shapes: Array, settings: SlipSettings) -> int:
    """The vertex whose own path has the most of the ramp, among those that are about equally probable."""
    rows = logsumexp(table, axis=1)
    shape = shapes[int(np.argmax(table[int(np.argmax(rows))]))]
    moved = positions[settings.first_frames :]
    before, after = shape == 0, shape == 1
    before[0] = True
    # Next to the ramp, so that slow motion matters less.
    jump = moved[after][: settings.stays].mean(0) - moved[before][-settings.stays :].mean(0)
    own = np.linalg.norm(jump, axis=-1)
    return int(np.argmax(np.where(rows > rows.max() - np.log(settings.odds), own, -1.0)))
