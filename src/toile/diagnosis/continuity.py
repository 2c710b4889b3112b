"""Gauss-Newton systems of windows that follow one another: each starts, but for a small jump, where the one
before has ended.

What an effect does grows with the square of the time that nothing corrects it, so most of what a clip says
about a weak one lies in how the windows hang together. The windows are simulated apart (errors of long
rollouts grow until they drown their cause) and are tied in the linear algebra: a start minus the end before
it is Gaussian with the deviation of a jump, and that end depends on all unknowns of its own window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from toile.diagnosis.positive import positive_lower
from toile.limits import Positive, Unit

Array = NDArray[np.float64]


class Discrepancy(NamedTuple):
    """Deviations of a mode of the missing force [m/s²].

    Attributes:
        internal: of a mode that leaves the balance of torques alone.
        external: of one that does not; see force_modes.
    """

    internal: Annotated[Positive, Unit("m/s²")]
    external: Annotated[Positive, Unit("m/s²")]


@dataclass(frozen=True)
class Link:
    """How the start of a window follows from the end of the one before, in units of the jump's deviation.

    The jump is ``jump + ratio * d_start - before @ d[shared | local unknowns of the window before]``.

    Attributes:
        jump: at present (m,).
        ratio: its derivative by the window's first m local unknowns (m,).
        before: derivative of the end (m, n_shared + n_local of the window before).
    """

    jump: Array
    ratio: Array
    before: Array


@dataclass(frozen=True)
class WindowSystem:
    """Gauss-Newton system of one window over [shared | local].

    Attributes:
        matrix, gradient: of the image term, local forces in m/s².
        standardised: current local unknowns in units of the base fit's deviations.
        internal, external: which local unknowns are forces of that kind (n_local,).
        fitted: deviations of the forces in the base fit.
        link: to the window before; without one the start has a prior of its own.
        motion: change of the positions of every sub-step by [shared | local] (S + 1, 3N, n) [m]; None where
            nobody asks for it.
    """

    matrix: Array
    gradient: Array
    standardised: Array
    internal: NDArray[np.bool_]
    external: NDArray[np.bool_]
    fitted: Discrepancy
    link: Link | None = None
    motion: NDArray[np.float32] | None = None

    def with_shared(self, kept: Sequence[int]) -> WindowSystem:
        """The same with some of the shared unknowns."""
        n = len(self.gradient) - len(self.standardised)
        at = np.array([*kept, *range(n, len(self.gradient))])
        link = self.link
        if link is not None:
            before = np.array([*kept, *range(n, link.before.shape[1])])
            link = replace(link, before=link.before[:, before])
        return replace(self, matrix=self.matrix[np.ix_(at, at)], gradient=self.gradient[at], link=link)


@dataclass(frozen=True)
class Reduced:
    """A system without local unknowns: ½ sᵀ matrix s - right·s - constant in the shared ones s.

    Attributes:
        determinant: half the log determinant of the local unknowns, not in the constant.
    """

    matrix: Array
    right: Array
    constant: float
    determinant: float


class Joined:
    """All windows at one size of the discrepancy, local unknowns in units of their deviations.

    Args:
        systems: in the order of time.
        size: of the discrepancy.
        damping: what a step costs beside, for every local unknown [1/deviation²] (Levenberg 1944); of each
            window, or of all.
    """

    def __init__(
        self, systems: Sequence[WindowSystem], size: Discrepancy, damping: float | Array = 0.0
    ) -> None:
        n = len(systems[0].gradient) - len(systems[0].standardised)
        shared, right = np.zeros((n, n)), np.zeros(n)
        constant = start = 0.0
        self._steps: list[_Eliminated] = []
        each = np.broadcast_to(damping, len(systems))
        for s, damped in zip(systems, each, strict=True):
            scale, mean = _scaled(s, size)
            local = len(scale)
            # Columns: [local | shared | right-hand side].
            own = scale[:, None] * s.matrix[n:, n:] * scale
            rest = np.empty((local, n + 1))
            rest[:, :n] = scale[:, None] * s.matrix[n:, :n]
            rest[:, n] = -scale * s.gradient[n:]
            m = 0 if s.link is None else len(s.link.jump)
            free = np.arange(m, local)
            own[free, free] += 1
            own[np.diag_indices(local)] += damped
            rest[m:, n] -= mean[m:]
            shared += s.matrix[:n, :n]
            right -= s.gradient[:n]
            start += 0.5 * float(mean[m:] @ mean[m:])
            if self._steps and s.link is None:
                constant += self._take(self._steps[-1], shared, right)
            elif s.link is not None:
                jump, ratio, before = s.link.jump, s.link.ratio, s.link.before
                last = self._steps[-1]
                ends = before[:, n:] * last.scale
                # The end's own spread, and what the window before has learnt of it.
                last.matrix += ends.T @ ends
                last.rest[:, :n] += ends.T @ before[:, :n]
                last.rest[:, n] += ends.T @ jump
                last.next = -ends.T * ratio
                own[np.arange(m), np.arange(m)] += ratio**2
                rest[:m, :n] -= ratio[:, None] * before[:, :n]
                rest[:m, n] -= ratio * jump
                shared += before[:, :n].T @ before[:, :n]
                right += before[:, :n].T @ jump
                start += 0.5 * float(jump @ jump)
                constant += self._take(last, shared, right)
                own[:m, :m] -= last.half_next.T @ last.half_next
                rest[:m] -= last.half_next.T @ last.half
            self._steps.append(_Eliminated(scale, own, rest))
        constant += self._take(self._steps[-1], shared, right)
        determinant = sum(step.determinant for step in self._steps)
        self.reduced = Reduced(shared, right, constant - start, determinant)
        self._start = start

    def promised(self, shared: Array) -> float:
        """By how much the quadratic falls from where it was put up to a change of the shared unknowns.

        Local unknowns follow, see ``locals``; priors of the shared unknowns are not in it.
        """
        r = self.reduced
        return float(self._start + r.constant + r.right @ shared - 0.5 * shared @ r.matrix @ shared)

    @staticmethod
    def _take(step: _Eliminated, shared: Array, right: Array) -> float:
        """Eliminate a window, and take what it explains from the shared unknowns; returns its constant."""
        step.eliminate()
        n = len(right)
        shared -= step.half[:, :n].T @ step.half[:, :n]
        right -= step.half[:, :n].T @ step.half[:, n]
        return step.constant

    def locals(self, shared: Array) -> list[Array]:
        """Best change of every window's local unknowns for a change of the shared unknowns."""
        n = len(shared)
        found: list[Array] = []
        following = np.zeros(0)
        for step in reversed(self._steps):
            standardised = step.half[:, n] - step.half[:, :n] @ shared
            standardised -= step.half_next @ following[: step.half_next.shape[1]]
            following = solve_triangular(step.factor, standardised, lower=True, trans=1)
            found.append(step.scale * following)
        return found[::-1]


