"""Bar-contrast MTF on bars whose image is known exactly: a square wave's Fourier series through the analytic MTF.

Statistical limits are two-sided chi-square quantiles with a false-alarm rate of 1e-6 per comparison.
"""

import math

import numpy as np
import pytest
from scipy import stats

from analysis.mtf.bar_mtf import BarError, _design, _waves, bar_mtf
from analysis.spots.noise import NoiseModel
from tests.analysis.refusals import refuses
from tests.analysis.test_slanted_edge import BRIGHT, DARK, FALSE_ALARM, MULTISPECTRAL, PAN, noisy, transfer
from tests.tiers import quick

CALM = {
    "dark": DARK + np.tile([-0.01, 0.01], 50),
    "bright": BRIGHT + np.tile([-0.01, 0.01], 50),
    "saturation": math.inf,
}


def bar_image(f, degrees, size=64, pitch=PAN, phase=0.3):
    """Near-vertical bars. 99 terms reach past every cut-off."""
    angle = math.radians(degrees)
    r = np.arange(size) - (size - 1) / 2
    d = r * math.cos(angle) - r[:, None] * math.sin(angle)
    wave = np.full(d.shape, 0.5)
    for h in range(1, 100, 2):
        sign = (-1) ** (h // 2)
        wave += sign * 2 / math.pi / h * transfer(h * f, angle, pitch) * np.cos(h * (2 * math.pi * f * d + phase))
    return DARK + (BRIGHT - DARK) * wave


def vector(f, degrees):
    return np.array([-f * math.sin(math.radians(degrees)), f * math.cos(math.radians(degrees))])


@pytest.mark.second
@pytest.mark.parametrize("how", ["vector", "length", "found"])
@pytest.mark.parametrize("degrees", quick(2, [2, 10, 3, 5]))
@pytest.mark.parametrize("f", [0.1, 0.2, 0.25, 0.3, 0.45, 0.5])
def test_mtf_is_exact(f, degrees, how):
    stated = {"vector": vector(f, degrees) + 0.003, "length": f, "found": None}[how]
    bars = bar_mtf(bar_image(f, degrees), frequency=stated, **CALM)
    # what is left are the ninth and higher harmonics, which pass below 0.13 cycles/pixel only
    assert bars.mtf == pytest.approx(transfer(f, math.radians(degrees)), abs=3e-4 if f == 0.1 else 1e-5)
    if f < 0.5 or how != "found":
        # at Nyquist the direction of the tilt cannot be seen: the other alias is longer
        assert bars.cycles_per_pixel == pytest.approx(f, abs=1e-4)
    if f < 0.5:
        # of f and -f, which are the same wave, the one that points along the row
        assert bars.frequency == pytest.approx(vector(f, degrees), abs=1e-4)


@pytest.mark.parametrize("f", [0.2, 0.3, 0.5])
def test_aliased_images(f):
    """28 um: the third to ninth harmonics of the bars pass and alias. The eleventh and more are left: 1e-3."""
    for degrees in (3, 5, 10):
        bars = bar_mtf(bar_image(f, degrees, pitch=MULTISPECTRAL), frequency=f, **CALM)
        assert bars.mtf == pytest.approx(transfer(f, math.radians(degrees), MULTISPECTRAL), abs=1e-3)
        assert list(bars.harmonics) == [3, 5, 7]
        for h, amplitude in bars.harmonics.items():
            passed = abs(transfer(h * f, math.radians(degrees), MULTISPECTRAL))
            assert amplitude == pytest.approx(passed * (BRIGHT - DARK) * 2 / math.pi / h, abs=0.01), h
    # the first term of Coltman's series forgets the third harmonic
    assert abs(bars.coltman - bars.mtf) > 0.02


@pytest.mark.parametrize("stated", [None, 0.3, -0.3])
def test_bars_parallel_to_the_pixels(stated):
    """Where nothing is along the row, the frequency points down the column. Its length has no sign."""
    image = bar_image(0.3, 0)
    for across, expected in ((image, (0.0, 0.3)), (image.T, (0.3, 0.0))):
        bars = bar_mtf(across, frequency=stated, **CALM)
        assert bars.frequency == pytest.approx(expected, abs=1e-5)
        assert bars.mtf == pytest.approx(transfer(0.3, 0.0), abs=1e-5)


def test_bars_above_nyquist_are_measured_when_the_frequency_is_stated():
    """0.7 cycles/pixel looks like 0.3; what it is has to be said."""
    for stated in (0.7, -0.7, vector(0.7, 4), -vector(0.7, 4)):
        bars = bar_mtf(bar_image(0.7, 4), frequency=stated, **CALM)
        assert bars.cycles_per_pixel == pytest.approx(0.7, abs=1e-4)
        assert bars.mtf == pytest.approx(transfer(0.7, math.radians(4)), abs=1e-5)


@pytest.mark.parametrize("f", [0.498, 0.499, 0.501, 0.502])
@pytest.mark.parametrize("degrees", [2, 10])
def test_the_stated_length_tells_the_aliases_near_nyquist_apart(f, degrees):
    """f and (0, 1) - f give the same pixels; the one is as long as stated, the other by some thousandths off."""
    bars = bar_mtf(bar_image(f, degrees), frequency=f, **CALM)
    assert bars.frequency == pytest.approx(vector(f, degrees), abs=1e-5)


def test_contrast_and_coltman():
    """At Nyquist the third harmonic lies beyond the cut-off, so Coltman's first term is exact; all phases occur."""
    image = bar_image(0.5, 5)
    bars = bar_mtf(image, frequency=0.5, **CALM)
    assert bars.contrast == pytest.approx((image.max() - image.min()) / (image.max() + image.min()))
    # of 4096 phases one lies within 1e-3 cycles of the crest
    assert bars.coltman == pytest.approx(transfer(0.5, math.radians(5)), abs=2e-4)
    with_offset = bar_mtf(image + 200, CALM["dark"] + 200, CALM["bright"] + 200, 0.5, offset=200.0)
    assert with_offset.contrast == pytest.approx(bars.contrast)
    assert with_offset.coltman == pytest.approx(bars.coltman)


def test_no_contrast_where_its_levels_cancel():
    """An offset halfway between the extremes leaves a sum of 0 to divide by; the MTF does not need it."""
    image = np.round(bar_image(0.3, 5))
    bars = bar_mtf(image, frequency=0.3, offset=(image.max() + image.min()) / 2, **CALM)
    assert math.isnan(bars.contrast)
    assert bars.mtf == pytest.approx(transfer(0.3, math.radians(5)), abs=1e-3)


@pytest.mark.parametrize(
    ("f", "seen"),
    [
        (1 / 4, []),  # 3 f = 1 - f, 5 f = 1 + f, 7 f = 2 - f
        (1 / 6, []),  # 3 f = 1/2, where a sine vanishes; 5 f = 1 - f, 7 f = 1 + f
        (1 / 5, [3]),  # 5 f = 1, 7 f = 2 - 3 f
        (3 / 10, [3]),  # 5 f = 3/2, 7 f = 3 - 3 f
        (1 / 7, [3, 5]),  # 7 f = 1
        (1 / 9, [3, 5, 7]),  # seen at 3, 4 and 2 of 9 cycles
        (1 / 12, [3, 5]),  # 7 f = 1 - 5 f
    ],
)
def test_harmonics_whose_aliases_fall_together_are_left_out(f, seen):
    """Of bars parallel to the pixels, whose phases repeat."""
    assert list(bar_mtf(bar_image(f, 0, size=72), frequency=f, **CALM).harmonics) == seen


def test_the_design_holds_derivatives_by_the_frequency():
    """A complex step has no truncation."""
    rng = np.random.default_rng(7)
    place, parameters, frequency = rng.uniform(-9, 9, (2, 30)), rng.standard_normal(9), np.array([0.07, 0.31])
    rows = _design(place, frequency, (3, 5, 7), parameters)
    for k in range(2):
        stepped = parameters @ _waves(place, frequency + 1e-40j * np.eye(2)[k], (3, 5, 7))
        assert rows[k - 2] == pytest.approx(stepped.imag / 1e-40, rel=1e-9, abs=1e-9)
    assert rows[:-2] == pytest.approx(_waves(place, frequency, (3, 5, 7)))


MODEL = NoiseModel(0.5, 6.0, 0.0, 64.0, 0.0, 0.0, 60000.0)


def repeats(contrast, use_model, count=200, f=0.5):
    rng = np.random.default_rng([23, int(contrast)])
    scale = contrast / (BRIGHT - DARK)
    mean = 80 + scale * (bar_image(f, 4, 32) - DARK)

    def draw(level):
        return np.round(rng.normal(level, np.sqrt(MODEL.temporal_variance_dn2(level, 1) - 1 / 12)))

    low, high = np.full((8, 8), 80.0), np.full((8, 8), 80.0 + contrast)
    noise = MODEL if use_model else None
    return [bar_mtf(draw(mean), draw(low), draw(high), vector(f, 4), noise=noise) for _ in range(count)]


@pytest.mark.second
@pytest.mark.parametrize("use_model", quick(1, [True, False]))
@pytest.mark.parametrize("f", quick(1, [0.2, 0.5]))
def test_sigma_agrees_with_the_scatter(f, use_model):
    bars = repeats(400.0, use_model, f=f)
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], len(bars) - 1)
    mtf, sigma = (np.array([getattr(b, name) for b in bars]) for name in ("mtf", "sigma"))
    assert low < np.sum((mtf - mtf.mean()) ** 2) / np.mean(sigma**2) < high
    assert abs(mtf.mean() - transfer(f, math.radians(4))) < 5 * sigma.mean() / math.sqrt(len(bars)) + 1e-4
    for k in range(2):
        found = np.array([b.frequency[k] for b in bars])
        assert low < np.sum((found - found.mean()) ** 2) / np.mean([b.frequency_sigma[k] ** 2 for b in bars]) < high


