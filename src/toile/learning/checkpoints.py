"""Where the checkpoint of a fit or a training is; known without loading what writes it."""

LAST = "last.ckpt"
"""Name of the last checkpoint in its folder."""
