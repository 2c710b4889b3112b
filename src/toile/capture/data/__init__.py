"""Data sets of moving people in garments with known truth: bodies, garments, cameras, images, landmarks."""
