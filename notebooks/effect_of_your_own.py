# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # An effect of your own, diagnosed
#
# The diagnosis says which effect a simulation lacks. Its catalogue has 17; here an eighteenth is written, a
# scene is filmed in which it acts, and the diagnosis is asked. Settings are tiny: half a minute on one core.

# %%
import dataclasses
from pathlib import Path
from tempfile import mkdtemp
from typing import ClassVar

import matplotlib.pyplot as plt
from torch import Tensor

import toile
from toile.effects.base import CameraEffect, Parameter, Stage
from toile.geometry.camera import Camera

folder = Path(mkdtemp(prefix="toile_"))

# %% [markdown]
# ## The effect
# An effect is a few named parameters and one hook. Pixels that are not square (old video formats, or a clip
# that was scaled) stretch what is seen from top to bottom: a `CameraEffect`, whose hook moves pixels. At zero
# it does nothing, and derivatives come from torch.


# %%
class PixelAspect(CameraEffect):
    """The picture is higher than it should be, by a fixed share."""

    NAME: ClassVar[str] = "pixel_aspect"
    STAGE: ClassVar[Stage] = Stage.CAMERA
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("stretch", "1", -0.2, 0.2, 0.03, "share by which the picture is too high"),
    )
    SOURCE: ClassVar[str] = "Hartley and Zisserman, Multiple View Geometry, 2nd edition 2004, section 6.1"

    def pixels(self, pixels: Tensor, camera: Camera) -> Tensor:
        """See CameraEffect."""
        centre = pixels.new_tensor([camera.cx, camera.cy])
        downwards = pixels.new_tensor([0.0, 1.0])
        return pixels + self.value("stretch").to(pixels.dtype) * downwards * (pixels - centre)


# %% [markdown]
# ## A scene in which it acts
# The motion of a generated scene is filmed through a camera whose pixels are 3 % too high, and recorded with
# the camera that one believes in.

# %%
small = {
    "texture": {"height": 160, "width": 160},
    "settings": {
        "grid": [8, 8],
        "refinement": 1,
        "cloth_size": [0.4, 0.4],
        "n_frames": 12,
        "fps": 25.0,
        "substeps": 4,
        "image_size": [160, 160],
        "focal_length": 225.0,
        "wind": [-0.3, 0.0, 1.0],
    },
}
plain = toile.generate(folder / "plain", small)
assert plain.ground_truth is not None
motion = plain.ground_truth.vertices

stretch = 0.03
true_camera = dataclasses.replace(plain.camera, fy=(1 + stretch) * plain.camera.fy)
scene = toile.render(plain, motion, camera=true_camera).as_scene("stretched")

figure, axes = plt.subplots(1, 2, figsize=(6, 3), layout="constrained")
for axis, picture, title in zip(axes, (plain, scene), ("as believed", "as filmed"), strict=True):
    axis.imshow(picture.frames[0].numpy())
    axis.set_title(title)
    axis.axis("off")

# %% [markdown]
# ## The diagnosis
# The new effect competes with five of the catalogue, "none" and "something else". Its value is zero: the
# question is whether it acts.

# %%
quick = {
    "diagnosis": "quick",
    "diagnosis.sides": [8],
    "diagnosis.shooting": {"modes": 2, "window": 4},
    "optimization.stages.track.term.per_side": 24,
    "effect@candidates": ["focal_error", "lens_distortion", "mask_bias", "air_drag", "shading"],
    "workers": 1,
}
found = toile.diagnose(scene, quick, folder=folder / "diagnosis", effects=[PixelAspect()])
found

# %%
found.table().round(3)

# %% [markdown]
# It is named, and its size is found: 3 % went in. Probabilities are calibrated for the default settings and
# the package's own candidates alone; with others they rank, as the answer says.
#
# ## Without it
# What would have been said without the new effect? Something else near it, with less evidence, or that the
# catalogue has not got the cause.

# %%
without = toile.diagnose(scene, quick, folder=folder / "without")
without

# %%
number = found.report.effect("pixel_aspect").parameters["stretch"]
assert found.effect == "pixel_aspect"
assert number.low < stretch < number.high
print(f"true {stretch:.3f}, found {number.estimate:.3f} [{number.low:.3f}, {number.high:.3f}]")
print(found.page().name, "shows where and when; found.page(show=True) opens it")

# %% [markdown]
# To keep the effect, put the class into a module of its own: [how](../docs/extending.md#a-new-effect).
