"""Roots from which random numbers are drawn: their covariance, and that rounding decides nothing about them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optics.numerics.array_math import covariance_root

PAIR = np.array([[1.0, 0.6], [0.6, 1.0]])
AWAY = np.subtract.outer(np.arange(30.0), np.arange(30.0)) / 6.0


@pytest.mark.parametrize(
    "correlation",
    [np.eye(12), np.kron(np.ones((3, 3)), np.eye(4)), np.kron(PAIR, np.eye(6)), np.exp(-0.5 * AWAY**2)],
    ids=["independent", "the same thrice", "equal pairs", "smooth"],
)
def test_draws_have_their_covariance_and_follow_it_where_eigenvalues_are_equal_or_zero(correlation) -> None:
    """Numbers of different units, one of which is known; a covariance that rounding changes draws the same, where
    eigenvectors turn by radians.
    """
    rng = np.random.default_rng(3)
    sigma = 10.0 ** rng.uniform(-9.0, 0.0, len(correlation))
    known = np.arange(len(sigma)) == 5
    covariance = np.where(known | known[:, None], 0.0, sigma[:, None] * correlation * sigma)
    root = covariance_root(covariance)
    assert_allclose(root @ root.T / sigma / sigma[:, None], covariance / sigma / sigma[:, None], atol=1e-14)
    wrong = 1e-15 * rng.uniform(-1.0, 1.0, correlation.shape)
    other = covariance_root(
        covariance + (wrong + wrong.T) * np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    )
    # a root of what rounding leaves of zero is its root at most
    assert np.max(np.abs((other - root) @ rng.standard_normal(len(sigma)) / sigma)) < 1e-6
