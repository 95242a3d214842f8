"""Marks on the ground and matched points in rendered images, for the checks of paper 003."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import Adjustment
from analysis.calibration.strip_adjustment import Stepwise, stepwise
from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.three_line_model import BIAS, INTERIOR, misclosure
from scenes.specs.orbit.angle import LINES
from scenes.specs.orbit.scene import TerrainSpec
from scenes.specs.orbit.setup import CalibrationSetup
from twin.orbit.calibration.calibration_run import source_of
from twin.orbit.calibration.campaign import Campaign, FieldPass
from twin.orbit.calibration.campaign_adjustment import GAUGE, calibrated_alone
from twin.orbit.calibration.schemes import tested, tested_before
from twin.orbit.ground.grid import GroundFrame, Terrain
from twin.orbit.images.line_optics import optics_of
from twin.orbit.images.patch import window_of
from twin.orbit.images.pushbroom import MARGIN, PushbroomScene, render_patch
from twin.run.random_streams import stream
from twin.validation.paper_003.exact import TOLERANCE, errors_of, rays_at, true_sensors

PLACES = (700.0, 6000.0, 11300.0)
"""Pixels of the nadir line, whose 12 000 see the swath, that see the middles of the windows."""
_SIDE = 190
_SIGMA = 2.5
"""Metres: of a mark, half a pixel. The terrain's curvature under it moves its centroid by 0.004 px at most."""
_APART = 300.0
_REACH = MARGIN + 4
_TERRAIN: dict[str, object] = {"kind": "fractal", "relief": "30 m", "exponent": 2.4}
Advance = Callable[[float], None]
ROLL_PITCH = BIAS[:2]
FREE_INTERIOR = tuple(n for n in (f"{line} {k}" for line in LINES for k in INTERIOR) if n not in GAUGE.held)


@dataclass(frozen=True, eq=False)
class FoundMarks:
    """Marks of all windows of one line.

    Attributes:
        line, pixel: (n,) of their centroids. ground: (n, 3) true places, ITRS, metres.
    """

    line: np.ndarray
    pixel: np.ndarray
    ground: np.ndarray


@dataclass(frozen=True, eq=False)
class _Spots:
    """Apparent reflectance of bright marks on black ground."""

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
    """Line -> its marks, four in each window over the first field of a campaign, found by their centroids."""
    one = campaign.passes[0]
    height = setup.test.fields[one.name].height
    sensors = true_sensors(setup, one)
    optics = optics_of(setup.camera, LINES, setup.test.line_time, setup.detectors)
    rows: dict[str, list[FoundMarks]] = {k: [] for k in LINES}
    for k, place in enumerate(PLACES):
        nadir, own = sensors["nadir"], stream(seed, k)
        point = nadir.ground(np.array([-nadir.first_line_time / nadir.line_time]), np.array([place]), height)
        lon, lat, _ = (float(np.ravel(v)[0]) for v in nadir.earth.geodetic(point))
        frame = GroundFrame(lon, lat)
        spec = TerrainSpec.model_validate({**_TERRAIN, "height": f"{height} m"})
        terrain = Terrain.fractal(spec, 3000.0, stream(own, 0))
        shift = np.random.default_rng(stream(own, 1)).uniform(-10.0, 10.0, (2, 4))
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
        k: FoundMarks(*(np.concatenate([getattr(r, part) for r in found]) for part in ("line", "pixel", "ground")))
        for k, found in rows.items()
    }


def missed(setup: CalibrationSetup, campaign: Campaign, marks: dict[str, FoundMarks]) -> dict[str, np.ndarray]:
    """Line -> (n, 2) misclosure of the analysis's model at the marks, pixels: with the true interior and bias, the
    measured attitude and the known ground.
    """
    one = campaign.passes[0]
    out = {}
    for name, found in marks.items():
        sensor, pitch = one.data.sensors[name], setup.camera.pitch_of(name)
        rays = rays_at(sensor, one.measured, pitch, found.line, found.pixel)
        out[name] = misclosure(campaign.truth[name], rays, found.ground, one.bias, np.zeros(3)) / pitch
    return out


