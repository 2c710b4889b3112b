"""Colours shared by figures, overlays and the result page."""

INK = "#1c2430"
MUTED = "#697586"
RULE = "#e3e8ef"
RECONSTRUCTION = "#0f62ac"
GROUND_TRUTH = "#d9730d"
SERIES = ("#0f62ac", "#d9730d", "#2a8c5a", "#8a3ffc", "#c2255c", "#0b7285", "#7a5c00", "#495057")
"""Line colours, distinguishable with the common colour-vision deficiencies in this order."""
ERROR_SCALE = ((0.0, "#d9e2ec"), (0.4, "#f4b860"), (0.7, "#e4572e"), (1.0, "#8f0d2c"))
"""Sequential scale of errors, plain cloth where the error is small."""
