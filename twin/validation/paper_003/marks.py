"""Marks on the ground, rendered through the true sensors of all lines and found again in the images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.orbit.three_line_model import misclosure
from scenes.orbit_angle import LINES
from scenes.orbit_scene import TerrainSpec
from scenes.orbit_setup import CalibrationSetup
from twin.orbit.calibration.campaign import Campaign
from twin.orbit.ground.frame import GroundFrame
from twin.orbit.ground.random_field import stream
from twin.orbit.ground.terrain import Terrain
from twin.orbit.images.camera_optics import optics_of
from twin.orbit.images.patch import window_of
from twin.orbit.images.pushbroom import MARGIN, PushbroomScene, render_patch
from twin.validation.paper_003.exact import rays_at
from twin.validation.paper_003.setups import true_sensors

PLACES = (700.0, 6000.0, 11300.0)
"""Pixels of the nadir line, whose 12 000 see the swath, that see the middles of the windows."""
_SIDE = 190
_SIGMA = 2.5
"""Metres: of a mark, half a pixel. The terrain's curvature under it moves its centroid by 0.004 px at most."""
_APART = 300.0
_REACH = MARGIN + 4
_TERRAIN: dict[str, object] = {"kind": "fractal", "relief": "30 m", "exponent": 2.4}


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
    """Of all within the reach of the point spread function from a pixel."""
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
