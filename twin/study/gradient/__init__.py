"""Jacobian of a study's responses (result numbers) with respect to its factors (varied inputs)."""
