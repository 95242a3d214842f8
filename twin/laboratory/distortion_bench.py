"""The bench of the distortion test: a camera on a turntable looks at a pinhole in a collimator.

The transfer function of an image about its chief ray changes slowly over the field. So its product with the pinhole's
spectrum and the line CCD's transfer is worked out at a few Chebyshev nodes and interpolated by the polynomial through
them. An image is then a Fourier sum at the pixel centres, shifted exactly.

World = camera frame. When the table turns by W the light's direction turns by +W about the table's axis, the camera's
X but for a tilt: from (0, 0, -1) to (0, sin W, -cos W), whose image lies at L = +f tan W along the line. W counts from
the true angle of the table at which the as-built camera images the pinhole to the middle of the line. The image is read
out where the line's scan sees it: over the field its rows drift by the smile of the mapping.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from analysis.spots.noise import NoiseModel
from optics.geometry.pose import rotation_matrix
from optics.geometry.tree import State
from optics.geometry.vector_shape import Disk, Polygon
from optics.numerics.backend import Backend, one_blas_thread
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from optics.targets.target_shapes import Target, pinhole
from optics.waves.optical_transfer import TransferTable, transfer
from optics.waves.pupil_stack import PupilFunction
from scenes.models.camera_model import ROOT, build_camera_under_test
from scenes.specs.resolved import DistortionSetup
from twin.framework.procedure import Advance, BenchError, silent
from twin.framework.random_streams import stream
from twin.laboratory.turntable_run import TurntableModel
from twin.sensors.line_ccd import LineCcd, band_wavelengths
from twin.targets.target_path import TargetPath

NODES = 10
"""Chebyshev nodes over the field: images of gf7 between them are right to 1e-5 of their peak, their centres to 1 nm."""

GUARD = 160.0
"""Distance between the window and the copies of the spot in the Fourier sum, in units of 1/cut-off. The irradiance of a
clear pupil falls as 1/distance^3: over the pan line's window a copy is below 1e-6 of the peak, and nearly even.
"""

_RIM = np.pi * np.arange(16) / 16


@dataclass(frozen=True, eq=False)
class PinholeImages:
    """Spots of a pinhole over the field.

    Attributes
    ----------
    reach : float
        Largest turn of the camera either way, radians.
    fx, fy : np.ndarray
        Frequencies along the line (half of them, from zero) and along the track, (U,), (V,), cycles/m.
    spectra : np.ndarray
        At the nodes over the field, complex (nodes, V, U); a wide bright area would have level 1.
    pitch : float
        Of the pixels, metres.
    window : int
        Pixels of an image either way.
    diameter : float
        Of the pinhole's geometric image along the line in the middle of the field, metres.
    """

    reach: float
    fx: np.ndarray
    fy: np.ndarray
    spectra: np.ndarray
    pitch: float
    window: int
    diameter: float

    @classmethod
    def build(
        cls,
        path: TargetPath,
        state: State,
        directions: Callable[[np.ndarray], np.ndarray],
        reach: float,
        target: Target,
        ccd: LineCcd,
        window: int,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> PinholeImages:
        """Work out the spectra.

        Parameters
        ----------
        path : TargetPath
            From the target to the line CCD's plane.
        state : State
            Of the camera.
        directions : Callable[[np.ndarray], np.ndarray]
            Turns of the camera (M,) to directions of the light (M, 3), world.
        reach : float
            Of the turns, radians.
        target : Target
            The pinhole, one disk.
        ccd : LineCcd
            The line CCD.
        window : int
            pixels.
        progress : Callable[[int, int], None]
            Told (done, total).

        Raises
        ------
        BeamMissedError, AimError, ValueError
            The beam does not get through, or its wavefront is too bad for a fit.
        """
        light = directions(reach * _nodes())
        pupils = path.pupils(state, light, path.places(state, light))
        wavelengths, weights = band_wavelengths(ccd.band)
        rim = np.stack([np.cos(_RIM), np.sin(_RIM)], axis=-1)
        cutoff = max(float(np.max(pupil.cutoff(rim, wavelengths[0]))) for pupil in pupils)
        pitch = ccd.band.pitch
        period = window * pitch + GUARD / cutoff
        most = int(cutoff * period)
        fx, fy = np.arange(most + 1) / period, np.arange(-most, most + 1) / period
        grid = fx, fy[:, None]
        # frequencies below zero are the conjugates of those above
        common = ccd.transfer(*grid) * np.where(fx > 0.0, 2.0, 1.0) / period**2
        ((_, hole),) = target.parts
        assert isinstance(hole, Disk)
        spectra, middle = np.empty((NODES, len(fy), len(fx)), complex), 0.0
        for n, (pupil, one) in enumerate(zip(pupils, light, strict=True)):
            image = hole.mapped(path.local_map(state, one, 1.5 * hole.radius))
            table = TransferTable.build(pupil, wavelengths, weights)
            spectra[n] = image.spectrum(*grid) * table(*grid) * common
            middle = _width(image) if n == NODES // 2 else middle
            progress(n + 1, NODES)
        return cls(reach, fx, fy, spectra, pitch, window, middle)

    def __call__(self, turn: float, place: np.ndarray) -> np.ndarray:
        """Images at one place of the field.

        Parameters
        ----------
        turn : float
            Of the camera, radians.
        place : np.ndarray
            Of the chief rays from the centre of the window's first pixel, (S, 2) (along, across), metres.

        Returns
        -------
        np.ndarray
            (S, window, window), rows along the track.
        """
        spectrum = np.tensordot(_share(turn / self.reach), self.spectra, 1)
        pixel = self.pitch * np.arange(self.window)
        along = np.exp(2j * np.pi * self.fx[:, None, None] * (pixel - place[:, :1]))
        across = np.exp(2j * np.pi * (pixel - place[:, 1:])[..., None] * self.fy)
        with one_blas_thread():
            half = (spectrum @ along.reshape(len(self.fx), -1)).reshape(len(self.fy), len(place), self.window)
            return np.asarray((across @ half.swapaxes(0, 1)).real)

    @property
    def width(self) -> float:
        """Diameter of the pinhole's geometric image along the line, pixels."""
        return self.diameter / self.pitch


