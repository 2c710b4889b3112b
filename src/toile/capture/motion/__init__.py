"""Motions of a subject: made by formulas, or read from BVH and glTF files."""
