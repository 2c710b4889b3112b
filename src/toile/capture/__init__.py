"""Clothed humans from one camera: bodies, garments on them, and the layer that moves cloth by physics."""
