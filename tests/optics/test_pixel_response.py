import numpy as np
import pytest

from optics.waves.diffraction import PixelResponse, UnsampledImageError, airy

PITCH, WAVELENGTH, F_NUMBER = 12e-6, 650e-9, 110.4


def oversampled(n: int, disk: float, shift: tuple[float, float], fine: int) -> np.ndarray:
    """Airy spot, convolved with a disk and averaged over pixels, by brute force on a fine midpoint grid."""
    step = PITCH / fine
    axis = (np.arange(n * fine) - 0.5 * (n * fine - 1)) * step
    x, y = np.meshgrid(axis - shift[0] * PITCH, axis - shift[1] * PITCH)
    spot = airy(np.hypot(x, y), WAVELENGTH, F_NUMBER)
    if disk:
        fx, fy = np.meshgrid(np.fft.rfftfreq(n * fine, step), np.fft.fftfreq(n * fine, step))
        f = np.hypot(fx, fy) * np.pi * disk
        from scipy.special import j1

        transfer = np.where(f == 0.0, 1.0, 2.0 * j1(f) / np.where(f == 0.0, 1.0, f))
        spot = np.fft.irfft2(np.fft.rfft2(spot) * transfer, s=spot.shape)
    return spot.reshape(n, fine, n, fine).mean(axis=(1, 3))


@pytest.mark.second
@pytest.mark.parametrize("disk", [0.0, 20e-6])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -0.21)])
def test_against_brute_force(disk: float, shift: tuple[float, float]) -> None:
    n = 41
    response = PixelResponse.fit(PITCH, disk, cutoff=1.0 / (WAVELENGTH * F_NUMBER))
    border = n + 2 * response.half_width
    axis = (np.arange(border) - 0.5 * (border - 1)) * PITCH
    x, y = np.meshgrid(axis - shift[0] * PITCH, axis - shift[1] * PITCH)
    got = response.apply(airy(np.hypot(x, y), WAVELENGTH, F_NUMBER)[None])[0]
    assert got.shape == (n, n)
    want = oversampled(n, disk, shift, fine=24)
    # the midpoint rule with 24 samples per pixel is good to 2e-5; the middle is free of the brute force's wrapped edge
    middle = slice(8, -8)
    np.testing.assert_allclose(got[middle, middle], want[middle, middle], atol=4e-5)


def test_flat_light_stays_flat() -> None:
    response = PixelResponse.fit(PITCH, 20e-6, cutoff=1.0 / (WAVELENGTH * F_NUMBER))
    assert np.sum(response.kernel) == pytest.approx(1.0, abs=1e-6)


def test_coarse_pixels_are_refused() -> None:
    with pytest.raises(UnsampledImageError, match=r"0\.50 cycles per pixel"):
        PixelResponse.fit(PITCH, 0.0, cutoff=0.5 / PITCH)


@pytest.mark.second
def test_a_source_far_wider_than_its_pixels_is_refused() -> None:
    with pytest.raises(UnsampledImageError) as caught:
        PixelResponse.fit(PITCH, 35 * PITCH, cutoff=0.2 / PITCH)
    assert caught.value.of_source
    assert caught.value.remedy.startswith("a smaller source")
