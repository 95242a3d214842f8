"""Simulated bench of two autocollimators that measure two mirrors on a turntable (paper 001, Wang et al. 2018).

Errors of the bench (mounting, focus, turntable) are motions of its bodies. They are drawn from the seed and applied to
the simulated bench alone: the analysis evaluates the frames with the calibration of the ideal autocollimator and the
nominal angles of the turntable and the mirrors. Each series begins with a reading at zero, which is subtracted from all
others; its first row is a second reading at zero, which shows the repeatability.

Images. The light goes from the pinhole through the lens to the mirror and back through the lens to a window of the area
CCD. As in ``twin.monitor.monitor_path``, rays from the pinhole are aimed at quadrature nodes of the smallest aperture,
which is the mirror, traced back to the CCD, and summed as plane waves on the pixels of the CCD. Only the window that is
read out is rendered. It is centred on the whole pixel nearest to the mean of the traced rays, as a camera would centre
it on the brightest pixel of the full frame. The analysis gets the corner of the window, as a camera reports it, and
nothing else.

Frames, all right-handed. System frame 1-XYZ (paper 001, section 3.1): X up, Y horizontal, Z = X x Y along the view of
autocollimator 1, from its lens to its mirror; the origin is the intersection of the three axes of the turntable. Frame
2-XYZ is frame 1 rotated about X by the angle b = 2 theta between the mirrors' normals, so that

    Y1 = Y2 cos b - Z2 sin b,    Z1 = Y2 sin b + Z2 cos b.

The frame of a mirror is that of its autocollimator rotated by 180 deg about Y: its +z is its normal, toward the lens.
The frame of a lens is rotated likewise, with +z toward the focal plane. Area CCD: columns along the autocollimator's
+Y, rows along its -X, facing the lens; a rotation of the mirror about +X moves the spot to larger columns, about +Y to
larger rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import autocollimator
from analysis.spots.centroid import energy_centroid, mean_frames
from analysis.spots.spot_image import SpotPositions
from optics.geometry import zernike
from optics.geometry.aperture import Circle
from optics.geometry.pose import Pose, about_axis, rotation_matrix, triple
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import Body, Motion, PlacedBodies, RigidTree, State
from optics.materials.glass import glass
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import RayFan, aim, transverse_axes
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import BeamMissedError, Traced, make_rays, require_rays, trace
from optics.waves.diffraction import Grid, PixelResponse, PupilField, UnsampledImageError, image
from optics.waves.imaging import eikonal
from scenes.specs.camera_tests import AutocollimatorSetup, AutocollimatorTestSpec, LensSpec
from twin.sensors.area_detector import EmvaDetector, FixedPattern

BENCH = "bench"
AXES = ("X", "Y", "Z")
UNITS = (1, 2)
"""Numbers of the two autocollimators; each views the mirror of the same number."""

_ABOUT_Y = np.diag([-1.0, 1.0, -1.0])  # half a turn
_DETECTOR = np.stack([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], axis=-1)


def autocollimator_body(unit: int) -> str:
    """Return the body path of autocollimator 1 or 2, which carries all its parts."""
    return f"{BENCH}/autocollimator_{unit}"


def pinhole_body(unit: int) -> str:
    """Return the body path of the pinhole of autocollimator 1 or 2."""
    return f"{autocollimator_body(unit)}/focal_plane/pinhole"


def ccd_body(unit: int) -> str:
    """Return the body path of the area CCD of autocollimator 1 or 2."""
    return f"{autocollimator_body(unit)}/focal_plane/area_ccd"


def axis_body(axis: str) -> str:
    """Return the body path of the turntable stage that rotates about X, Y or Z; stage X carries Y, and Y carries Z."""
    return "/".join([BENCH, "turntable", *AXES[: AXES.index(axis) + 1]])


def mirror_body(unit: int) -> str:
    """Return the body path of mirror 1 or 2, on the innermost stage of the turntable."""
    return f"{axis_body('Z')}/mirror_{unit}"


def outgoing(unit: int) -> str:
    """Return the name of the sequence of surfaces from the pinhole to the mirror of autocollimator 1 or 2."""
    return f"outgoing_{unit}"


def round_trip(unit: int) -> str:
    """Return the name of the sequence of surfaces from the pinhole via the mirror to the area CCD of unit 1 or 2."""
    return f"round_trip_{unit}"


@dataclass(frozen=True, eq=False)
class Bench:
    """Bench of two autocollimators and two mirrors whose normals enclose the angle 2 theta.

    Attributes
    ----------
    spec : AutocollimatorTestSpec
        Specification of the test from its YAML file.
    half_angle : float
        Half the angle between the mirrors' normals, theta, radians.
    assembly : Assembly
        Bodies, optical elements and sequences.
    focal_length : float
        Paraxial focal length of the autocollimators, metres.
    """

    spec: AutocollimatorTestSpec
    half_angle: float
    assembly: Assembly
    focal_length: float

    @property
    def mirror_angle(self) -> float:
        """Angle between the mirrors' normals, b = 2 theta, radians."""
        return 2.0 * self.half_angle

    @property
    def numerical_aperture(self) -> float:
        """Numerical aperture of the returned beam at the area CCD."""
        return 0.5 * self.spec.mirrors.aperture / self.focal_length

    def frame(self, unit: int) -> np.ndarray:
        """Return the axes X, Y, Z of autocollimator 1's or 2's frame as columns in the bench's frame, (3, 3)."""
        return about_axis(0, self.mirror_angle if unit == 2 else 0.0)


