"""Wavefront, spot and MTF of one camera in one state, at positions in its field.

A **field** is a pair (along the line, along the track) of fractions of the camera's half angles of view, each from -1
to 1: (1, 0) is the end of the unperturbed camera's field on the side of the left end (+Y') of its line CCD. Angles from
the middle of the field with a unit, ``"0.2 -0.1 deg"``, are taken as well. A field rotates with the camera, so that a
look angle or a motion of the whole camera does not change its image quality.

Wavefront errors are measured from the sphere about the image of the chief ray, with the radius of the nominal exit
pupil, and are positive where the wavefront is ahead. Piston and tilt, which shift an image without blurring it, are
removed over the light that passes; defocus remains.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from analysis.arrays import shows
from optics.geometry import zernike
from optics.geometry.polygon import area, covered
from optics.geometry.tree import State
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError, check_range
from optics.numerics.backend import Backend, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from optics.numerics.quadrature import circle
from optics.raytrace.assembly import Assembly
from optics.raytrace.first_order import equal_area_radius
from optics.waves.edge_shadow import IlluminatedStop, holes
from optics.waves.imaging import PartFit, fit_part, path_to_sphere
from optics.waves.line_transfer import line_transfers
from optics.waves.optical_transfer import polychromatic_transfer
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_stack import PupilFunction
from optics.waves.pupil_terms import products, smooth_terms
from scenes.models.camera_model import ROOT, CameraModel, camera_alone, derive_camera, field_direction, lenses
from scenes.models.camera_sharpness import FIELDS, FieldBeams, FocalPlane, Vignetting, stop_nodes
from scenes.models.instrument_model import Instrument
from scenes.models.shadow import ImagingShadows, imaging_shadows
from scenes.specs.camera import CameraSpec
from scenes.specs.instrument import BASE
from scenes.yaml.units import LENGTH
from twin.camera.camera_results import (
    ROUNDING,
    TERMS,
    Field,
    FieldText,
    Frequencies,
    Mtf,
    Spot,
    Wavefront,
    check_mtf,
    check_wavefront,
    field_fractions,
    in_cycles_per_m,
    in_si,
)
from twin.targets.target_path import LineRays, TargetPath

RINGS = 12
"""Number of rings of the quadrature over the stop.

