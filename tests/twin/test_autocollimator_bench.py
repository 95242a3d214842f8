"""The rendered bench with two autocollimators: ideal relations from images against the exact trace, the scatter against
the sigmas that are stated, the errors of the bench, and the table.

Chi-square tests have a false-alarm rate of 1e-4 each, two-sided; seeds are fixed, so that they pass or fail for good.
"""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from analysis.monitor.autocollimator import exact_reading, relation_factor
from optics.geometry.tree import Motion
from optics.numerics.backend import Backend
from optics.raytrace.trace import BeamMissedError
from scenes.specs.camera_tests import AutocollimatorSetup, BenchErrorsSpec
from scenes.specs.load import load_autocollimator_test
from twin.laboratory.autocollimator_bench import (
    UNITS,
    Reader,
    Series,
    autocollimator_body,
    axis_body,
    declared_spread,
    mirror_body,
    run_autocollimator_test,
    series_per_axis,
    states_of,
    window_pattern,
)

ARCSEC = math.pi / 648000
SETUP = load_autocollimator_test()
FALSE_ALARM = 1e-4


@pytest.fixture(scope="module")
def reader(backend: Backend) -> Reader:
    return Reader(SETUP, backend)


def with_errors(**sigmas: float) -> AutocollimatorSetup:
    """The experiment with these errors of the bench and no others."""
    zero = dict.fromkeys(BenchErrorsSpec.model_fields, 0.0)
    errors = BenchErrorsSpec.model_construct(**{**zero, **sigmas})
    return AutocollimatorSetup(SETUP.spec.model_copy(update={"errors": errors}), SETUP.detector)


def scatter_agrees(squares: float, freedom: int) -> bool:
    low, high = chi2.ppf([0.5 * FALSE_ALARM, 1 - 0.5 * FALSE_ALARM], freedom)
    return bool(low < squares < high)


@pytest.mark.second
def test_ideal_images_satisfy_the_relations(reader: Reader, backend: Backend) -> None:
    p = SETUP.spec.programme
    series = [
        Series(x, half, step, p.steps)
        for x in "XYZ"
        for half in (p.narrow, p.wide)
        for step in (p.small, p.table, p.large)
    ]
    table = run_autocollimator_test(SETUP, backend, series, ideal=True, reader=reader)
    assert len(table.results) == 18
    for result in table.results:
        # exact to all orders, on both axes of both mirrors
        assert np.max(np.abs(result.from_exact)) < 0.001 * ARCSEC
        # what is left of the first-order relations is the second order, and that is there
        s = result.series
        between = 2 * s.half_angle
        for unit in UNITS:
            factor = relation_factor(s.axis, unit, between)
            own = result.readings[unit - 1, :, 0 if s.axis == "X" else 1]
            second_order = exact_reading(s.axis, s.angles, unit, between)[:, 0 if s.axis == "X" else 1]
            left = second_order - factor * s.angles
            assert np.max(np.abs(own - factor * s.angles - left)) < 0.001 * ARCSEC
        if s.axis != "X":
            cross = result.readings[1, -1, 0]
            wanted = 0.5 * math.sin(between) * math.cos(between) * s.angles[-1] ** 2
            assert abs(cross) == pytest.approx(wanted, abs=0.001 * ARCSEC)
            assert wanted > 0.13 * ARCSEC  # so that this is no empty statement
        if s.axis == "Z":
            assert np.max(np.abs(result.readings[0])) < 0.001 * ARCSEC


@pytest.mark.second
def test_the_images_noise_is_as_stated(reader: Reader, backend: Backend) -> None:
    # one state seen 60 times: the only differences are the detectors' temporal noise
    setup = with_errors()
    windows = reader.path(math.radians(15)).windows([{axis_body("Y"): Motion(rotate=(0.0, 1e-3, 0.0))}])
    count = 60
    places, sigmas = [], []
    for seed in range(count):
        mean = reader.expose(windows, (7, seed), 3).mean(axis=2)
        place, spots = reader.positions(mean[:, 0], windows.corner[:, 0])
        places.append(place)
        sigmas.append(np.einsum("bkk->bk", spots.temporal_covariance))
    residual = np.array(places) - np.mean(places, axis=0)
    assert scatter_agrees(float(np.sum(residual**2 / np.mean(sigmas, axis=0))), 4 * (count - 1))
    # and the whole reading, fixed pattern and zero included
    result = run_autocollimator_test(
        setup, backend, [Series("X", math.radians(15), math.radians(0.003), 100)], 4, reader=reader
    )["X"]
    off = result.from_exact[..., 1:, :]
    freedom = off.size - 4
    # the reading at zero is common to all rows and drops out with their mean
    spread = off - off.mean(axis=1, keepdims=True)
    variance = 0.5 * result.sigma[:, 1:] ** 2
    assert scatter_agrees(float(np.sum(spread**2 / variance)), freedom)
    assert 0.003 * ARCSEC < np.max(result.sigma) < 0.05 * ARCSEC


