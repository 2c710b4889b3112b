"""Differentiable rendering of a textured mesh: rasterize → interpolate → texture → antialias."""

from toile.rendering.base import Fragments, RenderedImages, Renderer
from toile.rendering.warp import WarpRenderer

__all__ = ["Fragments", "RenderedImages", "Renderer", "WarpRenderer"]
