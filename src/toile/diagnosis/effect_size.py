"""How far an effect moves the cloth: what moves it less than the model's own errors do is no cause to name.

Where images are precise, evidence grows without limit for whatever takes up the last millimetre that a model
on a grid is wrong by. "None" therefore stands for an interval, not for a point (Berger and Delampady 1987,
Testing precise hypotheses).
"""

from __future__ import annotations

import numpy as np

from toile.diagnosis.mechanics import Mechanics
from toile.diagnosis.refits import Refit, acting_with, within_bounds


def effect_size(mechanics: Mechanics, model: Refit) -> float:
    """Mean distance [m] of windows with the effect from those without it, all else equal; second halves.

    The effect has the coefficients that are estimated, which its refit may still be on the way to.
    """
    shooting = mechanics.shooting
    (effect,) = model.effects
    acting = (acting_with(effect, within_bounds(effect, model.mean)),)
    away = []
    for window in model.windows:
        without = shooting.simulate(window, window.standardised, model.base)
        try:
            there = shooting.simulate(window, window.standardised, model.base, acting, mechanics.around)
        except FloatingPointError:
            # So strong that a step blows up here; the refit's own coefficients did not.
            there = window
        distance = np.linalg.norm((there.positions - without.positions)[:: shooting.substeps], axis=-1)
        away.append(distance[len(distance) // 2 :].mean())
    return float(np.mean(away))
