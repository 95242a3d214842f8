"""Two autocollimators that look at two mirrors on a turntable: the bench with its errors, and its readings from images.

The bench's errors are motions of bodies. They are drawn from the seed and applied to the scene alone: the analysis
reads the frames with the calibration of the ideal autocollimator and the angles that the turntable and the mirrors
*should* have. Each series begins with a reading at zero that is taken off all others, and its first row is a
second reading at zero, which shows the unrest.

Images of autocollimators that look at mirrors: pinhole, lens, mirror, lens, a window of the area CCD.

As in ``twin.monitor.monitor_path``, rays from the pinhole are aimed at quadrature nodes of the smallest aperture, which
is the mirror, traced back to the CCD, and summed as plane waves on the CCD's own pixels. Only the window that is read
out is rendered. Its place is the whole pixel nearest to the mean of the traced rays; it stands for a read-out that
first finds the brightest pixel of the full frame. The analysis is told the window's corner, as a camera reports it, and
nothing else.

From the YAML of a test with two autocollimators to the optical assembly: autocollimators, turntable, mirrors.

Frames, all right-handed. System frame 1-XYZ (paper 001, section 3.1): X up, Y horizontal, Z = X x Y along the
view of autocollimator 1, from its lens to its mirror; the origin is where the turntable's three axes cross.
Frame 2-XYZ is frame 1 turned about X by b = 2 theta, so that

    Y1 = Y2 cos b - Z2 sin b,    Z1 = Y2 sin b + Z2 cos b.

A mirror's frame is that of its autocollimator turned by half a turn about Y: its +z is its normal, toward the lens. A
lens's frame is likewise turned, with +z toward the focal plane. Area CCD: columns along the autocollimator's +Y, rows
along its -X, facing the lens; a turn of the mirror by +X moves the spot to larger columns, by +Y to larger rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor import autocollimator
from analysis.spots.centroid import energy_centroid, mean_frames
from analysis.spots.spot_positions import SpotPositions
from optics.geometry import zernike
from optics.geometry.aperture import Circle
from optics.geometry.pose import Pose, about_axis, rotation_matrix
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
from scenes.specs.autocollimators import AutocollimatorSetup, AutocollimatorTestSpec, LensSpec
from twin.sensors.area_detector import EmvaDetector, FixedPattern

BENCH = "bench"
AXES = ("X", "Y", "Z")
UNITS = (1, 2)
"""The two autocollimators, each with its mirror."""

_ABOUT_Y = np.diag([-1.0, 1.0, -1.0])  # half a turn
_DETECTOR = np.stack([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], axis=-1)


def autocollimator_body(unit: int) -> str:
    """Body path of autocollimator 1 or 2; all its parts ride on it."""
    return f"{BENCH}/autocollimator_{unit}"


def pinhole_body(unit: int) -> str:
    """Body path of its pinhole."""
    return f"{autocollimator_body(unit)}/focal_plane/pinhole"


def ccd_body(unit: int) -> str:
    """Body path of its area CCD."""
    return f"{autocollimator_body(unit)}/focal_plane/area_ccd"


def axis_body(axis: str) -> str:
    """Body path of the part of the turntable that turns about X, Y or Z; Z rides on Y, Y on X."""
    return "/".join([BENCH, "turntable", *AXES[: AXES.index(axis) + 1]])


def mirror_body(unit: int) -> str:
    """Body path of mirror 1 or 2, on the innermost part of the turntable."""
    return f"{axis_body('Z')}/mirror_{unit}"


def outgoing(unit: int) -> str:
    """Sequence from the pinhole to the mirror."""
    return f"outgoing_{unit}"


def round_trip(unit: int) -> str:
    """Sequence from the pinhole over the mirror to the area CCD."""
    return f"round_trip_{unit}"


@dataclass(frozen=True, eq=False)
class Bench:
    """The bench with its mirrors 2 theta apart.

    Attributes
    ----------
    spec : AutocollimatorTestSpec
        What the YAML says.
    half_angle : float
        Theta, radians.
    assembly : Assembly
        Bodies, elements, sequences.
    focal_length : float
        Of the autocollimators, paraxial, metres.
    """

    spec: AutocollimatorTestSpec
    half_angle: float
    assembly: Assembly
    focal_length: float

    @property
    def between(self) -> float:
        """b, twice theta: the angle between the mirrors' normals, radians."""
        return 2.0 * self.half_angle

    @property
    def numerical_aperture(self) -> float:
        """Numerical aperture of the returned beam at the area CCD."""
        return 0.5 * self.spec.mirrors.aperture / self.focal_length

    def frame(self, unit: int) -> np.ndarray:
        """X, Y, Z of frame 1-XYZ or 2-XYZ in the bench as columns, (3, 3)."""
        return about_axis(0, self.between if unit == 2 else 0.0)


