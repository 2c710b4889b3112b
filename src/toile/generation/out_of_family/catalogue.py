"""All effects of the out-of-family generator by name."""

from __future__ import annotations

from toile.effects.base import Scope
from toile.effects.catalogue import CATALOGUE
from toile.errors import InputError
from toile.generation.out_of_family.actuation import Gusts, StickSlip
from toile.generation.out_of_family.interface import OutOfFamilyEffect
from toile.generation.out_of_family.mechanics import (
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
from toile.generation.out_of_family.optics import (
    Lambert,
    RaggedMask,
    SubFrameBlur,
    TangentialLens,
    WrongFocalLength,
)
from toile.generation.out_of_family.other_forms import (
    BilinearStiffening,
    GradedDensity,
    GradedStiffness,
    NoisyGusts,
    PulsedGusts,
    QuadraticDrag,
    RayleighDamping,
)
from toile.generation.out_of_family.outside import (
    InternalPressure,
    Occluder,
    PlasticCreases,
    Shrinking,
    Vortex,
)

_ALL: tuple[type[OutOfFamilyEffect], ...] = (
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

_OTHER_FORMS: tuple[type[OutOfFamilyEffect], ...] = (
    QuadraticDrag,
    RayleighDamping,
    BilinearStiffening,
    PulsedGusts,
    NoisyGusts,
    GradedDensity,
    GradedStiffness,
)

OUT_OF_FAMILY_EFFECTS: dict[str, type[OutOfFamilyEffect]] = {effect.NAME: effect for effect in _ALL}
INSIDE = tuple(effect.NAME for effect in _ALL if not effect.OUTSIDE)
OUTSIDE = tuple(effect.NAME for effect in _ALL if effect.OUTSIDE)
LEVELS = ("weak", "medium", "strong")


def out_of_family_effect(name: str) -> type[OutOfFamilyEffect]:
    """The class of that name.

    Raises:
        InputError: there is none.
    """
    if name not in OUT_OF_FAMILY_EFFECTS:
        raise InputError(
            "No such effect in the out-of-family generator",
            where="effects",
            expected=", ".join(OUT_OF_FAMILY_EFFECTS),
            got=name,
        )
    return OUT_OF_FAMILY_EFFECTS[name]


def forms_of(name: str) -> tuple[type[OutOfFamilyEffect], ...]:
    """All functional forms of an effect, the one of ``out_of_family_effect`` first.

    Raises:
        InputError: there is no such effect.
    """
    return (out_of_family_effect(name), *(form for form in _OTHER_FORMS if name == form.NAME))


def scope_of(name: str) -> Scope:
    """What an effect belongs to: as the catalogue says, else as its own class does."""
    return CATALOGUE[name].SCOPE if name in CATALOGUE else out_of_family_effect(name).SCOPE
