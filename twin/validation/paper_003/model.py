"""Checks of the rigorous model of paper 003 (Mo et al. 2015).

They use exact points, bright targets on the ground and matched points in rendered images, and points with random
errors. A figure shows the combination of parameters that the points cannot determine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import Adjustment, adjust
from analysis.calibration.strip_adjustment import Stepwise, stepwise
from analysis.orbit.calibration_parameters import Combination, Gauge
from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.three_line_model import BIAS, INTERIOR, Rays, misclosure, partials
from analysis.statistics import rms
from optics.numerics.backend import one_blas_thread
from optics.numerics.number_tree import FrozenMap
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.angle import LINES, EffectsSpec
from scenes.specs.orbit.calibration import CalibrationImagesSpec
from scenes.specs.orbit.flight import ThermalDriftSpec
from scenes.specs.orbit.scene import TerrainSpec
from scenes.specs.orbit.setup import CalibrationSetup
from twin.framework.procedure import stream
from twin.framework.svg import BLUE, GREY, VERMILION
from twin.orbit.calibration.calibration_run import source_of
from twin.orbit.calibration.campaign import Campaign, FieldPass, line_model
from twin.orbit.calibration.campaign_adjustment import GAUGE, calibrated_alone
from twin.orbit.calibration.schemes import check_point_errors, laboratory_errors
from twin.orbit.flight.line_camera import changed_payload, line_cameras
from twin.orbit.flight.sensor import NO_EFFECTS, Platform, Sensor
from twin.orbit.ground.grid import GroundFrame, Terrain
from twin.orbit.images.line_optics import optics_of
from twin.orbit.images.patch import window_of
from twin.orbit.images.pushbroom import MARGIN, PushbroomScene, render_patch
from twin.validation.check import CheckResult, Chosen
from twin.validation.group import Context, drawing, group_of

FIELDS, IMAGES = "calibrate.yaml", "calibrate_images.yaml"
"""Names of the jobs in scenes/orbit: seven fields with simulated image points, and fields with rendered images."""
FIELD = "Beijing"
CAMPAIGNS, FAST_CAMPAIGNS = 9, 5
"""Numbers of campaigns over seven fields, in a full and a fast run, that compare errors of yaw with their sigma."""
FAST_SIDE = 380
"""Lines and pixels of a rendered image patch in the fast run."""
ROUNDS = (1, 3, 10, 30, 100, 300, 1000, 3000)
UNKNOWNS = len(LINES) * len(INTERIOR) + len(BIAS)
ROLL_PITCH = BIAS[:2]
FREE_INTERIOR = tuple(n for n in (f"{line} {k}" for line in LINES for k in INTERIOR) if n not in GAUGE.held)
TOLERANCE = 1e-3
"""Convergence limit of the stepwise solution: largest last step of a round, in conditional sigmas of the unknowns."""
COLUMNS = (700.0, 6000.0, 11300.0)
"""Positions, in pixels of the nadir line, of the middles of the rendered windows.

The line has 12 000 pixels over the swath.
"""
_FOCAL = 0.65
"""Focal length, metres, with which angles are converted to image motion in figures."""
_NO_LIGHT = EffectsSpec(light_time=False, aberration=False, refraction=False)
_STEP = {"f": 1e-5, "x": 1e-5, "y": 1e-5}
"""Half step of numerical derivatives with respect to an element of interior orientation, metres (1.5 px).

The error of third order is 1e-9 of the derivative.
"""
_ROTATION = 1.5e-5
"""Half step of numerical derivatives with respect to an attitude angle, radians."""
_SIDE = 190
_SIGMA = 2.5
"""Standard deviation of the Gaussian brightness profile of a target on the ground, metres: half a pixel.

