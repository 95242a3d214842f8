"""Simulated bench of the distortion test: a camera on a turntable views a pinhole in a collimator.

The transfer function of an image about its chief ray varies slowly over the field. Its product with the pinhole's
spectrum and the line CCD's transfer function is therefore computed at a few Chebyshev nodes and interpolated with the
polynomial through them. An image is then a Fourier sum at the pixel centres, shifted exactly.

World frame = camera frame. When the table rotates by the angle W the light's direction rotates by +W about the table's
axis, which is the camera's X but for a small tilt: from (0, 0, -1) to (0, sin W, -cos W), whose image lies at L = +f
tan W along the line, with the focal length f. W counts from the true angle of the table at which the as-built camera
images the pinhole to the middle of the line. The image is rendered where the line's scan passes it: over the field its
row drifts by the smile of the mapping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from analysis.spots.noise import NoiseModel
from optics.geometry.pose import rotation_matrix
from optics.geometry.tree import State
from optics.geometry.vector_shape import Disk
from optics.numerics.backend import Backend, one_blas_thread
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from optics.targets.target_shapes import Target, pinhole
from optics.waves.optical_transfer import TransferTable, transfer
from optics.waves.pupil_stack import PupilFunction
from scenes.models.camera_model import ROOT, build_camera_under_test
from scenes.specs.resolved import DistortionSetup
from twin.framework.procedure import Advance, BenchError, silent, stream
from twin.laboratory.turntable_run import TurntableModel
from twin.sensors.line_ccd import LineCcd, band_wavelengths
from twin.targets.target_path import TargetPath

NODES = 10
"""Number of Chebyshev nodes over the field at which images are computed.

Interpolated between them, images of the example camera gf7 are accurate to 1e-5 of their peak and their centroids to 1
nm.
"""

GUARD = 160.0
"""Distance between the window and the periodic copies of the spot in the Fourier sum, in periods of the cut-off
frequency.

The irradiance of a clear pupil falls as 1/distance^3: over the window of the panchromatic line a copy is below 1e-6
of the peak, and nearly even.
"""

_RIM = np.pi * np.arange(16) / 16
"""Azimuths, in radians, of the spatial frequencies at which the cut-off of a pupil's transfer function is evaluated."""


@dataclass(frozen=True, eq=False)
class PinholeImages:
    """Images of a pinhole on the line CCD over the field.

    Attributes
    ----------
    half_field : float
        Largest rotation of the camera to either side, radians.
    fx, fy : ndarray
        U spatial frequencies along the line (non-negative half), (U,), and V along the track, (V,), cycles/m.
    spectra : (nodes, V, U) ndarray of complex
        Spectra at the nodes of the field, scaled so that a large uniform bright area has signal 1.
    pitch : float
        Pixel pitch, metres.
    window : int
        Side of an image, pixels.
    diameter : float
        Diameter of the pinhole's geometric image along the line in the middle of the field, metres.
    """

    half_field: float
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
        light: np.ndarray,
        half_field: float,
        target: Target,
        ccd: LineCcd,
        window: int,
        advance: Advance = silent,
    ) -> PinholeImages:
        """Compute the spectra of the pinhole's images at the Chebyshev nodes of the field.

        Parameters
        ----------
        path : TargetPath
            Light path from the target to the plane of the line CCD.
        state : State
            State of the camera.
        light : (NODES, 3) ndarray
            Directions of the light at the nodes, in the world frame.
        half_field : float
            Largest rotation of the camera to either side, radians.
        target : Target
            Pinhole, a single disk.
        ccd : LineCcd
            Line CCD.
        window : int
            Side of an image, pixels.
        advance : callable
            Called with the stage, and the done and total nodes.

        Raises
        ------
        BeamMissedError, AimError, ValueError
            The beam does not pass, or its wavefront is too irregular for a fit.
        """
        pupils = path.pupils(state, light, path.positions(state, light))
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
        spectra, diameter = np.empty((NODES, len(fy), len(fx)), complex), 0.0
        for n, (pupil, direction) in enumerate(zip(pupils, light, strict=True)):
            image = hole.mapped(path.local_map(state, direction, 1.5 * hole.radius))
            table = TransferTable.build(pupil, wavelengths, weights)
            spectra[n] = image.spectrum(*grid) * table(*grid) * common
            if n == NODES // 2:
                low, high, _, _ = image.bounds
                diameter = high - low
            advance("spectra of the spots", n + 1, NODES)
        return cls(half_field, fx, fy, spectra, pitch, window, diameter)

    def __call__(self, field_angle: float, position: np.ndarray) -> np.ndarray:
        """Return S images of the pinhole at one field angle.

        Parameters
        ----------
        field_angle : float
            Rotation of the camera, radians.
        position : (S, 2) ndarray
            Chief rays (along, across the line) relative to the centre of the window's first pixel, metres.

        Returns
        -------
        (S, window, window) ndarray
            Images, rows along the track, scaled so that a large uniform bright area has signal 1.
        """
        spectrum = np.tensordot(_node_weights(field_angle / self.half_field), self.spectra, 1)
        pixel = self.pitch * np.arange(self.window)
        along = np.exp(2j * np.pi * self.fx[:, None, None] * (pixel - position[:, :1]))
        across = np.exp(2j * np.pi * (pixel - position[:, 1:])[..., None] * self.fy)
        with one_blas_thread():
            half = (spectrum @ along.reshape(len(self.fx), -1)).reshape(len(self.fy), len(position), self.window)
            return np.asarray((across @ half.swapaxes(0, 1)).real)

    @property
    def width(self) -> float:
        """Diameter of the pinhole's geometric image along the line, pixels."""
        return self.diameter / self.pitch


