"""Measurements of a pass and their files: readings of the platform, line times, ground and image points."""
