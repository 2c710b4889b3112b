"""A held vertex that slips through its grip, from where the held vertices were tracked.

Held vertices are mostly held by one body, so what they do relative to each other is small or slow: a share of
their common motion, slow sway of two hands, and errors of tracking, which drift and are far larger along the
rays of the camera than across. A slip is a relative displacement that comes within a short time and stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import log_ndtr, logsumexp

from toile.effects.anchor_slip import AnchorSlip
from toile.errors import InputError

Array = NDArray[np.float64]

# Tracking leaves the template in the first frames; what a held vertex does there says nothing.
_SETTLING = 3
# Frames after a ramp in which the displacement is seen to stay.
_STAYS = 3
# How long ramps take [s].
_DURATIONS = (0.06, 0.12, 0.24, 0.4)
# Deviations of the errors of tracking across the rays [m], and the times [s] over which they last.
_ACROSS = (0.0015, 0.003, 0.006, 0.012)
_MEMORY = (0.1, 0.5)
# Errors along the rays are larger by this factor.
_ALONG = 5.0
# Errors that every frame makes on its own, across the rays [m].
_WHITE = 0.0005
# The tracker jumps too, by about so many deviations of its errors. Where it follows badly it loses its hold
# altogether: from this error on jumps grow with its square, up to a size [m].
_JUMP = 2.5
_WELL_TRACKED = 0.0015
_FARTHEST = 0.04
# Two hands: deviations of their relative motion [m], and the time [s] in which it changes.
_SWAY = (0.0, 0.006, 0.02, 0.04)
_SLOW = 0.2
# Relative motion in proportion to the common one, beside the sway. The common motion has its part of a slip,
# so a wide share would explain slips away.
_SHARE = 0.1
# What remains of leaving the template, across the rays [m].
_OFFSET = 0.01


@dataclass(frozen=True)
class SlipFit:
    """How well a slip explains the paths of the held vertices.

    Attributes:
        log_evidence: against held vertices that do not slip.
        mean, covariance: of the displacement, (3,) and (3, 3), in units of its prior deviations.
        vertex: which held vertex it is that slips, from 0.
        start, duration: of the most probable ramp [s].
    """

    log_evidence: float
    mean: Array
    covariance: Array
    vertex: int
    start: float
    duration: float


def slip_evidence(effect: AnchorSlip, positions: Array, fps: float, pull: Array | None = None) -> SlipFit:
    """Evidence that one of the held vertices slips.

    Every vertex is judged by its displacement relative to the mean of the others, so what all do together
    does not matter. All unknowns but the sizes are Gaussian; sizes of errors and of sway, vertex, start and
    duration are averaged over, so trying them is charged for. With two held vertices their relative motion
    alone does not tell which one slips; the pull and the one that departs more from its own path decide.

    Args:
        effect: gives the prior deviations of the displacement; its vertex, start and duration do not matter.
        positions: tracked held positions (F, n_held, 3) [m] in the camera's frame.
        fps: frames per second.
        pull: direction (n_held, 3) in which the cloth pulls at each of them; a grip only gives way to it.
            None if unknown.

    Returns:
        See SlipFit; without evidence (0) if fewer than two vertices are held or the clip is too short.

    Raises:
        InputError: positions or pull do not have these shapes, or are not finite.
    """
    positions = np.asarray(positions, np.float64)
    if positions.ndim != 3 or positions.shape[2] != 3 or not np.isfinite(positions).all() or not fps > 0:
        raise InputError(
            "held positions cannot be judged",
            where="positions",
            expected="(F, n_held, 3) finite, fps > 0",
            got=f"{positions.shape}, fps {fps:g}",
        )
    F, n = positions.shape[:2]
    if pull is not None and np.shape(pull) != (n, 3):
        raise InputError(
            "pull has another shape", where="pull", expected=f"({n}, 3)", got=str(np.shape(pull))
        )
    ramps = _ramps(F, fps)
    if n < 2 or not ramps:
        return SlipFit(0.0, np.zeros(3), np.eye(3), 0, 0.0, 0.1)
    scales = effect.scales.numpy()
    shapes = np.stack([_ramp(F, fps, *ramp)[_SETTLING:] for ramp in ramps])
    solved = [_solved(positions, i, fps, shapes) for i in range(n if n > 2 else 1)]
    if n == 2:
        solved.append(solved[0].mirrored())
    found = [_judged(one, scales, None if pull is None else pull[i]) for i, one in enumerate(solved)]
    table = np.stack([values for values, _, _ in found])
    total = float(logsumexp(table) - np.log(table.size))
    vertex = _which(table, positions, shapes)
    values, means, covariances = found[vertex]
    w = np.exp(values - logsumexp(values))
    mean = w @ means
    away = means - mean
    covariance = np.einsum("k,kab->ab", w, covariances) + np.einsum("k,ka,kb->ab", w, away, away)
    best = int(np.argmax(values))
    return SlipFit(total, mean, covariance, vertex, *ramps[best])


def _ramps(n_frames: int, fps: float) -> list[tuple[float, float]]:
    """Starts and durations [s] that are tried."""
    last = (n_frames - 1 - _STAYS) / fps
    starts = np.arange(_SETTLING, n_frames) / fps
    return [(float(t), d) for d, t in product(_DURATIONS, starts) if t + d <= last]


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
        jumps: covariance of the tracker's own jumps (h, 3, 3) [m²].
    """

    null: Array
    slope: Array
    information: Array
    jumps: Array

    def mirrored(self) -> _Solved:
        """The same for the other of two vertices."""
        return _Solved(self.null, -self.slope, self.information, self.jumps)


