"""Frames and tables of a run folder in formats of other programs: the command ``python -m twin.export``."""
