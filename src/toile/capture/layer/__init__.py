"""The simulation layer: a garment on a moving body, one time step after the other."""
