"""All effects of the reality by name."""

from __future__ import annotations

from toile.errors import InputError
from toile.generation.reality.actuation import Gusts, StickSlip
from toile.generation.reality.interface import RealityEffect
from toile.generation.reality.mechanics import (
    CurvedBand,
    ExponentialStiffening,
    HeavyPatches,
    MixedDrag,
    PenaltyContact,
    StiffPatches,
    ThinningDamping,
    TiltedGravity,
    TwoRatioAnisotropy,
    WrongFrameRate,
)
from toile.generation.reality.optics import (
    Lambert,
    RaggedMask,
    SubFrameBlur,
    TangentialLens,
    WrongFocalLength,
)
from toile.generation.reality.outside import (
    InternalPressure,
    Occluder,
    PlasticCreases,
    Shrinking,
    Vortex,
)

_ALL: tuple[type[RealityEffect], ...] = (
    MixedDrag,
    ThinningDamping,
    TwoRatioAnisotropy,
    ExponentialStiffening,
    CurvedBand,
    HeavyPatches,
    StiffPatches,
    PenaltyContact,
    TiltedGravity,
    WrongFrameRate,
    StickSlip,
    Gusts,
    WrongFocalLength,
    TangentialLens,
    Lambert,
    SubFrameBlur,
    RaggedMask,
    PlasticCreases,
    InternalPressure,
    Vortex,
    Shrinking,
    Occluder,
)

REALITY_EFFECTS: dict[str, type[RealityEffect]] = {effect.NAME: effect for effect in _ALL}
INSIDE = tuple(effect.NAME for effect in _ALL if not effect.OUTSIDE)
OUTSIDE = tuple(effect.NAME for effect in _ALL if effect.OUTSIDE)
LEVELS = ("weak", "medium", "strong")


def reality_effect(name: str) -> type[RealityEffect]:
    """The class of that name.

    Raises:
        InputError: there is none.
    """
    if name not in REALITY_EFFECTS:
        raise InputError(
            "No such effect in the generated reality",
            where="effects",
            expected=", ".join(REALITY_EFFECTS),
            got=name,
        )
    return REALITY_EFFECTS[name]
