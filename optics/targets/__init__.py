"""Test targets, their images, and the collimator that presents them to a camera."""