def paraxial_focus(lens: LensSpec, wavelength: float) -> tuple[float, float]:
    """Return focal length and back focal distance of the lens for a beam from infinity, metres."""
    n = glass(lens.glass).index(wavelength)
    angle = -(n - 1.0) / (n * lens.front_radius)
    height = 1.0 + angle * lens.thickness
    leaving = n * angle - height * (1.0 - n) / lens.back_radius
    return -1.0 / leaving, -height / leaving


def build_bench(spec: AutocollimatorTestSpec, half_angle: float) -> Bench:
    """Build the bench with each mirror perpendicular to the axis of its autocollimator.

    Parameters
    ----------
    spec : AutocollimatorTestSpec
        Specification of the test.
    half_angle : float
        Half the angle between the mirrors' normals, theta, radians.
    """
    collimator = spec.autocollimator
    lens = collimator.lens
    n = glass(lens.glass).index(collimator.wavelength)
    bodies = [Body(BENCH)]
    elements: dict[str, Element] = {}
    sequences: dict[str, tuple[str, ...]] = {}
    for unit in UNITS:
        frame = about_axis(0, 2.0 * half_angle if unit == 2 else 0.0)
        bodies += _autocollimator_bodies(spec, unit, Pose(frame, -collimator.distance * frame[:, 2]))
    bodies.append(Body(f"{BENCH}/turntable"))
    bodies += [Body(axis_body(axis)) for axis in AXES]
    for unit in UNITS:
        frame = about_axis(0, 2.0 * half_angle if unit == 2 else 0.0)
        bodies.append(Body(mirror_body(unit), Pose(frame @ _ABOUT_Y, -spec.mirrors.radius * frame[:, 2])))
        root = f"{autocollimator_body(unit)}/lens"
        clear = Circle(0.5 * lens.diameter)
        front, back = Surface(1.0 / lens.front_radius, lens.front_conic), Surface(1.0 / lens.back_radius)
        mirror = Circle(0.5 * spec.mirrors.aperture)
        chain = (
            Element(f"{unit}/back_out", f"{root}/back", back, Interaction.REFRACT, clear, n),
            Element(f"{unit}/front_out", f"{root}/front", front, Interaction.REFRACT, clear),
            Element(f"{unit}/mirror", mirror_body(unit), plane(), Interaction.REFLECT, mirror),
            Element(f"{unit}/front_in", f"{root}/front", front, Interaction.REFRACT, clear, n),
            Element(f"{unit}/back_in", f"{root}/back", back, Interaction.REFRACT, clear),
            Element(f"{unit}/ccd", ccd_body(unit), plane(), Interaction.PASS),
        )
        elements.update({element.name: element for element in chain})
        names = tuple(element.name for element in chain)
        sequences[outgoing(unit)] = names[:3]
        sequences[round_trip(unit)] = names
    assembly = Assembly(RigidTree(tuple(bodies)), elements, sequences)
    return Bench(spec, half_angle, assembly, paraxial_focus(lens, collimator.wavelength)[0])


def _autocollimator_bodies(spec: AutocollimatorTestSpec, unit: int, pose: Pose) -> list[Body]:
    """Return the bodies of an autocollimator, whose origin is the front vertex of the lens.

    Scaling the autocollimator changes its focal length; the interior of the focal plane keeps its size.
    """
    collimator = spec.autocollimator
    lens = collimator.lens
    root = autocollimator_body(unit)
    to_image = lens.thickness + lens.focal_distance
    along_y, along_x = collimator.area_ccd.offset
    half = 0.5 * np.array([along_x, along_y, 0.0])
    return [
        Body(root, pose),
        Body(f"{root}/lens", Pose(_ABOUT_Y)),
        Body(f"{root}/lens/front"),
        Body(f"{root}/lens/back", Pose(np.eye(3), np.array([0.0, 0.0, lens.thickness]))),
        Body(f"{root}/focal_plane", Pose(np.eye(3), np.array([0.0, 0.0, -to_image])), scales=False),
        Body(pinhole_body(unit), Pose(np.eye(3), -half)),
        Body(ccd_body(unit), Pose(_DETECTOR, half)),
    ]


