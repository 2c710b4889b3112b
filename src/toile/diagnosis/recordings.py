"""What to record next so that the remaining candidates part."""

from __future__ import annotations

from collections.abc import Sequence

from toile.effects.catalogue import MOVING, STAGES

_BY_EFFECT = {
    "gravity_tilt": "the same cloth with a plumb line in view",
    "gusts": "the same cloth indoors with windows and doors closed",
    "air_drag": "two clips, one with slow, one with fast motion of the pinned corners, in still air",
    "internal_damping": "two clips, one with slow, one with fast motion of the pinned corners, in still air",
    "frame_rate": "a running stopwatch in view",
    "focal_error": "a ruler, or a calibration board, held in the plane of the cloth",
    "lens_distortion": "a calibration board that fills the image",
    "mask_bias": "the still cloth before a plain background of another colour",
    "shading": "the still cloth under the same light, turned by hand through 90°",
    "motion_blur": "the same motion with a shorter exposure",
    "anchor_slip": "a mark on the cloth beside each clamp, filmed close up",
    "contact": "the same motion with the cloth half a metre further from everything",
    "nonuniform_density": "the cloth on scales, then pinned by its other two corners",
    "nonuniform_stiffness": "the cloth pinned by its other two corners",
    "anisotropic_stiffness": "the cloth turned by 90°, pinned by two corners of another side",
    "strain_stiffening": "the cloth with a weight hung from its lower edge",
    "rest_curvature": "the cloth lying on a table, then hanging with its other side to the camera",
}


# Recordings that are asked for at once.
_MOST = 3


def next_recording(candidates: Sequence[str]) -> str:
    """Recordings that set the candidates apart, most telling first, and no more than somebody would make.

    Args:
        candidates: most probable first; what is not in the catalogue has no recording of its own.
    """
    known = [c for c in candidates if c in _BY_EFFECT]
    stages = [STAGES[c] for c in known]
    if not known:
        return "one more clip of the same cloth, a longer one, with another motion of the pinned corners"
    if len(known) > 1 and all(stage in MOVING for stage in stages):
        head = "one more clip with the pinned corners shaken about 3 cm at 2 to 3 Hz"
    else:
        head = ""
    wanted = list(dict.fromkeys(_BY_EFFECT[c] for c in known))
    return "; ".join((([head] if head else []) + wanted)[:_MOST])