class _Eliminated:
    """A window on its way out of the system, by a block of a Cholesky factorisation."""

    half: Array
    half_next: Array
    factor: Array
    constant: float
    determinant: float

    def __init__(self, scale: Array, matrix: Array, rest: Array) -> None:
        self.scale, self.matrix, self.rest = scale, matrix, rest
        self.next = np.zeros((len(scale), 0))

    def eliminate(self) -> None:
        """Factorise; ``half`` couples to [shared | right-hand side], ``half_next`` to the next start."""
        self.factor = positive_lower(self.matrix)
        solved = solve_triangular(self.factor, np.concatenate((self.rest, self.next), 1), lower=True)
        self.half, self.half_next = solved[:, : self.rest.shape[1]], solved[:, self.rest.shape[1] :]
        half = self.half[:, -1]
        self.determinant = float(np.log(np.diag(self.factor)).sum())
        self.constant = 0.5 * float(half @ half)


def _scaled(s: WindowSystem, size: Discrepancy) -> tuple[Array, Array]:
    """Prior deviations of the local unknowns and their standardised values, at a size of the discrepancy."""
    scale = np.ones(len(s.standardised))
    fitted = np.ones(len(s.standardised))
    for kind, now, then in zip((s.internal, s.external), size, s.fitted, strict=True):
        scale[kind], fitted[kind] = now, then
    return scale, s.standardised * fitted / scale
