"""toile: physics-based reconstruction of real cloth from one ordinary RGB video."""

__version__ = "0.1.0"
