"""Settings of a generated scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from toile.errors import InputError
from toile.generation.motion import PinnedMotion, Still
from toile.limits import Count, CountOrZero, Finite, NonNegative, Positive, Seed, TwoOrMore, Unit
from toile.physics.cloth import GRID_PARAMETERS
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.material import Material
from toile.physics.units import NetworkUnits


@dataclass(frozen=True)
class GeneratorSettings:
    """Everything that a generated scene follows from, apart from its texture and a real template.

    The stiffnesses are in the paper's network units for the fit's grid and one video frame per step. Winds
    are forces per mass, the same for every vertex, as fits model them.

    Attributes:
        name: name of the scene.
        grid: grid (H, W) of the template and the ground truth, which a fit uses.
        refinement: the simulated grid has refinement·(H-1)+1 by refinement·(W-1)+1 vertices.
        substeps: BDF2 steps per video frame.
        n_frames: number of frames F.
        fps: frames per second.
        cloth_size: rest length of the sides along axis 0 and 1 [m]; a real template brings its own.
        areal_density: [kg/m²].
        stretching: Y [network units].
        shearing: S [network units].
        bending: B [network units].
        gravity: [m/s²], camera frame.
        initial_wind: [m/s²], orthogonal to gravity; frame 0 is the equilibrium under it.
        wind: [m/s²], orthogonal to gravity; blows from frame 0 on.
        pinned_distance: distance of the pinned upper corners as a fraction of the side along axis 0, below 1.
        pinned_motion: motion of the pinned vertices from frame 0 on.
        distance: z of the cloth's centre before it settles [m].
        yaw: angle by which the cloth is turned about the direction of gravity [degrees].
        image_size: (height, width) [px]; a real template brings its own camera.
        focal_length: [px].
        image_scale: factor on the resolution of the camera, a real template's included.
        crop_margin: crop to the cloth's box over all frames plus this margin [px]; None keeps whole images.
        supersampling: samples per pixel and axis.
        blur: standard deviation of the lens blur [px]; 0 for none.
        noise: standard deviation of the image noise on the cloth, in [0, 1].
        settled: vertices of frame 0 accelerate by no more than this [m/s²].
        newton_tolerance: see NewtonSettings.
        seed: of the initial bend and the noise.
    """

    name: str = "generated"
    grid: tuple[TwoOrMore, TwoOrMore] = (32, 32)
    refinement: Count = 2
    substeps: Count = 8
    n_frames: Annotated[TwoOrMore, Unit("frames")] = 50
    fps: Annotated[Positive, Unit("1/s")] = 50.0
    cloth_size: tuple[Annotated[Positive, Unit("m")], Annotated[Positive, Unit("m")]] = (0.6, 0.6)
    areal_density: Annotated[Positive, Unit("kg/m²")] = 0.15
    stretching: Annotated[Positive, Unit("network units")] = 4000.0
    shearing: Annotated[Positive, Unit("network units")] = 20.0
    bending: Annotated[NonNegative, Unit("network units")] = 2.0
    gravity: tuple[float, float, float] = (0.0, 9.81, 0.0)
    initial_wind: tuple[float, float, float] = (0.5, 0.0, -1.0)
    wind: tuple[float, float, float] = (-0.3, 0.0, 1.5)
    pinned_distance: Positive = 0.96
    pinned_motion: PinnedMotion = field(default_factory=Still)
    distance: Annotated[Positive, Unit("m")] = 1.1
    yaw: Annotated[Finite, Unit("degrees")] = 0.0
    image_size: tuple[Annotated[Count, Unit("px")], Annotated[Count, Unit("px")]] = (480, 480)
    focal_length: Annotated[Positive, Unit("px")] = 720.0
    image_scale: Positive = 1.0
    crop_margin: Annotated[CountOrZero, Unit("px")] | None = None
    supersampling: Count = 2
    blur: Annotated[NonNegative, Unit("px")] = 0.4
    noise: NonNegative = 0.01
    settled: Annotated[Positive, Unit("m/s²")] = 1e-3
    newton_tolerance: Positive = 1e-6
    seed: Seed = 0

    def __post_init__(self) -> None:
        positive = ("refinement", "substeps", "n_frames", "fps", "areal_density", "distance", "focal_length")
        for name in (*positive, "image_scale", "settled", "newton_tolerance"):
            if not getattr(self, name) > 0:
                raise wrong_setting(name, "a number above 0", getattr(self, name))
        for name in (*GRID_PARAMETERS.names, "blur", "noise"):
            if not getattr(self, name) >= 0:
                raise wrong_setting(name, "a number of at least 0", getattr(self, name))
        if min(self.grid) < 3 or min(self.cloth_size) <= 0:
            raise wrong_setting(
                "grid, cloth_size", "at least 3 × 3 vertices, positive sides", (self.grid, self.cloth_size)
            )
        for name in ("wind", "initial_wind"):
            along = sum(a * b for a, b in zip(getattr(self, name), self.gravity, strict=True))
            if abs(along) > 1e-6 * sum(g * g for g in self.gravity):
                raise wrong_setting(name, "a horizontal vector, orthogonal to gravity", getattr(self, name))

    @property
    def newton(self) -> NewtonSettings:
        """Accuracy of every step."""
        return NewtonSettings(tolerance=self.newton_tolerance)

    def units(self, cloth_size: tuple[float, float]) -> NetworkUnits:
        """Network units of the fit's grid and one step per frame; of the mean spacing if the two differ."""
        cell = cloth_size[0] * cloth_size[1] / ((self.grid[0] - 1) * (self.grid[1] - 1))
        return NetworkUnits(self.areal_density * cell, cell**0.5, 1 / self.fps)

    def material(self, cloth_size: tuple[float, float]) -> Material:
        """True stiffnesses (1,) on the fit's grid [N/m, N·m, N·m]."""
        units = self.units(cloth_size)
        return Material.of(
            GRID_PARAMETERS, {p.name: getattr(self, p.name) * units.of(p.unit) for p in GRID_PARAMETERS}
        )


def wrong_setting(name: str, expected: str, got: object) -> InputError:
    """The error for a setting or argument that cannot be used."""
    return InputError("The scene cannot be generated", where=name, expected=expected, got=str(got))
