"""Training of PoseNet and SimNet in stages: pose, warm start, physics, adaptation."""
