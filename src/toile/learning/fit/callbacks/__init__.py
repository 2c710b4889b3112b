"""What happens beside the cycles of a fit: Chamfer distance, progress, TensorBoard."""
