"""Optimisation of a camera's optical prescription, and search for the layout of a monitor."""
