"""What the stiffness of a fit is worth, told by the recipe that found it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from toile.physics.cloth import GRID_PARAMETERS

_NO_MEASUREMENT = (
    "The stiffness is the one with which tracking goes well, and no measurement: free forces were fitted "
    "beside it and explain almost any motion. It depends on the template and on the values that the fit "
    "started from. Where gravity and steady wind are the only forces, "
    "optimization=identification measures it."
)
_MEASURED = (
    "The stiffness was fitted without free forces: a measurement where gravity and steady wind are the only "
    "forces, relative to the areal density of the configuration. Other forces would be taken for stiffness."
)
_GIVEN = "The stiffness was not fitted: it has the values that the configuration gives it."


def stiffness_note(settings: Mapping[str, Any]) -> str:
    """A few sentences, or "" for a recipe that is not known.

    Args:
        settings: the stored configuration of the fit as plain data.
    """
    recipe = settings.get("optimization")
    if not isinstance(recipe, Mapping):
        return ""
    match str(recipe.get("_target_")).rpartition(".")[2]:
        case "TrackingRecipe":
            return _of_stages(recipe.get("stages"))
        case "SuccessiveFramesAdam":
            rates = recipe.get("learning_rates")
            if not isinstance(rates, Mapping):
                return ""
            if not any(rates.get(name) for name in GRID_PARAMETERS.names):
                return _GIVEN
            return _NO_MEASUREMENT if rates.get("turbulence") else _MEASURED
    return ""


def _of_stages(stages: Any) -> str:
    """The last stage that fits the stiffness decides, with the forces that are there by then."""
    if not isinstance(stages, Mapping):
        return ""
    note, free_forces = _GIVEN, False
    for stage in stages.values():
        if not isinstance(stage, Mapping) or not isinstance(stage.get("priors"), Mapping):
            continue
        priors = stage["priors"]
        if stage.get("discard_turbulence"):
            free_forces = False
        free_forces = free_forces or priors.get("turbulence") is not None
        if priors.get("stiffness") is not None:
            note = _NO_MEASUREMENT if free_forces else _MEASURED
    return note
