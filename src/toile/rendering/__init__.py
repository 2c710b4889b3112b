"""Differentiable rendering of a textured mesh: rasterize → interpolate → texture → antialias."""

from typing import TYPE_CHECKING, Any

from toile.rendering.base import Fragments, RenderedImages, Renderer
from toile.rendering.nvdiffrast import NvdiffrastRenderer
from toile.rendering.reference import ReferenceRenderer
from toile.rendering.visibility import visible_points

if TYPE_CHECKING:
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


def __getattr__(name: str) -> Any:
    """Load Warp, which takes a second, when its renderer is asked for and not with everything beside it."""
    if name == "WarpRenderer":
        from toile.rendering.warp import WarpRenderer

        return WarpRenderer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
