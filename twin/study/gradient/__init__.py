"""Jacobian of a study's responses with respect to its factors."""
