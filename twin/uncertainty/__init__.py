"""Accuracy limits of the changes estimated by a monitor, for ``python -m twin.uncertainty`` and the main job."""