def _brightest(image: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Brightest pixels, each farther from the ones before than a mark's image reaches."""
    rest = image.copy()
    out = []
    for _ in range(count):
        row, column = (int(v) for v in np.unravel_index(int(rest.argmax()), rest.shape))
        out.append((row, column))
        rest[max(row - _REACH, 0) : row + _REACH + 1, max(column - _REACH, 0) : column + _REACH + 1] = -1.0
    return out


def _centroid(image: np.ndarray, row: int, column: int) -> np.ndarray:
    """Centroid of all pixels within the reach of the point spread function from a pixel."""
    part = image[row - _REACH : row + _REACH + 1, column - _REACH : column + _REACH + 1]
    if part.shape != (2 * _REACH + 1,) * 2:
        raise ValueError("a mark lies too near to the window's border")
    place, total = np.arange(-_REACH, _REACH + 1), part.sum()
    return np.array([row + part.sum(axis=1) @ place / total, column + part.sum(axis=0) @ place / total])


def _matched(predicted: tuple[np.ndarray, np.ndarray], at: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Ground points in the order of the marks found; marks lie 60 px apart, so that the nearest is meant."""
    away = np.hypot(predicted[0] - at[:, :1], predicted[1] - at[:, 1:])
    order = away.argmin(axis=1)
    if len(set(order.tolist())) != len(order):
        raise ValueError("two marks in the image are nearest to one on the ground")
    return ground[order]


@dataclass(frozen=True, eq=False)
class FromImages:
    """One field.

    Attributes:
        name: of it.
        control, check: points that are left.
        way: the stepwise solution. together: the simultaneous one, for sigmas.
        error: unknown -> stepwise estimate minus truth, radians and metres; free ones only.
        covariance: of these, in their order.
        before, after: errors at check points with the laboratory's camera and with the field's parameters.
    """

    name: str
    control: int
    check: int
    way: Stepwise
    together: Adjustment
    error: dict[str, float]
    covariance: np.ndarray
    before: CheckErrors
    after: CheckErrors

    def rms(self, names: tuple[str, ...]) -> tuple[float, float]:
        """RMS error of some unknowns and the standard deviation of that, by their covariance."""
        where = [list(self.error).index(n) for n in names]
        part = self.covariance[np.ix_(where, where)]
        # variance of a sum of squares of correlated normal errors is twice the trace of the squared covariance
        mean = float(np.trace(part)) / len(where)
        spread = float(np.sqrt(2.0 * np.trace(part @ part))) / len(where)
        found = float(np.sqrt(np.mean([self.error[n] ** 2 for n in names])))
        return found, spread / (2.0 * float(np.sqrt(mean)))


def measured(setup: CalibrationSetup, seed: np.random.SeedSequence, advance: Advance) -> Campaign:
    """Render the fields and match their points; what the adjustment rejects is left out."""

    def progress(_: str, done: int, total: int) -> None:
        advance(done / total)

    return source_of(setup, seed, progress)


def calibrated(campaign: Campaign) -> tuple[FromImages, ...]:
    """Every field by itself."""
    return tuple(_field(campaign, one) for one in campaign.passes)


def matching(campaign: Campaign) -> tuple[float, int, int]:
    """RMS of right places of control points against the truth over lines and pixels, px; places of all points that
    pass the matching, and those of them that are wrong by truth.
    """
    assert campaign.images is not None
    patches = [patch.judgements for field in campaign.images for patch in field.patches]
    every = [one for sorts in patches for lines in sorts.values() for one in lines.values()]
    control = [one for sorts in patches for one in sorts["control"].values()]
    right = np.array([one.degrees_of_freedom // 2 for one in control])
    square = float(sum(n * np.sum(np.nan_to_num(one.rms) ** 2) for n, one in zip(right, control, strict=True)))
    rms = float(np.sqrt(square / max(2 * int(right.sum()), 1)))
    return rms, sum(one.matched for one in every), sum(one.wrong_matched for one in every)


def _field(campaign: Campaign, one: FieldPass) -> FromImages:
    together = calibrated_alone(campaign, one)
    way = stepwise([one.control], campaign.laboratory, campaign.noise, held=GAUGE.held, tolerance=TOLERANCE)
    free = [n for n in together.names if n not in GAUGE.held]
    error = {n: v for n, v in errors_of(campaign, one, way).items() if n not in GAUGE.held}
    where = [together.names.index(n) for n in free]
    value = dict(zip(way.names, way.values, strict=True))
    cameras = {
        line: camera.with_interior([value[f"{line} {k}"] for k in INTERIOR])
        for line, camera in campaign.laboratory.items()
    }
    bias = np.array([value[f"{one.name} {n}"] for n in BIAS])
    after = tested(campaign, one, cameras, bias)
    return FromImages(
        one.name,
        int(one.control.control.sum()),
        len(one.check_ground),
        way,
        together,
        error,
        together.covariance[np.ix_(where, where)],
        tested_before(campaign)[one.name],
        after,
    )


def summary(found: FromImages, names: tuple[str, ...]) -> str:
    """Errors and sigmas of some unknowns of a field, in words."""
    sigma = dict(zip(found.error, np.sqrt(np.diag(found.covariance)).tolist(), strict=True))
    parts = []
    for n in names:
        scale, unit, digits = (ARCSEC, "″", 2) if n in BIAS else (1e-6, " µm", 1)
        parts.append(f"{n} {found.error[n] / scale:+.{digits}f} ± {sigma[n] / scale:.{digits}f}{unit}")
    return f"{found.name}, {found.control} control points: {', '.join(parts)}."