def centroid_offset(path: TargetPath, state: State, directions: np.ndarray) -> np.ndarray:
    """Energy centroid of the image of a point minus its chief ray along the line, (F,), metres: the mean slope of the
    wavefront over the pupil, which is the same for all wavelengths.

    From the phase of the transfer function at a ten-thousandth of the cut-off.
    """
    pupils: tuple[PupilFunction, ...] = path.pupils(state, directions, path.places(state, directions))
    wavelength, along = path.model.spec.wavelength, np.array([[1.0, 0.0]])
    out = []
    for pupil in pupils:
        frequency = 1e-4 * float(pupil.cutoff(along, wavelength)[0])
        phase = np.angle(transfer(pupil, frequency * along, wavelength, np.zeros(1))[0, 0])
        out.append(-phase / (2.0 * np.pi * frequency))
    return np.array(out)


def at_nodes(reach: float) -> np.ndarray:
    """Turns (NODES,) at which something smooth over the field is worked out for ``between``, radians."""
    return np.asarray(reach * _nodes())


def between(values: np.ndarray, reach: float, turn: np.ndarray) -> np.ndarray:
    """Values (M,) at turns (M,) of the polynomial through values (NODES,) at the nodes."""
    return np.array([_share(one / reach) @ values for one in turn])


def _nodes() -> np.ndarray:
    """Chebyshev nodes on -1 ... 1, from the left."""
    return np.asarray(-np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES))


