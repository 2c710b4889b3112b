"""Masks of the cloth in the frames of a clip."""
