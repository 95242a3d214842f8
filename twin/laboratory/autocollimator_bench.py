"""Two autocollimators that look at two mirrors on a turntable: the bench with its errors, and its readings from images.

The bench's errors are motions of bodies. They are drawn from the seed and applied to the scene alone: the analysis
reads the frames with the calibration of the ideal autocollimator and the angles that the turntable and the mirrors
*should* have. Each series begins with a reading at zero that is taken off all others, and its first row is a
second reading at zero, which shows the unrest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import autocollimator
from analysis.spots.centroid import energy_centroid, mean_frames
from analysis.spots.spot_positions import SpotPositions
from optics.geometry.pose import rotation_matrix
from optics.geometry.tree import Motion, State
from optics.numerics.backend import Backend
from scenes.models.autocollimator_model import UNITS, autocollimator_body, axis_body, build_bench, ccd_body, mirror_body
from scenes.specs.autocollimators import AutocollimatorSetup, AutocollimatorTestSpec
from twin.laboratory.autocollimator_images import AutocollimatorPath, SpotWindows, window_pattern
from twin.sensors.area_detector import EmvaDetector


@dataclass(frozen=True)
class Series:
    """One series: axis X, Y or Z of system 1-XYZ, half angle theta between the mirrors and step, radians, and number of
    steps after the first reading at zero.
    """

    axis: str
    half_angle: float
    step: float
    steps: int

    @property
    def angles(self) -> np.ndarray:
        """Turns of the table as commanded, (steps + 1,), radians."""
        return self.step * np.arange(self.steps + 1)

    @property
    def stream(self) -> tuple[int, int, int]:
        """Number of its random streams: a series draws the same whichever others are run with it."""
        return autocollimator.AXES.index(self.axis), round(self.half_angle / ARCSEC), round(1e3 * self.step / ARCSEC)


@dataclass(frozen=True, eq=False)
class SeriesResult:
    """Readings of one series.

    Attributes:
        series: what was turned.
        readings: (2 mirrors, rows, 2) turns about each autocollimator's own X and Y against its reading at zero,
            radians.
        sigma: (2, rows, 2) their standard deviations by the noise of the images alone, radians.
    """

    series: Series
    readings: np.ndarray
    sigma: np.ndarray

    @property
    def scale(self) -> float:
        """What mirror 2 is multiplied with: 1 (X), 1 / cos b (Y), 1 / sin b (Z)."""
        return 1.0 / autocollimator.relation_factor(self.series.axis, 2, 2.0 * self.series.half_angle)

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Mirror 1 and scaled mirror 2, (rows,) each, radians."""
        component = autocollimator.column_component(self.series.axis)
        return self.readings[0, :, component], self.scale * self.readings[1, :, component]

    @property
    def mean_difference(self) -> float:
        """Mean size, radians, of mirror 1 - scaled mirror 2; about Z, where mirror 1 shows nothing, of the turntable -
        scaled mirror 2.
        """
        first, second = self.columns
        return autocollimator.mean_difference(self.series.angles if self.series.axis == "Z" else first, second)

    @property
    def from_exact(self) -> np.ndarray:
        """Readings minus those of ideal mirrors, lens and turntable to all orders, (2, rows, 2), radians."""
        args = self.series.axis, self.series.angles
        return self.readings - np.stack(
            [autocollimator.exact_reading(*args, u, 2.0 * self.series.half_angle) for u in UNITS]
        )


@dataclass(frozen=True, eq=False)
class ReadingTable:
    """All series of one run of the experiment, and the seed that its errors and noise come from."""

    results: tuple[SeriesResult, ...]
    seed: int

    def __getitem__(self, axis: str) -> SeriesResult:
        """The first series about that axis. Raises KeyError if there is none."""
        for result in self.results:
            if result.series.axis == axis:
                return result
        raise KeyError(axis)


AIRY_RADII = 4.0
"""Radius of the centroid's window in radii of the first dark ring."""
CALIBRATION_POINTS = 9
"""Turns about each axis at which an autocollimator is calibrated."""
DRAWS = 4000
"""Benches without images from which a spread is taken."""
_BENCH, _PATTERN, _READINGS, _FRAMES = range(4)
"""Numbers of the seed's random streams."""


def series_per_axis(spec: AutocollimatorTestSpec) -> tuple[Series, ...]:
    """The main series: one about each axis."""
    p = spec.programme
    return tuple(Series(axis, getattr(p.stands, axis), p.table, p.steps) for axis in autocollimator.AXES)


