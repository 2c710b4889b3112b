"""Published numbers to stand beside ours, with their sources."""
