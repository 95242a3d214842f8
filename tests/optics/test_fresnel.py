"""Fresnel's formulas against their other forms and their limits."""

import numpy as np
import pytest

from optics.materials.finish import cosine_after, reflectance

INDICES = [(1.0, 1.5), (1.5, 1.0), (1.0, 4.0), (1.33, 1.52)]


@pytest.mark.parametrize(("before", "after"), INDICES)
def test_against_the_sine_and_tangent_form(before: float, after: float) -> None:
    critical = np.arcsin(min(1.0, after / before))
    a = np.linspace(0.01, 0.999 * min(critical, 0.5 * np.pi), 200)
    b = np.arcsin(before / after * np.sin(a))
    s, p = np.sin(a - b) / np.sin(a + b), np.tan(a - b) / np.tan(a + b)
    np.testing.assert_allclose(reflectance(np.cos(a), before, after), 0.5 * (s**2 + p**2), rtol=1e-9)
    np.testing.assert_allclose(cosine_after(np.cos(a), before, after), np.cos(b), rtol=1e-12)


@pytest.mark.parametrize(("before", "after"), INDICES)
def test_normal_and_grazing_incidence(before: float, after: float) -> None:
    assert reflectance(1.0, before, after) == pytest.approx(((before - after) / (before + after)) ** 2, rel=1e-14)
    assert reflectance(0.0, before, after) == pytest.approx(1.0, abs=1e-10)


def test_brewster_leaves_only_one_polarisation() -> None:
    n = 1.5
    angle = np.arctan(n)
    s = np.sin(angle - (0.5 * np.pi - angle))
    assert reflectance(np.cos(angle), 1.0, n) == pytest.approx(0.5 * s**2, rel=1e-12)


def test_beyond_the_critical_angle_all_is_reflected() -> None:
    cosine = np.cos(np.arcsin(1.0 / 1.5) + np.linspace(1e-9, 0.5, 50))
    assert np.all(reflectance(cosine, 1.5, 1.0) == 1.0)
    assert np.all(cosine_after(cosine, 1.5, 1.0) == 0.0)
    assert reflectance(np.cos(np.arcsin(1.0 / 1.5) - 1e-6), 1.5, 1.0) < 1.0


def test_the_same_on_drjit(backend) -> None:
    cosine = np.linspace(0.0, 1.0, 101)
    for before, after in INDICES:
        got = reflectance(backend.opaque(cosine), before, after).numpy()
        np.testing.assert_allclose(got, reflectance(cosine, before, after), rtol=0, atol=1e-15)
