"""Cameras that look at test targets, and what is measured in the images."""
