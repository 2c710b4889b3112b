"""Default back end: NVIDIA Warp kernels, one file per stage."""

from toile.rendering.warp.renderer import WarpRenderer

__all__ = ["WarpRenderer"]
