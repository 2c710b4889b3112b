"""The embedded demo: a small scene that the project makes itself in seconds, without any data."""

from __future__ import annotations

from toile.generation.settings import GeneratorSettings

DEMO = GeneratorSettings(
    name="demo",
    grid=(16, 16),
    refinement=2,
    substeps=8,
    n_frames=24,
    fps=50.0,
    cloth_size=(0.5, 0.5),
    stretching=2000.0,
    shearing=10.0,
    bending=0.5,
    initial_wind=(0.5, 0.0, -1.0),
    wind=(-0.8, 0.0, 2.5),
    pinned_distance=0.9,
    distance=1.0,
    image_size=(240, 240),
    focal_length=350.0,
    seed=1,
)
"""Settings of the demo scene."""
DEMO_TEXTURE_SIZE = 400
"""Side of the demo's texture [px]."""