@pytest.mark.second
def test_noise_bias_follows_from_the_scatter_of_the_phase():
    """A vector of length A that swings by a phase of rms p is longer by A p^2 / 2 on the average."""
    bars = repeats(60.0, True)
    swing = np.var([b.phase for b in bars], ddof=1)
    # 200 repeats give a variance to 10%; five of that
    assert np.mean([b.noise_bias for b in bars]) == pytest.approx(transfer(0.5, math.radians(4)) * swing / 2, rel=0.5)
    assert swing > 1e-4


GOOD = bar_image(0.3, 4)


def half_filled():
    image = noisy(GOOD)
    image[:, 32:] = noisy(np.full((64, 32), 650.0))
    return image


@pytest.mark.parametrize(
    ("image", "frequency", "message"),
    [
        (noisy(np.full((64, 64), 500.0)), None, "no bars in the region.*average frames"),
        (np.full((64, 64), 500), None, "all pixels have the same value"),
        (GOOD[:8, :], None, "8 x 64 px is too small: take at least 12 x 12"),
        (np.minimum(noisy(GOOD, 8), 850), None, "share the highest value 850.*lower the exposure"),
        (np.where(np.eye(64) > 0, np.nan, GOOD), None, "64 pixels of the region are not finite"),
        (np.zeros((3, 64, 64)), None, "must be a plane"),
        (noisy(bar_image(0.5, 0)), 0.5, "Nyquist frequency and parallel to the pixels.*tilt"),
        (noisy(bar_image(0.01, 4)), (0.0, 0.01), "less than two periods"),
        (half_filled(), 0.3, "do not fill the region.*(left|right) quarter"),
        (noisy(GOOD), 0.0, "one number or two"),
        (noisy(GOOD), (0.1, 0.2, 0.3), "one number or two"),
        (noisy(GOOD), (0.2, 0.0), "no bars in the region"),
    ],
)
def test_bad_regions_are_explained(image, frequency, message):
    refuses(BarError, message, bar_mtf, image, noisy(np.full(100, DARK)), noisy(np.full(100, BRIGHT)), frequency)