Mean squares of wavefront errors that are polynomials of degree 23 or less are exact with it.
"""

MAP_POINTS = 65
"""Number of points of a wavefront map along each axis of the stop."""

MTF_POINTS = 65
"""Default number of frequencies of an MTF."""

SPOT_RINGS = 8
"""Number of rings of rays about the chief ray in a spot diagram; each ring has six more rays than the one inside it."""


MAX_RAYS = 500_000
"""Largest number of rays traced at once, to limit memory."""

INSIDE = 1.0 - 1e-9
"""Radius, in units of the stop's, at which rays of the stop's edge are aimed, so that rounding does not vignet them."""


@shows("model.spec.name", "model.mirrors", "model.paraxial.focal_length [m]", "model.entrance_pupil [mm]", "state")
@dataclass(frozen=True, eq=False)
class CameraOptics:
    """Optical analysis of one camera in one state.

    Create it with ``CameraOptics.alone`` from a prescription or with ``CameraOptics.within`` from a camera of an
    instrument.

    Attributes
    ----------
    path : TargetPath
        Light path from the scene to the line CCD.
    state : State
        Motions of bodies and effects of heat; empty for the nominal state.
    colour : float or None
        Wavelength of the light, metres; None for the design wavelength.
    built : bool
        True if the camera's instrument departs from the prescription by its as-built errors.
    """

    path: TargetPath
    state: State = field(default_factory=FrozenMap)
    colour: float | None = None
    built: bool = False

    @classmethod
    def alone(cls, camera: CameraSpec | CameraModel, backend: Backend, state: State | None = None) -> Self:
        """Return a camera without an instrument; its bodies are ``camera/M1`` ... ``camera/focal_plane``.

        Raises
        ------
        InputError
            The prescription does not bring the light of its field through the stop to the image.
        """
        model = camera if isinstance(camera, CameraModel) else derive_camera(camera, backend)
        return cls(TargetPath(camera_alone(model), ROOT, ROOT, model, backend), FrozenMap(state or {}))

    @classmethod
    def within(
        cls, instrument: Instrument, name: str, backend: Backend, state: State | None = None, obstruction: bool = True
    ) -> Self:
        """Return a camera of an instrument, in a state of the whole instrument.

        Parameters
        ----------
        instrument : Instrument
            Instrument with the camera.
        name : str
            Name of the camera.
        backend : Backend
            Array backend of the trace.
        state : State, optional
            State of the instrument with the effects of heat, for example ``MonitorExperiment.state(job)``.
        obstruction : bool
            Remove the light that prisms and other bodies block.

        Raises
        ------
        KeyError
            There is no camera of that name.
        """
        shadows: ImagingShadows | None = imaging_shadows(instrument, name, backend) if obstruction else None
        path = TargetPath(
            instrument.assembly, name, f"{BASE}/{name}", instrument.cameras[name], backend, shadows=shadows
        )
        return cls(path, FrozenMap(state or {}), built=bool(instrument.as_built))

    def in_state(self, state: State) -> Self:
        """Return the analysis of the same camera in another state (motions of its bodies and effects of heat)."""
        return replace(self, state=FrozenMap(state))

    def at(self, wavelength: float | str) -> Self:
        """Return the camera in light of another wavelength, in metres or with its unit, such as ``"486 nm"``.

        Lenses have their refractive index there, and wavefront errors are in waves of it.

        Raises
        ------
        ValueError
            The glass of a lens is not named, or its index is unknown at this wavelength.
        """
        colour = in_si(wavelength, LENGTH, "wavelength")
        self.path.coloured(self.state, colour)
        return replace(self, colour=colour)

    @property
    def wavelength(self) -> float:
        """Wavelength of the light, metres."""
        return float(self.model.spec.wavelength if self.colour is None else self.colour)

    @property
    def model(self) -> CameraModel:
        """Quantities that the prescription implies, such as poses of surfaces and directions of fields."""
        return self.path.model

    @property
    def assembly(self) -> Assembly:
        """Assembly of bodies and optical elements that contains the camera, for ray tracing."""
        return self.path.assembly

    @cached_property
    def nyquist(self) -> float:
        """Nyquist frequency of the line CCD's pixels, cycles/m."""
        return float(0.5 / self.model.spec.line.pitch)

    @cached_property
    def vignetting(self) -> Vignetting | None:
        """Mask of the stop's points that bodies of the nominal instrument block; None where they block none."""
        if not np.any(area(self.path.shadow_pieces({}, self._designed(np.array(FIELDS)))) > SMALLEST):
            return None
        return lambda fields, points: covered(self.path.shadow_pieces({}, self._designed(fields)), points, SMALLEST)

    def fractions(self, fields: Sequence[Field | FieldText] | np.ndarray) -> np.ndarray:
        """Return F fields as fractions of the half angles of view, (F, 2).

        Raises
        ------
        ValueError
            A field lies beyond the camera's field of view, for which it has no clear apertures.
        """
        half = self.model.spec.field
        return np.array([field_fractions(field, (half.x, half.y)) for field in fields])

    def _angles(self, field: np.ndarray) -> tuple[float, float]:
        """Return the angles of a field, (2,) fractions, from the middle along line and track, radians."""
        half = self.model.spec.field
        return float(field[0]) * half.x, float(field[1]) * half.y

    def _designed(self, fields: np.ndarray) -> np.ndarray:
        """Return the directions of the light of F fields for the camera in its nominal state, (F, 3)."""
        return replace(self, state=FrozenMap()).directions(fields)

    def directions(self, fields: Sequence[Field | FieldText] | np.ndarray) -> np.ndarray:
        """Return the directions of the light of F fields, (F, 2), in the world frame, unit vectors (F, 3).

        Raises
        ------
        ValueError
            A field lies beyond the camera's field of view, for which it has no clear apertures.
        """
        light = np.array([field_direction(self.model.spec, *self._angles(field)) for field in self.fractions(fields)])
        root = self.assembly.place([self.state]).pose(self.path.root)
        return np.asarray(light @ self.model.camera_frame.rotation @ root.rotation.T)

    def rays(
        self, fields: Sequence[Field | FieldText] | np.ndarray, points: np.ndarray, edges: bool = True
    ) -> LineRays:
        """Trace rays of F fields, (F, 2), through N points of the stop, (N, 2), to the line CCD.

        Points are in units of the stop's radius. Without ``edges``, those of the file stop no ray.

        Raises
        ------
        AimError, BeamMissedError
            In this state the light misses the stop or the plane of the line CCD.
        """
        return self.path.rays(self.path.coloured(self.state, self.wavelength), self.directions(fields), points, edges)

    @one_blas_thread()  # small matrices: threads would only wait for each other
    def wavefronts(
        self,
        fields: Sequence[Field | FieldText] | np.ndarray,
        points: int = MAP_POINTS,
        terms: int = TERMS,
        by_rays: bool = False,
    ) -> tuple[Wavefront, ...]:
        """Compute wavefront errors at F fields, (F, 2), with maps of ``points`` by ``points``.

        With ``by_rays``, rays alone sample the light of a vignetted beam, to ``RAYS_ACCURACY``, which is ten times as
        fast.

        Raises
        ------
        AimError, BeamMissedError
            In this state the light misses the stop or the plane of the line CCD.
        """
        fields = self.fractions(fields)
        nodes = stop_nodes(self.model, RINGS, self.vignetting is not None)
        axis = np.linspace(-1.0, 1.0, points)
        x, y = np.meshgrid(axis, axis)
        inside = np.hypot(x, y) <= 1.0
        edge = rim(4 * RINGS)
        stop_nodes_xy = np.stack([nodes.x, nodes.y], axis=-1)
        stop = np.concatenate([[[0.0, 0.0]], stop_nodes_xy, edge, INSIDE * np.stack([x[inside], y[inside]], axis=-1)])
        rays = self.rays(fields, stop)
        wavelength = self.wavelength

        def in_waves(rays: LineRays) -> np.ndarray:
            return -self.path_error(rays) / wavelength

        error = in_waves(rays)
        out = []
        node_slice = slice(1, 1 + nodes.count)
        light = rays.valid[:, node_slice] @ nodes.share
        is_vignetted = self.vignetting is not None or bool(self.model.edges)
        sight = self.directions(fields)[:, None]
        state = self.path.coloured(self.state, wavelength)
        for k, where in enumerate(fields):
            passed = rays.valid[k]
            weight = nodes.weight * passed[node_slice]
            exact = None
            if is_vignetted and not by_rays:
                exact = fit_illuminated(self.path, state, sight[k], RINGS, float(light[k]), in_waves, terms)
            fit = fit_part(nodes.x, nodes.y, weight, error[k, node_slice], terms) if exact is None else exact.fit
            flat = error[k] - zernike.basis(3, *stop.T) @ fit.level
            table = np.full(inside.shape, np.nan)
            table[inside] = np.where(passed, flat, np.nan)[1 + nodes.count + len(edge) :]
            through = float(np.sum(weight) / np.sum(nodes.weight)) if exact is None else exact.light
            wave = Wavefront(
                field=(float(where[0]), float(where[1])),
                field_rad=self._angles(where),
                wavelength=wavelength,
                x=axis,
                y=axis,
                map=table,
                coefficients=fit.coefficients,
                parts=fit.parts,
                rms=fit.rms,
                peak_to_valley=float(np.ptp(flat[1:][passed[1:]])),
                residual=fit.residual_rms,
                strehl=fit.strehl,
                vignetted=1.0 - through,
                position=self._place(rays, k),
                hole=(np.nan if is_vignetted else 0.0) if exact is None else exact.hole,
                accuracy=(RAYS_ACCURACY if is_vignetted else 0.0) if exact is None else exact.accuracy,
            )
            check_wavefront(wave)
            out.append(wave)
        return tuple(out)

    def wavefront(self, field: Field | FieldText = (0.0, 0.0), points: int = MAP_POINTS) -> Wavefront:
        """Compute the wavefront error at one field, with a map of ``points`` by ``points``."""
        return self.wavefronts([field], points)[0]

    def spots(self, fields: Sequence[Field | FieldText] | np.ndarray, defocus: float | str = 0.0) -> tuple[Spot, ...]:
        """Compute spots at F fields, (F, 2), on the line CCD moved downstream by ``defocus``, metres or text.

        Raises
        ------
        AimError, BeamMissedError
            In this state the light misses the stop or the plane of the line CCD.
        """
        fields, moved = self.fractions(fields), in_si(defocus, LENGTH, "defocus")
        nodes = stop_nodes(self.model, RINGS, self.vignetting is not None)
        rings = [r / SPOT_RINGS * rim(6 * r) for r in range(1, SPOT_RINGS + 1)]
        stop = np.concatenate([np.zeros((1, 2)), np.stack([nodes.x, nodes.y], axis=-1), *rings])
        rays = self.rays(fields, stop)
        leaving = rays.direction
        # the light travels along -Z or +Z of the line CCD; downstream is its direction
        position = rays.position[..., 1::-1] + moved * leaving[..., 1::-1] / np.abs(leaving[..., 2:])
        position = position / rays.size
        out = []
        for k, where in enumerate(fields):
            passed = rays.valid[k]
            weight = nodes.weight * passed[1 : 1 + nodes.count]
            weight = weight / np.sum(weight)
            offset = position[k] - position[k, 0]
            node_offset = offset[1 : 1 + nodes.count]
            centroid = weight @ node_offset
            spread = weight @ (node_offset - centroid) ** 2
            hexapolar = np.concatenate([offset[:1], offset[1 + nodes.count :][passed[1 + nodes.count :]]])
            out.append(
                Spot(
                    field=(float(where[0]), float(where[1])),
                    field_rad=self._angles(where),
                    rays=hexapolar,
                    centroid=centroid,
                    rms=float(np.sqrt(np.sum(spread))),
                    rms_along=np.sqrt(spread),
                    farthest=float(np.max(np.linalg.norm(hexapolar - centroid, axis=-1))),
                    airy=0.61 * self.wavelength / equal_area_radius(leaving[k, -len(rings[-1]) :, :2]),
                    position=self._place(rays, k),
                )
            )
        return tuple(out)

    def spot(self, field: Field | FieldText = (0.0, 0.0), defocus: float | str = 0.0) -> Spot:
        """Compute the spot at one field on the line CCD moved downstream by ``defocus``, metres or text."""
        return self.spots([field], defocus)[0]

    def beams(self, fields: Sequence[Field | FieldText] | np.ndarray, rings: int = RINGS) -> FieldBeams:
        """Trace the beams of F fields near the image, in the prescription's frame.

        In a perturbed state the beams have their true position relative to the moved line CCD, which is drawn where it
        was designed to be.

        Parameters
        ----------
        fields : (F, 2) array_like
            The F fields.
        rings : int
            Rings of the quadrature over the stop.

        Raises
        ------
        AimError, BeamMissedError
            In this state the light misses the stop or the plane of the line CCD.
        InputError
            Edges block all of a field's light.
        """
        positions = tuple((float(x), float(y)) for x, y in self.fractions(fields))
        if not self.state and not self.built:
            model, blocked = self.model, self.vignetting
            return FieldBeams.trace(model, self.path.backend, positions, rings, blocked, wavelength=self.wavelength)
        nodes = stop_nodes(self.model, rings, self.vignetting is not None)
        rays = self.rays(fields, np.concatenate([np.zeros((1, 2)), np.stack([nodes.x, nodes.y], axis=-1)]))
        plane = self.model.focal_plane
        position, direction = plane.apply(rays.position), rays.direction @ plane.rotation.T
        last = self.model.mirror_pose(self.model.mirrors[-1]).translation
        room = np.sum((position[:, 0] - last) * direction[:, 0], -1)
        passed = rays.valid[:, 1:] if self.model.edges or self.vignetting is not None else None
        distance = float(self.model.first_order.exit_pupil_distance[0])
        spec, fields = self.model.spec, np.array(positions)
        return FieldBeams(spec, fields, nodes, position, direction, rays.path, distance, room, passed)

    @one_blas_thread()
    def errors(self, fields: Sequence[Field | FieldText] | np.ndarray, rings: int = RINGS) -> np.ndarray:
        """Compute rms wavefront errors at F fields, (F, 2), in waves of the design wavelength, (F,).

        Piston and tilt are removed. ``rings`` is the number of rings of the quadrature over the stop.

        Raises
        ------
        AimError, BeamMissedError
            In this state the light misses the stop or the plane of the line CCD.
        """
        all_fields, plane = self.fractions(fields), FocalPlane.of(self.model.spec)
        step = max(1, MAX_RAYS // stop_nodes(self.model, rings, self.vignetting is not None).count)
        parts = [all_fields[start : start + step] for start in range(0, len(all_fields), step)]
        return np.concatenate([self.beams(part, rings).errors(plane) for part in parts])

    def pupils(self, fields: Sequence[Field | FieldText] | np.ndarray) -> tuple[PupilFunction, ...]:
        """Compute the exit pupils of F fields, (F, 2), with image axes along the line and along the track.

        Each is the pupil as seen from the image of its field. The pupils are centred on the design wavelength's chief
        rays, whatever the wavelength of the light, so that they include lateral colour.

        Raises
        ------
        AimError, BeamMissedError
            In this state the light misses the stop or the plane of the line CCD.
        ValueError
            Edges cut a pupil into too many pieces, or a wavefront is too irregular for its polynomials.
        """
        light = self.directions(fields)
        positions = self.path.positions(self.state, light)
        pupils = self.path.pupils(self.state, light, positions, wavelength=self.wavelength)
        check_range("the light that a pupil's shadow leaves", np.array([p.light for p in pupils]), 0.0, 1.0, ROUNDING)
        if self.model.edges:
            nodes = stop_nodes(self.model, RINGS, True)
            traced_light = self.rays(fields, np.stack([nodes.x, nodes.y], axis=-1)).valid @ nodes.share
            difference = float(np.max(np.abs(traced_light - [pupil.light for pupil in pupils])))
            if difference > WORST_LIGHT:
                raise UnphysicalError(
                    f"the light by the shadows of its edges differs by {difference:.2g} from that of traced rays"
                )
        return pupils

    def mtfs(
        self,
        fields: Sequence[Field | FieldText] | np.ndarray,
        frequency: Frequencies | None = None,
        wavelengths: np.ndarray | None = None,
        weights: np.ndarray | None = None,
    ) -> tuple[Mtf, ...]:
        """Compute the MTF at F fields for M spatial frequencies, as a mean over K wavelengths.

        Parameters
        ----------
        fields : (F, 2) array_like
            The F fields.
        frequency : (M,) ndarray or sequence of str or str, optional
            Spatial frequencies in cycles/m, or with their unit, such as ``"50 cycles/mm"``; by default 65 from 0 to the
            cut-off or twice Nyquist, whichever is smaller.
        wavelengths : (K,) ndarray, optional
            Wavelengths of the light, metres; by default the design wavelength.
        weights : (K,) ndarray, optional
            Weights of the wavelengths; by default equal.

        Raises
        ------
        AimError, BeamMissedError, ValueError
            The light is lost, edges cut a pupil into too many pieces, or a wavefront is too irregular.
        """
        fields = self.fractions(fields)
        frequency = None if frequency is None else in_cycles_per_m(frequency)
        colours = np.array([self.wavelength]) if wavelengths is None else np.asarray(wavelengths, float)
        shares = np.ones(len(colours)) if weights is None else np.asarray(weights, float)
        if self.model.edges and (frequency is None or even_step(frequency)):
            return self._mtfs_by_lines(fields, frequency, colours, shares / np.sum(shares))
        pupils = self.colour_pupils(fields, colours)
        if frequency is None:
            cutoff = max(
                float(np.max(pupil.cutoff(np.eye(2), float(np.min(colours)))))
                for by_colour in pupils
                for pupil in by_colour
            )
            frequency = np.linspace(0.0, min(cutoff, 2.0 * self.nyquist), MTF_POINTS)
        both = np.concatenate([frequency[:, None] * axis for axis in np.eye(2)])
        out = []
        for where, field_pupils in zip(fields, pupils, strict=True):
            perfect = [replace(pupil, eikonal_terms=np.zeros_like(pupil.eikonal_terms)) for pupil in field_pupils]
            transfers = (
                polychromatic_transfer(pupils if len(pupils) > 1 else pupils[0], both, colours, shares, np.zeros(1))[0]
                for pupils in (field_pupils, perfect)
            )
            values, limit = (np.abs(transfer).reshape(2, -1) for transfer in transfers)
            place, weights = (float(where[0]), float(where[1])), shares / np.sum(shares)
            out.append(Mtf(place, self._angles(where), frequency, values, limit, colours, self.nyquist, weights))
            check_mtf(out[-1])
        return tuple(out)

    @one_blas_thread()  # small matrices: a second thread would only wait
    def _mtfs_by_lines(
        self,
        fields: Sequence[Field | FieldText] | np.ndarray,
        frequency: np.ndarray | None,
        colours: np.ndarray,
        shares: np.ndarray,
    ) -> tuple[Mtf, ...]:
        """Compute the MTF of vignetted pupils at evenly spaced frequencies, line by line over the pupil."""
        light = self.directions(fields)
        positions = self.path.positions(self.state, light)
        used = colours if lenses(self.model.spec) else [np.min(colours)]
        vignetted = [self.path.vignetted_pupils(self.state, light, positions, float(colour)) for colour in used]
        if frequency is None:
            shortest = float(np.min(colours))
            cutoff = max(float(np.max(v.pupil.cutoff(np.eye(2), shortest))) for pupils in vignetted for v in pupils)
            frequency = np.linspace(0.0, min(cutoff, 2.0 * self.nyquist), MTF_POINTS)
        pupils_by_colour = [vignetted[n if len(vignetted) > 1 else 0] for n in range(len(colours))]
        transfers = [
            line_transfers(pupils, [float(colour)] * len(pupils), np.eye(2), float(frequency[1]), len(frequency))
            for pupils, colour in zip(pupils_by_colour, colours, strict=True)
        ]
        out = []
        for k, where in enumerate(fields):
            # (colour, axis, with its wavefront and without, frequency)
            parts = np.array([[(t.values, t.perfect) for t in by_field[k]] for by_field in transfers])
            values, limit = np.abs(np.einsum("k,kawm->wam", shares, parts))
            place = (float(where[0]), float(where[1]))
            accuracy = max(t.error for by_field in transfers for t in by_field[k])
            angles = self._angles(where)
            out.append(Mtf(place, angles, frequency, values, limit, colours, self.nyquist, shares, accuracy=accuracy))
            check_mtf(out[-1])
        return tuple(out)

    def colour_pupils(
        self, fields: Sequence[Field | FieldText] | np.ndarray, wavelengths: np.ndarray
    ) -> list[tuple[PupilFunction, ...]]:
        """Return the pupils of each of F fields, (F, 2), for K wavelengths, (K,), in metres.

        Each field has one pupil per wavelength, or a single one for all wavelengths if the camera has no lenses.

        Raises
        ------
        AimError, BeamMissedError, ValueError
            The light is lost, edges cut a pupil into too many pieces, or a wavefront is too irregular.
        """
        if not lenses(self.model.spec):
            return [(pupil,) for pupil in self.at(float(np.min(wavelengths))).pupils(fields)]
        return list(zip(*(self.at(float(colour)).pupils(fields) for colour in wavelengths), strict=True))

    def mtf(self, field: Field | FieldText = (0.0, 0.0), frequency: Frequencies | None = None) -> Mtf:
        """Compute the MTF at one field and the wavelength of the light, over frequencies in cycles/m or with a unit."""
        return self.mtfs([field], frequency)[0]

    def path_error(self, rays: LineRays) -> np.ndarray:
        """Return optical paths to the reference spheres minus those of the chief rays, metres, (F, N).

        There are F fields with N rays each.
        """
        radius = float(self.model.first_order.exit_pupil_distance[0])
        path = path_to_sphere(rays.position, rays.direction, rays.path, rays.position[:, :1], radius)
        return path - path[:, :1]

    def _place(self, rays: LineRays, k: int) -> tuple[float, float]:
        """Return where the chief ray of a field meets the line CCD, (along the line, along the track), metres."""
        x, y = rays.position[k, 0, :2] / rays.size
        return float(y), float(x)


def even_step(frequency: np.ndarray) -> bool:
    """Return True if M frequencies, (M,), increase from 0 in equal steps."""
    return (
        len(frequency) > 1 and frequency[1] > 0.0 and np.allclose(frequency, frequency[1] * np.arange(len(frequency)))
    )


def rim(count: int) -> np.ndarray:
    """Return points evenly spaced just inside the edge of the stop, in units of its radius, (count, 2)."""
    return np.asarray(INSIDE * circle(count))


WORST_LIGHT = 5e-3
"""Largest accepted difference between the fractions of light computed from shadows of edges and from traced rays.

10 000 rays give that fraction to 1e-3.
"""

RAYS_ACCURACY = 2e-3
"""Accuracy of results for a vignetted beam if 10 000 rays sample its light, as a fraction of the rms wavefront error.
"""

SHARPEST = 1e-4
"""Rms wavefront error, waves, below which changes are relative to this value, as rounding of paths then dominates."""

_SHADOW_NODES = 6
"""Quadrature nodes along each side of a shadow's box."""

_ASTRAY, _DARK_DEGREE = 2.0, 12
"""Treatment of rays in the shadow that depart far from the wavefront.

The first is the largest accepted departure from the mean wavefront, in units of the peak-to-valley of its illuminated
part. Beyond it, the wavefront in the shadow is replaced by a smooth polynomial, of which the second is the degree.
"""

_FINER_RINGS, _FINER_NODES = 4, 2
"""Additional rings, and additional nodes per side of a shadow, of a finer quadrature that checks the results."""


@dataclass(frozen=True, eq=False)
class VignettedFit:
    """Wavefront statistics of a vignetted beam by exact quadrature.

    Attributes
    ----------
    fit : PartFit
        Statistics of the wavefront.
    light : float
        Fraction of the stop's light that passes.
    hole : float
        Radius of the central hole of an annular pupil, in units of the stop's radius; 0 for a whole pupil, NaN for any
        other.
    accuracy : float
        Change of the rms, relative to it, or of the Strehl ratio with a finer quadrature, whichever is larger.
    """

    fit: PartFit
    light: float
    hole: float
    accuracy: float


def fit_illuminated(
    path: TargetPath,
    state: State,
    direction: np.ndarray,
    rings: int,
    light: float,
    wavefront_error: Callable[[LineRays], np.ndarray],
    terms: int,
) -> VignettedFit | None:
    """Fit a wavefront over the light of a beam by a quadrature that ends at the edges.

    Parameters
    ----------
    path : TargetPath
        Light path of the camera.
    state : State
        State of its assembly, with the refractive indices at the wavelength of the light.
    direction : (1, 3) ndarray
        Direction of the light in the world frame.
    rings : int
        Rings of the quadrature over the whole stop.
    light : float
        Fraction of the stop's light that passes, counted by traced rays.
    wavefront_error : callable
        Function from N rays to their wavefront errors on the reference spheres, (1, N), waves of the light.
    terms : int
        Number of Zernike terms.

    Returns
    -------
    VignettedFit or None
        None if the shadows are not known or disagree with traced rays, if rays in the shadow do not reach the image, or
        if a finer quadrature gives other values.

    Raises
    ------
    AimError, BeamMissedError
        The beam is lost.
    """
    try:
        pieces, error = path.shadows_on_stop(state, direction)
    except UnphysicalError:
        return None
    refinement = (0, 0), (_FINER_RINGS, _FINER_NODES)
    stops = [IlluminatedStop.of(pieces, rings + r, _SHADOW_NODES + n) for r, n in refinement]
    if abs(float(stops[1].light[0]) - light) > WORST_LIGHT:
        return None
    points = [np.stack([stop.x[0], stop.y[0]], axis=-1) for stop in stops]
    all_points = np.concatenate([np.zeros((1, 2)), *points])
    rays = path.rays(state, direction, all_points, edges=False)
    # boxes about shadows extend a little beyond the stop, which vignettes these rays; their paths are valid
    if not np.all(rays.valid[0] | (np.hypot(*all_points.T) > 1.0)):
        return None
    waves = np.split(wavefront_error(rays)[0, 1:], [len(points[0])])
    both = list(zip(stops, waves, strict=True))
    continued = [
        (stop, _tamed(stop, pieces, rings + r, wave)) for (stop, wave), (r, _) in zip(both, refinement, strict=True)
    ]
    for attempt in (both, continued):
        try:
            coarse, fine = (fit_part(stop.x[0], stop.y[0], stop.weight[0], wave, terms) for stop, wave in attempt)
        except UnphysicalError:
            continue
        # shadowed rays that are far off can make the mean square negative
        if not min(coarse.rms, fine.rms) > 0.0:
            continue
        change = max(abs(fine.rms - coarse.rms) / max(fine.rms, SHARPEST), abs(fine.strehl - coarse.strehl))
        if change < RAYS_ACCURACY:
            return VignettedFit(fine, float(stops[1].light[0]), float(holes(pieces)[0]), max(change, error))
    return None


def _tamed(stop: IlluminatedStop, pieces: np.ndarray, rings: int, wave: np.ndarray) -> np.ndarray:
    """Return the wavefront at N nodes, (N,), smoothly continued where rays in the shadow depart far from it.

    Such rays pass outside the rims of lenses. Their contribution to a quadrature cancels, as the whole disk is
    integrated and the shadow is subtracted.
    """
    points = np.stack([stop.x[0], stop.y[0]], axis=-1)
    free = ~covered(pieces, points, SMALLEST)[0]
    middle, spread = np.mean(wave[free]), np.ptp(wave[free])
    if np.all(np.abs(wave[~free] - middle) <= _ASTRAY * spread):
        return wave
    ring_nodes = slice(0, quadrature.disk(rings).count)
    clamped = points / np.maximum(np.hypot(*points.T), 1.0)[:, None]
    table = products(clamped[:, 0], clamped[:, 1], _DARK_DEGREE)
    light_values = free[None, ring_nodes], wave[None, ring_nodes, None]
    terms = smooth_terms(table[ring_nodes], stop.weight[0, ring_nodes], *light_values)
    return np.where(free, wave, table @ terms[0, :, 0])
