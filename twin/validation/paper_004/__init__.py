"""Checks of paper 004 (Li et al. 2020): integration and test of a bi-linear camera."""
