"""Ratio of the MTFs of two images of one random scene, whose blur is exact in the Fourier plane of a larger field."""

import numpy as np
import pytest
from scipy.special import j1

import analysis

FREQUENCY, SIDE, MARGIN = 0.1, 320, 64
NOISE = analysis.NoiseModel(dark_noise_e=10.0)


def disk(frequency, width):
    """MTF of a disk with a diameter of so many pixels: a defocused image of geometrical optics."""
    x = np.pi * frequency * width + 1e-12
    return 2.0 * j1(x) / x


def texture(rng, slope=1.0):
    """Fourier transform of a scene of power f^(-2 slope) and a variance of 1, of the mean 0."""
    side = SIDE + MARGIN
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    f[0, 0] = np.inf
    spectrum = np.fft.fft2(rng.standard_normal((side, side))) * f**-slope
    return spectrum / np.std(np.fft.ifft2(spectrum).real)


def exposure(rng, spectrum, width, shift=(0.0, 0.0), contrast=0.2, electrons=1e4, shade=1.0):
    """Image of a scene with square pixels, blur by a disk, shading, shot noise and read noise."""
    f = np.meshgrid(*[np.fft.fftfreq(SIDE + MARGIN)] * 2, indexing="ij")
    transfer = disk(np.hypot(*f), width) * np.sinc(f[0]) * np.sinc(f[1])
    transfer = transfer * np.exp(-2j * np.pi * (f[0] * shift[0] + f[1] * shift[1]))
    light = electrons * shade * (1.0 + contrast * np.fft.ifft2(spectrum * transfer).real[:SIDE, :SIDE])
    return rng.poisson(np.maximum(light, 0.0)) + rng.normal(0.0, NOISE.dark_noise_e, light.shape)


def pair(seed, widths=(4.0, 6.0), shift=(0.0, 0.0), slope=1.0, **how):
    rng = np.random.default_rng(seed)
    spectrum = texture(rng, slope)
    return [exposure(rng, spectrum, w, s, **how) for w, s in zip(widths, ((0.0, 0.0), shift), strict=True)]


def pulls(pairs, widths=(4.0, 6.0), noise=NOISE):
    """Errors of the logarithms of the ratios over their sigmas, (2 N,), and these sigmas."""
    true = np.log(disk(FREQUENCY, widths[1]) / disk(FREQUENCY, widths[0]))
    found = [analysis.mtf_ratio(*images, FREQUENCY, noise=noise) for images in pairs]
    sigma = np.ravel([np.sqrt(np.diag(ratio.log_covariance[0])) for ratio in found])
    return (np.ravel([np.log(ratio.ratio[0]) for ratio in found]) - true) / sigma, sigma


@pytest.mark.parametrize(
    ("case", "noise"),
    [
        ({}, NOISE),
        ({}, None),
        ({"widths": (6.0, 4.0), "slope": 1.5}, NOISE),
        ({"shift": (0.4, -0.5), "shade": np.linspace(0.4, 1.6, SIDE)}, NOISE),
        ({"shift": (-9.3, 5.7)}, NOISE),
        ({"contrast": 0.03}, NOISE),
    ],
    ids=["stated noise", "free noise", "steep spectrum", "vignetting", "moved", "faint"],
)
def test_ratios_are_those_of_the_blurs(case, noise):
    """Twelve scenes with two directions: chi-square of 24 within 1 in 1000, and a mean error below 3 of its sigmas.

    Sigmas of the free noise also contain what noise cannot be told from.
    """
    pull, sigma = pulls([pair(seed, **case) for seed in range(12)], case.get("widths", (4.0, 6.0)), noise)
    assert np.sum(pull**2) < 51.0
    assert noise is None or np.sum(pull**2) > 7.5
    assert abs(np.sum(pull)) < 3.0 * np.sqrt(24)
    assert np.median(sigma) < (0.05 if case.get("contrast") == 0.03 else 0.02)


