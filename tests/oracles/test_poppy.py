"""Diffraction images and transfer functions of a traced exit pupil against poppy."""

from importlib.util import find_spec

import numpy as np
import pytest

from optics.geometry.tree import Motion, State
from optics.numerics import quadrature
from optics.waves import optical_transfer
from optics.waves.diffraction import Grid, image
from optics.waves.imaging import encircled_energy, ensquared_energy
from tests.oracles.pupil_grid import WAVELENGTH, FarPoint, fitted, pupil_grid
from tests.tiers import quick

# not imported here: each process that runs tests collects this file
pytestmark = [
    pytest.mark.oracle,
    pytest.mark.skipif(find_spec("poppy") is None, reason="poppy not installed (extra `oracles`)"),
]

ARCSEC = np.pi / 180 / 3600
STATES: dict[str, State] = {
    "nominal": {},
    "moved": {
        "M2": Motion(rotate=(20 * ARCSEC, -15 * ARCSEC, 0.0), shift=(20e-6, -30e-6, 15e-6)),
        "M3": Motion(rotate=(-5 * ARCSEC, 8 * ARCSEC, 0.0)),
    },
}
STEP, PIXELS = 1.5e-6, 96
AXIS = Grid(-0.5 * (PIXELS - 1) * STEP, STEP, PIXELS)


@pytest.fixture(scope="module", params=quick(1, ["moved", "nominal"]))
def point(request, backend, gf7) -> FarPoint:
    return FarPoint(backend, gf7, np.radians(1.0), np.radians(0.05), STATES[request.param])


@pytest.mark.second
def test_image_of_the_same_samples(point) -> None:
    """The same sum by other code: rounding, 1e-16 times the root of some ten thousand terms and the phases' size."""
    grid = pupil_grid(fitted(point), 128)
    ours, theirs = image(grid.field(), AXIS, AXIS)[0], grid.poppy_irradiance(AXIS)
    assert ours.shape == (PIXELS, PIXELS)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * theirs.max())


@pytest.mark.second
def test_image_from_the_stops_quadrature(point) -> None:
    """Some thousand traced nodes against poppy's samples on ever finer grids.

    The edge of a cell's share is right to 1/8 of a cell and each cell stands for its middle: errors fall at least
    with the cell's size, and 256 cells of gf7's pupil leave 1e-4 of the peak.
    """
    pupil = fitted(point)
    nodes = quadrature.disk_for(pupil_grid(pupil, 64).largest_phase(AXIS))
    ours, error = image(point.field(nodes), AXIS, AXIS)[0], []
    for size in (64, 256):
        theirs = pupil_grid(pupil, size).poppy_irradiance(AXIS)
        error.append(np.max(np.abs(theirs - ours)) / ours.max())
    assert error[1] < 1e-4, error
    assert error[1] < error[0] / 4.0, error
    assert ours.max() * STEP**2 > 0.01  # there is an image


@pytest.mark.second
def test_transfer_function(point) -> None:
    """MTF and phase by the transform of poppy's image on a large field against the pupil's autocorrelation.

    A field of 1.2 mm holds all of the light but 1e-3; what lies outside bends the function at the lowest frequencies
    only, where its kink is smeared over 1 / field, so frequencies from a tenth of the cut-off are compared.
    """
    pupil = fitted(point)
    grid = pupil_grid(pupil, 256)
    count, step = 512, 2.4e-6
    axis = Grid(-0.5 * (count - 1) * step, step, count)
    light = grid.poppy_irradiance(axis) * step**2
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.8]])
    cutoff = pupil.cutoff(directions, WAVELENGTH)
    f = (np.array([0.1, 0.3, 0.5, 0.7, 0.9])[:, None, None] * directions * cutoff[:, None]).reshape(-1, 2)
    assert np.max(f) < 0.5 / step  # the pixels sample the image finely enough
    waves = [np.exp(-2j * np.pi * np.outer(f[:, i], axis.points())) for i in (0, 1)]
    got = np.einsum("mr,rc,mc->m", waves[1], light, waves[0])
    want = optical_transfer.transfer(pupil, f, WAVELENGTH, np.array([0.0]))[0]
    assert len(want) == 15
    np.testing.assert_allclose(got, want, rtol=0, atol=2e-3)
    assert np.max(np.abs(want)) > 0.8
    assert np.min(np.abs(want)) < 0.1


@pytest.mark.second
def test_energy_in_circles_and_squares() -> None:
    """Of poppy's image of a ring with coma, against its sums over pixels.

    A square of whole pixels is summed by the midpoint rule, whose error falls with the square of the pixel: 3e-5 of the
    light at 1/64, 4e-6 at 1/192 of lambda / D. A circle cuts pixels: where the image is bright poppy's sum staggers by
    1e-3, so that radii near dark rings are compared. Samples 48 times coarser, lambda / D / 4, have the same energy.
    """
    import poppy

    diameter, wavelength, step, half = 0.2, 500e-9, 1.0 / 192.0, 576
    unit = wavelength / diameter / ARCSEC
    system = poppy.OpticalSystem(npix=512, oversample=1)
    ring = [poppy.CircularAperture(radius=0.1), poppy.SecondaryObscuration(secondary_radius=0.03, n_supports=0)]
    system.add_pupil(poppy.CompoundAnalyticOptic(ring))
    system.add_pupil(poppy.ZernikeWFE(radius=0.1, coefficients=[0.0] * 7 + [0.07 * wavelength]))
    system.add_detector(pixelscale=unit * step, fov_pixels=2 * half + 1)
    image = system.calc_psf(wavelength, normalize="first")
    light = image[0].data / step**2
    radii, measured = np.array([1.0, 1.1, 1.2, 2.3, 2.5]), poppy.utils.measure_ee(image)
    ours = encircled_energy(light, step, radii, (0.0, 0.0))
    np.testing.assert_allclose(ours, [measured(radius * unit) for radius in radii], atol=1e-4)
    pixels = np.array([96, 192, 288, 480])
    sums = [float(image[0].data[half - k : half + k + 1, half - k : half + k + 1].sum()) for k in pixels]
    np.testing.assert_allclose(ensquared_energy(light, step, (pixels + 0.5) * step, (0.0, 0.0)), sums, atol=1e-5)
    coarse = ensquared_energy(light[::48, ::48], 48 * step, (pixels + 0.5) * step, (0.0, 0.0))
    np.testing.assert_allclose(coarse, sums, atol=2e-5)
    assert 0.3 < sums[0] < sums[-1] < 0.9
