"""Sensors of a block by name. The command's help names them, so that nothing else is imported here."""

SENSORS = ("ties", "control", "monitor", "laser", "terrain", "tracker_angles")
"""What an adjustment can be asked to do without."""