def test_several_frequencies_and_light():
    """At two frequencies; a longer exposure and a black level change neither; the displacement is that of the scene."""
    first, second = pair(3, shift=(4.3, -2.6))
    plain = analysis.mtf_ratio(first, second, [0.08, FREQUENCY], noise=NOISE)
    scaled = analysis.mtf_ratio(500 + 0.5 * first, 500 + 0.5 * second, [0.08, FREQUENCY],
                                noise=analysis.NoiseModel(0.5, 10.0, offset_dn=500.0))  # fmt: skip
    np.testing.assert_allclose(scaled.ratio, plain.ratio, rtol=1e-4)
    np.testing.assert_allclose(plain.ratio[1], analysis.mtf_ratio(first, second, FREQUENCY, noise=NOISE).ratio[0])
    np.testing.assert_allclose(plain.displacement, [4.3, -2.6], atol=0.2)
    bright = analysis.mtf_ratio(first, 1.7 * second, FREQUENCY)
    np.testing.assert_allclose([bright.light, *bright.ratio[0]], [1.7, *plain.ratio[1]], rtol=0.01)


def test_a_partly_different_scene_has_a_large_sigma_or_is_refused():
    """A tenth of the second scene is another one: the sigma grows with what both images do not share."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        parts = [np.fft.ifft2(texture(rng)).real for _ in range(2)]
        changed = np.where(np.arange(SIDE + MARGIN)[:, None] < 0.1 * SIDE, parts[1], parts[0])
        images = [exposure(rng, np.fft.fft2(part), w) for part, w in ((parts[0], 4.0), (changed, 6.0))]
        pull, sigma = pulls([images])
        assert np.max(np.abs(pull)) < 4.0
        assert np.min(sigma) > 1.5 * np.max(pulls([pair(seed)])[1])


def grating(seed):
    rng = np.random.default_rng(seed)
    bars = np.fft.fft2(np.tile(np.sign(np.sin(2 * np.pi * np.arange(SIDE + MARGIN) / 12.0)), (SIDE + MARGIN, 1)))
    return [exposure(rng, bars, w) for w in (4.0, 6.0)]


@pytest.mark.parametrize(
    ("images", "frequency", "noise", "message"),
    [
        (lambda: [np.ones((300, 300)), np.ones((300, 301))], FREQUENCY, None, "sizes, (300, 300) and (300, 301)"),
        (lambda: pair(0), 0.4, None, "frequencies must be 0.03 to 0.25 cycles/pixel, found [0.4]"),
        (lambda: [image[:80, :80] for image in pair(0)], FREQUENCY, None, "(80, 80) px are too small"),
        (lambda: [image[:200, :200] for image in pair(0)], FREQUENCY, None, "9 patches of 100 px"),
        (lambda: [pair(0)[0], pair(1)[1]], FREQUENCY, NOISE, "do not show one scene displaced by at most 24 px"),
        (lambda: pair(0, shift=(40.0, 0.0)), FREQUENCY, NOISE, "do not show one scene displaced by at most 24 px"),
        (lambda: pair(0, contrast=0.0), FREQUENCY, NOISE, "do not show one scene"),
        (lambda: grating(0), FREQUENCY, NOISE, "which has contrast and does not repeat itself"),
        (lambda: pair(0, contrast=0.03), 0.2, NOISE, "no contrast beyond the noise at 0.2 cycles/pixel"),
        (lambda: pair(0, widths=(4.0, 15.0)), FREQUENCY, NOISE, "reverses the contrast at 0.1 cycles/pixel along"),
        (lambda: pair(0), FREQUENCY, analysis.NoiseModel(saturation_dn=9000.0), "% of the pixels of an image"),
        (lambda: [image - 2e4 for image in pair(0)], FREQUENCY, None, "no light above its black level"),
    ],
)  # fmt: skip
def test_refusals(images, frequency, noise, message):
    """Images that do not give the ratio are refused with the reason."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        analysis.mtf_ratio(*images(), frequency, noise=noise)
    assert message in str(caught.value)


def test_few_saturated_pixels_only_cost_patches():
    """Pixels above the stated saturation exclude their patches; the ratio of the others is right."""
    images = [image.copy() for image in pair(5)]
    for image in images:
        image[30:40, 30:60] = 16000.0
    found = analysis.mtf_ratio(*images, FREQUENCY, noise=analysis.NoiseModel(dark_noise_e=10.0, saturation_dn=16000.0))
    assert 16 <= found.patches < 25
    pull, _ = pulls([pair(5)])
    assert abs(np.log(found.ratio[0, 0]) / np.log(disk(FREQUENCY, 6.0) / disk(FREQUENCY, 4.0)) - 1.0) < 0.2
    assert np.max(np.abs(pull)) < 4.0
