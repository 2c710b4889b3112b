"""Networks that state a person's pose and the deformation of the garment from one image."""
