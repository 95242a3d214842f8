"""Numerical foundations: array backends, deterministic sums, quadrature, constrained least squares, immutable maps."""