def _solved(positions: Array, vertex: int, fps: float, shapes: Array) -> _Solved:
    n = positions.shape[1]
    others = [i for i in range(n) if i != vertex]
    moved = positions - positions[_SETTLING]
    relative = (moved[:, vertex] - moved[:, others].mean(1))[_SETTLING:].reshape(-1)
    common = moved.mean(1)[_SETTLING:]
    rays = positions[0] / np.linalg.norm(positions[0], axis=-1, keepdims=True)
    # Errors of a vertex and of a mean of others, each along its own ray.
    along = np.einsum("na,nb->nab", rays, rays)
    along = along[vertex] + along[others].mean(0) / len(others)
    errors = (1 + 1 / len(others)) * np.eye(3) + (_ALONG**2 - 1) * along
    T, K = len(common), len(shapes)
    lag = np.abs(np.subtract.outer(np.arange(T), np.arange(T))) / fps
    columns: Array = np.einsum("kt,ab->takb", shapes, np.eye(3)).reshape(3 * T, -1)
    share = _SHARE**2 * np.einsum("ta,ub,ab->taub", common, common, np.eye(3)).reshape(3 * T, -1)
    null, slope, information, jumps = [], [], [], []
    for across, memory, sway in product(_ACROSS, _MEMORY, _SWAY):
        drift = across**2 * np.exp(-lag / memory) + _OFFSET**2 + _WHITE**2 * np.eye(T)
        C = np.kron(drift, errors) + share
        C += np.kron(sway**2 * np.exp(-0.5 * (lag / _SLOW) ** 2), 2 * np.eye(3))
        factor = cho_factor(C, lower=True)
        weighted = cho_solve(factor, np.column_stack((relative, columns)))
        log_det = 2 * float(np.log(np.diag(factor[0])).sum())
        null.append(-0.5 * float(relative @ weighted[:, 0]) - 0.5 * log_det)
        slope.append((columns.T @ weighted[:, 0]).reshape(K, 3))
        blocks, solved = columns.reshape(3 * T, K, 3), weighted[:, 1:].reshape(3 * T, K, 3)
        information.append(np.einsum("ska,skb->kab", blocks, solved))
        jump = min(_JUMP * across * max(1.0, across / _WELL_TRACKED), _FARTHEST)
        jumps.append(jump**2 * errors)
    return _Solved(np.array(null), np.array(slope), np.array(information), np.array(jumps))


def _gains(solved: _Solved, roots: Array) -> tuple[Array, Array, Array]:
    """Log evidence (h, k), mean and covariance of white displacements; roots (h, 3, 3) make them metres."""
    b = np.einsum("hba,hkb->hka", roots, solved.slope)
    H = np.eye(3) + np.einsum("hba,hkbc,hcd->hkad", roots, solved.information, roots)
    V = np.linalg.inv(H)
    m = np.einsum("hkab,hkb->hka", V, b)
    return 0.5 * (b * m).sum(-1) - 0.5 * np.linalg.slogdet(H)[1], m, V


def _judged(solved: _Solved, scales: Array, pull: Array | None) -> tuple[Array, Array, Array]:
    """Of every ramp: log evidence (k,), mean (k, 3), covariance (k, 3, 3) of the displacement in scales."""
    n_sizes, n_ramps = solved.slope.shape[:2]
    jumped, _, _ = _gains(solved, np.asarray(np.linalg.cholesky(solved.jumps), np.float64))
    jumped = logsumexp(jumped, axis=1) - np.log(n_ramps)
    null = solved.null + np.logaddexp(0.0, jumped) - np.log(2)
    gain, m, V = _gains(solved, np.broadcast_to(np.diag(scales), (n_sizes, 3, 3)))
    if pull is not None:
        # Half of all directions are open to a grip that gives way.
        u = pull * scales
        gain = gain + np.log(2) + log_ndtr((m @ u) / np.sqrt(np.einsum("a,hkab,b->hk", u, V, u)))
    values = solved.null[:, None] + gain
    total = logsumexp(values, axis=0)
    w = np.exp(values - total)
    mean = np.einsum("hk,hka->ka", w, m)
    away = m - mean
    covariance = np.einsum("hk,hkab->kab", w, V) + np.einsum("hk,hka,hkb->kab", w, away, away)
    return np.asarray(total - logsumexp(null)), mean, covariance


def _which(table: Array, positions: Array, shapes: Array) -> int:
    """The vertex whose own path has the most of the ramp, among those that are about equally probable."""
    rows = logsumexp(table, axis=1)
    shape = shapes[int(np.argmax(table[int(np.argmax(rows))]))]
    moved = positions[_SETTLING:]
    before, after = shape == 0, shape == 1
    before[0] = True
    # Next to the ramp, so that slow motion matters less.
    jump = moved[after][:_STAYS].mean(0) - moved[before][-_STAYS:].mean(0)
    own = np.linalg.norm(jump, axis=-1)
    return int(np.argmax(np.where(rows > rows.max() - np.log(20), own, -1.0)))