def centroid_offset(path: TargetPath, state: State, directions: np.ndarray) -> np.ndarray:
    """Return energy centroid minus chief ray of a point's image along the line at F field points, (F,), metres.

    It is the mean slope of the wavefront over the pupil, the same for all wavelengths, and is computed from the phase
    of the transfer function at a ten-thousandth of the cut-off frequency.
    """
    pupils: tuple[PupilFunction, ...] = path.pupils(state, directions, path.positions(state, directions))
    wavelength, along = path.model.spec.wavelength, np.array([[1.0, 0.0]])
    out = []
    for pupil in pupils:
        frequency = 1e-4 * float(pupil.cutoff(along, wavelength)[0])
        phase = np.angle(transfer(pupil, frequency * along, wavelength, np.zeros(1))[0, 0])
        out.append(-phase / (2.0 * np.pi * frequency))
    return np.array(out)


def interpolated(values: np.ndarray, half_field: float, field_angle: np.ndarray) -> np.ndarray:
    """Return the polynomial through values at the Chebyshev nodes, (NODES,), evaluated at M field angles, (M,)."""
    return np.array([_node_weights(angle / half_field) @ values for angle in field_angle])


def _nodes() -> np.ndarray:
    """Return the Chebyshev nodes of the interpolation over the field, scaled to -1 ... 1, in increasing order."""
    return np.asarray(-np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES))


def _node_weights(position: float) -> np.ndarray:
    """Return the interpolation weights of the values at the nodes, (NODES,), for a position on -1 ... 1."""
    order = np.polynomial.chebyshev.chebvander(_nodes(), NODES - 1)
    return np.linalg.solve(order.T, np.polynomial.chebyshev.chebvander(np.array([position]), NODES - 1)[0])


MIN_WIDTH = 2.0
"""Smallest allowed diameter of the pinhole's image, pixels.

Below it, pixel sampling moves an energy centroid by more than 0.001 pixel.
"""

MARGIN = 6
"""Smallest distance between the centroid's window and the edge of the image, pixels.

It leaves four rows of background, and room for the spot's position between pixels.
"""

BLUR = 3.0
"""Pixels around the pinhole's geometric image that the centroid's window must also contain."""

