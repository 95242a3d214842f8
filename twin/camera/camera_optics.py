"""Wavefront, spot and MTF of one camera in one state, at places of its field.

A **field** is a pair (along the line, along the track) of shares of the camera's half angles of view, each from -1 to
1: (1, 0) is the end of the unperturbed camera's field on the side of the left end (+Y') of its line CCD. It turns with
the camera, so that a look angle or a motion of the whole camera changes nothing of its image quality.

Wavefront errors count from the sphere about the image of the chief ray, with the radius of the nominal exit pupil;
positive where the wavefront is ahead. Piston and tilt, which move an image and do not blur it, are taken out over the
light that comes through; defocus stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from analysis.arrays import shows
from optics.geometry import zernike
from optics.geometry.polygon import area, covered
from optics.geometry.tree import State
from optics.numerics.array_math import UnphysicalError, check_range
from optics.numerics.backend import Backend, one_blas_thread
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Assembly
from optics.raytrace.first_order import equal_area_radius
from optics.waves.imaging import path_to_sphere
from optics.waves.line_transfer import line_transfers
from optics.waves.optical_transfer import polychromatic_transfer
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_stack import PupilFunction
from scenes.models.camera_model import ROOT, CameraModel, camera_alone, derive_camera, field_direction, lenses
from scenes.models.camera_sharpness import FIELDS, Cut, FieldBeams, FocalPlane, stop_nodes
from scenes.models.instrument_model import Instrument
from scenes.models.shadow import ImagingShadows, imaging_shadows
from scenes.specs.camera import CameraSpec
from scenes.specs.instrument import BASE
from twin.camera.camera_results import ROUNDING, TERMS, Field, Mtf, Spot, Wavefront, hold_mtf, hold_wavefront
from twin.camera.cut_wavefront import RAYS_ACCURACY, WORST_LIGHT, counted_fit, exact_fit
from twin.targets.target_path import LineRays, TargetPath

RINGS = 12
"""Rings of the quadrature over the stop, which is exact for squares of wavefronts up to order 23."""

MAP_POINTS = 65
"""Points of a wavefront's map on each axis."""

MTF_POINTS = 65
"""Frequencies of an MTF if none are asked for."""

SPOT_RINGS = 8
"""Rings of a spot diagram's rays about the chief ray, six more rays on each."""


MOST_RAYS = 500_000
"""Traced at once, to bound memory."""

INSIDE = 1.0 - 1e-9
"""Rays at the very edge of the stop are aimed this far out, so that rounding does not stop them."""


