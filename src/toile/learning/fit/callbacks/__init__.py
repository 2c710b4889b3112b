"""What happens beside the cycles of a fit: checkpoints, progress, TensorBoard."""
