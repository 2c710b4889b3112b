"""Gauss-Newton through the simulator: the default recipe."""