def _share(place: float) -> np.ndarray:
    """What each node gives to the polynomial at a place on -1 ... 1, (NODES,)."""
    order = np.polynomial.chebyshev.chebvander(_nodes(), NODES - 1)
    return np.linalg.solve(order.T, np.polynomial.chebyshev.chebvander(np.array([place]), NODES - 1)[0])


def _width(image: Disk | Polygon) -> float:
    """Size of a shape along x, metres."""
    low, high, _, _ = image.bounds
    return high - low


LEAST_WIDTH = 2.0
"""Diameter of the pinhole's image, pixels, below which pixel sampling moves an energy centroid by more than 0.001 of
a pixel.
"""

MARGIN = 6
"""Pixels between the centroid's window and the image's edge: four rows of background, and the spot's place between
pixels."""

BLUR = 3.0
"""Pixels around the pinhole's geometric image that the centroid's window has to hold as well."""

_BENCH, _SETTING, _READING, _PATTERN, _NOISE = range(10, 15)
"""Numbers of the seed's random streams; those below belong to the turntable."""


@dataclass(frozen=True, eq=False)
class DistortionTruth:
    """What the analysis must not see, for N points and S sets.

    Attributes
    ----------
    zero : float
        True angle of the table at which the line's middle is imaged, minus the one at which the table reads
        ``camera_angle``, radians.
    axis : np.ndarray
        Of the table in the camera frame, unit, (3,).
    turn : np.ndarray
        W of each exposure, (N, S), radians.
    place : np.ndarray
        (along, across) of the chief ray, (N, S, 2), metres.
    gross : np.ndarray
        Exposures that a shock spoiled, (N, S).
    """

    zero: float
    axis: np.ndarray
    turn: np.ndarray
    place: np.ndarray
    gross: np.ndarray


@dataclass(frozen=True, eq=False)
class DistortionRecord:
    """What a test leaves for the analysis: N points, S sets.

    Attributes
    ----------
    reading : np.ndarray
        Of the table, (N, S), radians.
    frames : np.ndarray
        uint16 (N, S, frames, rows, columns).
    column : np.ndarray
        Of the line, first of each region that was kept, (N, S).
    """

    reading: np.ndarray
    frames: np.ndarray
    column: np.ndarray


