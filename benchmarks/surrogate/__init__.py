"""Measurements of the neural surrogate for its model card; see ``surrogate_card.py``."""
