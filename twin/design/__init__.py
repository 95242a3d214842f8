"""Optimisation of a camera's prescription."""
