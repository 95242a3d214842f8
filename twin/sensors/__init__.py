"""Detectors: photons in, recorded frames out."""
