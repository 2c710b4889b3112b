"""Terms of the paper's Shape-from-Template loss (Eqs. 14 to 17), one per file."""
