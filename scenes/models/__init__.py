"""Models built from checked input files: bodies, optical elements, glass solids, thermal and disturbance models."""
