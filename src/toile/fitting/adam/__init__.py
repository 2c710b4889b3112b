"""The paper's optimisation: Adam over successively more frames."""
