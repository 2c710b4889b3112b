"""The learned decision layer: what moves a cloth, from the physics of its tracked motion."""
