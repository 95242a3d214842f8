"""Checks of paper 004: integration and test of a bi-linear camera."""
