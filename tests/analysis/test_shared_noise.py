"""Noise of readings that image points share: its covariance against SciPy's spline, and campaigns whose sigmas hold."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from analysis.calibration.adjustment import adjust, single_ray
from analysis.calibration.normal_equations import SharedNoise, State, Weights, assemble
from analysis.orbit.calibration_parameters import CalibrationError, CalibrationField, Noise, Parameters
from analysis.orbit.forward_intersection import reading_variance
from analysis.orbit.three_line_model import Partials, Rays, misclosure, partials
from tests.analysis.refusals import refuses
from tests.analysis.test_adjustment import (
    BIAS,
    HOLD_X,
    LABORATORY,
    OFFSETS,
    ORBIT,
    SEVEN_NODES,
    TRUTH,
    measured,
    priors,
    seen,
)
from tests.analysis.test_three_line_model import ARCSEC, PITCH, orbit

NOISE = Noise(0.3 * PITCH, 0.5 * ARCSEC, 0.05, attitude_interval=0.125, station_interval=1.0)


def flight(count, nodes=SEVEN_NODES):
    return [seen(10 + i, count, node=node) for i, node in enumerate(nodes)]


def campaign(views, rng, noise=NOISE):
    """Fields with shared noise, their true offsets."""
    fields, truth = [], dict(TRUTH)
    for i, view in enumerate(views):
        offset = ORBIT * rng.standard_normal(3)
        name, axes = f"F{i}", orbit(view.node, np.zeros(1))[1][0]
        fields.append(measured(view, rng, noise, offset=axes @ offset, name=name))
        truth |= {f"{name} {n}": v for n, v in zip(("roll", "pitch", "yaw"), BIAS, strict=True)}
        truth |= {f"{name} offset {n}": v for n, v in zip(("along", "across", "down"), offset, strict=True)}
    return fields, truth


def solve(fields, noise=NOISE, **options):
    names = [f.name for f in fields]
    return adjust(fields, LABORATORY, noise, unknowns=OFFSETS, priors=priors(*names), gauge=HOLD_X, **options)


@pytest.mark.parametrize(
    "moments",
    [np.concatenate([np.linspace(0.03, 1.9, 23), np.linspace(6.11, 6.3, 5)]), np.array([0.03]), np.array([0.03, 0.2])],
    ids=["long and short", "one", "two"],
)
def test_covariance_of_points_is_that_of_the_spline(moments):
    """SciPy's spline is linear in the readings, so its matrix gives the covariance; its ends, 60 readings away, leave
    0.27^60. A gap of 30 readings cuts the unknowns into two stretches, of correlation 1e-16. A single moment has the
    shortest stretch there is."""
    knots = 0.125 * np.arange(-60, 120)
    by_reading = CubicSpline(knots, np.eye(len(knots)))(moments)
    count = len(moments)
    rays = Rays.of(
        np.arange(count), np.zeros((count, 2)), np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)), moments
    )
    field = CalibrationField(
        "one", {"nadir": rays}, np.zeros((count, 3)), np.zeros((count, 3, 3)), np.ones(count, bool)
    )
    shared = SharedNoise.of([field], Noise(PITCH, 2.0, attitude_interval=0.125))
    turn = np.zeros((count, 2, 3))
    turn[:, 0, 1] = 1.0  # x by pitch alone
    none = np.zeros((count, 2, 3))
    rows = shared.rows("one", "nadir", np.tile(np.eye(2), (count, 1, 1)), Partials(none, none, none, turn, none))[::2]
    found = rows @ np.linalg.inv(shared.precision.toarray()) @ rows.T
    expected = 4.0 * by_reading @ by_reading.T
    assert found == pytest.approx(expected, abs=1e-9)
    assert 4.0 * reading_variance(moments, 0.125) == pytest.approx(np.diag(expected), abs=1e-9)
    assert reading_variance(np.array([0.0, 0.0625]), 0.125) == pytest.approx([1.0, 0.76], abs=0.01)


def test_corrections_at_any_time_are_those_of_the_rays():
    fields, _ = campaign(flight(8, SEVEN_NODES[:1]), np.random.default_rng(1))
    shared = SharedNoise.of(fields, NOISE)
    values = np.random.default_rng(2).standard_normal(shared.size)
    for line, rays in fields[0].rays.items():
        direct = shared.corrected("F0", line, rays, values)
        other = shared.corrected_at("F0", rays, values)
        assert np.array_equal(direct.station, other.station)
        assert np.array_equal(direct.attitude, other.attitude)
        assert np.abs(direct.station - rays.station).max() > 0.01
        # far from all rays nothing is known
        far = shared.corrected_at("F0", replace(rays, time=rays.time + 1e4), values)
        assert np.array_equal(far.station, rays.station)
        assert np.array_equal(far.attitude, rays.attitude)


def test_a_walk_of_the_attitude_is_as_large_whatever_the_interval_of_its_values():
    fields, _ = campaign(flight(8, SEVEN_NODES[:1]), np.random.default_rng(1))
    sizes = [
        single_ray(fields, LABORATORY, Noise(PITCH, attitude_walk=1e-6, walk_interval=step))["attitude walk"]
        for step in (0.05, 1.0)
    ]
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-6)


@pytest.mark.second
def test_rows_of_shared_noise_are_derivatives_of_the_misclosures():
    """Central differences through the corrected rays, for readings of attitude and of station. A z of one sigma moves
    the image by 1e-6 m at most, of which the second order is 1e-12; rounding of 1e-17 m leaves 1e-10 of it."""
    fields, _ = campaign(flight(8, SEVEN_NODES[:1]), np.random.default_rng(3))
    field = fields[0]
    shared = SharedNoise.of(fields, NOISE)
    assert set(shared.groups) == {"attitude", "station"}
    still = np.zeros(3)
    for line, rays in field.rays.items():
        camera, ground = LABORATORY[line], field.ground[rays.point]
        by = partials(camera, rays, ground, still, still)
        rows = shared.rows("F0", line, np.tile(np.eye(2), (len(ground), 1, 1)), by).toarray()
        for group, columns in shared.groups.items():
            seen = columns[np.abs(rows[:, columns]).max(axis=0) > 0]
            assert len(seen) > 10, group
            for k in seen[:: max(1, len(seen) // 12)]:
                sides = []
                for way in (1.0, -1.0):
                    z = np.zeros(shared.size)
                    z[k] = way
                    sides.append(misclosure(camera, shared.corrected("F0", line, rays, z), ground, still, still))
                slope = 0.5 * (sides[0] - sides[1]).ravel()
                assert slope == pytest.approx(rows[:, k], rel=1e-5, abs=1e-5 * np.abs(rows[:, k]).max()), group


def test_sparse_elimination_is_the_dense_covariance_of_all_image_points():
    """The same system with the full covariance of image points, and control and tie points as unknowns. To 1e-5 of the
    sigmas: the weakest combination has a strength of 3e-3, so that rounding of 1e-16 counts 1e5 times, twice."""
    (view,) = flight(12, SEVEN_NODES[:1])
    fields = [measured(view, np.random.default_rng(24), NOISE, name="F0", control=np.arange(12) < 10)]
    found = solve(fields)
    shared = SharedNoise.of(fields, NOISE)
    parameters = Parameters.of(fields, LABORATORY, OFFSETS)
    weights = Weights(np.ones(36), {"image": 1.0})
    state = State(found.values, (found.ground["F0"],), np.zeros(shared.size))
    at = assemble(fields, LABORATORY, parameters, state, NOISE, (), weights, shared)
    rows = at.design_shared.toarray()
    spread = np.eye(72) + rows @ np.linalg.inv(shared.precision.toarray()) @ rows.T
    design = np.hstack([at.design.toarray(), at.design_point.toarray()])
    normal = design.T @ np.linalg.solve(spread, design)
    count = len(found.names)
    normal[count:, count:] += at.control_weight.toarray()
    for i, name in enumerate(found.names):
        normal[i, i] += (ORBIT**-2) * ("offset" in name)
    kept = [i for i in range(len(normal)) if i >= count or found.names[i] not in HOLD_X.held]
    size = 1 / np.sqrt(np.diag(normal)[kept])
    inverse = size[:, None] * np.linalg.inv(size[:, None] * normal[np.ix_(kept, kept)] * size) * size
    sigma = np.sqrt(np.diag(inverse))
    free = [i for i in kept if i < count]
    off = found.covariance[np.ix_(free, free)] - inverse[: len(free), : len(free)]
    assert np.abs(off / sigma[: len(free)] / sigma[: len(free), None]).max() < 2e-5
    points = np.sqrt(found.ground_covariance["F0"][:, [0, 1, 2], [0, 1, 2]]).ravel()
    assert points == pytest.approx(sigma[len(free) :], rel=1e-5)
    # of what is seen beside the adjusted image points
    half = np.linalg.solve(spread, design[:, kept])
    rest = np.linalg.inv(spread) - half @ inverse @ half.T
    blocks = rest.reshape(36, 2, 36, 2)[np.arange(36), :, np.arange(36)]
    assert np.eye(2) - at.image_cofactors(found.covariance) == pytest.approx(blocks, abs=1e-5)


def test_bad_noise_is_told():
    fields, _ = campaign(flight(12, SEVEN_NODES[:1]), np.random.default_rng(27))
    with pytest.raises(CalibrationError, match="intervals must be finite and positive"):
        solve(fields, replace(NOISE, attitude_interval=0.0))
    refuses(CalibrationError, "no other negative", solve, fields, replace(NOISE, attitude=-1.0))
    row = fields[0].rays["nadir"]
    moments = np.where(np.arange(12) == 2, np.nan, row.time)
    with pytest.raises(ValueError, match="time of ray 2 is not finite"):
        Rays.of(row.point, row.image, row.station, row.attitude, moments)
