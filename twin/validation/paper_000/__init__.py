"""Checks of paper 000: the camera intersection angle from ground points."""