def paraxial_focus(lens: LensSpec, wavelength: float) -> tuple[float, float]:
    """Focal length, and distance of the focus from the back vertex, of the lens for a beam from infinity, metres."""
    n = glass(lens.glass).index(wavelength)
    angle = -(n - 1.0) / (n * lens.front_radius)
    height = 1.0 + angle * lens.thickness
    leaving = n * angle - height * (1.0 - n) / lens.back_radius
    return -1.0 / leaving, -height / leaving


def build_bench(spec: AutocollimatorTestSpec, half_angle: float) -> Bench:
    """Build the bench with the mirrors square to their autocollimators.

    Parameters
    ----------
    spec : AutocollimatorTestSpec
        The experiment.
    half_angle : float
        Theta, radians.
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
    """An autocollimator, its origin at the front vertex of the lens. Scaling it changes its focal length; the interior
    of the focal plane keeps its size.
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
MAP_TERMS = 15
FINE = 2
"""Samples per pixel side. The pixels sample the irradiance at 0.43 cycles each, too near to the limit of 0.5 for the
exact pixel filter; on half pixels it is exact, and four of their means are a pixel's mean."""
CHUNK = 24
"""States traced and rendered at once, to bound memory."""
TILE = 64
"""Side of the square tiles in which a CCD's fixed pattern is drawn, pixels."""


@dataclass(frozen=True, eq=False)
class SpotWindows:
    """What two autocollimators see in S states.

    Attributes
    ----------
    photons : np.ndarray
        Expected photons per pixel and frame, (2, S, window, window).
    corner : np.ndarray
        (row, column) of each window's first pixel on the CCD, (2, S, 2).
    """

    photons: np.ndarray
    corner: np.ndarray


