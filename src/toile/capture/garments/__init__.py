"""Garments on a subject: format, attachment, skirts and dresses, checks of a user's own."""

from toile.capture.garments.checks import check_garment
from toile.capture.garments.garment import Garment, Material, attached_targets
from toile.capture.garments.own_mesh import own_garment
from toile.capture.garments.patterns import make_dress, make_skirt

__all__ = [
    "Garment",
    "Material",
    "attached_targets",
    "check_garment",
    "make_dress",
    "make_skirt",
    "own_garment",
]
