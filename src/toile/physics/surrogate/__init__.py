"""A neural surrogate of the implicit step, learned from the equations alone."""
