"""Vertices of physical through-focus curves: defocused OTFs integrated over an F/9.2 pupil at the Nyquist frequencies
of the 7 um and 28 um pixels, never the formula that is fitted.
"""

import numpy as np
import pytest
from scipy import stats

from analysis.focal_plane import through_focus as module
from analysis.focal_plane.through_focus import FocusError, focus_vertex, focus_vertices
from tests.analysis.refusals import refuses

FALSE_ALARM = 1e-6
WAVELENGTH, F_NUMBER = 650e-9, 9.2
PAN, MS = 1 / 14e-6, 1 / 56e-6
UM = 1e-6


def through_focus(defocus, frequency, spherical=0.0, coma=0.0):
    """|OTF| of a round pupil, by integration over the overlap of the two sheared pupils (Hopkins 1955).

    defocus: (...) m. frequency: cycles/m. spherical, coma: W040 and W131 (along the shear), waves.
    """
    shear = 2 * frequency * WAVELENGTH * F_NUMBER
    t, weight = np.polynomial.legendre.leggauss(48)
    angle = 0.5 * np.pi * t
    x = ((1 - shear / 2) * np.sin(angle))[:, None]
    dx = ((1 - shear / 2) * np.cos(angle) * 0.5 * np.pi * weight)[:, None]
    height = np.sqrt(1 - (np.abs(x) + shear / 2) ** 2)
    y, area = height * t, dx * height * weight
    focus = np.asarray(defocus)[..., None, None] / (8 * F_NUMBER**2 * WAVELENGTH)

    def wave(u):
        square = u**2 + y**2
        return focus * square + spherical * square**2 + coma * square * u

    phase = 2j * np.pi * (wave(x + shear / 2) - wave(x - shear / 2))
    return np.abs(np.sum(area * np.exp(phase), axis=(-2, -1))) / np.pi


def curve(position, focus, frequency, peak, **aberration):
    """MTF at positions (Z,) for best foci (N,), scaled to a camera's peak: (N, Z)."""
    return (
        peak
        * through_focus(position - np.asarray(focus)[..., None], frequency, **aberration)
        / through_focus(0.0, frequency)
    )


def steps(step, low, high):
    return np.arange(round(low / step), round(high / step) + 1) * step


@pytest.mark.second
@pytest.mark.parametrize(
    ("frequency", "step", "low", "high", "middle", "lobe_um", "parabola_um"),
    [
        (PAN, 50 * UM, -0.6e-3, 0.6e-3, 0.0, 0.1, 1.5),
        (PAN, 75 * UM, -0.6e-3, 0.6e-3, 0.0, 0.5, 3.0),
        (MS, 50 * UM, -1.0e-3, 1.0e-3, 0.0, 0.1, 2.0),
        (MS, 100 * UM, -0.6e-3, 0.6e-3, 0.0, 0.2, 4.0),
        # a scan narrower than the curve, its focus near one end: the worst case for a parabola
        (MS, 50 * UM, -0.3e-3, 0.3e-3, 0.2e-3, 0.5, 20.0),
    ],
)
def test_bias_over_sampling_phases(monkeypatch, frequency, step, low, high, middle, lobe_um, parabola_um):
    """Without noise: vertex minus true focus for 21 phases of the steps. The limits are rounded up from the numerical
    study; 0.5 um is a hundredth of the confocal tolerance of 40 um. The parabola is shown to be worse.
    """
    z = steps(step, low, high)
    focus = middle + np.linspace(-0.5, 0.5, 21) * step
    value = curve(z, focus, frequency, 0.3)
    error = np.abs(focus_vertices(z, value, 0.006).position - focus) / UM
    with monkeypatch.context() as patch:
        patch.setattr(module, "QUARTIC", 1e-9)
        plain = np.abs(focus_vertices(z, value, 0.006).position - focus) / UM
    assert error.max() < lobe_um
    assert lobe_um < plain.max() < parabola_um


@pytest.mark.second
@pytest.mark.parametrize(
    ("frequency", "step", "half", "noise"),
    [(PAN, 50 * UM, 0.6e-3, 0.02), (PAN, 50 * UM, 0.6e-3, 0.05), (MS, 50 * UM, 1e-3, 0.02), (MS, 100 * UM, 6e-4, 0.02)],
)
def test_sigma_agrees_with_scatter(frequency, step, half, noise):
    """Chi-square of 500 noisy repeats, each with its own sigma, two-sided at 1e-6; peak and residuals as well."""
    z = steps(step, -half, half)
    focus, peak = 0.23 * step, 0.2
    exact = curve(z, [focus], frequency, peak)
    # sigma differs from point to point, as between field images of different light
    sigma = noise * peak * np.linspace(0.7, 1.4, z.size)
    noisy = exact + sigma * np.random.default_rng(11).standard_normal((500, z.size))
    found = focus_vertices(z, noisy, sigma)
    assert not np.any(found.fault)
    for statistic, freedom in (
        (np.sum(((found.position - focus) / found.sigma) ** 2), 500),
        (np.sum(((found.peak - peak) / found.peak_sigma) ** 2), 500),
    ):
        assert FALSE_ALARM / 2 < stats.chi2.sf(statistic, freedom) < 1 - FALSE_ALARM / 2
    # what the form misses (up to 0.5% of the peak) adds little to the residuals at these noise levels
    total, freedom = found.chi_square.sum(), found.degrees_of_freedom.sum()
    assert stats.chi2.sf(total, freedom) > FALSE_ALARM / 2


