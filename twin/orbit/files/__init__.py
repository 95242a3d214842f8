"""Orbits, attitudes, ground points and maps from files in the formats that others write."""
