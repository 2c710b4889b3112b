"""Contact of a cloth with a surface whose motion is given."""