_BENCH, _SETTING, _READING, _PATTERN, _NOISE = range(10, 15)
"""Numbers of the random streams of the seed; those below 10 belong to the turntable.

They are for the bench's misalignment, the settings of the table, the reference's readings, the pattern of the pixels,
and the noise of frames.
"""


@dataclass(frozen=True, eq=False)
class DistortionTruth:
    """True values that the analysis must not use, for N points and S sets of repeated exposures.

    A point is a nominal angle of the turntable; in each set every point is exposed once.

    Attributes
    ----------
    zero : float
        True angle of the table at which the line's middle is imaged, minus the one at which the table reads
        ``camera_angle``, radians.
    axis : (3,) ndarray
        Axis of the table in the camera frame, unit vector.
    field_angle : (N, S) ndarray
        Field angle W of each exposure, radians.
    position : (N, S, 2) ndarray
        Position (along, across the line) of the chief ray, metres.
    gross : (N, S) ndarray of bool
        Exposures with a gross error from a shock.
    """

    zero: float
    axis: np.ndarray
    field_angle: np.ndarray
    position: np.ndarray
    gross: np.ndarray


@dataclass(frozen=True, eq=False)
class DistortionRecord:
    """Measurements that a test gives to the analysis, for N points and S sets of repeated exposures.

    A point is a nominal angle of the turntable; in each set every point is exposed once.

    Attributes
    ----------
    reading : (N, S) ndarray
        Readings of the turntable, radians.
    frames : (N, S, frames, rows, columns) ndarray of uint16
        Recorded frames, DN.
    column : (N, S) ndarray of int
        First column of each recorded window on the line.
    """

    reading: np.ndarray
    frames: np.ndarray
    column: np.ndarray


