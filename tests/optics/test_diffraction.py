"""The matrix Fourier transform against what is known in closed form about a perfect pupil."""

import numpy as np
import pytest

from optics.numerics import quadrature
from optics.numerics.quadrature import PupilNodes
from optics.waves import diffraction
from optics.waves.diffraction import MAX_POINTS, FieldSamples, Grid, PupilField, airy, image
from tests.tiers import quick

WAVELENGTH, F_NUMBER = 650e-9, 9.2
APERTURE = 0.5 / F_NUMBER
NODES = quadrature.disk(24, 80)
SMALL = Grid(-10e-6, 1e-6, 21)


def shifted(grid: Grid, by: float) -> Grid:
    return Grid(grid.start + by, grid.step, grid.count)


def centred(count: int, step: float) -> Grid:
    return Grid(-0.5 * (count - 1) * step, step, count)


def perfect(u0: float = 0.0, v0: float = 0.0, apodisation: int = 0, nodes: PupilNodes = NODES) -> PupilField:
    """Flat wavefront over a disk of direction cosines about (u0, v0), unit power."""
    u, v = APERTURE * nodes.x, APERTURE * nodes.y
    shape = (1.0 - nodes.x**2 - nodes.y**2) ** apodisation
    power = np.sum(shape**2 * nodes.weight) * APERTURE**2
    amplitude = shape * nodes.weight * APERTURE**2 / np.sqrt(power)
    return PupilField(u[None] + u0, v[None] + v0, np.zeros((1, nodes.count)), amplitude[None], WAVELENGTH)


def test_airy_disk() -> None:
    axis = centred(161, 0.5e-6)  # 5.5 dark rings
    got = image(perfect(), axis, axis)[0]
    want = airy(np.hypot(*np.meshgrid(axis.points(), axis.points())), WAVELENGTH, F_NUMBER)
    peak = np.pi * APERTURE**2 / WAVELENGTH**2
    np.testing.assert_allclose(got / peak, want, rtol=0, atol=1e-10)
    first_dark = 1.2196698912665045 * WAVELENGTH * F_NUMBER
    assert image(perfect(), Grid(first_dark, 0.0, 1), Grid(0.0, 0.0, 1))[0, 0, 0] / peak < 1e-20


def test_images_of_a_batch() -> None:
    fields = [perfect(0.001 * i, 0.0, apodisation=i) for i in range(6)]
    together = PupilField(
        *(np.concatenate([getattr(f, n) for f in fields]) for n in ("u", "v", "eikonal", "amplitude")), WAVELENGTH
    )
    batch = image(together, SMALL, shifted(SMALL, 1e-6))
    assert batch.shape == (6, 21, 21)
    for i, field in enumerate(fields):
        np.testing.assert_allclose(batch[i], image(field, SMALL, shifted(SMALL, 1e-6))[0], rtol=1e-12)
    np.testing.assert_allclose(image(together[2:4], SMALL, SMALL), image(together, SMALL, SMALL)[2:4], rtol=1e-12)


@pytest.mark.parametrize("single", [False, True])
def test_wave_tables_in_pieces_give_the_same_bits(single: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded by making the waves of some nodes after the other; the sums are the same."""
    axis = centred(95, 3e-6)
    whole = image(perfect(0.001), axis, axis, single)
    monkeypatch.setattr(diffraction, "_TABLES", 1)  # the fewest nodes at once
    np.testing.assert_array_equal(image(perfect(0.001), axis, axis, single), whole)


@pytest.mark.parametrize(("single", "error"), quick(1, [(False, 1e-12), (True, 2e-7)]))
def test_few_samples_of_the_field_make_the_image(single: bool, error: float) -> None:
    """Against the plain sum over all waves, of an aberrated and slanted beam, on a CCD longer than samples are made for
    at once and off the beam's middle. The pixels sample the field 12 and 8 times as densely as its band asks for."""
    eikonal = 1.5 * WAVELENGTH * (NODES.x**2 + NODES.x * NODES.y**2 - 0.5 * NODES.y)
    field = perfect(0.02, -0.01, apodisation=1)
    field = PupilField(field.u, field.v, eikonal[None], field.amplitude, WAVELENGTH)
    x, y = shifted(centred(MAX_POINTS + 9, 0.5e-6), 7e-6), shifted(centred(96, 0.7e-6), -11e-6)
    for grid in (x, y):
        samples = FieldSamples.of(96, 2.0 * np.pi * APERTURE * grid.step / WAVELENGTH, single)
        assert samples is not None
        assert samples.count < 60
    got = image(field, x, y, single)[0]
    columns, rows = np.arange(0, x.count, 13), np.arange(0, y.count, 7)
    k = 2.0 * np.pi / WAVELENGTH
    along = np.exp(1j * k * field.u[0] * x.points()[columns, None])
    down = field.amplitude[0] * np.exp(1j * k * (eikonal + field.v[0] * y.points()[rows, None]))
    want = np.abs(np.einsum("rn,cn->rc", down, along)) ** 2 / WAVELENGTH**2
    np.testing.assert_allclose(got[np.ix_(rows, columns)], want, rtol=0, atol=error * got.max())


def test_tilt_of_the_wavefront_moves_the_image() -> None:
    """An eikonal that grows by u X0 is a wave that has to travel on: the image moves to -X0."""
    field = perfect()
    x0, y0 = 3.3e-6, -1.7e-6
    tilted = PupilField(field.u, field.v, field.u * x0 + field.v * y0, field.amplitude, WAVELENGTH)
    np.testing.assert_allclose(
        image(tilted, shifted(SMALL, -x0), shifted(SMALL, -y0)), image(field, SMALL, SMALL), rtol=1e-9
    )
