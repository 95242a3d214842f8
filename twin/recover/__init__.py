"""Analysis of measured frames of a monitor as in the main job: the command ``python -m twin.recover``."""