@dataclass(frozen=True, eq=False)
class DistortionBench:
    """Simulated bench with everything that stays the same from test to test.

    Attributes
    ----------
    setup : DistortionSetup
        Test with the contents of all files that it refers to.
    path : TargetPath
        Light path from the collimator to the image.
    as_built : State
        As-built state of the camera.
    ccd : LineCcd
        Line CCD of the band.
    images : PinholeImages
        Images of the pinhole.
    field_angle : (N,) ndarray
        Nominal field angles W of the N points, radians, increasing.
    centre_direction : (3,) ndarray
        Direction of the light that is imaged to the middle of the line.
    design_offset : (N,) ndarray
        Energy centroid minus chief ray along the line at the points, by the design, metres. The analysis knows it, as
        every laboratory has the prescription.
    true_offset : (N,) ndarray
        Energy centroid minus chief ray of the as-built camera in this collimator, metres; the analysis does not know
        it.
    """

    setup: DistortionSetup
    path: TargetPath
    as_built: State
    ccd: LineCcd
    images: PinholeImages
    field_angle: np.ndarray
    centre_direction: np.ndarray
    design_offset: np.ndarray
    true_offset: np.ndarray

    @classmethod
    def build(cls, setup: DistortionSetup, backend: Backend, advance: Advance = silent) -> DistortionBench:
        """Trace the camera and compute the spectra of its spots, from which all images are made.

        Raises
        ------
        InputError
            ``as_built`` names a body that the camera does not have.
        BenchError
            The beam does not pass, the pinhole is too small or too large, or points lie beyond the turntable's
            calibration.
        """
        test = setup.test
        camera = build_camera_under_test(test, setup.camera, backend)
        path = TargetPath(camera.assembly, ROOT, ROOT, camera.model, backend, test.collimator.model)
        design = TargetPath(camera.assembly, ROOT, ROOT, camera.model, backend)
        band = setup.camera.bands[test.band]
        ccd = LineCcd.from_specs(band, setup.detectors[band.detector])
        _check_pinhole(setup, camera.model.line_principal_distance)
        half_length = 0.5 * band.pixels * band.pitch
        edge = np.arctan(test.extent * half_length / camera.model.line_principal_distance)
        field_angle = edge * np.linspace(-1.0, 1.0, test.points)
        _check_table(setup, field_angle)
        try:
            centre_direction = _aim(path, camera.as_built, band.offset)

            def directions(angle: np.ndarray) -> np.ndarray:
                return _rotated(np.array([1.0, 0.0, 0.0]), angle, centre_direction)

            half_field = float(field_angle[-1])
            nodes = directions(half_field * _nodes())
            hole = pinhole(test.pinhole)
            images = PinholeImages.build(path, camera.as_built, nodes, half_field, hole, ccd, test.window, advance)
            offsets = [centroid_offset(*light, nodes) for light in ((design, {}), (path, camera.as_built))]
        except (AimError, BeamMissedError, ValueError) as error:
            problem = f"the camera's beam cannot be traced: {error}"
            remedy = "a wider collimator, or smaller errors in `as_built`"
            raise BenchError(problem, ("collimator",), remedy) from error
        known, true = (interpolated(offset, half_field, field_angle) for offset in offsets)
        return cls(setup, path, camera.as_built, ccd, images, field_angle, centre_direction, known, true)

    @property
    def noise(self) -> NoiseModel:
        """Noise model of one frame of the line CCD."""
        return self.ccd.noise

    @property
    def radius(self) -> float:
        """Radius of the window over which a spot's centroid is computed, pixels."""
        return 0.5 * self.setup.test.window - MARGIN

    @property
    def middle_column(self) -> float:
        """Column of the line CCD at the middle of the line, where the position along the line is 0."""
        return 0.5 * (self.ccd.band.pixels - 1)

    def positions(self, axis: np.ndarray, field_angle: np.ndarray) -> np.ndarray:
        """Return the chief rays' positions on the focal plane, (..., 2) (along, across the line), metres.

        ``axis`` is the table's axis, a unit vector; ``field_angle`` are the rotations about it, (...), radians.
        """
        light = _rotated(axis, np.ravel(field_angle), self.centre_direction)
        return self.path.positions(self.as_built, light).reshape(*np.shape(field_angle), 2)

    def record(
        self, table: TurntableModel, seed: int, advance: Advance = silent
    ) -> tuple[DistortionRecord, DistortionTruth]:
        """Simulate one test: rotate the table, expose the spots and return measurements and true values.

        Parameters
        ----------
        table : TurntableModel
            Turntable that rotates the camera.
        seed : int
            Seed of all other random numbers.
        advance : Advance
            Called with the number of recorded points.

        Raises
        ------
        BenchError
            A spot falls beside the line.
        """
        test, spec = self.setup.test, self.setup.turntable
        rng = {key: np.random.default_rng(stream(seed, key)) for key in (_BENCH, _READING)}
        zero = float(rng[_BENCH].normal(0.0, test.zero))
        tilt = rng[_BENCH].normal(0.0, test.axis_tilt, 2)
        axis = np.array([1.0, *tilt]) / np.sqrt(1.0 + tilt @ tilt)
        shape = len(self.field_angle), test.sets
        setting = np.random.default_rng(stream(seed, _SETTING))
        reading = spec.camera_angle + self.field_angle[:, None] + setting.normal(0.0, test.setting, shape)
        shock = rng[_READING].random(shape) < spec.reference.gross_probability
        push = shock * rng[_READING].choice([-1.0, 1.0], shape) * spec.reference.gross_error
        start = float(table.true_angle(np.array(spec.camera_angle))) + zero
        field_angle = table.true_angle(reading, rng[_READING]) + push - start
        position = self.positions(axis, field_angle)
        frames, column = self._expose(position, seed, advance)
        return DistortionRecord(reading, frames, column), DistortionTruth(zero, axis, field_angle, position, shock)

    def _expose(self, position: np.ndarray, seed: int, advance: Advance) -> tuple[np.ndarray, np.ndarray]:
        """Expose frames of all spots; return them with the first column of each window."""
        test, pitch = self.setup.test, self.ccd.band.pitch
        spot = position / pitch + np.array([self.middle_column, 0.0])
        first = np.rint(spot).astype(int) - test.window // 2
        column = first[..., 0]
        if np.min(column) < 0 or np.max(column) + test.window > self.ccd.band.pixels:
            overshoot = 0.5 * test.window + np.max(np.abs(position[..., 0])) / pitch - 0.5 * self.ccd.band.pixels
            most = test.extent - 2.0 * max(overshoot, 0.0) / self.ccd.band.pixels
            allowed = f"at most about {most:.4f} for this zero of the table"
            raise BenchError("the first or last spot falls beside the line", ("extent",), allowed)
        inside = (spot - first) * pitch
        light = np.stack([self.images(w, at) for w, at in zip(self.field_angle, inside, strict=True)])
        # far tails of the Fourier sum may ring below zero by rounding
        photons = np.maximum(light, 0.0) * (self.ccd.white_photons(test.light) / np.max(light))
        pattern = self.ccd.pattern(stream(seed, _PATTERN))
        count, sets = column.shape
        frames = np.empty((count, sets, test.frames, test.window, test.window), np.uint16)
        for i in range(count):
            for s in range(sets):
                noise_seed = stream(seed, _NOISE, i, s)
                frames[i, s] = self.ccd.expose(photons[i, s], int(column[i, s]), pattern, test.frames, noise_seed)
            advance("exposures", i + 1, count)
        return frames, column