def run_autocollimator_test(
    setup: AutocollimatorSetup,
    backend: Backend,
    series: Sequence[Series] | None = None,
    seed: int = 0,
    ideal: bool = False,
    reader: Reader | None = None,
    progress: Callable[[str], None] | None = None,
) -> ReadingTable:
    """Render and read the experiment.

    Args:
        setup: the experiment with its detector.
        backend: where to trace.
        series: what to turn; by default one series about each axis. Those of one half angle are traced together.
        seed: of the bench's errors and the detectors' noise.
        ideal: no errors of the bench, and images without noise or rounding.
        reader: of an earlier run of the same setup, to save the calibration.
        progress: told what is being done.

    Raises:
        BeamMissedError: a turn takes a spot off its area CCD.
    """
    wanted = tuple(series_per_axis(setup.spec) if series is None else series)
    say = progress or (lambda text: None)
    if reader is None:
        say("calibrate the autocollimators")
        reader = Reader(setup, backend)
    done: dict[Series, SeriesResult] = {}
    for half_angle in dict.fromkeys(s.half_angle for s in wanted):
        say(f"mirrors {2.0 * np.degrees(half_angle):.4g} deg apart")
        group = [s for s in wanted if s.half_angle == half_angle]
        states = [state for s in group for state in states_of(setup.spec, s, None if ideal else seed)]
        windows = reader.path(half_angle).windows(states)
        first = 0
        for s in group:
            part = slice(first, first + s.steps + 2)
            first = part.stop
            own = SpotWindows(windows.photons[:, part], windows.corner[:, part])
            done[s] = reader.read(s, own, None if ideal else seed)
    return ReadingTable(tuple(done[s] for s in wanted), seed)


def states_of(spec: AutocollimatorTestSpec, series: Series, seed: int | None) -> list[State]:
    """The reading at zero and all rows of a series as states of the bench, with errors drawn from the seed.

    Errors of the bench are the same in all series of a seed, except how the mirrors are mounted: they are set anew for
    every half angle. ``seed`` None is the ideal bench.
    """
    e = spec.errors
    on = 0.0 if seed is None else 1.0
    bench, mounts, readings = (
        np.random.default_rng(np.random.SeedSequence(seed or 0, spawn_key=key))
        for key in ((_BENCH,), (_BENCH, series.stream[1]), (_READINGS, *series.stream))
    )
    growth = on * e.focal_length * bench.standard_normal(2)
    roll = on * e.ccd_rotation * bench.standard_normal(2)
    tilts = on * e.axis_tilt * bench.standard_normal((3, 3))
    mount = on * e.mirror_mount * mounts.standard_normal((2, 2))
    # the table does not move between the reading at zero and the first row
    angles = np.concatenate([[0.0], series.angles])
    angles[2:] += on * e.turntable_step * readings.standard_normal(series.steps)
    unrest = on * e.reading * readings.standard_normal((len(angles), 2, 2))
    k = autocollimator.AXES.index(series.axis)
    axis = np.where(np.arange(3) == k, 1.0, tilts[k])
    axis = axis / np.linalg.norm(axis)
    out: list[State] = []
    for i, angle in enumerate(angles):
        state = {axis_body(series.axis): Motion(rotate=_triple(angle * axis))}
        for n, unit in enumerate(UNITS):
            turn = _triple((*unrest[i, n], 0.0))
            state[autocollimator_body(unit)] = Motion(rotate=turn, scale=float(growth[n]))
            state[ccd_body(unit)] = Motion(rotate=(0.0, 0.0, float(roll[n])))
            state[mirror_body(unit)] = Motion(rotate=_triple((*mount[n], 0.0)))
        out.append(state)
    return out


def declared_spread(
    spec: AutocollimatorTestSpec, series: Series, image_sigma: float, draws: int = DRAWS, seed: int = 0
) -> np.ndarray:
    """Mean differences of a series, (draws,), radians, under the errors that the scene declares, without images.

    Args:
        spec: the experiment.
        series: one of its series.
        image_sigma: standard deviation of one reading by the noise of the images, radians.
        draws: number of benches.
        seed: of the draws.
    """
    e, rng = spec.errors, np.random.default_rng(seed)
    between = 2.0 * series.half_angle
    angles = np.broadcast_to(series.angles, (draws, series.steps + 1)).copy()
    angles[:, 1:] += e.turntable_step * rng.standard_normal((draws, series.steps))
    k = autocollimator.AXES.index(series.axis)
    axis = np.where(np.arange(3) == k, 1.0, e.axis_tilt * rng.standard_normal((draws, 3)))
    turn = rotation_matrix(angles[..., None] * (axis / np.linalg.norm(axis, axis=1, keepdims=True))[:, None])
    columns = []
    for unit in UNITS:
        frame = rotation_matrix(np.array([between if unit == 2 else 0.0, 0.0, 0.0]))
        mount = rotation_matrix(e.mirror_mount * rng.standard_normal((draws, 3)) * [1.0, 1.0, 0.0])
        start = mount @ np.array([0.0, 0.0, -1.0])
        normal = np.einsum("xi,drxy,yj,dj->dri", frame, turn, frame, start, optimize=True)
        reading = autocollimator.reading_of_normal(normal) - autocollimator.reading_of_normal(start)[:, None]
        roll = rotation_matrix(e.ccd_rotation * rng.standard_normal((draws, 1)) * [0.0, 0.0, 1.0])[:, :2, :2]
        reading = np.einsum("dij,drj->dri", roll, reading)[..., autocollimator.column_component(series.axis)]
        reading *= 1.0 + e.focal_length * rng.standard_normal((draws, 1))
        # the reading at zero is common to all rows; image_sigma already holds its share
        unrest = e.reading * rng.standard_normal((draws, series.steps + 2))
        reading += unrest[:, 1:] - unrest[:, :1] + image_sigma * rng.standard_normal(reading.shape)
        columns.append(reading)
    first = series.angles if series.axis == "Z" else columns[0]
    return np.asarray(
        np.mean(np.abs(first - columns[1] / autocollimator.relation_factor(series.axis, 2, between)), axis=1)
    )


