"""Validation of the source papers: their formulas and numbers, one check each, worked out anew by simulation."""
