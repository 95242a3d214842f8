import math

import numpy as np
import pytest

from optics.numerics import quadrature


def disk_moment(a: int, b: int, inner: float = 0.0) -> float:
    """Integral of x^a y^b over the unit disk less a hole."""
    if a % 2 or b % 2:
        return 0.0
    azimuth = 2.0 * math.gamma((a + 1) / 2) * math.gamma((b + 1) / 2) / math.gamma((a + b) / 2 + 1)
    return azimuth * (1.0 - inner ** (a + b + 2)) / (a + b + 2)


@pytest.mark.second
@pytest.mark.parametrize("inner", [0.0, 0.3])
@pytest.mark.parametrize(("rings", "arms"), [(1, 4), (3, 12), (6, 24), (12, 40)])
def test_disk_is_exact_up_to_its_degree(rings: int, arms: int, inner: float) -> None:
    nodes = quadrature.disk(rings, arms, inner)
    assert nodes.count == rings * arms
    degree = min(4 * rings, arms) - 1
    checked = 0
    for a in range(degree + 1):
        for b in range(degree + 1 - a):
            got = np.sum(nodes.weight * nodes.x**a * nodes.y**b)
            assert got == pytest.approx(disk_moment(a, b, inner), abs=2e-14)
            checked += 1
    assert checked >= 10


def test_shared_nodes_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        quadrature.disk(3).x[0] = 1.0