def _triple(vector: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


class Reader:
    """Detectors and calibration of the two autocollimators, which are alike.

    Args:
        setup: the experiment with its detector.
        backend: where to trace.

    Attributes:
        map: the calibration, from the place of a spot to the turn of the mirror.
    """

    def __init__(self, setup: AutocollimatorSetup, backend: Backend) -> None:
        self.spec = setup.spec
        self.backend = backend
        self.exposure: float = setup.spec.autocollimator.area_ccd.exposure
        self.detector = EmvaDetector.from_sheet(setup.detector, self.exposure)
        self._paths: dict[float, AutocollimatorPath] = {}
        self.map = self._calibrate()

    def path(self, half_angle: float) -> AutocollimatorPath:
        """Light path with the mirrors 2 theta apart."""
        if half_angle not in self._paths:
            self._paths[half_angle] = AutocollimatorPath(build_bench(self.spec, half_angle), self.backend)
        return self._paths[half_angle]

    def _calibrate(self) -> autocollimator.ReadingMap:
        """Calibration of the ideal autocollimator by noise-free images of known turns about X and Y together."""
        p = self.spec.programme
        reach = 1.02 * max(p.small, p.table, p.large) * p.steps
        turns = np.linspace(-reach, reach, CALIBRATION_POINTS)
        known = np.stack([*np.meshgrid(turns, turns, indexing="ij"), np.zeros((len(turns),) * 2)], -1).reshape(-1, 3)
        windows = self.path(p.narrow).windows([{axis_body("X"): Motion(rotate=_triple(turn))} for turn in known])
        photons, corner = windows.photons[0], windows.corner[0]
        place, _ = self.place(self.detector.expected_dn(photons, self.exposure), corner)
        return autocollimator.ReadingMap.fit(
            place, autocollimator.reading_of_normal(rotation_matrix(known) @ np.array([0.0, 0.0, -1.0]))
        )

    def place(self, mean: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, SpotPositions]:
        """Spots (B, 2) on the whole CCD, (row, column) px, from mean windows (B, H, W) and their corners (B, 2)."""
        bench = self.path(self.spec.programme.narrow).bench
        airy = 0.61 * self.spec.autocollimator.wavelength / bench.numerical_aperture
        noise = self.detector.noise_model(self.exposure)
        radius = min(AIRY_RADII * airy / self.spec.autocollimator.area_ccd.pitch, 0.4 * mean.shape[-1])
        spots = energy_centroid(mean, self.spec.autocollimator.frames, noise, radius, keep_maps=False)
        return spots.position + corner, spots

    def expose(self, windows: SpotWindows, stream: tuple[int, ...], seed: int) -> np.ndarray:
        """Frames of both CCDs, uint16 (2, S, frames, window, window)."""
        out = []
        for n, (photons, corner) in enumerate(zip(windows.photons, windows.corner, strict=True)):
            pattern = window_pattern(self.detector, corner, photons.shape[-1], seed, (_PATTERN, n))
            noise = np.random.SeedSequence(seed, spawn_key=(_FRAMES, n, *stream))
            out.append(self.detector.expose(photons, pattern, self.spec.autocollimator.frames, self.exposure, noise))
        return np.stack(out)

    def read(self, series: Series, windows: SpotWindows, seed: int | None) -> SeriesResult:
        """Read the mirrors' turns from the images of a series that begins with the reading at zero."""
        if seed is None:
            mean = self.detector.expected_dn(windows.photons, self.exposure)
        else:
            mean = mean_frames(self.expose(windows, series.stream, seed))
        place, spots = self.place(mean.reshape(-1, *mean.shape[2:]), windows.corner.reshape(-1, 2))
        shape = windows.corner.shape
        turns = self.map(place).reshape(shape)
        variance = np.einsum("bkk->bk", self.map.covariance(place, spots.covariance)).reshape(shape)
        return SeriesResult(series, turns[:, 1:] - turns[:, :1], np.sqrt(variance[:, 1:] + variance[:, :1]))
