"""The picture of frame 0 in which the template's points get the colours that they must keep."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.reconstruction.problem import Reconstruction


def first_frame(reconstruction: Reconstruction) -> Tensor:
    """Frame 0 itself, (h, w, 3) in [0, 1].

    The template lies where the cloth is in frame 0, so this is the texture with the coordinates that follow
    from template and camera; the scene's own texture coordinates are not used.
    """
    return reconstruction.scene.frames[0]


@torch.no_grad()
def drawn_template(reconstruction: Reconstruction) -> Tensor:
    """The template with the scene's texture and texture coordinates, as the renderer draws it, (h, w, 3)."""
    r = reconstruction
    positions = r.template[None]
    images = r.renderer.render(positions, r.faces, r.texture_coordinates, r.scene.texture, r.scene.camera)
    return images.rgb[0]
