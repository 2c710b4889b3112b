"""What a Blender scene can have that a fit's base model lacks: names, stages, parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from toile.errors import InputError


@dataclass(frozen=True)
class BlenderEffect:
    """One effect as this engine offers it.

    Attributes:
        name: that of the catalogue of effects where it is there.
        stage: where along the way from forces to pixels it acts.
        accepted_stages: further stages that are no wrong answer.
        in_catalogue: whether the catalogue has an effect of this name.
        defaults: parameters and their usual values.
        scaled: the parameter that grows with the size of the gap, or None if it has no size in the motion.
        doc: its form in Blender, with the units of the parameters.
    """

    name: str
    stage: str
    doc: str
    defaults: Mapping[str, float]
    scaled: str | None = None
    accepted_stages: tuple[str, ...] = ()
    in_catalogue: bool = True

    def values(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """Defaults with some replaced.

        Raises:
            InputError: a parameter that the effect does not have.
        """
        for name in parameters:
            if name not in self.defaults:
                raise InputError(
                    f"{self.name} has no such parameter in Blender",
                    where="parameters",
                    expected=", ".join(self.defaults) or "none",
                    got=name,
                )
        return {name: float(parameters.get(name, value)) for name, value in self.defaults.items()}


_ALL = (
    BlenderEffect("none", "none", "The engine itself, with nothing added.", {}),
    BlenderEffect(
        "air_drag",
        "mechanics",
        "Isotropic viscous drag on every vertex; `air_damping` in Blender's unit.",
        {"air_damping": 0.3},
        "air_damping",
    ),
    BlenderEffect(
        "internal_damping",
        "mechanics",
        "Damping of the springs; `damping` of shear and bending in Blender's unit, `axial_ratio` times that "
        "of tension and compression.",
        {"damping": 8.0, "axial_ratio": 0.3},
        "damping",
    ),
    BlenderEffect(
        "anisotropic_stiffness",
        "mechanics",
        "Twice as many threads per metre across the pinned edge as along it: springs `ratio` (whole number) "
        "times shorter along axis 1, so the cloth is ratio² times stiffer along axis 0 than along axis 1.",
        {"ratio": 2.0},
    ),
    BlenderEffect(
        "nonuniform_stiffness",
        "mechanics",
        "A smooth patch of vertices whose springs are up to `factor` times stiffer, `bend_factor` in "
        "bending; `width` of the patch as a fraction of the cloth's.",
        {"factor": 3.0, "bend_factor": 40.0, "width": 0.6},
        "bend_factor",
    ),
    BlenderEffect(
        "rest_curvature",
        "mechanics",
        "A rest shape that is rolled about an axis along the pinned edge; `curvature` [1/m].",
        {"curvature": 8.0},
        "curvature",
    ),
    BlenderEffect(
        "contact",
        "mechanics",
        "An invisible sphere in the way of the swing; `depth` [m] by which the undisturbed cloth would enter "
        "it, `radius` [m], `friction` in Blender's unit.",
        {"depth": 0.05, "radius": 0.2, "friction": 5.0},
        "depth",
    ),
    BlenderEffect(
        "gravity_tilt",
        "mechanics",
        "Gravity turned by `angle` [degrees] about the camera's viewing direction, unlike the declared one.",
        {"angle": 4.0},
        "angle",
    ),
    BlenderEffect(
        "frame_rate",
        "mechanics",
        "Frames taken at (1 + `error`) times the declared rate.",
        {"error": 0.06},
        "error",
    ),
    BlenderEffect(
        "gusts",
        "actuation",
        "A wind field that swells and ebbs twice, of `strength` in Blender's unit, on the faces' normals.",
        {"strength": 15000.0},
        "strength",
        ("mechanics",),
    ),
    BlenderEffect(
        "anchor_slip",
        "actuation",
        "The second pinned corner slides by `distance` [m] towards the first and down, from `start` on, in "
        "`duration` (fractions of the clip).",
        {"distance": 0.02, "start": 0.3, "duration": 0.2},
        "distance",
    ),
    BlenderEffect(
        "focal_error",
        "camera",
        "A camera with (1 + `error`) times the declared focal length.",
        {"error": 0.06},
    ),
    BlenderEffect(
        "lens_distortion",
        "camera",
        "Radial distortion, factor 1 + `k1` r², r in focal lengths; frames warped after rendering.",
        {"k1": 0.2},
    ),
    BlenderEffect(
        "shading",
        "appearance",
        "A sun of `lambert` on a diffuse cloth over a glow of `ambient`, with cast shadows; it moves by "
        "`sweep` [degrees] over the clip.",
        {"ambient": 0.35, "lambert": 0.75, "sweep": 60.0},
    ),
    BlenderEffect(
        "motion_blur",
        "appearance",
        "Shutter open for `shutter` of a frame, centred on it, as a mean of `exposures` images.",
        {"shutter": 0.7, "exposures": 7.0},
    ),
    BlenderEffect(
        "mask_bias",
        "observation",
        "Masks grown by `pixels` [px], shrunk if negative; frames are black outside of them.",
        {"pixels": -2.5},
    ),
    BlenderEffect(
        "vortex_field",
        "mechanics",
        "Forces around a vertical axis through the cloth's middle, of `strength` in Blender's unit.",
        {"strength": 150.0},
        "strength",
        ("actuation",),
        in_catalogue=False,
    ),
    BlenderEffect(
        "turbulence",
        "actuation",
        "A force that varies randomly in space, `strength` in Blender's unit, `size` [m].",
        {"strength": 12000.0, "size": 0.3},
        "strength",
        ("mechanics",),
        in_catalogue=False,
    ),
    BlenderEffect(
        "internal_pressure",
        "mechanics",
        "Pressure along the normals, `force` in Blender's unit.",
        {"force": 5.0},
        "force",
        ("actuation",),
        in_catalogue=False,
    ),
    BlenderEffect(
        "shrinking",
        "mechanics",
        "Rest lengths shorten steadily, by `fraction` at the end.",
        {"fraction": 0.05},
        "fraction",
        in_catalogue=False,
    ),
    BlenderEffect(
        "occluder",
        "observation",
        "A bar of `width` [m] that crosses in front of the cloth by `travel` [m]; the masks ignore it.",
        {"width": 0.05, "travel": 0.25},
        None,
        ("appearance",),
        in_catalogue=False,
    ),
)
EFFECTS: Mapping[str, BlenderEffect] = {effect.name: effect for effect in _ALL}
"""All effects by name."""

WITHIN = (
    "internal_damping",
    "anisotropic_stiffness",
    "nonuniform_stiffness",
    "rest_curvature",
    "shrinking",
)
"""Effects that are forces within the cloth."""


def effect_named(name: str) -> BlenderEffect:
    """The effect of a name.

    Raises:
        InputError: there is none.
    """
    if name not in EFFECTS:
        raise InputError(
            "Blender scenes have no such effect", where="effect", expected=", ".join(EFFECTS), got=name
        )
    return EFFECTS[name]
