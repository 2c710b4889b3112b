"""The person under the garment: mesh, skeleton, skinning weights, landmarks."""
