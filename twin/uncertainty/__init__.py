"""What limits a monitor's readings: the command ``python -m twin.uncertainty``, and the main job's section of it."""