@pytest.mark.parametrize("row", ["upper", "lower"])
@pytest.mark.parametrize("column", ["left", "right"])
def test_a_quarter_without_bars_is_named(row, column):
    """A patch of even grey in one corner takes a quarter of that quarter's bars, and none of the others'."""
    image = noisy(GOOD)
    rows, columns = (slice(0, 16) if side in ("upper", "left") else slice(48, 64) for side in (row, column))
    image[rows, columns] = 650.0
    with pytest.raises(BarError, match=f"amplitude in its {row} {column} quarter"):
        bar_mtf(image, noisy(np.full(100, DARK)), noisy(np.full(100, BRIGHT)), 0.3)


@pytest.mark.parametrize(("uneven", "refused"), [(0.14, False), (0.16, True)])
def test_quarters_may_differ_by_15_per_cent(uneven, refused):
    """Two opposite quarters stronger, two weaker by as much: the amplitude of the whole stays as it is."""
    side = np.sign(np.arange(64) - 31.5)
    image = 650.0 + (GOOD - 650.0) * (1.0 + uneven * side * side[:, None])
    calm = NoiseModel(1e-4, 0.0, 0.0, 0.0, 0.0, 0.0, 60000.0)
    if refused:
        refuses(BarError, r"quarter is off by 16%", bar_mtf, image, CALM["dark"], CALM["bright"], 0.3, noise=calm)
    else:
        found = bar_mtf(image, CALM["dark"], CALM["bright"], 0.3, noise=calm)
        assert found.mtf == pytest.approx(transfer(0.3, math.radians(4)), rel=0.01)


