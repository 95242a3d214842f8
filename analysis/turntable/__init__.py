"""Dividing error of a turntable: repeated comparisons, outliers, fits and compensation (paper 004)."""
