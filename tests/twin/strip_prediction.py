"""What covariances predict of check points of one pass, by plain linear algebra over all of its noise: no elimination
and nothing of the adjustments but the derivatives of the image points."""

import numpy as np

from analysis.calibration.normal_equations import SharedNoise, State, Weights, assemble
from analysis.orbit.calibration_parameters import CalibrationField, Parameters, Unknowns
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import LineModel
from optics.numerics.number_tree import FrozenMap
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.schemes import with_points
from twin.orbit.flight.earth import east_north_up


def predicted(campaign: Campaign, one: FieldPass) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances (n, 3, n, 3) of the errors of n check points, east, north, up, m^2, with known cameras
    and bias: without the adjustment of the strip on its tie points, and with it. Linear in every noise of the pass.
    """
    control, ties, check = len(one.control.ground), len(one.ties["nadir"].point), len(one.check_ground)
    field = with_points(one.control, FrozenMap(one.ties), np.tile(one.check_ground[0], (ties, 1)))
    field = with_points(field, FrozenMap(one.check), one.check_ground)
    ground = field.ground.copy()
    ground[control : control + ties] = intersect(one.ties, campaign.truth, campaign.noise, bias=one.bias).ground
    shared, point, where, prior = _derivatives(campaign, one, field, ground)
    in_ties, in_check = (where >= control) & (where < control + ties), where >= control + ties
    # ties lose their points: what is left of them tells of what they share
    by_tie = point[in_ties][:, 3 * control : 3 * (control + ties)]
    project = np.eye(in_ties.sum()) - by_tie @ np.linalg.solve(by_tie.T @ by_tie, by_tie.T)
    seen = (project @ shared[in_ties]).T
    answer = -np.linalg.solve(seen @ shared[in_ties] + prior, seen)
    covariance, own = np.linalg.inv(prior), np.eye(len(prior))
    lon, lat, _ = one.data.earth.geodetic(one.check_ground.mean(axis=0))
    rows = (in_check, shared, point, where)
    gain = _intersection(east_north_up(lon, lat), rows, covariance, control + ties, check)
    found = []
    for by_ties, by_shared in ((0.0 * answer, own), (answer, own + answer @ shared[in_ties])):
        b, c = (gain @ shared[in_check] @ noise for noise in (by_ties, by_shared))
        found.append((gain @ gain.T + b @ b.T + c @ covariance @ c.T).reshape(check, 3, check, 3))
    return found[0], found[1]


def _derivatives(
    campaign: Campaign, one: FieldPass, field: CalibrationField, ground: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return whitened rows by shared noise and points, each row's point, and the precision of the shared noise."""
    laboratory: dict[str, LineModel] = dict(campaign.truth)
    parameters = Parameters.of([field], laboratory, Unknowns())
    values = parameters.start.copy()
    for axis, value in zip(("roll", "pitch", "yaw"), one.bias, strict=True):
        values[parameters.names.index(f"{one.name} {axis}")] = value
    shared = SharedNoise.of([field], campaign.noise)
    rows = sum(len(r.point) for r in field.rays.values())
    factor = dict.fromkeys(("image", "control", *shared.groups), 1.0)
    weights = Weights(np.ones(rows), factor)
    state = State(values, (ground,), np.zeros(shared.size))
    at = assemble([field], laboratory, parameters, state, campaign.noise, (), weights, shared)
    where = np.repeat(np.concatenate([r.point for r in field.rays.values()]), 2)
    return at.design_shared.toarray(), at.design_point.toarray(), where, shared.precision.toarray()


def _intersection(
    axes: np.ndarray, at: tuple[np.ndarray, ...], covariance: np.ndarray, first: int, count: int
) -> np.ndarray:
    """(3n, rows) from whitened image points of the check points to their east, north, up: each ray weighs by all of
    its own noise, what rays share does not count."""
    rows, shared, point, where = at
    places = np.flatnonzero(rows)
    gain = np.zeros((3 * count, len(places)))
    for k in range(count):
        mine = np.flatnonzero(where[places] == first + k)
        at = places[mine]
        by = point[at, 3 * (first + k) : 3 * (first + k) + 3]
        full = shared[at] @ covariance @ shared[at].T
        own = np.eye(len(at))
        for ray in range(0, len(at), 2):
            own[ray : ray + 2, ray : ray + 2] += full[ray : ray + 2, ray : ray + 2]
        weighted = np.linalg.solve(own, by).T
        gain[3 * k : 3 * k + 3, mine] = axes @ np.linalg.solve(weighted @ by, weighted)
    return gain
