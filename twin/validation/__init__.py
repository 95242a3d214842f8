"""Validation of the source papers: their formulas and numbers, one check for each, recomputed by simulation."""