AIM_TOLERANCE = 1e-9
"""Largest distance on the mirror between an aimed ray and its target point, metres."""
MAP_TERMS = 15
"""Number of Zernike terms that represent ray directions as functions of the position on the mirror."""
FINE = 2
"""Number of samples along each side of a pixel at which the irradiance is computed.

With one sample per pixel, the irradiance contains up to 0.43 cycles per sample, too near to the limit of 0.5 for the
exact pixel filter; with two per side it is exact, and the mean of the four samples is the mean over a pixel.
"""
CHUNK = 24
"""Number of states that are traced and rendered at once, to limit memory."""
TILE = 64
"""Side, in pixels, of the square tiles in which the random fixed pattern of a CCD is generated."""


@dataclass(frozen=True, eq=False)
class SpotWindows:
    """Rendered windows around the spots of both autocollimators in S states.

    Attributes
    ----------
    photons : (2, S, window, window) ndarray
        Expected photons per pixel and frame.
    corner : (2, S, 2) ndarray of int
        Row and column of each window's first pixel on the CCD.
    """

    photons: np.ndarray
    corner: np.ndarray


class AutocollimatorPath:
    """Ray trace and spot images of both autocollimators of one bench.

    Parameters
    ----------
    bench
        Bench to trace.
    backend
        Array backend of the trace.
    nodes
        Quadrature nodes on the mirror; by default a quadrature with which the images are accurate to 1e-6 of their
        peak.

    Raises
    ------
    InputError
        The pixels of the area CCDs are too coarse for the spots.
    """

    def __init__(self, bench: Bench, backend: Backend, nodes: PupilNodes | None = None) -> None:
        self.bench = bench
        self.backend = backend
        collimator = bench.spec.autocollimator
        self.pitch: float = collimator.area_ccd.pitch
        self.window: int = collimator.window
        self.shape = (collimator.area_ccd.rows, collimator.area_ccd.columns)
        # largest distance of a pixel from a spot up to one pixel off the window's centre, kernel included
        half_diagonal = (0.5 * self.window + 1.0 + self.response.half_width / FINE) * np.sqrt(2.0) * self.pitch
        phase = 2.0 * np.pi * bench.numerical_aperture * half_diagonal / collimator.wavelength
        self.nodes = quadrature.disk_for(phase) if nodes is None else nodes

    @cached_property
    def response(self) -> PixelResponse:
        """Filter of the pinhole and of one sample (1/FINE of a pixel's side), applied to the image of a point.

        Raises
        ------
        InputError
            The pixels are too coarse for the image, or the pinhole is too wide for them.
        """
        collimator = self.bench.spec.autocollimator
        cutoff = 2.0 * self.bench.numerical_aperture / collimator.wavelength
        try:
            return PixelResponse.fit(self.pitch / FINE, collimator.reticle.pinhole, cutoff)
        except UnsampledImageError as error:
            key = ("reticle", "pinhole") if error.of_source else ("area_ccd", "pitch")
            problem = f"the area CCDs do not sample the spots: with {FINE} samples per pixel, {error}"
            raise self.bench.spec.error(problem, ("autocollimator", *key), allowed=error.remedy) from error

    @cached_property
    def _slopes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Matrices for derivatives of smooth functions over the mirror, by a Zernike series.

        They are (T, N) from values at N nodes to the coefficients of T Zernike terms, and (N, T) from the coefficients
        to d/dx and to d/dy at the nodes, where x and y are coordinates on the mirror in units of its radius.
        """
        x, y = self.nodes.x, self.nodes.y
        root = np.sqrt(self.nodes.weight)
        solve = np.linalg.pinv(zernike.basis(MAP_TERMS, x, y) * root[:, None]) * root
        dx, dy = (zernike.gradient_basis(MAP_TERMS, x, y, axis) for axis in (0, 1))
        return solve, dx, dy

    @cached_property
    def _start(self) -> tuple[np.ndarray, np.ndarray]:
        """Initial aim parameters of the N rays of both autocollimators, (2, N, 2), and their Jacobian.

        They are those of the unperturbed bench. The aim parameters are two components of a ray's launch direction; the
        Jacobian holds the derivatives of the point on the mirror with respect to them.
        """
        placed = self.bench.assembly.place()
        fan, systems = self._fan(placed, [{}])
        middle, slope = aim(self.backend, systems, fan, np.zeros((1, 2)), tolerance=AIM_TOLERANCE)
        guess = middle + np.einsum("bnij,pj->bpi", np.linalg.inv(slope), self._targets)
        return aim(self.backend, systems, fan, self._targets, guess, slope, AIM_TOLERANCE)

    @property
    def _targets(self) -> np.ndarray:
        """Points on the mirror at which the N rays are aimed, (N, 2), metres."""
        return 0.5 * self.bench.spec.mirrors.aperture * np.stack([self.nodes.x, self.nodes.y], axis=-1)

    def _fan(self, placed: PlacedBodies, states: Sequence[State]) -> tuple[RayFan, SystemBatch]:
        """Return the rays launched from the pinholes toward the lenses, and the optical systems up to the mirrors.

        All states of autocollimator 1 come first, then those of autocollimator 2.
        """
        origin = np.concatenate([placed.translation[:, placed.index[pinhole_body(u)]] for u in UNITS])[:, None]
        frames = np.concatenate([placed.rotation[:, placed.index[autocollimator_body(u)]] for u in UNITS])
        view, up = frames[:, None, :, 2], frames[:, None, :, 0]
        systems = assemble(self.bench.assembly, [outgoing(u) for u in UNITS], states, placed=placed)
        return RayFan(origin, view, transverse_axes(view, up)), systems

    def rays(self, states: Sequence[State]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Trace N rays of both autocollimators in S states to the CCDs, one autocollimator after the other.

        Returns
        -------
        tuple of ndarray
            Position and direction (2 S, N, 3) in the CCDs' frames, path length and validity (2 S, N).

        Raises
        ------
        BeamMissedError, AimError
            The light of a spot does not return to its CCD.
        """
        rays = self._traced(self.bench.assembly.place(states), states)[1].numpy()
        require_rays(rays[3], "the autocollimators")
        return rays

    def _traced(
        self, placed: PlacedBodies, states: Sequence[State], keep: Sequence[int] = ()
    ) -> tuple[np.ndarray, Traced]:
        """Return launch points in the bench's frame, (2 S, N, 3), and the traced rays at the CCDs.

        There are N rays of each autocollimator in each of S states.
        """
        fan, systems = self._fan(placed, states)
        start, slope = (np.repeat(a, len(states), axis=0) for a in self._start)
        q, _ = aim(self.backend, systems, fan, self._targets, start, slope, AIM_TOLERANCE)
        systems_back = assemble(self.bench.assembly, [round_trip(u) for u in UNITS], states, placed=placed)
        position, direction = fan.at(q)
        return position, trace(self.backend, systems_back, make_rays(self.backend, position, direction), keep)

    def polylines(self, state: State) -> np.ndarray:
        """Return N rays of both autocollimators as points in the bench's frame, (2, N, 7, 3), metres.

        The seven points are the pinhole, the five surfaces and the CCD.
        """
        placed = self.bench.assembly.place([state])
        chains = [self.bench.assembly.sequence(round_trip(u)) for u in UNITS]
        launch, traced = self._traced(placed, [state], range(len(chains[0])))
        points = [launch]
        for i in range(len(chains[0])):
            local = traced.hit(i)
            points.append(np.stack([placed.pose(c[i].body).apply(p) for c, p in zip(chains, local, strict=True)]))
        return np.stack(points, axis=2)

    def windows(self, states: Sequence[State]) -> SpotWindows:
        """Render the spots of both autocollimators in every state.

        Raises
        ------
        AimError
            A ray cannot be aimed at the mirror.
        BeamMissedError
            A spot is too near to the edge of its CCD for its window.
        """
        parts = list(self._pieces(states))
        return SpotWindows(*(np.concatenate([part[k] for part in parts], axis=1) for k in (0, 1)))

    def _pieces(self, states: Sequence[State]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield photons and window corners of the images for CHUNK states at a time, which limits memory."""
        kernel_radius = self.response.half_width
        count = FINE * self.window + 2 * kernel_radius
        grid = Grid(-0.5 * (count - 1) * self.pitch / FINE, self.pitch / FINE, count)
        light = self.bench.spec.autocollimator.reticle.photons_per_frame * self.pitch**2
        for first in range(0, len(states), CHUNK):
            chunk = states[first : first + CHUNK]
            position, direction, path, valid = self.rays(chunk)
            corner = self._corner(position, valid)
            window_centre = np.zeros((len(corner), 1, 3))
            centre = corner + 0.5 * (self.window - 1) - 0.5 * (np.array(self.shape) - 1)
            window_centre[:, 0, :2] = self.pitch * centre[:, ::-1]  # detector x counts columns, y rows
            field = self._field(position - window_centre, direction, path, valid)
            fine = self.response.apply(image(field, grid, grid, single=True))
            photons = light * fine.reshape(len(fine), self.window, FINE, self.window, FINE).mean(axis=(2, 4))
            # the kernel's lobes may leave -1e-9 of the peak where there is no light
            photons = np.maximum(photons, 0.0)
            yield photons.reshape(2, len(chunk), *photons.shape[1:]), corner.reshape(2, len(chunk), 2)

    def _field(self, position: np.ndarray, direction: np.ndarray, path: np.ndarray, valid: np.ndarray) -> PupilField:
        """Return the light of traced rays at the CCD as one plane wave for each ray, for an evenly illuminated mirror.

        Positions count from the origin of ``position``.
        """
        u, v = direction[..., 0], direction[..., 1]
        solve, dx, dy = self._slopes
        a, b = u @ solve.T, v @ solve.T
        ratio = (a @ dx.T) * (b @ dy.T) - (a @ dy.T) * (b @ dx.T)
        amplitude = np.sqrt(np.abs(ratio) / np.pi) * self.nodes.weight * valid
        phase = eikonal(position, direction, path, np.zeros(3))
        return PupilField(u, v, phase - phase[:, :1], amplitude, self.bench.spec.autocollimator.wavelength)

    def _corner(self, position: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return row and column of the first pixel of each window, (B, 2), centred on the mean of its rays.

        ``position`` holds the positions of N rays of each of B windows on the CCDs, (B, N, 3), metres.
        """
        share = self.nodes.share * valid
        mean = np.einsum("bn,bnk->bk", share, position[..., 1::-1]) / share.sum(axis=1, keepdims=True)
        pixel = mean / self.pitch + 0.5 * (np.array(self.shape) - 1)
        corner = np.rint(pixel - 0.5 * (self.window - 1)).astype(int)
        outside = np.any((corner < 0) | (corner + self.window > np.array(self.shape)), axis=1)
        if np.any(outside):
            row, column = pixel[np.argmax(outside)]
            raise BeamMissedError(
                f"the spot of an autocollimator falls on row {row:.0f}, column {column:.0f}: its window of "
                f"{self.window} pixels does not fit on the area CCD of {self.shape[0]} x {self.shape[1]} pixels; "
                "rotate the table by less"
            )
        return corner


def window_pattern(
    detector: EmvaDetector, corner: np.ndarray, window: int, seed: int, key: tuple[int, ...]
) -> FixedPattern:
    """Return the fixed pattern (gain and offset of each pixel) of S windows of a large CCD, (S, window, window).

    A pixel has the same gain and offset in every window that contains it.

    Parameters
    ----------
    detector : EmvaDetector
        Detector model of the CCD.
    corner : (S, 2) ndarray of int
        First pixels of the windows.
    window : int
        Side of the windows, pixels.
    seed : int
        Seed of the run.
    key : tuple of int
        Number of the CCD among the random streams of the seed.
    """
    tiles: dict[tuple[int, int], FixedPattern] = {}
    gain, offset = np.empty((len(corner), window, window)), np.empty((len(corner), window, window))
    for s, (row, column) in enumerate(corner.tolist()):
        rows, columns = (range(first // TILE, (first + window - 1) // TILE + 1) for first in (row, column))
        for tile in ((r, c) for r in rows for c in columns):
            if tile not in tiles:
                stream = np.random.SeedSequence(seed, spawn_key=(*key, *tile))
                tiles[tile] = detector.fixed_pattern((TILE, TILE), stream)
        top, left = row - rows[0] * TILE, column - columns[0] * TILE
        part = np.s_[top : top + window, left : left + window]
        gain[s] = np.block([[tiles[r, c].gain for c in columns] for r in rows])[part]
        offset[s] = np.block([[tiles[r, c].offset_e for c in columns] for r in rows])[part]
    return FixedPattern(gain, offset)


@dataclass(frozen=True)
class Series:
    """Rotation series about one axis of the turntable.

    Attributes
    ----------
    axis : str
        Axis X, Y or Z of system 1-XYZ.
    half_angle : float
        Half the angle between the mirrors' normals, theta, radians.
    step : float
        Angle between two readings, radians.
    steps : int
        Number of steps after the first reading at zero.
    """

    axis: str
    half_angle: float
    step: float
    steps: int

    @property
    def angles(self) -> np.ndarray:
        """Commanded angles of the turntable, (steps + 1,), radians."""
        return self.step * np.arange(self.steps + 1)

    @property
    def stream(self) -> tuple[int, int, int]:
        """Key of the series' random streams, which makes its random numbers independent of those of other series."""
        return autocollimator.AXES.index(self.axis), round(self.half_angle / ARCSEC), round(1e3 * self.step / ARCSEC)


@dataclass(frozen=True, eq=False)
class SeriesResult:
    """Readings of one rotation series: rotations of both mirrors at each angle of the turntable.

    Attributes
    ----------
    series : Series
        Series that was measured.
    readings : (2, rows, 2) ndarray
        Rotations of both mirrors about X and Y of their autocollimator, relative to the first reading at zero, radians;
        one row for each commanded angle.
    sigma : (2, rows, 2) ndarray
        Standard deviations of the readings due to image noise alone, radians.
    """

    series: Series
    readings: np.ndarray
    sigma: np.ndarray

    @property
    def scale(self) -> float:
        """Factor applied to the readings of mirror 2 in a series about X (1), Y (1 / cos b) or Z (1 / sin b).

        The angle b is that between the mirrors' normals.
        """
        return 1.0 / autocollimator.relation_factor(self.series.axis, 2, 2.0 * self.series.half_angle)

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Readings of mirror 1 and scaled readings of mirror 2 about the series' axis, (rows,) each, radians."""
        component = autocollimator.column_component(self.series.axis)
        return self.readings[0, :, component], self.scale * self.readings[1, :, component]

    @property
    def mean_difference(self) -> float:
        """Mean absolute difference between the readings of mirror 1 and the scaled readings of mirror 2, radians.

        In a series about Z, a rotation that mirror 1 does not show, mirror 2 is compared with the commanded angle of
        the turntable.
        """
        first, second = self.columns
        return autocollimator.mean_difference(self.series.angles if self.series.axis == "Z" else first, second)

    @property
    def from_exact(self) -> np.ndarray:
        """Readings minus the exact ones for an ideal turntable, mirrors and lenses, (2, rows, 2), radians."""
        axis, angles, mirrors = self.series.axis, self.series.angles, 2.0 * self.series.half_angle
        return self.readings - np.stack([autocollimator.exact_reading(axis, angles, u, mirrors) for u in UNITS])


@dataclass(frozen=True, eq=False)
class ReadingTable:
    """Readings of all rotation series in one run of the experiment.

    Attributes
    ----------
    results : tuple of SeriesResult
        Readings of the series.
    seed : int
        Seed of the bench's errors and of the noise.
    """

    results: tuple[SeriesResult, ...]
    seed: int

    def __getitem__(self, axis: str) -> SeriesResult:
        """Return the first series about an axis.

        Raises
        ------
        KeyError
            There is no series about this axis.
        """
        return {result.series.axis: result for result in reversed(self.results)}[axis]


AIRY_RADII = 4.0
"""Radius of the centroid's window, in units of the radius of the first dark ring of the Airy pattern."""
CALIBRATION_POINTS = 9
"""Number of rotations about each axis at which an autocollimator is calibrated."""
DRAWS = 4000
"""Number of random benches from which the spread of the readings is computed, without rendering images."""
_BENCH, _PATTERN, _READINGS, _FRAMES = range(4)
"""Numbers of the random streams of the seed: errors of the bench, pixel patterns, readings, and noise of frames."""


def series_per_axis(spec: AutocollimatorTestSpec) -> tuple[Series, ...]:
    """Return the main rotation series of the experiment: one about each axis."""
    p = spec.programme
    return tuple(Series(axis, getattr(p.stands, axis), p.table, p.steps) for axis in autocollimator.AXES)


def run_autocollimator_test(
    setup: AutocollimatorSetup,
    backend: Backend,
    series: Sequence[Series] | None = None,
    seed: int = 0,
    ideal: bool = False,
    reader: Reader | None = None,
) -> ReadingTable:
    """Simulate the experiment: render and expose the images of every series, and measure the mirrors' rotations.

    Parameters
    ----------
    setup : AutocollimatorSetup
        Experiment with its detector.
    backend : Backend
        Array backend of the trace.
    series : sequence of Series, optional
        Series to measure; by default one about each axis. Series of equal half angle are traced together.
    seed : int
        Seed of the bench's errors and of the detectors' noise.
    ideal : bool
        Omit all errors of the bench, noise and rounding.
    reader : Reader, optional
        Reader of an earlier run of the same setup, to save the calibration.

    Raises
    ------
    BeamMissedError
        A rotation moves a spot off its area CCD.
    """
    all_series = tuple(series_per_axis(setup.spec) if series is None else series)
    reader = reader or Reader(setup, backend)
    results: dict[Series, SeriesResult] = {}
    for half_angle in dict.fromkeys(s.half_angle for s in all_series):
        group = [s for s in all_series if s.half_angle == half_angle]
        states = [state for s in group for state in states_of(setup.spec, s, None if ideal else seed)]
        windows = reader.path(half_angle).windows(states)
        first = 0
        for s in group:
            part = slice(first, first + s.steps + 2)
            first = part.stop
            series_windows = SpotWindows(windows.photons[:, part], windows.corner[:, part])
            results[s] = reader.read(s, series_windows, None if ideal else seed)
    return ReadingTable(tuple(results[s] for s in all_series), seed)


def states_of(spec: AutocollimatorTestSpec, series: Series, seed: int | None) -> list[State]:
    """Return the states of the bench for the reading at zero and all rows of a series, with random errors.

    Errors of the bench are the same in all series of a seed, except the mounting errors of the mirrors, which are drawn
    anew for every half angle. ``seed`` None is the ideal bench.
    """
    e = spec.errors
    on = 0.0 if seed is None else 1.0
    bench, mounts, readings = (
        np.random.default_rng(np.random.SeedSequence(seed or 0, spawn_key=key))
        for key in ((_BENCH,), (_BENCH, series.stream[1]), (_READINGS, *series.stream))
    )
    scale_error = on * e.focal_length * bench.standard_normal(2)
    roll = on * e.ccd_rotation * bench.standard_normal(2)
    tilts = on * e.axis_tilt * bench.standard_normal((3, 3))
    mount = on * e.mirror_mount * mounts.standard_normal((2, 2))
    # the table does not move between the reading at zero and the first row
    angles = np.concatenate([[0.0], series.angles])
    angles[2:] += on * e.turntable_step * readings.standard_normal(series.steps)
    jitter = on * e.reading * readings.standard_normal((len(angles), 2, 2))
    k = autocollimator.AXES.index(series.axis)
    axis = np.where(np.arange(3) == k, 1.0, tilts[k])
    axis = axis / np.linalg.norm(axis)
    out: list[State] = []
    for i, angle in enumerate(angles):
        state = {axis_body(series.axis): Motion(rotate=triple(angle * axis))}
        for n, unit in enumerate(UNITS):
            rotation = triple((*jitter[i, n], 0.0))
            state[autocollimator_body(unit)] = Motion(rotate=rotation, scale=float(scale_error[n]))
            state[ccd_body(unit)] = Motion(rotate=(0.0, 0.0, float(roll[n])))
            state[mirror_body(unit)] = Motion(rotate=triple((*mount[n], 0.0)))
        out.append(state)
    return out


def declared_spread(
    spec: AutocollimatorTestSpec, series: Series, image_sigma: float, draws: int = DRAWS, seed: int = 0
) -> np.ndarray:
    """Return random values of a series' mean difference under the specified errors, (draws,), radians.

    The mean difference is that of `SeriesResult.mean_difference`; no images are rendered.

    Parameters
    ----------
    spec : AutocollimatorTestSpec
        Specification of the test with the standard deviations of its errors.
    series : Series
        Series of the experiment.
    image_sigma : float
        Standard deviation of one reading due to image noise, radians.
    draws : int
        Number of random benches.
    seed : int
        Seed of the random numbers.
    """
    e, rng = spec.errors, np.random.default_rng(seed)
    mirror_angle = 2.0 * series.half_angle
    angles = np.broadcast_to(series.angles, (draws, series.steps + 1)).copy()
    angles[:, 1:] += e.turntable_step * rng.standard_normal((draws, series.steps))
    k = autocollimator.AXES.index(series.axis)
    axis = np.where(np.arange(3) == k, 1.0, e.axis_tilt * rng.standard_normal((draws, 3)))
    rotation = rotation_matrix(angles[..., None] * (axis / np.linalg.norm(axis, axis=1, keepdims=True))[:, None])
    columns = []
    for unit in UNITS:
        frame = rotation_matrix(np.array([mirror_angle if unit == 2 else 0.0, 0.0, 0.0]))
        mount = rotation_matrix(e.mirror_mount * rng.standard_normal((draws, 3)) * [1.0, 1.0, 0.0])
        start = mount @ np.array([0.0, 0.0, -1.0])
        normal = np.einsum("xi,drxy,yj,dj->dri", frame, rotation, frame, start, optimize=True)
        reading = autocollimator.reading_of_normal(normal) - autocollimator.reading_of_normal(start)[:, None]
        roll = rotation_matrix(e.ccd_rotation * rng.standard_normal((draws, 1)) * [0.0, 0.0, 1.0])[:, :2, :2]
        reading = np.einsum("dij,drj->dri", roll, reading)[..., autocollimator.column_component(series.axis)]
        reading *= 1.0 + e.focal_length * rng.standard_normal((draws, 1))
        # the reading at zero is common to all rows; image_sigma already includes its noise
        jitter = e.reading * rng.standard_normal((draws, series.steps + 2))
        reading += jitter[:, 1:] - jitter[:, :1] + image_sigma * rng.standard_normal(reading.shape)
        columns.append(reading)
    first = series.angles if series.axis == "Z" else columns[0]
    second = columns[1] / autocollimator.relation_factor(series.axis, 2, mirror_angle)
    return np.asarray(np.mean(np.abs(first - second), axis=1))


class Reader:
    """Detectors and calibration of the two autocollimators, which are equal.

    It exposes the detectors to the light and measures the rotations of the mirrors from the frames.

    Parameters
    ----------
    setup
        Experiment with its detector.
    backend
        Array backend of the trace.

    Attributes
    ----------
    map
        Calibration from the position of a spot to the rotation of the mirror.
    """

    def __init__(self, setup: AutocollimatorSetup, backend: Backend) -> None:
        self.spec = setup.spec
        self.backend = backend
        self.exposure: float = setup.spec.autocollimator.area_ccd.exposure
        self.detector = EmvaDetector.from_sheet(setup.detector, self.exposure)
        self._paths: dict[float, AutocollimatorPath] = {}
        self.map = self._calibrate()

    def path(self, half_angle: float) -> AutocollimatorPath:
        """Return the light path for a half angle theta between the mirrors' normals, radians; it is built only once."""
        if half_angle not in self._paths:
            self._paths[half_angle] = AutocollimatorPath(build_bench(self.spec, half_angle), self.backend)
        return self._paths[half_angle]

    def _calibrate(self) -> autocollimator.ReadingMap:
        """Calibrate the ideal autocollimator with noise-free images at known rotations about X and Y together."""
        p = self.spec.programme
        half_range = 1.02 * max(p.small, p.table, p.large) * p.steps
        angles = np.linspace(-half_range, half_range, CALIBRATION_POINTS)
        rotations = np.stack(np.meshgrid(angles, angles, 0.0, indexing="ij"), axis=-1).reshape(-1, 3)
        windows = self.path(p.narrow).windows([{axis_body("X"): Motion(rotate=triple(r))} for r in rotations])
        photons, corner = windows.photons[0], windows.corner[0]
        positions, _ = self.positions(self.detector.expected_dn(photons, self.exposure), corner)
        normals = rotation_matrix(rotations) @ np.array([0.0, 0.0, -1.0])
        return autocollimator.ReadingMap.fit(positions, autocollimator.reading_of_normal(normals))

    def positions(self, mean: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, SpotPositions]:
        """Measure the positions of the spots in B window images, in pixels of the whole CCD.

        Parameters
        ----------
        mean : (B, H, W) ndarray
            Mean images of the windows of H rows and W columns, DN.
        corner : (B, 2) ndarray of int
            First pixel of each window on the CCD.

        Returns
        -------
        tuple of ndarray and SpotPositions
            Positions (row, column) on the CCD, (B, 2), and the spot measurements in their windows.
        """
        bench = self.path(self.spec.programme.narrow).bench
        airy = 0.61 * self.spec.autocollimator.wavelength / bench.numerical_aperture
        noise = self.detector.noise_model(self.exposure)
        radius = min(AIRY_RADII * airy / self.spec.autocollimator.area_ccd.pitch, 0.4 * mean.shape[-1])
        spots = energy_centroid(mean, self.spec.autocollimator.frames, noise, radius, keep_maps=False)
        return spots.position + corner, spots

    def expose(self, windows: SpotWindows, stream: tuple[int, ...], seed: int) -> np.ndarray:
        """Expose frames of both CCDs in S states of the bench, uint16 (2, S, frames, window, window)."""
        out = []
        for n, (photons, corner) in enumerate(zip(windows.photons, windows.corner, strict=True)):
            pattern = window_pattern(self.detector, corner, photons.shape[-1], seed, (_PATTERN, n))
            noise = np.random.SeedSequence(seed, spawn_key=(_FRAMES, n, *stream))
            out.append(self.detector.expose(photons, pattern, self.spec.autocollimator.frames, self.exposure, noise))
        return np.stack(out)

    def read(self, series: Series, windows: SpotWindows, seed: int | None) -> SeriesResult:
        """Measure the mirrors' rotations from the images of a series, relative to its first reading at zero."""
        if seed is None:
            mean = self.detector.expected_dn(windows.photons, self.exposure)
        else:
            mean = mean_frames(self.expose(windows, series.stream, seed))
        positions, spots = self.positions(mean.reshape(-1, *mean.shape[2:]), windows.corner.reshape(-1, 2))
        shape = windows.corner.shape
        rotations = self.map(positions).reshape(shape)
        variance = np.einsum("bkk->bk", self.map.covariance(positions, spots.covariance)).reshape(shape)
        return SeriesResult(series, rotations[:, 1:] - rotations[:, :1], np.sqrt(variance[:, 1:] + variance[:, :1]))
