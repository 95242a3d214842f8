"""What covariances predict of check points of one pass, by plain linear algebra over all of its noise: no elimination
and nothing of the adjustments but the derivatives of the image points."""

from dataclasses import dataclass

import numpy as np

from analysis.calibration.normal_equations import State, Weights, assemble
from analysis.calibration.shared_noise import SharedNoise
from analysis.orbit.calibration_parameters import CalibrationField, Parameters, Unknowns
from analysis.orbit.forward_intersection import intersect
from analysis.orbit.three_line_model import LineModel
from optics.numerics.frozen_map import FrozenMap
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import GAUGE
from twin.orbit.calibration.strip import with_points
from twin.orbit.flight.earth import east_north_up


@dataclass(frozen=True, eq=False)
class Predicted:
    """Covariances (n, 3, n, 3) of the errors of n check points, east, north, up, metres^2; without the adjustment of
    the strip, and with it."""

    before: np.ndarray
    after: np.ndarray

    def rms(self, after: bool) -> tuple[float, float]:
        """In plan and height, metres."""
        east, north, up = np.einsum("nini->i", self.after if after else self.before) / len(self.after)
        return float(np.sqrt(east + north)), float(np.sqrt(up))


def predicted(campaign: Campaign, one: FieldPass, calibrated: str | None, elsewhere: bool = False) -> Predicted:
    """Linear in every noise of the pass.

    Args:
        campaign: for cameras and noise.
        one: the pass.
        calibrated: None with known cameras and bias, else by its own "control" or its control and "ties".
        elsewhere: calibrated in another pass of the same geometry and the same bias, with noise of its own.
    """
    control, ties, check = len(one.control.ground), len(one.ties["nadir"].point), len(one.check_ground)
    field = with_points(one.control, FrozenMap(one.ties), np.tile(one.check_ground[0], (ties, 1)))
    field = with_points(field, FrozenMap(one.check), one.check_ground)
    ground = field.ground.copy()
    ground[control : control + ties] = intersect(one.ties, campaign.truth, campaign.noise, bias=one.bias).ground
    design, shared, point, where, prior = _derivatives(campaign, one, field, ground)
    in_control, in_ties, in_check = (
        where < control,
        (where >= control) & (where < control + ties),
        where >= control + ties,
    )
    # control coordinates and image points of control are one observation; ties lose their points
    noise = np.kron(np.eye(control), np.eye(3)) * np.mean(np.diagonal(one.control.covariance, axis1=1, axis2=2))
    by_control = point[in_control][:, : 3 * control]
    spread = np.eye(in_control.sum()) + by_control @ noise @ by_control.T
    by_tie = point[in_ties][:, 3 * control : 3 * (control + ties)]
    project = np.eye(in_ties.sum()) - by_tie @ np.linalg.solve(by_tie.T @ by_tie, by_tie.T)
    x, z = design.shape[1], shared.shape[1]
    # basis of the noise: n of control, n of ties, z
    sizes = (int(in_control.sum()), int(in_ties.sum()), z)
    first, second = sizes[0], sizes[0] + sizes[1]
    basis = sum(sizes)
    own, wrong = np.zeros((2, x, basis))
    both = np.hstack([design, shared])
    if calibrated is not None:
        weighted = np.linalg.solve(spread, both[in_control]).T
        normal = weighted @ both[in_control]
        normal[x:, x:] += prior
        right = np.zeros((x + z, basis))
        right[:, :first] = weighted
        right[x:, second:] = -prior
        if calibrated == "ties":
            seen = (project @ both[in_ties]).T
            normal += seen @ both[in_ties]
            right[:, first:second] = seen
        scale = 1.0 / np.sqrt(np.diag(normal))
        found = scale[:, None] * np.linalg.solve(scale[:, None] * normal * scale, scale[:, None] * right)
        own, wrong = (own, found[:x]) if elsewhere else (found[:x], wrong)
    seen = (project @ shared[in_ties]).T
    told = np.zeros((sizes[1], basis))
    told[:, first:second] = np.eye(sizes[1])
    told[:, second:] = shared[in_ties]
    answer = -np.linalg.solve(seen @ shared[in_ties] + prior, seen)
    left = answer @ (told - design[in_ties] @ own)
    left[:, second:] += np.eye(z)
    alone = np.zeros((z, basis))
    alone[:, second:] = np.eye(z)
    covariance = np.linalg.inv(prior)
    gain = _intersection(campaign, one, in_check, shared, point, where, covariance, control + ties, check)
    answers = []
    for errors, foreign in ((alone, np.zeros((z, basis))), (left, -answer @ design[in_ties] @ wrong)):
        total = gain @ gain.T
        for noise_of, inner in ((errors, own), (foreign, wrong)):
            image = gain @ (shared[in_check] @ noise_of - design[in_check] @ inner)
            a, b, c = image[:, :first], image[:, first:second], image[:, second:]
            total = total + a @ spread @ a.T + b @ b.T + c @ covariance @ c.T
        answers.append(total.reshape(check, 3, check, 3))
    return Predicted(*answers)


def _derivatives(
    campaign: Campaign, one: FieldPass, field: CalibrationField, ground: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Whitened rows by the free unknowns, shared noise and points; each row's point; precision of the shared noise."""
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
    free = [i for i, n in enumerate(parameters.names) if n not in GAUGE.held]
    where = np.repeat(np.concatenate([r.point for r in field.rays.values()]), 2)
    return (
        at.design.toarray()[:, free],
        at.design_shared.toarray(),
        at.design_point.toarray(),
        where,
        shared.precision.toarray(),
    )


def _intersection(
    campaign: Campaign,
    one: FieldPass,
    rows: np.ndarray,
    shared: np.ndarray,
    point: np.ndarray,
    where: np.ndarray,
    covariance: np.ndarray,
    first: int,
    count: int,
) -> np.ndarray:
    """(3n, rows) from whitened image points of the check points to their east, north, up: each ray weighs by all of
    its own noise, what rays share does not count."""
    places = np.flatnonzero(rows)
    gain = np.zeros((3 * count, len(places)))
    lon, lat, _ = one.data.earth.geodetic(one.check_ground.mean(axis=0))
    axes = east_north_up(lon, lat)
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