@dataclass(frozen=True, eq=False)
class DistortionBench:
    """Everything that does not change from one test to the next.

    Attributes
    ----------
    setup : DistortionSetup
        The test with all it refers to.
    path : TargetPath
        From the collimator to the image.
    as_built : State
        State of the camera.
    ccd : LineCcd
        Of the band.
    images : PinholeImages
        Of the pinhole.
    turn : np.ndarray
        Nominal W of the points, (N,), radians, increasing.
    middle : np.ndarray
        Direction of the light that is imaged to the middle of the line, (3,).
    design_offset : np.ndarray
        Energy centroid minus chief ray along the line at the points, by the design, (N,), metres: known to the
        analysis, as every laboratory has the prescription.
    true_offset : np.ndarray
        The same of the as-built camera in this collimator; the analysis does not know it.
    """

    setup: DistortionSetup
    path: TargetPath
    as_built: State
    ccd: LineCcd
    images: PinholeImages
    turn: np.ndarray
    middle: np.ndarray
    design_offset: np.ndarray
    true_offset: np.ndarray

    @classmethod
    def build(cls, setup: DistortionSetup, backend: Backend, advance: Advance = silent) -> DistortionBench:
        """Trace the camera and work out the spectra of its spots.

        Raises
        ------
        InputError
            ``as_built`` names what the camera does not have.
        BenchError
            The beam does not get through, the pinhole is too small or too large, or points lie beyond the turntable's
            calibration.
        """
        test = setup.test
        camera = build_camera_under_test(test, setup.camera, backend)
        path = TargetPath(camera.assembly, ROOT, ROOT, camera.model, backend, test.collimator.model)
        design = TargetPath(camera.assembly, ROOT, ROOT, camera.model, backend)
        band = setup.camera.bands[test.band]
        ccd = LineCcd.from_specs(band, setup.detectors[band.detector])
        _check_pinhole(setup, camera.model.line_principal_distance)
        half = 0.5 * band.pixels * band.pitch
        turn = np.arctan(test.reach * half / camera.model.line_principal_distance) * np.linspace(-1.0, 1.0, test.points)
        _check_table(setup, turn)
        try:
            middle = _aim(path, camera.as_built, band.offset)

            def directions(angle: np.ndarray) -> np.ndarray:
                return _turned(np.array([1.0, 0.0, 0.0]), angle, middle)

            reach = float(turn[-1])
            images = PinholeImages.build(
                path,
                camera.as_built,
                directions,
                reach,
                pinhole(test.pinhole),
                ccd,
                test.window,
                lambda done, total: advance("spectra of the spots", done, total),
            )
            nodes = directions(at_nodes(reach))
            offsets = [centroid_offset(*way, nodes) for way in ((design, {}), (path, camera.as_built))]
        except (AimError, BeamMissedError, ValueError) as error:
            raise BenchError(
                f"the camera's beam cannot be traced: {error}", ("collimator",), "a wider one, or smaller `as_built`"
            ) from error
        known, true = (between(offset, reach, turn) for offset in offsets)
        return cls(setup, path, camera.as_built, ccd, images, turn, middle, known, true)

    @property
    def noise(self) -> NoiseModel:
        """Noise of one frame."""
        return self.ccd.noise

    @property
    def radius(self) -> float:
        """Radius of the centroid's window, pixels."""
        return 0.5 * self.setup.test.window - MARGIN

    @property
    def middle_column(self) -> float:
        """Column of the line's middle, where L = 0."""
        return 0.5 * (self.ccd.band.pixels - 1)

    def places(self, axis: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Where chief rays meet the focal plane, (..., 2) (along, across), metres, for turns (...) about an axis."""
        light = _turned(axis, np.ravel(turn), self.middle)
        return self.path.places(self.as_built, light).reshape(*np.shape(turn), 2)

    def record(
        self, table: TurntableModel, seed: int, advance: Advance = silent
    ) -> tuple[DistortionRecord, DistortionTruth]:
        """Carry out one test.

        Parameters
        ----------
        table : TurntableModel
            That turns the camera.
        seed : int
            Of everything else that is drawn.
        advance : Advance
            Told how many points are done.

        Raises
        ------
        BenchError
            a spot falls beside the line.
        """
        test, spec = self.setup.test, self.setup.turntable
        rng = {key: np.random.default_rng(stream(seed, key)) for key in (_BENCH, _READING)}
        zero = float(rng[_BENCH].normal(0.0, test.zero))
        tilt = rng[_BENCH].normal(0.0, test.axis_tilt, 2)
        axis = np.array([1.0, *tilt]) / np.sqrt(1.0 + tilt @ tilt)
        shape = len(self.turn), test.sets
        setting = np.random.default_rng(stream(seed, _SETTING))
        reading = spec.camera_angle + self.turn[:, None] + setting.normal(0.0, test.setting, shape)
        shock = rng[_READING].random(shape) < spec.reference.gross_probability
        push = shock * rng[_READING].choice([-1.0, 1.0], shape) * spec.reference.gross_error
        start = float(table.stand(np.array(spec.camera_angle))) + zero
        turn = table.stand(reading, rng[_READING]) + push - start
        place = self.places(axis, turn)
        frames, column = self._expose(place, seed, advance)
        return DistortionRecord(reading, frames, column), DistortionTruth(zero, axis, turn, place, shock)

    def _expose(self, place: np.ndarray, seed: int, advance: Advance) -> tuple[np.ndarray, np.ndarray]:
        test, pitch = self.setup.test, self.ccd.band.pitch
        spot = place / pitch + np.array([self.middle_column, 0.0])
        first = np.rint(spot).astype(int) - test.window // 2
        column = first[..., 0]
        if np.min(column) < 0 or np.max(column) + test.window > self.ccd.band.pixels:
            beside = 0.5 * test.window + np.max(np.abs(place[..., 0])) / pitch - 0.5 * self.ccd.band.pixels
            most = test.reach - 2.0 * max(beside, 0.0) / self.ccd.band.pixels
            raise BenchError(
                "the first or last spot falls beside the line",
                ("reach",),
                f"at most about {most:.4f} with this zero of the table",
            )
        inside = (spot - first) * pitch
        light = np.stack([self.images(w, at) for w, at in zip(self.turn, inside, strict=True)])
        # far tails of the Fourier sum may ring below zero by rounding
        photons = np.maximum(light, 0.0) * (self.ccd.white_photons(test.light) / np.max(light))
        pattern = self.ccd.pattern(stream(seed, _PATTERN))
        count, sets = column.shape
        frames = np.empty((count, sets, test.frames, test.window, test.window), np.uint16)
        for i in range(count):
            for s in range(sets):
                own = stream(seed, _NOISE, i, s)
                frames[i, s] = self.ccd.expose(photons[i, s], int(column[i, s]), pattern, test.frames, own)
            advance("exposures", i + 1, count)
        return frames, column


def _turned(axis: np.ndarray, turn: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Directions of the light (M, 3) after turns (M,) about an axis (3,)."""
    return np.asarray(rotation_matrix(turn[:, None] * axis) @ middle)


def _aim(path: TargetPath, state: State, offset: float) -> np.ndarray:
    """Direction of the light that is imaged to the middle of the line, by Newton's steps with finite differences."""
    slope, step, wanted = np.zeros(2), 1e-6, np.array([0.0, offset])
    for _ in range(6):
        around = slope + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        # light that travels along -Z + t has its image at +f t; slopes are (along, across)
        light = np.stack([around[:, 1], around[:, 0], -np.ones(3)], axis=-1)
        light /= np.linalg.norm(light, axis=1)[:, None]
        seen = path.places(state, light)
        slope = slope + np.linalg.solve((seen[1:] - seen[0]).T / step, wanted - seen[0])
    out = np.array([slope[1], slope[0], -1.0])
    return np.asarray(out / np.linalg.norm(out))


def _check_pinhole(setup: DistortionSetup, focal_length: float) -> None:
    test, pitch = setup.test, setup.camera.bands[setup.test.band].pitch
    per_pixel = pitch * test.collimator.focal_length / focal_length
    width = test.pinhole / per_pixel
    most = 2.0 * (0.5 * test.window - MARGIN - BLUR)
    allowed = f"{1e6 * LEAST_WIDTH * per_pixel:.0f} um to {1e6 * most * per_pixel:.0f} um"
    if width < LEAST_WIDTH:
        raise BenchError(
            f"the pinhole's image is {width:.2g} pixels wide: too small for these pixels, which would bias its "
            "centroid",
            ("pinhole",),
            allowed,
        )
    if width > most:
        raise BenchError(
            f"the pinhole's image is {width:.3g} pixels wide and does not fit into a window of {test.window} pixels",
            ("pinhole",),
            f"{allowed}, or a larger window",
        )


def _check_table(setup: DistortionSetup, turn: np.ndarray) -> None:
    plan, angle = setup.turntable.calibration, setup.turntable.camera_angle
    room = min(angle - plan.first, plan.last - angle) - 6.0 * setup.test.setting
    if turn[-1] > room:
        raise BenchError(
            f"the camera's field needs +-{np.rad2deg(turn[-1]):.3f} deg of the turntable, but about its camera_angle "
            f"only +-{np.rad2deg(max(room, 0.0)):.3f} deg are calibrated",
            ("reach",),
            "a smaller share, or a turntable file that is calibrated over the field",
        )
