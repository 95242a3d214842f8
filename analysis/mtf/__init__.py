"""MTF from images of slanted edges and bars; also the command `python -m analysis.mtf`."""
