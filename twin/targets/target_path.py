"""Optical path from a target in front of a camera to its image: pupils and exact field mapping, by ray tracing.

Image coordinates are (along, across) = (Y', X') of the focal-plane frame, in metres: columns of an image run along the
line CCD, rows along the track. A target is in the collimator's focal plane with its own coordinates in the same sense,
so that its image is ``f / focal_length`` times its size and upright in these coordinates.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from analysis.arrays import shows
from optics.geometry.aperture import Circle
from optics.geometry.polygon import covered
from optics.geometry.tree import PlacedBodies, State
from optics.numerics import quadrature
from optics.numerics.array_math import UnphysicalError
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes
from optics.raytrace.aim import transverse_axes
from optics.raytrace.assembly import Assembly, points_to_world
from optics.raytrace.first_order import chief_rays
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import make_rays, require_rays, trace
from optics.targets.collimator import Collimator
from optics.waves.diffraction import PupilField
from optics.waves.edge_shadow import StopOutlines, converged_shadows
from optics.waves.imaging import ImagingRays, aim_collimated, imaging_rays, pupil_field
from optics.waves.line_transfer import LINE_SIDES, VignettedPupil, unvignetted_at, vignetted_pupils
from optics.waves.optical_transfer import with_enough_nodes
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_stack import DEGREE, VIGNETTED_RESIDUAL, VIGNETTED_RINGS, PupilFunction, fit_pupils
from scenes.models.camera_model import LAUNCH_DISTANCE, CameraModel, coloured, line_body
from scenes.models.shadow import ImagingShadows, PupilEdges, TracedBeams

RINGS = 14
"""Number of rings of the pupil's quadrature.

Integrals are exact for wavefronts to degree 55, far beyond those of mirrors and figure errors.
"""

MORE_RINGS = 28
"""Number of rings of the pupil's quadrature if polynomials fitted to fewer rays do not describe a vignetted wavefront.
"""

SMOOTH = 1e-6
"""Largest RMS difference between the traced optical path and its polynomial for a wavefront to count as smooth, in
wavelengths.
"""

WORST_PLACED = 5e-3
"""Largest fraction of the quadrature's rays whose blocking by edges the outlines of the edges may predict wrongly.

It is four rays, close to an edge.
"""

MAP_POINTS = 7
"""Number of chief rays per axis that are traced to fit the local mapping from target to image coordinates."""
MAP_ORDER = 4
"""Degree of the polynomial that maps target to image coordinates near a field direction."""


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Exact chief-ray mapping near one field direction: target coordinates to image coordinates.

    Attributes
    ----------
    scale : float
        Largest target coordinate, in metres; coordinates are divided by it.
    coefficients : (terms, 2) ndarray
        Coefficients of the monomials of the scaled target coordinates, for along and across, in metres.
    residual : float
        Largest distance of the traced chief rays from the polynomial, in metres.
    """

    scale: float
    coefficients: np.ndarray
    residual: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return image coordinates (N, 2) relative to the central chief ray, for target coordinates (N, 2), metres."""
        return np.asarray(_monomials(points / self.scale) @ self.coefficients)

    @property
    def jacobian(self) -> np.ndarray:
        """Derivative of image coordinates (along, across) with respect to target coordinates at the centre, (2, 2)."""
        return np.asarray(self.coefficients[1:3].T / self.scale)


@shows("position [mm]", "path [m]", "valid")
@dataclass(frozen=True, eq=False)
class LineRays:
    """Rays of F beams, N each, at the line CCD, in its frame: X' along the track, Y' along the line.

    Attributes
    ----------
    position, direction : (F, N, 3) ndarray
        Positions, in metres, and unit directions.
    path : (F, N) ndarray
        Optical path from the incoming plane wavefront, in metres.
    valid : (F, N) ndarray of bool
        False if an aperture stops the ray.
    size : float
        Thermal scale of the line CCD: its size relative to nominal.
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    valid: np.ndarray
    size: float


def _monomials(q: np.ndarray) -> np.ndarray:
    """Return all monomials, to the degree ``MAP_ORDER``, of two scaled target coordinates, for the local mapping."""
    powers = [(a - b, b) for a in range(MAP_ORDER + 1) for b in range(a + 1)]
    return np.stack([q[..., 0] ** a * q[..., 1] ** b for a, b in powers], axis=-1)


