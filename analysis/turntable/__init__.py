"""Dividing error of a turntable: repeats, outliers, fits, compensation (paper 004)."""
