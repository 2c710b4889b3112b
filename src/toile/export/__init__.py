"""Exports of a reconstructed cloth to the formats of other programs, one file per format."""
