"""Elasticities against finite changes of the statement, and heavy tails against draws of them."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.monitor.disturbances import TimeLaw
from analysis.monitor.limits import elasticities, heavy_tails, posterior_sigma, prior_numbers, unobserved_bodies
from tests.analysis.refusals import refuses
from tests.analysis.stated_motions import disturbances

RNG = np.random.default_rng(11)
WHAT = ("rotate x", "rotate y", "shift x", "shift y", "figure Z4", "figure Z5")
BODIES = ("base/one", "base/two")
COUNT = len(WHAT) * len(BODIES)
SIGMAS = np.tile([2.0, 2.0, 1.0, 3.0, 5.0, 5.0], 2)
CORRELATION = np.eye(COUNT)
CORRELATION[0, 6] = CORRELATION[6, 0] = 0.6
STATED = disturbances(
    (TimeLaw(),) * COUNT,
    *RNG.standard_normal((2, 4, COUNT)),
    [f"{body} {what}" for body in BODIES for what in WHAT],
    CORRELATION,
    SIGMAS,
)
NOISE = 0.01 * np.eye(4)
ROWS = np.eye(4)
GAIN = STATED.best_gain(NOISE)


def scaled(own, factor):
    factors = np.ones(COUNT)
    factors[own] = factor
    return STATED.scaled(factors)


def test_a_number_is_what_a_cause_gives_alike() -> None:
    """Both turns have one number, shifts of different size two, figure terms one each; bodies share them."""
    found = prior_numbers(STATED)
    assert list(found) == [f"mounts {what}" for what in ("rotate", "shift x", "shift y", "figure Z4", "figure Z5")]
    assert found["mounts rotate"] == [0, 1, 6, 7]
    assert sorted(k for own in found.values() for k in own) == list(range(COUNT))


def test_elasticities_are_derivatives_of_sigma() -> None:
    """Against a change by 1e-4 of the number, told and not told; all and the noise's share together make 1."""
    before = posterior_sigma(ROWS, STATED, NOISE)
    found = {one.number: one for one in elasticities(ROWS, STATED, NOISE, GAIN)}
    for number, own in prior_numbers(STATED).items():
        step = 1e-4
        wider_sigma = posterior_sigma(ROWS, scaled(own, 1.0 + step), NOISE)
        # of second order is the square of the step
        assert found[number].elasticity == pytest.approx((wider_sigma / before - 1.0) / step, abs=2e-4), number
        wider = scaled(own, 2.0)
        assert found[number].doubled_in_prior == pytest.approx(posterior_sigma(ROWS, wider, NOISE))
        left = wider.misfit(GAIN) + GAIN @ NOISE @ GAIN.T
        assert found[number].doubled == pytest.approx(np.sqrt(np.diag(left)))
        assert np.all(found[number].doubled >= found[number].doubled_in_prior * (1.0 - 1e-12))
    noise = np.einsum("qd,de,qe->q", GAIN, NOISE, GAIN) / before**2
    assert sum(one.elasticity for one in found.values()) + noise == pytest.approx(np.ones(4))


@pytest.mark.second
def test_heavy_tails_are_those_of_drawn_states() -> None:
    """200 000 states drawn number by number: a rms with four degrees of freedom scatters by some per cent."""
    degrees, count = 6.0, 200_000
    tail = heavy_tails(ROWS, STATED, NOISE, GAIN, degrees)
    rng = np.random.default_rng(3)
    values, vectors = np.linalg.eigh(CORRELATION)
    x = rng.standard_normal((count, COUNT)) @ ((vectors * np.sqrt(values)) @ vectors.T)
    for own in prior_numbers(STATED).values():
        x[:, own] /= np.sqrt(rng.gamma(0.5 * degrees, 2.0 / degrees, count))[:, None]
    noise = rng.multivariate_normal(np.zeros(4), NOISE, count)
    error = x @ (GAIN @ STATED.spots - STATED.parameters).T + noise @ GAIN.T
    assert tail.rms == pytest.approx(np.sqrt(np.mean(error**2, axis=0)), rel=0.02)
    for k, level in enumerate((0.6827, 0.9545, 0.9973)):
        assert tail.half_widths[k] == pytest.approx(np.quantile(np.abs(error), level, axis=0), rel=0.06), level
    sigma = posterior_sigma(ROWS, STATED, NOISE)
    assert tail.beyond == pytest.approx(np.mean(np.abs(error) > 3.0 * sigma, axis=0), rel=0.1)
    assert np.all(tail.beyond > 0.0027)


def test_many_degrees_of_freedom_are_the_normal_statement() -> None:
    tail, sigma = heavy_tails(ROWS, STATED, NOISE, GAIN, 1e4), posterior_sigma(ROWS, STATED, NOISE)
    for k in range(3):
        assert tail.half_widths[k] == pytest.approx((k + 1) * sigma, rel=2e-3)
    assert tail.beyond == pytest.approx(np.full(4, 0.0027), rel=0.02)
    refuses(ValueError, "more than 2 degrees of freedom", heavy_tails, ROWS, STATED, NOISE, GAIN, 2.0)


def test_a_body_that_moves_no_spot_is_found() -> None:
    assert unobserved_bodies(ROWS, STATED, NOISE, GAIN) == {}
    spots = STATED.spots.copy()
    spots[:, 6:] *= 1e-6
    still = replace(STATED, spots=spots)
    found = unobserved_bodies(ROWS, still, NOISE, still.best_gain(NOISE))
    assert list(found) == ["base/two"]
    assert np.all(found["base/two"] > 0.3)
