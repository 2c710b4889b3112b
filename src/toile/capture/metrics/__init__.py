"""Measures of a garment on a body that need to know what the garment is made of."""
