"""Names of earlier versions: files that have them are read, settings that have them get the new name told.

Settings, keys and columns were renamed to the field's terms once; whatever is written has the new names.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")

SETTINGS: Mapping[str, str] = {
    "callbacks.curves.every": "trainer.log_every_n_steps",
    "diagnosis.attachment_slip.settling": "diagnosis.attachment_slip.first_frames",
    "diagnosis.attachment_slip.white": "diagnosis.attachment_slip.independent",
    "diagnosis.grip.settling": "diagnosis.attachment_slip.first_frames",
    "diagnosis.grip.white": "diagnosis.attachment_slip.independent",
    "diagnosis.grip": "diagnosis.attachment_slip",
    "diagnosis.border": "diagnosis.outline",
    "diagnosis.colours": "diagnosis.brightness",
    "diagnosis.evidence.slack": "diagnosis.evidence.prior_inflation",
    "diagnosis.refits.promising": "diagnosis.refits.least_score",
    "diagnosis.refits.settled": "diagnosis.refits.converged",
    "diagnosis.settling_passes": "diagnosis.base_refits",
    "diagnosis.shooting.anchor": "diagnosis.shooting.boundary",
    "diagnosis.shooting.anchor_knot": "diagnosis.shooting.boundary_knot",
    "diagnosis.shooting.trust": "diagnosis.shooting.likelihood_weight",
    "diagnosis.weights.foresight": "diagnosis.weights.predictive",
    "diagnosis.weights.hindsight": "diagnosis.weights.in_sample",
    "optimization.learning_rates.anchor_motion": "optimization.learning_rates.boundary_motion",
    "reality": "out_of_family",
    "scene.held_vertices": "scene.pinned_vertices",
    "held_vertices": "pinned_vertices",
    "held_motion": "pinned_motion",
    "settings.held_distance": "settings.pinned_distance",
    "settings.held_motion": "settings.pinned_motion",
    "training.pool.held_corners": "training.pool.pinned_corners",
}
"""Settings, and groups of them, by their former names."""

_PARTS = {"anchor_motion": "boundary_motion", "anchor_motion_time": "boundary_motion_time"}
# Of a class that builds a part, as settings that evidence was made with list it.
_CLASSES = {
    "BorderSettings": "OutlineSettings",
    "ColourSettings": "BrightnessSettings",
    "GripSettings": "SlipSettings",
    "Stage": "TrackingStage",
}

SCENE_KEYS: Mapping[str, str] = {"held_vertices": "pinned_vertices"}
"""Keys of scene.json."""

TRAJECTORY_ARRAYS: Mapping[str, str] = {
    "anchor motion [m]": "boundary motion [m]",
    "held vertices": "pinned vertices",
}
"""Arrays of trajectory.npz."""

EVIDENCE_COLUMNS: Mapping[str, str] = {"hindsight": "in_sample", "foretold": "prediction_gain"}
"""Of screening.npz and of tables of measured scenes."""

SET_KEYS: Mapping[str, str] = {"reality": "out_of_family"}
"""Keys of the description of a blind set."""

GENERATORS: Mapping[str, str] = {"reality": "toile"}
"""Values of ``generator`` in labels."""


def setting(name: str) -> str:
    """The present name of a setting; the name itself where it was never another one."""
    best = max((old for old in SETTINGS if f"{name}.".startswith(f"{old}.")), key=len, default=None)
    found = name if best is None else SETTINGS[best] + name[len(best) :]
    head, dot, last = found.rpartition(".")
    return f"{head}{dot}{_PARTS.get(last, last)}"


def settings(values: Mapping[str, T]) -> dict[str, T | str]:
    """Settings by their present names, with the present names of the classes that build a part."""
    return {
        setting(name): _CLASSES.get(value, value)
        if isinstance(value, str) and name.endswith("_target_")
        else value
        for name, value in values.items()
    }


def renamed(values: Mapping[str, T], names: Mapping[str, str]) -> dict[str, T]:
    """A mapping by its present keys; one that is there under both keeps the present one's value."""
    return {names.get(key, key): value for key, value in values.items() if names.get(key) not in values}
