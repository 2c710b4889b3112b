"""Generated scenes: known truth, simulated on a finer grid and with smaller steps than a fit uses."""
