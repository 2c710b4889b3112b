"""Colours shared by figures, overlays and the result page."""

INK = "#1c2430"
MUTED = "#697586"
RULE = "#e3e8ef"
RECONSTRUCTION = "#0f62ac"
GROUND_TRUTH = "#d9730d"
FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif'
SERIES = ("#0f62ac", "#d9730d", "#2a8c5a", "#8a3ffc", "#c2255c", "#0b7285", "#7a5c00", "#495057")
"""Line colours, distinguishable with the common colour-vision deficiencies in this order."""
ERROR_SCALE = ((0.0, "#e9edf2"), (0.35, "#f3bdb6"), (0.7, "#d9435e"), (1.0, "#650f35"))
"""Sequential scale of errors, plain cloth where the error is small."""
FORCE_SCALE = ((0.0, "#eef2f7"), (0.35, "#a9c8e8"), (0.7, "#3f83c4"), (1.0, "#0b3560"))
"""Sequential scale of forces."""
