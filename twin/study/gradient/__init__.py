"""The Jacobian of a study's responses by its factors."""