class TargetPath:
    """Optical path of a camera that looks at targets.

    Parameters
    ----------
    assembly
        Assembly that contains the camera.
    name
        Prefix of its sequences ``NAME/imaging``, ``NAME/to_stop``, ``NAME/image_to_stop`` ...
    root
        Path of its body.
    model
        Derived numbers of the camera.
    backend
        Backend of the ray trace.
    collimator
        Collimator before the camera; None for a distant scene.
    shadows
        Bodies in its beams; None for a camera alone, or to ignore them.
    """

    def __init__(
        self,
        assembly: Assembly,
        name: str,
        root: str,
        model: CameraModel,
        backend: Backend,
        collimator: Collimator | None = None,
        shadows: ImagingShadows | None = None,
    ) -> None:
        self.assembly = assembly
        self.name = name
        self.root = root
        self.model = model
        self.backend = backend
        self.collimator = collimator
        self.shadows = shadows
        stop = assembly.elements[f"{name}/{model.spec.stop}"].aperture
        assert isinstance(stop, Circle)
        self.stop = stop
        self.nodes = quadrature.disk(VIGNETTED_RINGS if model.edges else RINGS)
        self._axes = assembly.nominal_pose(root).rotation

    @property
    def target_distance(self) -> float:
        """Distance by which target coordinates are divided to obtain tangents of angles, in metres.

        It is the collimator's focal length. Without a collimator it is the principal distance of the camera along its
        line, so that coordinates of a distant target are those of its nominal image.
        """
        return self.model.line_principal_distance if self.collimator is None else self.collimator.focal_length

    def directions(self, positions: np.ndarray, state: State | None = None) -> np.ndarray:
        """Return the directions of light, world frame, (F, 3), imaged at F positions (F, 2) on the line CCD.

        Positions are (along, across), in metres.

        They are those of the camera as designed unless a ``state`` is given.
        """
        states = [state or {}]
        placed = self.assembly.place(states)
        body = line_body(self.root)
        local = np.stack([positions[:, 1], positions[:, 0], np.zeros(len(positions))], axis=-1)
        guess = self.model.toward_optics(placed.rotation[:, placed.index[body]].real)
        _, sight = chief_rays(
            self.backend,
            assemble(self.assembly, [f"{self.name}/image_to_stop"], states, placed=placed),
            assemble(self.assembly, [f"{self.name}/image_to_object"], states, placed=placed),
            points_to_world(placed, body, local).real,
            guess[:, None],
            self._axes[:, 1],
        )
        return np.asarray(-sight[0])

    def coloured(self, state: State, wavelength: float) -> State:
        """Return the state with the refractive indices of the camera's lenses at a given wavelength, in metres.

        Raises
        ------
        ValueError
            The glass of a lens has no name, or its index at this wavelength is unknown.
        """
        return coloured(self.model.spec, self.root, state, wavelength)

    def positions(self, state: State, directions: np.ndarray) -> np.ndarray:
        """Return the positions (along, across) at which F chief rays hit the line CCD, (F, 2), in metres.

        ``directions`` (F, 3) are those of the light. Positions are in metres of the nominal CCD: in these coordinates
        the pixel pitch is constant when the CCD expands.

        Raises
        ------
        BeamMissedError
            A chief ray does not reach the line CCD.
        """
        # a chief ray blocked by a mirror at the centre of the beam is still the centre of the beam
        rays = self.rays(state, directions, np.zeros((1, 2)), edges=False)
        return np.asarray(rays.position[:, 0, 1::-1] / rays.size)

    def rays(self, state: State, directions: np.ndarray, points: np.ndarray, edges: bool = True) -> LineRays:
        """Trace rays of F beams through points of the stop to the line CCD.

        Parameters
        ----------
        state : State
            State of the assembly.
        directions : (F, 3) ndarray
            Directions of the light, world frame.
        points : (N, 2) ndarray
            Points of the stop in units of its radius; without ``edges`` also one set for each beam, (F, N, 2).
        edges : bool
            True if edges of the camera's surfaces and bodies in the beams stop rays.

        Raises
        ------
        AimError
            A beam does not reach the stop.
        BeamMissedError
            No ray of a beam reaches the line CCD.
        """
        placed = self.assembly.place([state])
        systems, to_stop = self._systems(state, len(directions), placed)
        target = self.stop.radius * points + np.array(self.stop.centre)
        launch, _ = aim_collimated(self.backend, to_stop, directions, self._launch(directions), target)
        numbers = {name: self.model.mirrors.index(name) for name in (self.model.edges if edges else ())}
        kept = tuple(numbers.values())
        traced = trace(self.backend, systems, make_rays(self.backend, launch, directions[:, None]), keep=kept)
        position, leaving, path, valid = traced.numpy()
        if numbers:

            def met(name: str) -> np.ndarray:
                size = placed.scale[0, placed.index[f"{self.root}/{name}"]].real
                return np.asarray(traced.hit(numbers[name]) / size)

            valid = valid & self.model.unvignetted(met)
        if edges and self.shadows is not None:
            valid = valid & ~covered(self.shadow_pieces(state, directions), points, SMALLEST)
        require_rays(valid, "the imaging path")
        return LineRays(position, leaving, path, valid, float(systems.size[0]))

    def shadow_pieces(self, state: State, directions: np.ndarray) -> np.ndarray:
        """Return the shadows that bodies cast in F beams, as K convex polygons of V vertices on the stop, (F, K, V, 2).

        Vertices are on the stop's unit disk; ``directions`` (F, 3) are those of the light.

        Raises
        ------
        AimError, BeamMissedError
            A beam does not reach the stop, or none of its rays reaches the line CCD.
        """
        if self.shadows is None:
            return np.zeros((len(directions), 0, 3, 2))
        placed, systems, rays = self._imaging(state, directions)
        owner = np.zeros(len(directions), dtype=int)
        return self.shadows.cast(
            TracedBeams(self.assembly, placed, owner, systems, rays, directions, self.nodes)
        ).pieces

    def _imaging(
        self, state: State, directions: np.ndarray, nodes: PupilNodes | None = None
    ) -> tuple[PlacedBodies, SystemBatch, ImagingRays]:
        """Trace beams through nodes of the stop, by default ``self.nodes``, to the line CCD."""
        nodes = self.nodes if nodes is None else nodes
        placed = self.assembly.place([state])
        systems, to_stop = self._systems(state, len(directions), placed)
        start, first = self._launch(directions), self._axes[:, 1]
        rays = imaging_rays(self.backend, systems, to_stop, directions, start, self.stop, nodes, first)
        return placed, systems, rays

    def pupils(
        self,
        state: State,
        directions: np.ndarray,
        positions: np.ndarray,
        target_shift: float = 0.0,
        wavelength: float | None = None,
    ) -> tuple[PupilFunction, ...]:
        """Return the pupil function of the image of each of F directions, about its position on the line CCD.

        Lengths in the image are in metres of the nominal (unexpanded) line CCD, as in ``positions``.

        Parameters
        ----------
        state : State
            State of the assembly.
        directions : (F, 3) ndarray
            Directions of the light, world.
        positions : (F, 2) ndarray
            Image points about which the pupils are computed, from the method ``positions`` for the same state; for all
            colours of an image those at the design wavelength.
        target_shift : float
            Displacement of the collimator's target from its focus, along the light, in metres.
        wavelength : float | None
            Wavelength, in metres; None for the design wavelength.

        Raises
        ------
        BeamMissedError, AimError
            The beam is lost.
        ValueError
            The beam is vignetted, or the index of a glass is unknown at that wavelength.
        """
        colour = self.model.spec.wavelength if wavelength is None else wavelength
        state = self.coloured(state, colour)
        placed, systems, rays = self._imaging(state, directions)
        shadows, _ = self._taken(placed, systems, rays, directions)
        field = self._field(rays, systems, positions, colour, target_shift)
        if not self.model.edges or shadows is None:
            return fit_pupils(field, self.nodes, DEGREE, shadows)
        points = np.stack([self.nodes.x, self.nodes.y], axis=-1)
        illuminated = ~covered(shadows, points, SMALLEST)
        vignetted = fit_pupils(field, self.nodes, DEGREE, shadows, illuminated)
        return tuple(with_enough_nodes(pupil, field.wavelength) for pupil in vignetted)

    def _field(
        self,
        rays: ImagingRays,
        systems: SystemBatch,
        positions: np.ndarray,
        wavelength: float,
        target_shift: float = 0.0,
    ) -> PupilField:
        """Return the plane waves of traced beams at the line CCD: optical path and amplitude over direction cosines.

        The image axes are along the line and across it; ``positions`` are the image points of reference, and
        ``target_shift`` is the displacement of the collimator's target from its focus, in metres.
        """
        origin = systems.size[:, None] * np.stack([positions[:, 1], positions[:, 0], np.zeros(len(positions))], axis=-1)
        collimator = self.collimator
        incoming = None if collimator is None else lambda point: collimator.path(point, target_shift)
        field = pupil_field(rays, wavelength, origin, incoming)
        swapped = PupilField(field.v, field.u, field.eikonal, field.amplitude, field.wavelength)
        return swapped.scaled_by(systems.size)

    def vignetted_pupils(
        self, state: State, directions: np.ndarray, positions: np.ndarray, wavelength: float | None = None
    ) -> tuple[VignettedPupil, ...]:
        """Return the pupil functions of a camera whose surface edges vignette its beams, with the edges as polygons.

        They are for ``optics.waves.line_transfer``. A smooth wavefront needs no more nodes than that of a pupil without
        vignetting; any other is traced at those of ``nodes``, and at more if polynomials through these do not fit it.

        Parameters
        ----------
        state : State
            State of the assembly.
        directions : (F, 3) ndarray
            Directions of the light, world frame.
        positions : (F, 2) ndarray
            Image points (along, across) on the line CCD, in metres.
        wavelength : float | None
            Wavelength, in metres; None for the design wavelength.

        Raises
        ------
        BeamMissedError, AimError
            The beam is lost.
        ValueError
            The wavefront cannot be described, or the index of a glass is unknown at that wavelength.
        """
        colour = self.model.spec.wavelength if wavelength is None else wavelength
        for nodes, tolerance in ((quadrature.disk(RINGS), SMOOTH), (self.nodes, VIGNETTED_RESIDUAL)):
            with suppress(UnphysicalError):
                vignetted = self._vignetted_pupils(state, directions, positions, colour, nodes)
                if all(pupil.pupil.eikonal_residual <= tolerance * colour for pupil in vignetted):
                    return vignetted
        return self._vignetted_pupils(state, directions, positions, colour, quadrature.disk(MORE_RINGS))

    def _vignetted_pupils(
        self, state: State, directions: np.ndarray, positions: np.ndarray, colour: float, nodes: PupilNodes
    ) -> tuple[VignettedPupil, ...]:
        """Return vignetted pupils from rays traced through given nodes of the stop, for the wavelength ``colour``."""
        state = self.coloured(state, colour)
        placed, systems, rays = self._imaging(state, directions, nodes)
        owner = np.zeros(len(directions), dtype=int)
        beams = TracedBeams(self.assembly, placed, owner, systems, rays, directions, nodes)
        bodies = np.zeros((len(directions), 0, 3, 2)) if self.shadows is None else self.shadows.cast(beams).pieces
        edges = PupilEdges.of(beams, self.model, self.name, self.backend)
        outlines = edges.outlines(LINE_SIDES) + StopOutlines((), tuple(np.moveaxis(bodies, 1, 0)))
        illuminated = edges.passed[-1] & ~covered(bodies, np.stack([nodes.x, nodes.y], axis=-1), SMALLEST)
        field = self._field(rays, systems, positions, colour)
        vignetted = vignetted_pupils(
            fit_pupils(field, nodes, DEGREE, None, illuminated), field.u, field.v, nodes, outlines, illuminated
        )
        for k, pupil in enumerate(vignetted):
            (x, y), (a, b) = (
                np.linalg.inv(pupil.pupil.axes),
                np.stack([field.u[k], field.v[k]]) - pupil.pupil.centre[:, None],
            )
            misjudged = float(
                nodes.share
                @ (unvignetted_at(pupil, (x[0] * a + x[1] * b) + 1j * (y[0] * a + y[1] * b)) != illuminated[k])
            )
            if misjudged > WORST_PLACED:
                raise UnphysicalError(
                    f"the outlines of the apertures put a fraction {misjudged:.2g} of the traced rays on the wrong side"
                )
        return vignetted

    def shadows_on_stop(self, state: State, directions: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the shadows that surface edges and bodies cast in F beams of given directions (F, 3).

        Returns
        -------
        tuple of (ndarray, float)
            K convex polygons of V vertices on the stop's unit disk for each beam, (F, K, V, 2), which do not overlap;
            and the accuracy of the fraction of the stop's area that they cover.

        Raises
        ------
        AimError, BeamMissedError
            A beam does not reach the stop, or none of its rays reaches the line CCD.
        UnphysicalError
            Polygons cannot follow the edges.
        """
        taken, error = self._taken(*self._imaging(state, directions), directions)
        return (np.zeros((len(directions), 0, 3, 2)) if taken is None else taken), error

    def _taken(
        self, placed: PlacedBodies, systems: SystemBatch, rays: ImagingRays, directions: np.ndarray
    ) -> tuple[np.ndarray | None, float]:
        """Return polygons of the stop that edges and bodies shadow in traced beams, or None if nothing blocks them.

        The second value is the accuracy of the fraction of the stop's area that they cover.
        """
        owner = np.zeros(len(directions), dtype=int)
        beams = TracedBeams(self.assembly, placed, owner, systems, rays, directions, self.nodes)
        shadows = None if self.shadows is None else self.shadows.cast(beams).pieces
        if not self.model.edges:
            return shadows, 0.0
        other_shadows = () if shadows is None else tuple(np.moveaxis(shadows, 1, 0))
        edges = PupilEdges.of(beams, self.model, self.name, self.backend)
        return converged_shadows(edges.outlines, len(directions), other_shadows)

    def local_map(self, state: State, direction: np.ndarray, extent: float) -> LocalMap:
        """Return the mapping of target coordinates up to ``extent``, in metres, about a direction (3,) of the light."""
        along, across = self._target_axes(direction)
        step = np.linspace(-extent, extent, MAP_POINTS)
        points = np.stack([a.ravel() for a in np.meshgrid(step, step)], axis=-1)
        around = direction + (points[:, :1] * along + points[:, 1:] * across) / self.target_distance
        around = around / np.linalg.norm(around, axis=-1, keepdims=True)
        positions = self.positions(state, np.concatenate([direction[None], around]))
        design, wanted = _monomials(points / extent), positions[1:] - positions[0]
        terms, *_ = np.linalg.lstsq(design, wanted, rcond=None)
        residual = float(np.max(np.linalg.norm(design @ terms - wanted, axis=-1)))
        return LocalMap(extent, terms, residual)

    def _target_axes(self, direction: np.ndarray) -> np.ndarray:
        """Return the changes of the light's direction that move its image along +Y' and +X', unit vectors (2, 3).

        With the camera's Z toward the scene, light that travels along -Z + t has its image at +f t; the second axis,
        direction x Y, is then near the camera's X.
        """
        return transverse_axes(direction, self._axes[:, 1])

    def _launch(self, directions: np.ndarray) -> np.ndarray:
        """Return a start point of each of F beams before the first surface, world frame, in metres, (F, 3)."""
        first = self.assembly.nominal_pose(f"{self.root}/{self.model.mirrors[0]}").translation
        return np.asarray(first - LAUNCH_DISTANCE * directions)

    def _systems(self, state: State, count: int, placed: PlacedBodies | None = None) -> tuple[SystemBatch, SystemBatch]:
        """Return the optical systems to the line CCD and to the stop, repeated ``count`` times, once for each beam."""
        placed = self.assembly.place([state]) if placed is None else placed
        zeros = np.zeros(count, dtype=int)
        systems, to_stop = (
            assemble(self.assembly, [f"{self.name}/{sequence}"], [state], placed=placed).take(zeros)
            for sequence in ("imaging", "to_stop")
        )
        return systems, to_stop
