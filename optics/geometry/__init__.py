"""Geometry of an optical system: rigid bodies, surfaces, apertures, solids and polygons."""