@pytest.mark.second
def test_errors_of_the_bench_act_as_they_should(reader: Reader, backend: Backend) -> None:
    series = series_per_axis(SETUP.spec)[0]
    angle = series.angles[-1]

    def last(**sigmas: float) -> tuple[np.ndarray, dict[str, Motion]]:
        setup = with_errors(**sigmas)
        result = run_autocollimator_test(setup, backend, [series], 2, reader=reader)["X"]
        return result.readings[:, -1], dict(states_of(setup.spec, series, 2)[-1])

    limit = 6 * 0.015 * ARCSEC  # six sigma of the images
    reading, state = last(focal_length=2e-3)
    for k, unit in enumerate(UNITS):
        growth = state[autocollimator_body(unit)].scale
        assert abs(growth) > 1e-4
        assert reading[k, 0] == pytest.approx(angle * (1 + growth), abs=limit)
    reading, state = last(ccd_rotation=math.radians(0.5))
    for k, unit in enumerate(UNITS):
        roll = state[f"{autocollimator_body(unit)}/focal_plane/area_ccd"].rotate[2]
        assert abs(roll) > math.radians(0.05)
        # a detector turned by +r about Z sees the spot turned by -r: of +Y some is seen along +X, rows run along -X
        assert reading[k] == pytest.approx([angle * math.cos(roll), -angle * math.sin(roll)], abs=limit)
    reading, state = last(axis_tilt=math.radians(0.2))
    turn = state[axis_body("X")].rotate
    assert abs(turn[1]) > 1e-4 * angle
    assert reading[0] == pytest.approx([turn[0], turn[1]], abs=limit)
    # a mirror that leans keeps reading relative to its zero; its lean is in the state
    reading, state = last(mirror_mount=math.radians(0.02))
    assert abs(state[mirror_body(1)].rotate[0]) > 1e-5
    assert reading[:, 0] == pytest.approx([angle, angle], abs=limit)


@pytest.mark.second
def test_seeds(reader: Reader, backend: Backend) -> None:
    first, again, other = (
        run_autocollimator_test(SETUP, backend, series_per_axis(SETUP.spec)[:n], seed, reader=reader)
        for n, seed in ((1, 1), (3, 1), (1, 2))
    )
    # a series does not depend on those run with it
    assert np.array_equal(first["X"].readings, again["X"].readings)
    assert not np.array_equal(first["X"].readings, other["X"].readings)


def test_a_pixel_keeps_its_pattern_in_every_window(reader: Reader) -> None:
    corner = np.array([[130, 190], [150, 180], [0, 0]])
    pattern = window_pattern(reader.detector, corner, 64, 3, (9,))
    np.testing.assert_array_equal(pattern.gain[0, 20:, : 64 - 10], pattern.gain[1, : 64 - 20, 10:])
    assert np.std(pattern.gain) == pytest.approx(SETUP.detector.prnu, rel=0.05)
    assert not np.array_equal(pattern.gain[0], window_pattern(reader.detector, corner, 64, 3, (8,)).gain[0])


def test_too_large_a_turn_is_told(reader: Reader, backend: Backend) -> None:
    with pytest.raises(BeamMissedError, match="does not fit on the area CCD"):
        run_autocollimator_test(
            SETUP, backend, [Series("X", math.radians(15), math.radians(0.04), 10)], reader=reader, ideal=True
        )


@pytest.mark.parametrize(
    ("error", "sigma", "x", "z"),
    [
        # E|n| = sqrt(2 / pi) sigma; the mean angle is 360 arcsec, ten of eleven rows are turned
        ("focal_length", 1e-3, math.sqrt(2) * 0.36, 0.36),
        ("turntable_step", ARCSEC, 0.0, 10 / 11),
        ("reading", ARCSEC, 2.0, math.sqrt(2) * 2 / math.sqrt(3)),
    ],
)
def test_declared_spread_of_single_errors(error: str, sigma: float, x: float, z: float) -> None:
    spec = with_errors(**{error: sigma}).spec
    for series, wanted in zip(series_per_axis(spec)[::2], (x, z), strict=True):
        mean = declared_spread(spec, series, 0.0).mean() / ARCSEC
        assert mean == pytest.approx(math.sqrt(2 / math.pi) * wanted, rel=0.05, abs=1e-3)
