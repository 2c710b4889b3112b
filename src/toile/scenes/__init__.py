"""Scenes: one frozen description, loaders for the native and the φ-SfT layout, validation."""
