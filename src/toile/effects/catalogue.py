"""All effects by name, from forces to pixels."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from toile.effects.air_drag import AirDrag
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.anisotropic_stiffness import AnisotropicStiffness
from toile.effects.base import Effect, Stage
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
from toile.effects.rest_curvature import RestCurvature
from toile.effects.shading import Shading
from toile.effects.strain_stiffening import StrainStiffening

CATALOGUE: Mapping[str, type[Effect]] = MappingProxyType(
    {
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
)
"""Classes by name; every one but Contact, which needs its obstacle, can be made without arguments."""

STAGES: Mapping[str, Stage] = MappingProxyType({name: effect.STAGE for name, effect in CATALOGUE.items()})
"""Stage of every effect by name."""

MOVING = (Stage.MECHANICS, Stage.ACTUATION)
"""Stages whose effects move the cloth."""
