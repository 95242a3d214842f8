"""Optimisation of a camera's prescription, and search for the layout of a monitor."""