The terrain's curvature under it moves its centroid by 0.004 px at most.
"""
_APART = 300.0
_HALF = MARGIN + 4
_TERRAIN: dict[str, Any] = {"kind": "fractal", "relief": "30 m", "exponent": 2.4}


def setup_of(file: str, fields: Sequence[str] = (), **changes: Any) -> CalibrationSetup:
    """Return a calibration test of the library with only some of its fields, and other values of some attributes."""
    setup = CalibrationSetup.read(SCENES / ORBIT / file)
    if fields:
        chosen = FrozenMap({name: setup.test.fields[name] for name in fields})
        changes = {"fields": chosen, "schemes": (tuple(fields[:1]),), **changes}
    return changed(setup, **changes)


def changed(setup: CalibrationSetup, **changes: Any) -> CalibrationSetup:
    """Return a setup in which some attributes of its test have other values."""
    return setup.model_copy(update={"test": setup.test.model_copy(update=changes)})


def without_light(setup: CalibrationSetup) -> CalibrationSetup:
    """Return a setup without light time, aberration and refraction, which the paper does not mention.

    The adjustment removes them from image points to 0.004 px, and a flight without them takes half the time.
    """
    return changed(setup, effects=_NO_LIGHT)


def exact_and_images() -> CalibrationSetup:
    """Return a setup of one field with exact points and with the detectors that images need.

    Image points, control and orbit are exact, the light has no effects, and the attitude has a constant bias only.
    """
    points = setup_of(FIELDS).test.points
    setup = without_light(setup_of(IMAGES, (FIELD,), images=None, points=points))
    errors = setup.test.errors
    tracker = errors.star_tracker.model_copy(update={"thermal": ThermalDriftSpec()})
    update = {"switched_on": False, "season": (0.0, 0.0, 0.0), "star_tracker": tracker}
    return changed(setup, errors=errors.model_copy(update=update))


def all_errors(value: float) -> Chosen:
    """Return the errors of biases, orbit, attitude and points as one input that the paper does not print.

    They have one factor in common, to which the errors of a calibration are proportional.
    """
    return Chosen.power("biases and errors of scenes/orbit/calibrate.yaml, times", 1.0, "1", value)


def true_sensors(
    setup: CalibrationSetup,
    field_pass: FieldPass,
    trajectory: Platform | None = None,
    interior: Mapping[str, np.ndarray] = FrozenMap(),
) -> dict[str, Sensor]:
    """Return the sensor model of each camera line as it is after launch, on a trajectory.

    Parameters
    ----------
    setup : CalibrationSetup
        Setup with the cameras.
    field_pass : FieldPass
        Pass over a field.
    trajectory : Platform | None
        Trajectory to be used; None for the true one of the pass.
    interior : Mapping[str, np.ndarray]
        Line -> change of its f, x, y, (3,), metres.
    """
    payload = changed_payload(setup.test, setup.camera)
    lines = dict(payload.lines)
    for line, (f, x, y) in interior.items():
        spec = lines[line]
        point = spec.principal_point[0] + float(x), spec.principal_point[1] + float(y)
        other = {"principal_distance": spec.principal_distance + float(f), "principal_point": point}
        lines[line] = spec.model_copy(update=other)
    cameras = line_cameras(payload.model_copy(update={"lines": FrozenMap(lines)}))
    path = field_pass.trajectory if trajectory is None else trajectory
    known = field_pass.data.sensors
    return {k: replace(known[k], camera=cameras[k], trajectory=path, effects=NO_EFFECTS) for k in LINES}


@dataclass(frozen=True, eq=False)
class Rotated:
    """Platform with its body rotated: its attitude is multiplied by Rx(roll) Ry(pitch) Rz(yaw) from the right.

    Attributes
    ----------
    base : Platform
        The platform without the rotation.
    angles : np.ndarray
        (3,) roll, pitch, yaw of the rotation, radians.
    """

    base: Platform
    angles: np.ndarray

    def position(self, seconds: np.ndarray) -> np.ndarray:
        """Return the position of the platform, which the rotation does not change."""
        return self.base.position(seconds)

    def inertial_velocity(self, seconds: np.ndarray) -> np.ndarray:
        """Return the inertial velocity of the platform, which the rotation does not change."""
        return self.base.inertial_velocity(seconds)

    def body_to_itrs(self, seconds: np.ndarray) -> np.ndarray:
        """Return the rotated platform's rotation matrices from its body frame to the ITRS at given times."""
        return np.asarray(self.base.body_to_itrs(seconds) @ Rotation.from_euler("XYZ", self.angles).as_matrix())


def rays_at(sensor: Sensor, attitude: Platform, pitch: float, line: np.ndarray, pixel: np.ndarray) -> Rays:
    """Return the rays of image points, from the exposure stations and with the given attitude at the exposure times."""
    seconds = sensor.time(line)
    y = pitch * (pixel - 0.5 * (sensor.camera.pixels - 1))
    image = np.column_stack([np.zeros_like(y), y])
    return Rays.of(
        np.arange(len(y)), image, sensor.trajectory.position(seconds), attitude.body_to_itrs(seconds), seconds
    )


