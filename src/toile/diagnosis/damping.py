"""Damping of Gauss-Newton steps (Levenberg 1944, Marquardt 1963), in prior precisions."""

from __future__ import annotations

TRIED = 5
"""Steps of a pass that are tried, each with more damping."""

# Damping of the first step that has any, and by which factors it grows and falls.
_FIRST, _STRONGER, _WEAKER = 10.0, 5.0, 4.0


def more(damping: float) -> float:
    """Damping after a step that did not lower the cost."""
    return max(_STRONGER * damping, _FIRST)


def less(damping: float) -> float:
    """Damping after a step that did."""
    return damping / _WEAKER if damping > _FIRST / _WEAKER else 0.0
