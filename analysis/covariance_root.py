"""Roots of covariances, from which random numbers are drawn that are the same on every processor."""

from __future__ import annotations

import numpy as np

from analysis.arrays import Array


def covariance_root(covariance: Array) -> Array:
    """G (M, M) with G G' = covariance (M, M), positive semidefinite: standard deviations times the symmetric root of
    the correlations, so that numbers without correlations are drawn by themselves, each in its unit.

    It changes little where the covariance does, whatever its rank. Eigenvectors alone do not: those of equal
    eigenvalues are what rounding makes of them, and every processor would draw other numbers.
    """
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / safe / safe[:, None])
    return np.asarray(sigma[:, None] * ((vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T))