def test_unmeasured_points_are_left_out():
    z = steps(50 * UM, -0.6e-3, 0.6e-3)
    value = curve(z, [30 * UM], PAN, 0.2)[0]
    sigma = np.full(z.size, 0.004)
    spoiled = value.copy()
    spoiled[11], sigma[11] = 0.9, np.inf
    found = focus_vertex(z, spoiled, sigma)
    assert found.position == pytest.approx(30 * UM, abs=0.5 * UM)
    assert not found.used[11]


@pytest.mark.parametrize(
    ("focus", "frequency", "reason", "remedy"),
    [
        (0.7e-3, PAN, "peak above", "move the scan up"),
        (-0.7e-3, PAN, "peak below", "move the scan down"),
        (0.9e-3, MS, "peak above", "upper end of the scan, 0.0006"),
        (-0.62e-3, MS, "peak below", "move the scan down"),
    ],
)
def test_peak_outside_the_scan(focus, frequency, reason, remedy):
    """All of 100 noisy curves; an outside focus must never be told as an inside one."""
    z = steps(50 * UM, -0.6e-3, 0.6e-3)
    value = curve(z, [focus], frequency, 0.2) + np.random.default_rng(1).normal(0, 0.004, (100, z.size))
    told = focus_vertices(z, value, 0.004, strict=False)
    # two sigma at the very end of the scan: 2.3% of the curves 20 um outside may slip through, well outside none
    assert np.mean(told.fault == reason) >= (0.9 if abs(focus) < 0.65e-3 else 1.0)
    with pytest.raises(FocusError, match=remedy) as caught:
        focus_vertex(z, value[0], 0.004)
    assert caught.value.reason == reason
    assert caught.value.faults == {(): reason}


@pytest.mark.second
def test_flat_curves():
    """1000 curves of noise alone: less than 1% of them get any other name than flat, and none a vertex; each of them
    gets the same name alone.
    """
    value = 0.2 + np.random.default_rng(2).normal(0, 0.01, (1000, 25))
    told = focus_vertices(np.linspace(-1e-3, 1e-3, 25), value, 0.01, strict=False)
    assert not np.any(told.fault == "")
    assert np.mean(told.fault != "flat") < 0.01
    assert np.all(np.isnan(told.position))
    assert not told.used.any()
    alone = [focus_vertices(np.linspace(-1e-3, 1e-3, 25), one, 0.01, strict=False).fault for one in value[:40]]
    assert alone == told.fault[:40].tolist()
    with pytest.raises(FocusError, match="no curvature above the noise; scan a wider range"):
        focus_vertices(np.linspace(-1e-3, 1e-3, 25), value, 0.01)


def test_other_faults():
    z = steps(50 * UM, -0.6e-3, 0.6e-3)
    value = curve(z, [0.0], PAN, 0.2)[0]
    sparse = slice(None, None, 3)  # 150 um steps: three points in the upper half
    with pytest.raises(FocusError, match=r"fewer than 5 positions near the peak.*steps of at most") as caught:
        focus_vertex(z[sparse], value[sparse], 0.004)
    assert caught.value.reason == "few points"
    # the promised step is enough at any phase
    step = float(str(caught.value).rsplit("at most ", 1)[1])
    fine = steps(step, -0.6e-3, 0.6e-3)
    assert not np.any(focus_vertices(fine, curve(fine, np.linspace(0, step, 9), PAN, 0.2), 0.004, strict=False).fault)
    with pytest.raises(FocusError, match="fewer than 5") as caught:
        focus_vertex(np.repeat(z[10:14], 3), np.repeat(value[10:14], 3), 0.004)  # repeats are not positions
    refuses(FocusError, "not finite", focus_vertex, z, np.where(np.arange(z.size) == 4, np.nan, value), 0.004)
    batch = np.stack([value, np.full_like(value, 0.1), value])
    with pytest.raises(FocusError, match="curve 1: no curvature") as caught:
        focus_vertices(z, batch, 0.004)
    assert caught.value.faults == {(1,): "flat"}
    told = focus_vertices(z, batch, 0.004, strict=False)
    assert list(told.fault) == ["", "flat", ""]
    assert np.isfinite(told.position[[0, 2]]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": 0.0}, "sigma must be positive"),
        ({"position": np.zeros(4)}, "same Z points"),
        ({"sigma": np.ones((2, 3))}, "do not match"),
        ({"value": np.ones((2, 9))}, r"must be \(Z,\)"),
    ],
)
def test_bad_arguments(change, message):
    given = {"position": np.linspace(-1, 1, 9), "value": np.ones(9), "sigma": 0.1} | change
    refuses(ValueError, message, focus_vertex, **given)
