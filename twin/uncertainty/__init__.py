"""Accuracy limits of a monitor's readings, for ``python -m twin.uncertainty`` and the main job."""
