"""Differentiable rendering of a textured mesh: rasterize → interpolate → texture → antialias."""

from toile.rendering.base import Fragments, RenderedImages, Renderer
from toile.rendering.nvdiffrast import NvdiffrastRenderer
from toile.rendering.reference import ReferenceRenderer
from toile.rendering.visibility import visible_points
from toile.rendering.warp import WarpRenderer

__all__ = [
    "Fragments",
    "NvdiffrastRenderer",
    "ReferenceRenderer",
    "RenderedImages",
    "Renderer",
    "WarpRenderer",
    "visible_points",
]
