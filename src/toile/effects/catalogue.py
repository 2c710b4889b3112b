"""All effects by name, from forces to pixels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType

from toile.effects.air_drag import AirDrag
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.anisotropic_stiffness import AnisotropicStiffness
from toile.effects.base import CameraEffect, Effect, MaskEffect, Stage
from toile.effects.contact import Contact
from toile.effects.focal_error import FocalError
from toile.effects.frame_rate import FrameRate
from toile.effects.gravity_tilt import GravityTilt
from toile.effects.gusts import Gusts
from toile.effects.internal_damping import InternalDamping
from toile.effects.lens_distortion import LensDistortion
from toile.effects.mask_bias import MaskBias
from toile.effects.motion_blur import MotionBlur
from toile.effects.nonuniform_density import NonuniformDensity
from toile.effects.nonuniform_stiffness import NonuniformStiffness
from toile.effects.pressure import Pressure
from toile.effects.rest_curvature import RestCurvature
from toile.effects.rest_length_drift import RestLengthDrift
from toile.effects.shading import Shading
from toile.effects.steady_forces import SteadyForces
from toile.effects.strain_stiffening import StrainStiffening
from toile.errors import InputError

_EFFECTS: dict[str, type[Effect]] = {
    effect.NAME: effect
    for effect in (
        AnchorSlip,
        Gusts,
        AirDrag,
        InternalDamping,
        AnisotropicStiffness,
        StrainStiffening,
        RestCurvature,
        NonuniformDensity,
        NonuniformStiffness,
        Contact,
        GravityTilt,
        FrameRate,
        FocalError,
        LensDistortion,
        Shading,
        MotionBlur,
        MaskBias,
    )
}
CATALOGUE: Mapping[str, type[Effect]] = MappingProxyType(_EFFECTS)
"""Classes by name; every one can be made without arguments. A Contact that knows no obstacle touches none."""

_STAGES: dict[str, Stage] = {name: effect.STAGE for name, effect in _EFFECTS.items()}
STAGES: Mapping[str, Stage] = MappingProxyType(_STAGES)
"""Stage of every effect by name."""

OUTLINED = tuple(name for name, effect in _EFFECTS.items() if issubclass(effect, CameraEffect | MaskEffect))
"""Effects that are read from one outline: rivals, whichever stage they are of."""

OUTSIDE = ("air_drag", "gusts", "gravity_tilt", "nonuniform_density", "frame_rate", "contact")
"""Effects that change the balance of inertia, gravity and forces from outside; all others that move the cloth
act within it, or through what holds it."""

WEIGHING = ("nonuniform_density",)
"""Those of them that change what forces within the cloth do to its motion as well: m a = m g + f."""

PUSHING = ("contact",)
"""Those of them whose push, in a place and for a moment, may hardly show in that balance."""

UNCHANGING = ("air_drag", "gravity_tilt", "frame_rate")
"""Those of them that one to three numbers say, the same all over the cloth and all the time."""

StandInEffect = SteadyForces | RestLengthDrift | Pressure

STAND_INS: Mapping[str, type[StandInEffect]] = MappingProxyType(
    {effect.NAME: effect for effect in (SteadyForces, RestLengthDrift, Pressure)}
)
"""What stands in for causes that the catalogue lacks: it names none, so what speaks for it speaks for
``unknown``. Not in the catalogue."""

MOVING = (Stage.MECHANICS, Stage.ACTUATION)
"""Stages whose effects move the cloth."""


@contextmanager
def also_known(effects: Sequence[Effect]) -> Iterator[None]:
    """Let the catalogue hold effects from outside the package as well, as long as the block runs.

    Args:
        effects: instances; those of the catalogue's own classes change nothing.

    Raises:
        InputError: one that bears the name of another effect.
    """
    new: dict[str, type[Effect]] = {}
    for effect in effects:
        if _EFFECTS.get(effect.NAME, type(effect)) is not type(effect):
            raise InputError(
                "An effect of that name is in the catalogue",
                where=f"NAME of {type(effect).__qualname__}",
                expected=f"another name than {', '.join(_EFFECTS)}",
                got=effect.NAME,
            )
        if effect.NAME not in _EFFECTS:
            new[effect.NAME] = type(effect)
    _EFFECTS.update(new)
    _STAGES.update({name: effect.STAGE for name, effect in new.items()})
    try:
        yield
    finally:
        for name in new:
            del _EFFECTS[name], _STAGES[name]
