"""Garments on a subject: format, attachment, skirts and dresses, checks of a user's own."""

from toile.capture.garments.garment import Garment, Material, attached_targets

__all__ = ["Garment", "Material", "attached_targets"]