def derivatives(setup: CalibrationSetup, field_pass: FieldPass, bias: np.ndarray) -> tuple[str, str, float]:
    """Compare the coefficients of the error equations with finite changes of the rigorous sensor.

    Each unknown of the sensor is changed slightly; the resulting misclosure of the unchanged model is minus its
    coefficient.

    Parameters
    ----------
    setup : CalibrationSetup
        Setup with the cameras.
    field_pass : FieldPass
        Pass whose check points are used.
    bias : (3,) ndarray
        Rotation from the measured to the true attitude, radians.

    Returns
    -------
    tuple of (str, str, float)
        Line and unknown with the largest deviation, and that deviation relative to the largest coefficient.
    """
    payload = changed_payload(setup.test, setup.camera)
    ground, still = field_pass.check_ground, np.zeros(3)
    ratios = []
    for line in LINES:
        model, pitch = line_model(payload, line), setup.camera.pitch_of(line)
        base = true_sensors(setup, field_pass, Rotated(field_pass.trajectory, bias))[line]
        seen = image_positions(setup, field_pass, line, np.zeros(3), bias)
        by = partials(model, rays_at(base, field_pass.trajectory, pitch, *seen), ground, bias, still)
        for k, name in enumerate((*INTERIOR, *BIAS)):
            step = _STEP.get(name, _ROTATION)
            sides = []
            for sign in (1.0, -1.0):
                change = np.zeros(6)
                change[k] = sign * step
                seen = image_positions(setup, field_pass, line, change[:3], bias + change[3:])
                sides.append(misclosure(model, rays_at(base, field_pass.trajectory, pitch, *seen), ground, bias, still))
            coefficient = -(sides[0] - sides[1]) / (2.0 * step)
            expected = by.interior[:, :, k] if k < 3 else by.bias[:, :, k - 3]
            ratios.append((line, name, float(np.abs(coefficient - expected).max() / np.abs(coefficient).max())))
    return max(ratios, key=lambda entry: entry[2])


