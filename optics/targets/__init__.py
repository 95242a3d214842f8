"""Test targets, their images, the collimator they are shown in."""
