"""Measured frames of a monitor through the analysis of the main job: the command ``python -m twin.recover``."""
