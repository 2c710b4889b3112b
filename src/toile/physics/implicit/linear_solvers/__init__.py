"""Direct solvers for the symmetric systems of Newton's method, behind one interface."""
