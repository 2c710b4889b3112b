"""What the method is compared with: other ways from the same pictures to body and garment."""