@shows("model.spec.name", "model.mirrors", "model.paraxial.focal_length [m]", "model.entrance_pupil [mm]", "state")
@dataclass(frozen=True, eq=False)
class CameraOptics:
    """One camera in one state, ready to be looked at.

    ``CameraOptics.alone`` makes it of a camera's prescription, ``CameraOptics.within`` of a camera of an instrument.

    Attributes
    ----------
    path : TargetPath
        Its way from the scene to the line CCD.
    state : State
        Motions of bodies, with heat; empty as designed.
    colour : float | None
        Wavelength of the light, metres; None for that of the design.
    built : bool
        Whether it stands apart from the prescription by itself, as its instrument was built.
    """

    path: TargetPath
    state: State = field(default_factory=FrozenMap)
    colour: float | None = None
    built: bool = False

    @classmethod
    def alone(cls, camera: CameraSpec | CameraModel, backend: Backend, state: State | None = None) -> Self:
        """A camera by itself; its bodies are ``camera/M1`` ... ``camera/focal_plane``.

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
        """A camera of an instrument, in a state of the whole instrument.

        Parameters
        ----------
        instrument : Instrument
            With the camera.
        name : str
            Of the camera there.
        backend : Backend
            Where to trace.
        state : State | None
            For example ``MonitorExperiment.state(job)``: motions and what heat does.
        obstruction : bool
            Whether what prisms and other bodies take of the beam is missing in it.

        Raises
        ------
        KeyError
            No camera of that name.
        """
        shadows: ImagingShadows | None = imaging_shadows(instrument, name, backend) if obstruction else None
        path = TargetPath(
            instrument.assembly, name, f"{BASE}/{name}", instrument.cameras[name], backend, shadows=shadows
        )
        return cls(path, FrozenMap(state or {}), built=bool(instrument.as_built))

    def in_state(self, state: State) -> Self:
        """Return the camera in another state."""
        return replace(self, state=FrozenMap(state))

    def at(self, wavelength: float) -> Self:
        """Return the camera in light of another wavelength, metres.

        Lenses have their index there; wavefront errors are in waves of it.

        Raises
        ------
        ValueError
            a lens whose glass is not named, or not known there.
        """
        self.path.coloured(self.state, wavelength)
        return replace(self, colour=wavelength)

    @property
    def wavelength(self) -> float:
        """Of the light, metres."""
        return float(self.model.spec.wavelength if self.colour is None else self.colour)

    @property
    def model(self) -> CameraModel:
        """Derived numbers of the prescription."""
        return self.path.model

    @property
    def assembly(self) -> Assembly:
        """Assembly that holds the camera."""
        return self.path.assembly

    @cached_property
    def nyquist(self) -> float:
        """Nyquist frequency of the line CCD's pixels, cycles/m."""
        return float(0.5 / self.model.spec.line.pitch)

    @cached_property
    def cut(self) -> Cut | None:
        """What bodies of the instrument take of beams as designed; None where none stands in any of those of FIELDS."""
        if not np.any(area(self.path.shadow_pieces({}, self._designed(np.array(FIELDS)))) > SMALLEST):
            return None
        return lambda fields, points: covered(self.path.shadow_pieces({}, self._designed(fields)), points, SMALLEST)

    def _designed(self, fields: np.ndarray) -> np.ndarray:
        """``directions`` of the camera as designed."""
        return replace(self, state=FrozenMap()).directions(fields)

    def directions(self, fields: Sequence[Field] | np.ndarray) -> np.ndarray:
        """Directions of the light of fields (F, 2), world, (F, 3).

        Raises
        ------
        ValueError
            a field beyond the camera's, for which it has no clear apertures.
        """
        shares = np.asarray(fields, dtype=np.float64)
        if shares.ndim != 2 or shares.shape[1] != 2 or not np.all(np.abs(shares) <= 1.0):
            raise ValueError(
                f"fields are pairs (along the line, along the track) of shares of half the field, from -1 to 1; "
                f"got {shares.tolist()}"
            )
        spec = self.model.spec
        light = np.array([field_direction(spec, x * spec.field.x, y * spec.field.y) for x, y in shares])
        root = self.assembly.place([self.state]).pose(self.path.root)
        return np.asarray(light @ self.model.camera_frame.rotation @ root.rotation.T)

    def rays(self, fields: Sequence[Field] | np.ndarray, points: np.ndarray) -> LineRays:
        """Rays of fields (F, 2) through points (N, 2) of the stop, in units of its radius, at the line CCD.

        Raises
        ------
        AimError, BeamMissedError
            The state brings the light off the stop or off the line CCD's plane.
        """
        return self.path.rays(self.path.coloured(self.state, self.wavelength), self.directions(fields), points)

    @one_blas_thread()  # of small matrices: threads would only wait for each other
    def wavefronts(
        self, fields: Sequence[Field] | np.ndarray, points: int = MAP_POINTS, terms: int = TERMS
    ) -> tuple[Wavefront, ...]:
        """Wavefront errors at fields (F, 2); ``points`` of the map on each axis. Raises as ``rays``."""
        nodes = stop_nodes(self.model, RINGS, self.cut is not None)
        axis = np.linspace(-1.0, 1.0, points)
        x, y = np.meshgrid(axis, axis)
        inside = np.hypot(x, y) <= 1.0
        edge = rim(4 * RINGS)
        within = np.stack([nodes.x, nodes.y], axis=-1)
        stop = np.concatenate([[[0.0, 0.0]], within, edge, INSIDE * np.stack([x[inside], y[inside]], axis=-1)])
        rays = self.rays(fields, stop)
        wavelength = self.wavelength
        error = -self._path(rays) / wavelength
        out = []
        own = slice(1, 1 + nodes.count)
        light, is_cut = rays.valid[:, own] @ nodes.share, self.cut is not None or bool(self.model.edges)
        sight = self.directions(fields)[:, None]
        for k, where in enumerate(np.asarray(fields, dtype=np.float64)):
            lit = rays.valid[k]
            weight = nodes.weight * lit[own]
            level = zernike.fit(3, nodes.x, nodes.y, error[k, own], weight)
            known = None
            if is_cut:
                known = exact_fit(self.path, self.state, sight[k], RINGS, float(light[k]), self._path, terms)
            level = level if known is None else known.fit.level
            flat = error[k] - zernike.basis(3, *stop.T) @ level
            table = np.full(inside.shape, np.nan)
            table[inside] = np.where(lit, flat, np.nan)[1 + nodes.count + len(edge) :]
            judged = counted_fit(nodes, weight, flat[own], terms, bool(np.all(lit))) if known is None else known.fit
            through = float(np.sum(weight) / np.sum(nodes.weight)) if known is None else known.light
            wave = Wavefront(
                field=(float(where[0]), float(where[1])),
                wavelength=wavelength,
                x=axis,
                y=axis,
                map=table,
                coefficients=judged.coefficients,
                parts=judged.parts,
                rms=judged.rms,
                peak_to_valley=float(np.ptp(flat[1:][lit[1:]])),
                residual=judged.residual_rms,
                strehl=judged.strehl,
                vignetted=1.0 - through,
                place=self._place(rays, k),
                hole=(np.nan if is_cut else 0.0) if known is None else known.hole,
                accuracy=(RAYS_ACCURACY if is_cut else 0.0) if known is None else known.accuracy,
            )
            hold_wavefront(wave)
            out.append(wave)
        return tuple(out)

    def wavefront(self, field: Field = (0.0, 0.0), points: int = MAP_POINTS) -> Wavefront:
        """Wavefront error at one field, as ``wavefronts``."""
        return self.wavefronts([field], points)[0]

    def spots(self, fields: Sequence[Field] | np.ndarray, defocus: float = 0.0) -> tuple[Spot, ...]:
        """Spots at fields (F, 2) on the line CCD moved by ``defocus`` metres downstream. Raises as ``rays``."""
        nodes = stop_nodes(self.model, RINGS, self.cut is not None)
        rings = [r / SPOT_RINGS * rim(6 * r) for r in range(1, SPOT_RINGS + 1)]
        stop = np.concatenate([np.zeros((1, 2)), np.stack([nodes.x, nodes.y], axis=-1), *rings])
        rays = self.rays(fields, stop)
        leaving = rays.direction
        # the light travels along -Z of the line CCD or along +Z: downstream is its own way
        place = rays.position[..., 1::-1] + defocus * leaving[..., 1::-1] / np.abs(leaving[..., 2:])
        place = place / rays.size
        out = []
        for k, where in enumerate(np.asarray(fields, dtype=np.float64)):
            lit = rays.valid[k]
            share = nodes.weight * lit[1 : 1 + nodes.count]
            share = share / np.sum(share)
            offset = place[k] - place[k, 0]
            own = offset[1 : 1 + nodes.count]
            centroid = share @ own
            spread = share @ (own - centroid) ** 2
            hexapolar = np.concatenate([offset[:1], offset[1 + nodes.count :][lit[1 + nodes.count :]]])
            out.append(
                Spot(
                    field=(float(where[0]), float(where[1])),
                    rays=hexapolar,
                    centroid=centroid,
                    rms=float(np.sqrt(np.sum(spread))),
                    rms_along=np.sqrt(spread),
                    farthest=float(np.max(np.linalg.norm(hexapolar - centroid, axis=-1))),
                    airy=0.61 * self.wavelength / equal_area_radius(leaving[k, -len(rings[-1]) :, :2]),
                    place=self._place(rays, k),
                )
            )
        return tuple(out)

    def spot(self, field: Field = (0.0, 0.0), defocus: float = 0.0) -> Spot:
        """Spot at one field, as ``spots``."""
        return self.spots([field], defocus)[0]

    def beams(self, fields: Sequence[Field] | np.ndarray, rings: int = RINGS) -> FieldBeams:
        """Beams of fields (F, 2) near the image, in the prescription's frame.

        In a state they stand to the line CCD as they do to the moved one, but this is where it was designed to be.

        Parameters
        ----------
        fields : Sequence[Field] | np.ndarray
            where.
        rings : int
            Of the quadrature over the stop.

        Raises
        ------
        AimError, BeamMissedError
            As ``rays``.
        InputError
            Edges stop all of a field's light.
        """
        places = tuple((float(x), float(y)) for x, y in np.asarray(fields, dtype=np.float64))
        if not self.state and not self.built:
            return FieldBeams.trace(self.model, self.path.backend, places, rings, self.cut, wavelength=self.wavelength)
        nodes = stop_nodes(self.model, rings, self.cut is not None)
        rays = self.rays(fields, np.concatenate([np.zeros((1, 2)), np.stack([nodes.x, nodes.y], axis=-1)]))
        plane = self.model.focal_plane
        position, direction = plane.apply(rays.position), rays.direction @ plane.rotation.T
        room = np.sum(
            (position[:, 0] - self.model.mirror_pose(self.model.mirrors[-1]).translation) * direction[:, 0], -1
        )
        return FieldBeams(
            self.model.spec,
            np.array(places),
            nodes,
            position,
            direction,
            rays.path,
            float(self.model.first_order.exit_pupil_distance[0]),
            room,
            rays.valid[:, 1:] if self.model.edges or self.cut is not None else None,
        )

    @one_blas_thread()
    def errors(self, fields: Sequence[Field] | np.ndarray) -> np.ndarray:
        """Rms wavefront errors alone at fields (F, 2), piston and tilt taken out, waves of the design wavelength, (F,).

        Raises
        ------
        AimError, BeamMissedError
            As ``rays``.
        """
        every, plane = np.asarray(fields, dtype=np.float64), FocalPlane.of(self.model.spec)
        step = max(1, MOST_RAYS // stop_nodes(self.model, RINGS, self.cut is not None).count)
        parts = [every[start : start + step] for start in range(0, len(every), step)]
        return np.concatenate([self.beams(part).errors(plane) for part in parts])

    def pupils(self, fields: Sequence[Field] | np.ndarray) -> tuple[PupilFunction, ...]:
        """Exit pupils as the images of fields (F, 2) see them, axes along the line and along the track.

        They are about the places of the design wavelength's chief rays, whatever the light's: so the colours of an
        image that stand apart do so in its pupils.

        Raises
        ------
        AimError, BeamMissedError
            As ``rays``.
        ValueError
            a pupil that edges cut into too many pieces, or a wavefront too rough for its polynomials.
        """
        light = self.directions(fields)
        places = self.path.places(self.state, light)
        pupils = self.path.pupils(self.state, light, places, wavelength=self.wavelength)
        check_range("the light that a pupil's shadow leaves", np.array([p.light for p in pupils]), 0.0, 1.0, ROUNDING)
        if self.model.edges:
            nodes = stop_nodes(self.model, RINGS, True)
            lit = self.rays(fields, np.stack([nodes.x, nodes.y], axis=-1)).valid @ nodes.share
            off = float(np.max(np.abs(lit - [pupil.light for pupil in pupils])))
            if off > WORST_LIGHT:
                raise UnphysicalError(
                    f"the shadows of its edges leave {off:.2g} more or less of its light than traced rays do"
                )
        return pupils

    def mtfs(
        self,
        fields: Sequence[Field] | np.ndarray,
        frequency: np.ndarray | None = None,
        wavelengths: np.ndarray | None = None,
        weights: np.ndarray | None = None,
    ) -> tuple[Mtf, ...]:
        """MTF at fields (F, 2).

        Parameters
        ----------
        fields : Sequence[Field] | np.ndarray
            where.
        frequency : np.ndarray | None
            cycles/m, (M,); by default 65 from 0 to the cut-off or twice Nyquist, whichever is less.
        wavelengths : np.ndarray | None
            Of the light, metres, (K,); default the design wavelength.
        weights : np.ndarray | None
            Of the wavelengths, (K,); default all alike.

        Raises
        ------
        AimError, BeamMissedError, ValueError
            As ``pupils``.
        """
        colours = np.array([self.wavelength]) if wavelengths is None else np.asarray(wavelengths, float)
        shares = np.ones(len(colours)) if weights is None else np.asarray(weights, float)
        if self.model.edges and (frequency is None or even_step(frequency)):
            return self._mtfs_by_lines(fields, frequency, colours, shares / np.sum(shares))
        pupils = self.colour_pupils(fields, colours)
        if frequency is None:
            cutoff = max(
                float(np.max(pupil.cutoff(np.eye(2), float(np.min(colours))))) for each in pupils for pupil in each
            )
            frequency = np.linspace(0.0, min(cutoff, 2.0 * self.nyquist), MTF_POINTS)
        both = np.concatenate([frequency[:, None] * axis for axis in np.eye(2)])
        out = []
        for where, own in zip(np.asarray(fields, dtype=np.float64), pupils, strict=True):
            perfect = [replace(pupil, eikonal_terms=np.zeros_like(pupil.eikonal_terms)) for pupil in own]
            values, limit = (
                np.abs(
                    polychromatic_transfer(one if len(one) > 1 else one[0], both, colours, shares, np.zeros(1))[0]
                ).reshape(2, -1)
                for one in (own, perfect)
            )
            place = (float(where[0]), float(where[1]))
            out.append(Mtf(place, frequency, values, limit, colours, self.nyquist, shares / np.sum(shares)))
            hold_mtf(out[-1])
        return tuple(out)

    @one_blas_thread()  # of small matrices: a second thread would only wait, which counts
    def _mtfs_by_lines(
        self,
        fields: Sequence[Field] | np.ndarray,
        frequency: np.ndarray | None,
        colours: np.ndarray,
        shares: np.ndarray,
    ) -> tuple[Mtf, ...]:
        """``mtfs`` of pupils that edges cut at even steps of frequency."""
        light = self.directions(fields)
        places = self.path.places(self.state, light)
        used = colours if lenses(self.model.spec) else [np.min(colours)]
        cut = [self.path.vignetted_pupils(self.state, light, places, float(colour)) for colour in used]
        if frequency is None:
            shortest = float(np.min(colours))
            cutoff = max(float(np.max(one.pupil.cutoff(np.eye(2), shortest))) for own in cut for one in own)
            frequency = np.linspace(0.0, min(cutoff, 2.0 * self.nyquist), MTF_POINTS)
        every = [cut[n if len(cut) > 1 else 0] for n in range(len(colours))]
        told = [
            line_transfers(own, [float(colour)] * len(own), np.eye(2), float(frequency[1]), len(frequency))
            for own, colour in zip(every, colours, strict=True)
        ]
        out = []
        for k, where in enumerate(np.asarray(fields, dtype=np.float64)):
            # (colour, axis, with its wavefront and without, frequency)
            parts = np.array([[(one.values, one.perfect) for one in own[k]] for own in told])
            values, limit = np.abs(np.einsum("k,kawm->wam", shares, parts))
            place = (float(where[0]), float(where[1]))
            accuracy = max(one.error for own in told for one in own[k])
            out.append(Mtf(place, frequency, values, limit, colours, self.nyquist, shares, accuracy=accuracy))
            hold_mtf(out[-1])
        return tuple(out)

    def colour_pupils(
        self, fields: Sequence[Field] | np.ndarray, wavelengths: np.ndarray
    ) -> list[tuple[PupilFunction, ...]]:
        """Pupils of every field (F, 2): of each one for every wavelength (K,), metres, or one alone that serves all,
        where the camera has no lenses.

        Raises
        ------
        AimError, BeamMissedError, ValueError
            As ``pupils``.
        """
        if not lenses(self.model.spec):
            return [(pupil,) for pupil in self.at(float(np.min(wavelengths))).pupils(fields)]
        return list(zip(*(self.at(float(colour)).pupils(fields) for colour in wavelengths), strict=True))

    def mtf(self, field: Field = (0.0, 0.0), frequency: np.ndarray | None = None) -> Mtf:
        """MTF at one field and the wavelength of the light, as ``mtfs``."""
        return self.mtfs([field], frequency)[0]

    def _path(self, rays: LineRays) -> np.ndarray:
        """Optical paths to the reference spheres about the chief rays, the first of each beam, (F, N), metres."""
        radius = float(self.model.first_order.exit_pupil_distance[0])
        path = path_to_sphere(rays.position, rays.direction, rays.path, rays.position[:, :1], radius)
        return path - path[:, :1]

    def _place(self, rays: LineRays, k: int) -> tuple[float, float]:
        x, y = rays.position[k, 0, :2] / rays.size
        return float(y), float(x)


def even_step(frequency: np.ndarray) -> bool:
    """Whether frequencies (M,) go up from 0 in even steps."""
    return (
        len(frequency) > 1 and frequency[1] > 0.0 and np.allclose(frequency, frequency[1] * np.arange(len(frequency)))
    )


def rim(count: int) -> np.ndarray:
    """Places evenly along the edge of the stop, within it by a rounding, in units of its radius, (count, 2)."""
    turn = 2.0 * np.pi * np.arange(count) / count
    return np.asarray(INSIDE * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