@pytest.mark.parametrize("frames", [1, 16])
def test_levels_have_the_noise_of_their_pixels(frames):
    """Photon transfer by hand: gain 0.5 DN/e, 20 e dark signal and a black level of 64 DN, 2% PRNU, 10 e DSNU."""
    model = NoiseModel(0.5, 6.0, 20.0, 64.0, 0.02, 10.0, 60000.0)
    bars = bar_mtf(GOOD, np.full(400, DARK), np.full(100, BRIGHT), 0.3, noise=model, frames=frames)
    for level, sigma, count in ((DARK, bars.dark_sigma, 400), (BRIGHT, bars.bright_sigma, 100)):
        electrons = (level - 64.0) / 0.5
        temporal = 0.25 * (electrons + 36.0) + 1 / 12
        fixed = 0.25 * ((0.02 * (electrons - 20.0)) ** 2 + 100.0)
        assert sigma == pytest.approx(math.sqrt((temporal / frames + fixed) / count), rel=1e-9)
    # the contrast of the levels is in the sigma of the MTF, beside the noise of the bars
    assert bars.sigma > bars.mtf * math.hypot(bars.dark_sigma, bars.bright_sigma) / (BRIGHT - DARK)


def test_bad_patches_are_explained():
    for count, dark, bright, message in (
        (100, DARK, DARK, "no contrast"),
        (100, BRIGHT, DARK, "the brighter one as bright"),
        (9, DARK, BRIGHT, "dark patch needs at least 16"),
        (100, DARK, 5000.0, "bright patch reaches the saturation level of 4095"),
    ):
        patches = np.full(count, dark), np.full(100, bright)
        refuses(BarError, message, bar_mtf, noisy(GOOD), *patches, 0.3, saturation=4095.0)
