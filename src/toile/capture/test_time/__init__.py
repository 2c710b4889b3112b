"""What is done with a network's prediction of a clip: smoothing, collision resolution, the command."""
