"""Training of the neural cloth model on a pool of cloths that it moves itself (paper, section 3.1.5)."""
