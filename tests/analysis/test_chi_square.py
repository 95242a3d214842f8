"""The chi-square distribution is SciPy's, to the bit."""

import numpy as np
from scipy.stats import chi2

from analysis.statistics import density, limit_of, p_value_of


def test_as_scipy_has_it() -> None:
    rng = np.random.default_rng(1)
    value, chance = rng.exponential(20.0, 5000), 10.0 ** rng.uniform(-15.0, 0.0, 5000)
    degrees = rng.integers(1, 200, 5000)
    assert np.array_equal(p_value_of(value, degrees), chi2.sf(value, degrees))
    assert np.array_equal(limit_of(chance, degrees), chi2.isf(chance, degrees))
    assert np.array_equal(density(value, degrees), chi2.pdf(value, degrees))
    assert p_value_of(0.0, 3) == 1.0
    assert limit_of(1.0, 3) == 0.0
