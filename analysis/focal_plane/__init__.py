"""Focal-plane alignment (paper 004, Li et al. 2020): best focus, the plane through the foci, and shims."""
