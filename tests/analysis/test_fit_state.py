"""What fits of spots are thought of: those of calibrated shapes are good, others are found, named and widened, and none
ends in a second-best place. Spots and noise are those of ``test_spot_centroids``.
"""

import numpy as np
import pytest

from analysis.monitor.recovery import AFTER, BEFORE, NOISE, SpotEvidence
from analysis.spots import likelihood
from analysis.spots.centroid import energy_centroid, gaussian_fit
from analysis.spots.likelihood import fit_states, maximum_likelihood_fit, require_convergence, widened
from analysis.spots.spot_image import SpotError
from analysis.spots.spot_template import SpotTemplate
from analysis.statistics import limit_of
from tests.analysis import test_spot_centroids as spots
from tests.analysis.refusals import refuses
from tests.analysis.test_spot_centroids import FRAMES, GAIN, OFFSET, SHAPE, airy, electrons, pattern, record

PLACES = np.random.default_rng(8).uniform(44, 51, (40, 2))


@pytest.fixture(scope="module")
def template():
    return SpotTemplate.from_image(airy(73.7, 73.2, (148, 148)), 73.7, 73.2, SHAPE)


@pytest.fixture(scope="module")
def fit(template):
    """Function: mean frames -> positions."""
    return lambda mean: maximum_likelihood_fit(mean, FRAMES, spots.NOISE, template)


@pytest.fixture(scope="module")
def clean():
    return record(electrons(PLACES), pattern(len(PLACES), 21), 22)


@pytest.fixture(scope="module")
def good(fit, clean):
    return fit(clean)


@pytest.mark.second
def test_calibrated_spots_fit_and_keep_their_sigma(good) -> None:
    states = fit_states(good)
    assert states.fits.all()
    assert np.array_equal(states.widening, np.ones(len(PLACES)))
    assert widened(good, states.widening) is good


def test_both_chi_squares_have_the_distribution_of_their_limits(good) -> None:
    """Of 40 spots those beyond the limits of a chance of a quarter: 10 are expected, 24 or more have 1e-6."""
    limits = limit_of(0.25, good.degrees) / good.degrees
    beyond = np.stack([good.reduced_chi_square, good.core_chi_square], axis=1) > limits
    assert np.all(beyond.sum(axis=0) < 24)
    assert np.all((~beyond).sum(axis=0) < 40)


def test_few_electrons_have_fewer_degrees_of_freedom() -> None:
    """A Poisson number of mean m, read without noise, has the excess 1/m: its square has the variance 2 + 1/m."""
    found = likelihood._degrees(np.ones((1, 1000), bool), np.full((1, 1000), 0.5))
    assert found[0] == pytest.approx(2.0 * 1000.0 / 2.5)


@pytest.mark.second
def test_another_shape_is_found_and_widened(fit, good, clean) -> None:
    ghost = clean[:4] + GAIN * 2000 * np.stack([airy(r + 9, c) for r, c in PLACES[:4]])
    found = fit(ghost)
    states = fit_states(found)
    assert not states.fits.any()
    factor = np.sqrt(np.maximum(found.reduced_chi_square, found.core_chi_square))
    assert states.widening == pytest.approx(factor)
    assert np.all(factor > 1.5)
    wider = widened(found, states.widening)
    for name in ("temporal_covariance", "fixed_covariance"):
        assert getattr(wider, name) == pytest.approx(getattr(found, name) * factor[:, None, None] ** 2)
    assert wider.gain_maps == pytest.approx(found.gain_maps * factor[:, None, None, None])
    before = fit_states(good).at(slice(4)).reshaped(4)
    told = SpotEvidence(before, states.reshaped(4)).doubt(0, ["a", "b", "c", "d"])
    assert told.cause == AFTER
    assert told.spots == (0, 1, 2, 3)
    assert "a, b, c, d" in told.text
    assert "differs from the calibration" in told.text
    told = SpotEvidence(states.reshaped(4), before).doubt(0)
    assert told.cause == BEFORE


