"""Dividing error of a turntable (paper 004, Li et al. 2020): comparisons, outliers, fits and compensation."""
