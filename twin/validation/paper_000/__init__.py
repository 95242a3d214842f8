"""Checks of paper 000 (Liu and Huang 2014): the camera intersection angle from ground points."""