class AutocollimatorPath:
    """Traces and images both autocollimators of one bench.

    Parameters
    ----------
    bench
        The bench.
    backend
        Where to trace.
    nodes
        On the mirror; by default a quadrature that makes the images right to 1e-6 of their peak.

    Raises
    ------
    InputError
        Area CCDs that do not sample the spots.
    """

    def __init__(self, bench: Bench, backend: Backend, nodes: PupilNodes | None = None) -> None:
        self.bench = bench
        self.backend = backend
        collimator = bench.spec.autocollimator
        self.pitch: float = collimator.area_ccd.pitch
        self.window: int = collimator.window
        self.shape = (collimator.area_ccd.rows, collimator.area_ccd.columns)
        # the farthest pixel from a spot that is up to a pixel off the window's middle, kernel included
        reach = (0.5 * self.window + 1.0 + self.response.reach / FINE) * np.sqrt(2.0) * self.pitch
        phase = 2.0 * np.pi * bench.numerical_aperture * reach / collimator.wavelength
        self.nodes = quadrature.disk_for(phase) if nodes is None else nodes

    @cached_property
    def response(self) -> PixelResponse:
        """What a 1/FINE part of a pixel and the pinhole do to the image.

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
            problem = f"the area CCDs cannot follow the spots: of {FINE} samples to the pixel, {error}"
            raise self.bench.spec.error(problem, ("autocollimator", *key), allowed=error.remedy) from error

    @cached_property
    def _slopes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Operators on smooth functions: values on the nodes to Zernike terms (T, N), terms to d/dx, d/dy (N, T)."""
        x, y = self.nodes.x, self.nodes.y
        root = np.sqrt(self.nodes.weight)
        solve = np.linalg.pinv(zernike.basis(MAP_TERMS, x, y) * root[:, None]) * root
        dx, dy = (zernike.gradient_basis(MAP_TERMS, x, y, axis) for axis in (0, 1))
        return solve, dx, dy

    @cached_property
    def _start(self) -> tuple[np.ndarray, np.ndarray]:
        """Aim parameters (2, N, 2) and their Jacobian of the unperturbed bench."""
        placed = self.bench.assembly.place()
        fan, systems = self._fan(placed, [{}])
        middle, slope = aim(self.backend, systems, fan, np.zeros((1, 2)), tolerance=AIM_TOLERANCE)
        near = middle + np.einsum("bnij,pj->bpi", np.linalg.inv(slope), self._targets)
        return aim(self.backend, systems, fan, self._targets, near, slope, AIM_TOLERANCE)

    @property
    def _targets(self) -> np.ndarray:
        """Nodes on the mirror, (N, 2), metres."""
        return 0.5 * self.bench.spec.mirrors.aperture * np.stack([self.nodes.x, self.nodes.y], axis=-1)

    def _fan(self, placed: PlacedBodies, states: Sequence[State]) -> tuple[RayFan, SystemBatch]:
        """Rays that leave the pinholes toward the lens, unit by unit, and the systems up to the mirror."""
        origin = np.concatenate([placed.translation[:, placed.index[pinhole_body(u)]] for u in UNITS])[:, None]
        frames = np.concatenate([placed.rotation[:, placed.index[autocollimator_body(u)]] for u in UNITS])
        view, up = frames[:, None, :, 2], frames[:, None, :, 0]
        systems = assemble(self.bench.assembly, [outgoing(u) for u in UNITS], states, placed=placed)
        return RayFan(origin, view, transverse_axes(view, up)), systems

    def rays(self, states: Sequence[State]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position, direction (2 S, N, 3), path, validity (2 S, N) at the CCDs in their frames, unit by unit.

        Raises
        ------
        BeamMissedError, AimError
            The light of a spot does not come back.
        """
        rays = self._traced(self.bench.assembly.place(states), states)[1].numpy()
        require_rays(rays[3], "the autocollimators")
        return rays

    def _traced(
        self, placed: PlacedBodies, states: Sequence[State], keep: Sequence[int] = ()
    ) -> tuple[np.ndarray, Traced]:
        """Launch points (2 S, N, 3), world, and the rays at the CCDs."""
        fan, systems = self._fan(placed, states)
        start, slope = (np.repeat(a, len(states), axis=0) for a in self._start)
        q, _ = aim(self.backend, systems, fan, self._targets, start, slope, AIM_TOLERANCE)
        back = assemble(self.bench.assembly, [round_trip(u) for u in UNITS], states, placed=placed)
        position, direction = fan.at(q)
        return position, trace(self.backend, back, make_rays(self.backend, position, direction), keep)

    def polylines(self, state: State) -> np.ndarray:
        """Rays of both autocollimators as points in the bench, pinhole, surfaces, CCD, (2, N, 7, 3), metres."""
        placed = self.bench.assembly.place([state])
        chains = [self.bench.assembly.sequence(round_trip(u)) for u in UNITS]
        launch, traced = self._traced(placed, [state], range(len(chains[0])))
        points = [launch]
        for i in range(len(chains[0])):
            local = traced.hit(i)
            points.append(np.stack([placed.pose(c[i].body).apply(p) for c, p in zip(chains, local, strict=True)]))
        return np.stack(points, axis=2)

    def windows(self, states: Sequence[State]) -> SpotWindows:
        """Images of both autocollimators in every state.

        Raises
        ------
        BeamMissedError
            a spot is too near its CCD's edge for its window; AimError.
        """
        parts = list(self._pieces(states))
        return SpotWindows(*(np.concatenate([part[k] for part in parts], axis=1) for k in (0, 1)))

    def _pieces(self, states: Sequence[State]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        reach = self.response.reach
        count = FINE * self.window + 2 * reach
        grid = Grid(-0.5 * (count - 1) * self.pitch / FINE, self.pitch / FINE, count)
        light = self.bench.spec.autocollimator.reticle.photons_per_frame * self.pitch**2
        for first in range(0, len(states), CHUNK):
            some = states[first : first + CHUNK]
            position, direction, path, valid = self.rays(some)
            corner = self._corner(position, valid)
            middle = np.zeros((len(corner), 1, 3))
            centre = corner + 0.5 * (self.window - 1) - 0.5 * (np.array(self.shape) - 1)
            middle[:, 0, :2] = self.pitch * centre[:, ::-1]  # detector x counts columns, y rows
            field = self._field(position - middle, direction, path, valid)
            fine = self.response.apply(image(field, grid, grid, single=True))
            photons = light * fine.reshape(len(fine), self.window, FINE, self.window, FINE).mean(axis=(2, 4))
            # the kernel's lobes may leave -1e-9 of the peak where there is no light
            photons = np.maximum(photons, 0.0)
            yield photons.reshape(2, len(some), *photons.shape[1:]), corner.reshape(2, len(some), 2)

    def _field(self, position: np.ndarray, direction: np.ndarray, path: np.ndarray, valid: np.ndarray) -> PupilField:
        """Plane waves about the origin of ``position``; the mirror is evenly lit."""
        u, v = direction[..., 0], direction[..., 1]
        solve, dx, dy = self._slopes
        a, b = u @ solve.T, v @ solve.T
        ratio = (a @ dx.T) * (b @ dy.T) - (a @ dy.T) * (b @ dx.T)
        amplitude = np.sqrt(np.abs(ratio) / np.pi) * self.nodes.weight * valid
        phase = eikonal(position, direction, path, np.zeros(3))
        return PupilField(u, v, phase - phase[:, :1], amplitude, self.bench.spec.autocollimator.wavelength)

    def _corner(self, position: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """First pixels (B, 2) of the windows around the mean of rays (B, N, 3) on the CCDs."""
        share = self.nodes.share * valid
        mean = np.einsum("bn,bnk->bk", share, position[..., 1::-1]) / share.sum(axis=1, keepdims=True)
        place = mean / self.pitch + 0.5 * (np.array(self.shape) - 1)
        corner = np.rint(place - 0.5 * (self.window - 1)).astype(int)
        outside = np.any((corner < 0) | (corner + self.window > np.array(self.shape)), axis=1)
        if np.any(outside):
            row, column = place[np.argmax(outside)]
            raise BeamMissedError(
                f"the spot of an autocollimator falls on row {row:.0f}, column {column:.0f}: its window of "
                f"{self.window} pixels does not fit on the area CCD of {self.shape[0]} x {self.shape[1]} pixels; "
                "turn the table by less"
            )
        return corner


def window_pattern(
    detector: EmvaDetector, corner: np.ndarray, window: int, seed: int, key: tuple[int, ...]
) -> FixedPattern:
    """Fixed pattern of windows of one large CCD, (S, window, window): a pixel differs from its neighbours in the same
    way in whichever window it is read out.

    Parameters
    ----------
    detector : EmvaDetector
        Its data sheet.
    corner : np.ndarray
        First pixels of the windows, (S, 2).
    window : int
        Their side.
    seed : int
        Of the run.
    key : tuple[int, ...]
        The CCD's number among the seed's streams.
    """
    tiles: dict[tuple[int, int], FixedPattern] = {}
    gain, offset = np.empty((len(corner), window, window)), np.empty((len(corner), window, window))
    for s, (row, column) in enumerate(corner.tolist()):
        rows, columns = (range(first // TILE, (first + window - 1) // TILE + 1) for first in (row, column))
        for place in ((r, c) for r in rows for c in columns):
            if place not in tiles:
                stream = np.random.SeedSequence(seed, spawn_key=(*key, *place))
                tiles[place] = detector.fixed_pattern((TILE, TILE), stream)
        top, left = row - rows[0] * TILE, column - columns[0] * TILE
        part = np.s_[top : top + window, left : left + window]
        gain[s] = np.block([[tiles[r, c].gain for c in columns] for r in rows])[part]
        offset[s] = np.block([[tiles[r, c].offset_e for c in columns] for r in rows])[part]
    return FixedPattern(gain, offset)


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

    Attributes
    ----------
    series : Series
        What was turned.
    readings : np.ndarray
        (2 mirrors, rows, 2) turns about each autocollimator's own X and Y against its reading at zero, radians.
    sigma : np.ndarray
        (2, rows, 2) their standard deviations by the noise of the images alone, radians.
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

    Parameters
    ----------
    setup : AutocollimatorSetup
        The experiment with its detector.
    backend : Backend
        Where to trace.
    series : Sequence[Series] | None
        What to turn; by default one series about each axis. Those of one half angle are traced together.
    seed : int
        Of the bench's errors and the detectors' noise.
    ideal : bool
        No errors of the bench, and images without noise or rounding.
    reader : Reader | None
        Of an earlier run of the same setup, to save the calibration.
    progress : Callable[[str], None] | None
        Told what is being done.

    Raises
    ------
    BeamMissedError
        a turn takes a spot off its area CCD.
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

    Parameters
    ----------
    spec : AutocollimatorTestSpec
        The experiment.
    series : Series
        One of its series.
    image_sigma : float
        Standard deviation of one reading by the noise of the images, radians.
    draws : int
        Number of benches.
    seed : int
        Of the draws.
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

    Parameters
    ----------
    setup
        The experiment with its detector.
    backend
        Where to trace.

    Attributes
    ----------
    map
        The calibration, from the place of a spot to the turn of the mirror.
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