def test_noise_above_the_data_sheet_is_named_as_such(fit, good) -> None:
    """Twice the read-out noise."""
    rng = np.random.default_rng(5)
    light = electrons(PLACES[:2])
    more = np.sqrt(3.0) * spots.DARK_NOISE_E * GAIN / np.sqrt(FRAMES)
    loud = record(light, pattern(2, 31), 32) + more * rng.standard_normal(light.shape)
    states = fit_states(fit(loud))
    assert not states.fits.any()
    read = (GAIN * spots.DARK_NOISE_E) ** 2 / FRAMES
    stated = read + 1 / 12 / FRAMES + (GAIN * spots.DSNU_E) ** 2
    # the median of 2304 squares has a sigma of 5 %
    assert states.noise == pytest.approx((stated + 3.0 * read) / stated, rel=0.25)
    before = fit_states(good).at(slice(2)).reshaped(2)
    evidence = SpotEvidence(before, states.reshaped(2))
    told = evidence.doubt()
    assert told.cause == NOISE
    assert "data sheet" in told.text
    assert evidence.consistent.tolist() == [False]
    assert SpotEvidence.joined([SpotEvidence(before, before), evidence]).consistent.tolist() == [True, False]
    assert SpotEvidence(before, before).doubt() is None


def test_centroids_without_a_shape_are_not_judged(clean) -> None:
    for measure in (energy_centroid, gaussian_fit):
        states = fit_states(measure(clean[:2], FRAMES, spots.NOISE))
        assert states.fits.all()
        assert np.all(states.widening == 1.0)


def comb(row, column, shape=SHAPE):
    """Four spots in an uneven row, about as bright: what coma and folded beams look like."""
    parts = ((1.0, -3, -20), (0.97, 4, -7), (1.0, -2, 6), (0.95, 3, 19))
    return sum(share * airy(row + down, column + right, shape) for share, down, right in parts)


@pytest.mark.second
def test_a_shape_of_several_lobes_ends_where_it_is(monkeypatch) -> None:
    """Which lobe the first guess is on, the noise decides, and from there scoring ends on the wrong one. From two
    starts all end at the truth: 5 sigma on 24 numbers have a false alarm of 1e-5.
    """
    template = SpotTemplate.from_image(comb(87.7, 87.2, (176, 176)), 87.7, 87.2, SHAPE)
    places = PLACES[:12]
    light = np.stack([spots.PEAK_E * comb(r, c) + spots.SKY_E for r, c in places])
    mean = record(light, pattern(len(places), 41), 42)
    found = require_convergence(maximum_likelihood_fit(mean, FRAMES, spots.NOISE, template))
    off = (found.position - places) / np.stack([found.sigma_row, found.sigma_column], axis=1)
    assert np.abs(off).max() < 5.0
    assert fit_states(found).fits.all()
    monkeypatch.setattr(likelihood, "_second_start", lambda *told: None)
    alone = maximum_likelihood_fit(mean, FRAMES, spots.NOISE, template)
    assert np.count_nonzero(np.abs(alone.position - places).max(axis=1) > 4.0) > 5


def test_two_places_that_fit_alike_are_refused() -> None:
    """Twins 24 px apart of which the template has one: both are as good."""
    template = SpotTemplate.from_image(airy(87.7, 87.2, (176, 176)), 87.7, 87.2, SHAPE)
    light = np.stack([spots.PEAK_E * (airy(47, 35) + airy(47, 59)) + spots.SKY_E])
    with pytest.raises(SpotError, match="fits equally well at two positions"):
        maximum_likelihood_fit(GAIN * light + OFFSET, FRAMES, spots.NOISE, template, edge_px=5.0)


def test_a_fit_that_does_not_come_to_rest_is_started_anew_then_refused(template, clean, monkeypatch) -> None:
    """One step is too few; the second start makes up for it, if it is let."""
    assert maximum_likelihood_fit(clean[:1], FRAMES, spots.NOISE, template, max_iterations=1).converged.all()
    monkeypatch.setattr(likelihood, "_MOST_DAMPED", 1)
    found = maximum_likelihood_fit(clean[:1], FRAMES, spots.NOISE, template, max_iterations=1)
    assert not found.converged.any()
    refuses(SpotError, "does not converge", require_convergence, found)
