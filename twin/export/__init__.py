"""Command ``python -m twin.export``: frames and tables of a run folder in the formats of other programs."""
