"""What PoseNet and SimNet are trained on, and how their weights are kept."""