def _rotated(axis: np.ndarray, field_angle: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the light's direction rotated about an axis by M angles, (M, 3).

    ``field_angle`` holds the angles, (M,), radians.
    """
    return np.asarray(rotation_matrix(field_angle[:, None] * axis) @ direction)


def _aim(path: TargetPath, state: State, offset: float) -> np.ndarray:
    """Return the direction of the light that is imaged to the middle of the line, by Newton's method."""
    slope, step, target = np.zeros(2), 1e-6, np.array([0.0, offset])
    for _ in range(6):
        around = slope + step * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        # light that travels along -Z + t has its image at +f t; slopes are (along, across)
        light = np.stack([around[:, 1], around[:, 0], -np.ones(3)], axis=-1)
        light /= np.linalg.norm(light, axis=1)[:, None]
        positions = path.positions(state, light)
        slope = slope + np.linalg.solve((positions[1:] - positions[0]).T / step, target - positions[0])
    out = np.array([slope[1], slope[0], -1.0])
    return np.asarray(out / np.linalg.norm(out))


def _check_pinhole(setup: DistortionSetup, focal_length: float) -> None:
    """Raise BenchError if the pinhole's image is too small for the pixels or too large for the window."""
    test, pitch = setup.test, setup.camera.bands[setup.test.band].pitch
    per_pixel = pitch * test.collimator.focal_length / focal_length
    width = test.pinhole / per_pixel
    most = 2.0 * (0.5 * test.window - MARGIN - BLUR)
    allowed = f"{1e6 * MIN_WIDTH * per_pixel:.0f} um to {1e6 * most * per_pixel:.0f} um"
    if width < MIN_WIDTH:
        problem = f"the pinhole's image is {width:.2g} pixels wide: too small, the pixels would bias its centroid"
        raise BenchError(problem, ("pinhole",), allowed)
    if width > most:
        into = f"a window of {test.window} pixels"
        problem = f"the pinhole's image is {width:.3g} pixels wide and does not fit into {into}"
        raise BenchError(problem, ("pinhole",), f"{allowed}, or a larger window")


def _check_table(setup: DistortionSetup, field_angle: np.ndarray) -> None:
    """Raise BenchError if the field exceeds the calibrated region of the turntable."""
    plan, angle = setup.turntable.calibration, setup.turntable.camera_angle
    margin = min(angle - plan.first, plan.last - angle) - 6.0 * setup.test.setting
    if field_angle[-1] > margin:
        raise BenchError(
            f"the camera's field requires +-{np.rad2deg(field_angle[-1]):.3f} deg of the turntable, but about its "
            f"camera_angle only +-{np.rad2deg(max(margin, 0.0)):.3f} deg are calibrated",
            ("extent",),
            "a smaller extent, or a turntable file that is calibrated over the field",
        )