def image_positions(
    setup: CalibrationSetup, field_pass: FieldPass, line: str, interior: np.ndarray, bias: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return image lines and pixels of the check points in a camera line with changed orientation.

    They are computed by the rigorous sensor model.

    ``interior`` holds the changes of f, x, y, (3,), metres; ``bias`` the attitude bias, (3,), radians.
    """
    rotated = Rotated(field_pass.trajectory, bias)
    return true_sensors(setup, field_pass, rotated, {line: interior})[line].image(field_pass.check_ground)


def exact_campaign(setup: CalibrationSetup, seed: np.random.SeedSequence) -> Campaign:
    """Return a campaign whose image points are computed by the rigorous sensor model, without noise."""
    return source_of(setup, seed).independent


def recovered(campaign: Campaign, pitch: float) -> tuple[float, str]:
    """Return the largest error of the unknowns calibrated from exact points, and the unknown with it.

    The error is in pixels of image motion.
    """
    field_pass = campaign.passes[0]
    adjustment = calibrated_alone(campaign, field_pass)
    worst, which = 0.0, ""
    for name, error in errors_of(campaign, field_pass, adjustment).items():
        pixels = abs(error) * (adjustment.cameras["nadir"].interior[0] if name in BIAS else 1.0) / pitch
        if pixels >= worst:
            worst, which = float(pixels), name
    return worst, which


def errors_of(campaign: Campaign, field_pass: FieldPass, adjustment: Adjustment | Stepwise) -> dict[str, float]:
    """Return the estimated minus the true value of each unknown, by name without the field's, metres or radians."""
    value = dict(zip(adjustment.names, adjustment.values, strict=True))
    out = {
        f"{line} {name}": float(value[f"{line} {name}"] - true)
        for line in LINES
        for name, true in zip(INTERIOR, campaign.truth[line].interior, strict=True)
    }
    return out | {n: float(value[f"{field_pass.name} {n}"] - t) for n, t in zip(BIAS, field_pass.bias, strict=True)}


@dataclass(frozen=True, eq=False)
class Rank:
    """Combinations of the twelve unknowns of a field that its points leave undetermined.

    Attributes
    ----------
    unknowns : int
        Number of unknowns.
    undetermined : tuple of Combination
        Undetermined combinations.
    weak_sigma : float
        Sigma of the nadir line's y, in metres, with its x held fixed.
    moved : float
        RMS displacement of the rigorous sensor's image points, in pixels, due to the undetermined combination, scaled
        to 0.1 mm in x of every line.
    alone : float
        RMS displacement due to the changes of x alone, in pixels.
    """

    unknowns: int
    undetermined: tuple[Combination, ...]
    weak_sigma: float
    moved: float
    alone: float

    @property
    def rank(self) -> int:
        """Rank of the normal equations: the unknowns minus the undetermined combinations."""
        return self.unknowns - len(self.undetermined)


def rank_of(setup: CalibrationSetup, campaign: Campaign) -> Rank:
    """Compute the undetermined combinations (null vectors) of one field, and apply the first of them to the sensor."""
    field_pass = campaign.passes[0]
    independent = campaign.independent
    adjustment = adjust([field_pass.control], independent.laboratory, independent.noise, gauge=GAUGE)
    loose = adjust([field_pass.control], independent.laboratory, independent.noise, gauge=Gauge(held=("nadir x",)))
    first = dict(zip(adjustment.open[0].names, adjustment.open[0].change, strict=True)) if adjustment.open else {}
    size = 1e-4 / max(abs(first.get("nadir x", 1.0)), 1e-12)
    rotation = np.array([first.get(f"{field_pass.name} {n}", 0.0) for n in BIAS]) * size
    moved, alone = [], []
    for line in LINES:
        inner = np.array([first.get(f"{line} {n}", 0.0) for n in INTERIOR]) * size
        start, both, inside = (
            np.stack(image_positions(setup, field_pass, line, a, b))
            for a, b in ((np.zeros(3), np.zeros(3)), (inner, rotation), (inner, np.zeros(3)))
        )
        moved.append(both - start)
        alone.append(inside - start)
    sizes = (rms(np.hypot(*np.concatenate(v, axis=1))) for v in (moved, alone))
    return Rank(len(adjustment.names), adjustment.open, loose.sigma["nadir y"], *sizes)


@dataclass(frozen=True, eq=False)
class Walk:
    """Comparison of the stepwise solution of a field's calibration with the simultaneous one.

    Attributes
    ----------
    steps : Stepwise
        Stepwise solution.
    together : Adjustment
        Simultaneous solution.
    distance : float
        Largest difference between the unknowns of both, in sigmas.
    after : Mapping[int, float]
        Number of rounds of the stepwise solution -> largest difference after these, sigmas.
    """

    steps: Stepwise
    together: Adjustment
    distance: float
    after: Mapping[int, float]


def walked(campaign: Campaign, field_pass: FieldPass, rounds: tuple[int, ...] = (1, 10, 100)) -> Walk:
    """Compute the stepwise and the simultaneous solution of one field, and their difference after some rounds."""
    observations = [field_pass.control], campaign.laboratory, campaign.noise
    together = adjust(*observations, gauge=GAUGE)
    free = np.array([name not in GAUGE.held for name in together.names])
    sigma = np.sqrt(np.diag(together.covariance))[free]

    def distance(solution: Stepwise) -> np.ndarray:
        return np.asarray(np.abs(solution.values - together.values)[free] / sigma)

    solution = stepwise(*observations, held=GAUGE.held, tolerance=TOLERANCE)
    after = {n: float(distance(stepwise(*observations, held=GAUGE.held, rounds=n)).max()) for n in rounds}
    return Walk(solution, together, float(distance(solution).max()), FrozenMap(after))


@dataclass(frozen=True, eq=False)
class FoundMarks:
    """Measured image positions of the bright ground targets in all image windows of one camera line.

    Attributes
    ----------
    line, pixel : np.ndarray
        (n,) image line and pixel of the n centroids.
    ground : np.ndarray
        (n, 3) true positions on the ground, ITRS, metres.
    """

    line: np.ndarray
    pixel: np.ndarray
    ground: np.ndarray


@dataclass(frozen=True, eq=False)
class _Spots:
    """Function of the position on the ground that gives the reflectance of bright targets on black ground."""

    east: np.ndarray
    north: np.ndarray

    def __call__(self, east: np.ndarray, north: np.ndarray) -> np.ndarray:
        out = np.zeros(np.shape(east))
        for a, b in zip(self.east, self.north, strict=True):
            square = (east - a) ** 2 + (north - b) ** 2
            near = square < (8.0 * _SIGMA) ** 2
            out[near] += np.exp(-0.5 * square[near] / _SIGMA**2)
        return out


def rendered_marks(setup: CalibrationSetup, campaign: Campaign, seed: np.random.SeedSequence) -> dict[str, FoundMarks]:
    """Return the bright ground targets measured in each camera line, four per window over a campaign's first field.

    They are located by their centroids.
    """
    field_pass = campaign.passes[0]
    height = setup.test.fields[field_pass.name].height
    sensors = true_sensors(setup, field_pass)
    optics = optics_of(setup.camera, LINES, setup.test.line_time, setup.detectors)
    rows: dict[str, list[FoundMarks]] = {k: [] for k in LINES}
    for k, column in enumerate(COLUMNS):
        nadir, rng = sensors["nadir"], stream(seed, k)
        point = nadir.ground(np.array([-nadir.first_line_time / nadir.line_time]), np.array([column]), height)
        lon, lat, _ = (float(np.ravel(v)[0]) for v in nadir.earth.geodetic(point))
        frame = GroundFrame(lon, lat)
        spec = TerrainSpec.model_validate({**_TERRAIN, "height": f"{height} m"})
        terrain = Terrain.fractal(spec, 3000.0, stream(rng, 0))
        shift = np.random.default_rng(stream(rng, 1)).uniform(-10.0, 10.0, (2, 4))
        east = 0.5 * _APART * np.array([-1.0, 1.0, -1.0, 1.0]) + shift[0]
        north = 0.5 * _APART * np.array([-1.0, -1.0, 1.0, 1.0]) + shift[1]
        ground = frame.itrs(east, north, terrain.height(east, north))
        middle = float(terrain.height(np.zeros(1), np.zeros(1))[0])
        scene = PushbroomScene(frame, terrain, _Spots(east, north))
        for name, sensor in sensors.items():
            window = window_of(name, sensor, frame, middle, (_SIDE, _SIDE))
            image = render_patch(sensor, optics[name], scene, window).photons
            at = np.stack([_centroid(image, *start) for start in _brightest(image, len(east))])
            at += [window.first_line, window.first_pixel]
            rows[name].append(FoundMarks(at[:, 0], at[:, 1], _matched(sensor.image(ground), at, ground)))
    return {
        k: FoundMarks(*(np.concatenate([getattr(r, part) for r in positions]) for part in ("line", "pixel", "ground")))
        for k, positions in rows.items()
    }


def missed(setup: CalibrationSetup, campaign: Campaign, marks: dict[str, FoundMarks]) -> dict[str, np.ndarray]:
    """Return the misclosures of the analysis's model at each camera line's n bright targets, (n, 2), in pixels.

    The model has the true interior orientation and bias, the measured attitude and the known ground.
    """
    field_pass = campaign.passes[0]
    out = {}
    for name, line_marks in marks.items():
        sensor, pitch = field_pass.data.sensors[name], setup.camera.pitch_of(name)
        rays = rays_at(sensor, field_pass.measured, pitch, line_marks.line, line_marks.pixel)
        out[name] = misclosure(campaign.truth[name], rays, line_marks.ground, field_pass.bias, np.zeros(3)) / pitch
    return out


def _brightest(image: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Return the brightest pixels of an image, one for each of ``count`` targets, as (row, column).

    Each is farther from the previous ones than the image of a target extends.
    """
    rest = image.copy()
    out = []
    for _ in range(count):
        row, column = (int(v) for v in np.unravel_index(int(rest.argmax()), rest.shape))
        out.append((row, column))
        rest[max(row - _HALF, 0) : row + _HALF + 1, max(column - _HALF, 0) : column + _HALF + 1] = -1.0
    return out


def _centroid(image: np.ndarray, row: int, column: int) -> np.ndarray:
    """Return the centroid (line, pixel) of all pixels that the point spread function reaches from a given pixel."""
    part = image[row - _HALF : row + _HALF + 1, column - _HALF : column + _HALF + 1]
    if part.shape != (2 * _HALF + 1,) * 2:
        raise ValueError("a mark lies too near to the window's border")
    position, total = np.arange(-_HALF, _HALF + 1), part.sum()
    return np.array([row + part.sum(axis=1) @ position / total, column + part.sum(axis=0) @ position / total])


def _matched(predicted: tuple[np.ndarray, np.ndarray], at: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Return ground points in the order of the targets found in the image.

    Targets are 60 px apart, so that the nearest predicted position is the right one.
    """
    away = np.hypot(predicted[0] - at[:, :1], predicted[1] - at[:, 1:])
    order = away.argmin(axis=1)
    if len(set(order.tolist())) != len(order):
        raise ValueError("two marks in the image are nearest to one on the ground")
    return ground[order]


@dataclass(frozen=True, eq=False)
class FromImages:
    """Calibration of one field from rendered images.

    Attributes
    ----------
    name : str
        Name of the field.
    control, check : int
        Numbers of accepted control points and check points.
    steps : Stepwise
        Stepwise solution.
    together : Adjustment
        Simultaneous solution, for sigmas.
    error : dict of str to float
        Stepwise estimate minus true value of each free unknown, radians and metres.
    covariance : ndarray
        Covariance of these unknowns, in their order.
    before, after : CheckErrors
        Errors at check points with the laboratory calibration of the camera and with the field's parameters.
    """

    name: str
    control: int
    check: int
    steps: Stepwise
    together: Adjustment
    error: dict[str, float]
    covariance: np.ndarray
    before: CheckErrors
    after: CheckErrors

    def rms(self, names: tuple[str, ...]) -> tuple[float, float]:
        """Return the RMS error of some unknowns and its standard deviation according to their covariance."""
        where = [list(self.error).index(n) for n in names]
        part = self.covariance[np.ix_(where, where)]
        # variance of a sum of squares of correlated normal errors is twice the trace of the squared covariance
        mean = float(np.trace(part)) / len(where)
        spread = float(np.sqrt(2.0 * np.trace(part @ part))) / len(where)
        value = float(np.sqrt(np.mean([self.error[n] ** 2 for n in names])))
        return value, spread / (2.0 * float(np.sqrt(mean)))


def calibrated(campaign: Campaign) -> tuple[FromImages, ...]:
    """Calibrate the camera from every field of a campaign separately."""
    return tuple(_field(campaign, field_pass) for field_pass in campaign.passes)


def matching(campaign: Campaign) -> tuple[float, int, int]:
    """Return the matching error of control points, and the numbers of accepted and of wrong matches.

    The error is the RMS of correctly matched minus true positions over lines and pixels, in pixels.
    """
    assert campaign.images is not None
    patches = [patch.judgements for field in campaign.images for patch in field.patches]
    all_lines = [line_matches for sorts in patches for lines in sorts.values() for line_matches in lines.values()]
    control = [line_matches for sorts in patches for line_matches in sorts["control"].values()]
    right = np.array([line_matches.degrees_of_freedom // 2 for line_matches in control])
    square = float(
        sum(n * np.sum(np.nan_to_num(line_matches.rms) ** 2) for n, line_matches in zip(right, control, strict=True))
    )
    rms = float(np.sqrt(square / max(2 * int(right.sum()), 1)))
    return (
        rms,
        sum(line_matches.matched for line_matches in all_lines),
        sum(line_matches.wrong_matched for line_matches in all_lines),
    )


def _field(campaign: Campaign, field_pass: FieldPass) -> FromImages:
    together = calibrated_alone(campaign, field_pass)
    steps = stepwise([field_pass.control], campaign.laboratory, campaign.noise, held=GAUGE.held, tolerance=TOLERANCE)
    free = [n for n in together.names if n not in GAUGE.held]
    error = {n: v for n, v in errors_of(campaign, field_pass, steps).items() if n not in GAUGE.held}
    where = [together.names.index(n) for n in free]
    value = dict(zip(steps.names, steps.values, strict=True))
    cameras = {
        line: camera.with_interior([value[f"{line} {k}"] for k in INTERIOR])
        for line, camera in campaign.laboratory.items()
    }
    bias = np.array([value[f"{field_pass.name} {n}"] for n in BIAS])
    after = check_point_errors(campaign, field_pass, cameras, bias)
    return FromImages(
        field_pass.name,
        int(field_pass.control.control.sum()),
        len(field_pass.check_ground),
        steps,
        together,
        error,
        together.covariance[np.ix_(where, where)],
        laboratory_errors(campaign)[field_pass.name],
        after,
    )


def summary(from_images: FromImages, names: tuple[str, ...]) -> str:
    """Return a text with the errors and sigmas of some unknowns of a field's calibration."""
    sigma = dict(zip(from_images.error, np.sqrt(np.diag(from_images.covariance)).tolist(), strict=True))
    parts = []
    for n in names:
        scale, unit, digits = (ARCSEC, "″", 2) if n in BIAS else (1e-6, " µm", 1)
        parts.append(f"{n} {from_images.error[n] / scale:+.{digits}f} ± {sigma[n] / scale:.{digits}f}{unit}")
    return f"{from_images.name}, {from_images.control} control points: {', '.join(parts)}."


@drawing("paper-003-open", 3.4)
def undetermined_svg(figure: Figure, rank: Rank, walk: Walk) -> None:
    """Draw the undetermined combination as bars, and how the stepwise solution converges over its rounds, in sigmas."""
    left, right = figure.subplots(1, 2)
    combination = rank.undetermined[0]
    names = [n if n.split()[-1] in "fxy" else n.split()[-1] for n in combination.names]
    angle = [n.split()[-1] not in "fxy" for n in combination.names]
    size = [float(c) * (_FOCAL if a else 1.0) * 1e3 for c, a in zip(combination.change, angle, strict=True)]
    position = np.arange(len(names))
    left.barh(position, size, color=[VERMILION if a else BLUE for a in angle], height=0.6)
    labels = [
        f"{c / ARCSEC:+.0f}″" if a else f"{c * 1e3:+.2f} mm" for c, a in zip(combination.change, angle, strict=True)
    ]
    for k, label in enumerate(labels):
        left.text(0.5 * size[k], k, label, ha="center", va="center", color="white", fontsize=9.0)
    left.set_yticks(position, names)
    left.set_ylim(len(names) - 0.5, -0.5)
    left.axvline(0.0, color=GREY, lw=0.8)
    left.set_xlabel("image motion of each alone [mm]")
    left.set_title(f"Together: {rank.moved:.4f} px instead of {rank.alone:.0f} px, x of 0.1 mm")
    rounds, away = list(walk.after), list(walk.after.values())
    right.loglog(rounds, away, "o-", color=BLUE, ms=5)
    right.axhline(0.1, color=GREY, lw=0.9, ls="--")
    right.text(rounds[0], 0.105, "a tenth of a sigma", color=GREY, va="bottom")
    right.set_xticks((1, 10, 100, 1000), ("1", "10", "100", "1000"))
    right.set_yticks((0.01, 0.1, 1, 10), ("0.01", "0.1", "1", "10"))
    right.minorticks_off()
    right.set_xlabel("rounds of biases, then interior")
    right.set_ylabel("farthest unknown [sigmas]")
    right.set_title("Stepwise against simultaneous solution")


@one_blas_thread()
def run(context: Context) -> Iterator[CheckResult]:
    """Yield the results of the checks of the model: with exact data, then a simulated field, then rendered images."""
    seed = np.random.SeedSequence(context.seed, spawn_key=(3, 1))
    if {"003.model", "003.equations", "003.equations.exact"} & context.selected:
        yield from _exact(context, seed)
    if {"003.model.rank", "003.model.stepwise"} & context.selected:
        yield from _simulated(context, stream(seed, 2))
    if "003.model.bias.yaw" in context.selected:
        yield _yaw(context, stream(seed, 4))
    if context.selected & {f"003.model.{name}" for name in ("points", "bias", "interior", "plan", "height")}:
        yield from _rendered(context, stream(seed, 3))


def _exact(context: Context, seed: np.random.SeedSequence) -> Iterator[CheckResult]:
    setup = exact_and_images()
    campaign = exact_campaign(setup, stream(seed, 0))
    field_pass = campaign.passes[0]
    if "003.model" in context.selected:
        context.progress(0.02, "render marks")
        misses = missed(setup, campaign, rendered_marks(setup, campaign, stream(seed, 1)))
        largest = {line: np.abs(miss).max() for line, miss in misses.items()}
        facts: dict[str, Any] = {
            "marks": sum(map(len, misses.values())),
            "largest": {line: f"{miss:.4f} px" for line, miss in largest.items()},
            "mean": max(float(np.abs(miss.mean(axis=0)).max()) for miss in misses.values()),
        }
        yield context.row("003.model", max(largest.values()), implied=0.0, **facts)
    if "003.equations" in context.selected:
        line, name, worst = derivatives(setup, field_pass, field_pass.bias)
        yield context.row("003.equations", worst, implied=0.0, field_pass=field_pass, name=name, line=line)
    if "003.equations.exact" in context.selected:
        worst, name = recovered(campaign, setup.camera.pitch)
        yield context.row("003.equations.exact", worst, implied=0.0, field_pass=field_pass, name=name)


def _simulated(context: Context, seed: np.random.SeedSequence) -> Iterator[CheckResult]:
    setup = without_light(setup_of(FIELDS, (FIELD,)))
    campaign = source_of(setup, seed).independent
    if "003.model.rank" in context.selected:
        rank = rank_of(setup, campaign)
        facts: dict[str, Any] = {
            "simulated": rank,
            "combinations": "; ".join(str(o) for o in rank.undetermined),
            "pixels": rank.weak_sigma / setup.camera.pitch,
        }
        yield context.row("003.model.rank", rank.rank, None, float(UNKNOWNS), [UNKNOWNS - 1.0], **facts)
        context.figure("open", undetermined_svg(rank, walked(campaign, campaign.passes[0], ROUNDS)))
    if "003.model.stepwise" in context.selected:
        walk = walked(campaign, campaign.passes[0])
        after = ", ".join(f"{v:.1f} after {n}" for n, v in walk.after.items())
        facts = {"field": FIELD, "tolerance": TOLERANCE, "walk": walk, "after": after}
        yield context.row("003.model.stepwise", walk.distance, implied=0.0, **facts)


def image_setup(fast: bool) -> CalibrationSetup:
    """Return the fields of rendered images; the fast run has one field with fewer points."""
    setup = setup_of(IMAGES, (FIELD,) if fast else (FIELD, "Anhui"))
    if not fast:
        return setup
    spec = setup.test.images
    assert isinstance(spec, CalibrationImagesSpec)
    points = spec.points.model_copy(update={"tie": 0})
    small = spec.model_copy(update={"lines": FAST_SIDE, "pixels": FAST_SIDE, "points": points})
    return setup.model_copy(update={"test": setup.test.model_copy(update={"images": small})})


def _yaw(context: Context, seed: np.random.SeedSequence) -> CheckResult:
    setup, count = without_light(setup_of(FIELDS)), context.count(CAMPAIGNS, FAST_CAMPAIGNS)
    ratios, sigmas = [], []
    for k in range(count):
        context.progress(0.1 + 0.05 * k / count, f"fly campaign {k + 1} of {count}")
        campaign = source_of(setup, stream(seed, k)).independent
        for field_pass in campaign.passes:
            adjustment = calibrated_alone(campaign, field_pass)
            sigmas.append(adjustment.sigma[f"{field_pass.name} yaw"])
            ratios.append((adjustment.bias(field_pass.name) - field_pass.bias)[BIAS.index("yaw")] / sigmas[-1])
    facts: dict[str, Any] = {"ratios": ratios, "sigmas": sigmas}
    return context.row("003.model.bias.yaw", rms(ratios), float(np.sqrt(0.5 / len(ratios))), 1.0, **facts)


def _rendered(context: Context, seed: np.random.SeedSequence) -> Iterator[CheckResult]:
    setup = image_setup(context.fast)

    def progress(_: str, done: int, total: int) -> None:
        context.progress(0.15 + 0.8 * done / total, "render patches and match points")

    campaign = source_of(setup, seed, progress)
    fields = calibrated(campaign)
    spec = setup.test.images
    assert spec is not None
    count = f"{len(fields)} field{'s' * (len(fields) > 1)} of {len(spec.patches)}"
    facts: dict[str, Any] = {"fields": count, "spec": spec, "images": 3 * len(fields) * len(spec.patches)}
    if "003.model.points" in context.selected:
        error, matched, wrong = matching(campaign)
        limit = setup_of(FIELDS).test.errors.image
        yield context.row("003.model.points", error, None, limit, matched=matched, wrong=wrong, **facts)
    facts["rounds"] = ", ".join(str(f.steps.rounds) for f in fields)
    for row, names, unit in (("bias", ROLL_PITCH, ARCSEC), ("interior", FREE_INTERIOR, 1e-6)):
        worst, sigma = (value / unit for value in max(f.rms(names) for f in fields))
        errors = " ".join(summary(f, names) for f in fields)
        yield context.row(f"003.model.{row}", worst, sigma, inputs=[all_errors(worst)], errors=errors, **facts)
    for what in ("plan", "height"):
        field = max(fields, key=lambda f: getattr(f.after, f"{what}_rms"))
        error, before = (float(getattr(e, f"{what}_rms")) for e in (field.after, field.before))
        sigma, limit = error / float(np.sqrt(2.0 * field.check)), getattr(setup.test.limits, what)
        inputs = [all_errors(error)]
        yield context.row(f"003.model.{what}", error, sigma, limit, (), inputs, field=field, before=before, **facts)
    rows = []
    for f in fields:
        deviations = np.sqrt(np.diag(f.covariance))
        for k, (name, off) in enumerate(f.error.items()):
            called, scale = ("arcsec", ARCSEC) if name in BIAS else ("µm", 1e-6)
            rows.append((f.name, name, called, off / scale, float(deviations[k]) / scale))
    context.table("images", rows)


GROUP = group_of("003.model", run)
