"""From a target in front of a camera to its image: pupils and the exact mapping of the field, by ray tracing.

Image coordinates are (along, across) = (Y', X') of the focal-plane frame, metres: columns of an image run along the
line CCD, rows along the track. A target stands in the collimator's focal plane with its own coordinates in the same
sense, so that its image is ``f / focal_length`` times its size and upright in these coordinates.
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
from optics.waves.line_transfer import LINE_SIDES, VignettedPupil, vignetted_pupils, unvignetted_at
from optics.waves.optical_transfer import with_enough_nodes
from optics.waves.pupil_shadow import SMALLEST
from optics.waves.pupil_stack import VIGNETTED_RESIDUAL, VIGNETTED_RINGS, DEGREE, PupilFunction, fit_pupils
from scenes.models.camera_model import LAUNCH_DISTANCE, CameraModel, coloured, line_body
from scenes.models.shadow import ImagingShadows, SeenEdges, TracedBeams

RINGS = 14
"""Rings of the pupil's quadrature: exact for wavefronts to order 55, far beyond what mirrors and figures make."""

MORE_RINGS = 28
"""Of the quadrature of a pupil that edges leave a wavefront which polynomials through fewer rays do not follow."""

SMOOTH = 1e-6
"""Rms eikonal that the polynomials of a wavefront leave which is smooth, wavelengths."""

WORST_PLACED = 5e-3
"""Share of the rays through the pupil's quadrature that may pass edges where outlines tell otherwise: four, close to
an edge."""

MAP_POINTS = 7
MAP_ORDER = 4
"""Chief rays per axis, and order of the polynomial through them, of the local mapping from angles to the image."""


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Exact chief-ray mapping near one field direction: target coordinates to image coordinates.

    Attributes
    ----------
    scale : float
        Largest target coordinate, metres; coordinates are divided by it.
    coefficients : np.ndarray
        (terms, 2), of the monomials of ``_monomials``.
    residual : float
        Largest distance of the traced chief rays from the polynomial, metres.
    """

    scale: float
    coefficients: np.ndarray
    residual: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Image coordinates (N, 2) relative to the middle's chief ray, of target coordinates (N, 2), metres."""
        return np.asarray(_monomials(points / self.scale) @ self.coefficients)

    @property
    def jacobian(self) -> np.ndarray:
        """d(along, across)/d(target coordinates) in the middle, (2, 2)."""
        return np.asarray(self.coefficients[1:3].T / self.scale)


@shows("position [mm]", "path [m]", "valid")
@dataclass(frozen=True, eq=False)
class LineRays:
    """Rays of F beams, N each, where they meet the line CCD, in its own frame: X' along the track, Y' along the line.

    Attributes
    ----------
    position, direction : np.ndarray
        (F, N, 3), metres and unit.
    path : np.ndarray
        Optical path from the incoming plane wavefront, (F, N), metres.
    valid : np.ndarray
        False where an aperture stops the ray, (F, N).
    size : float
        Of the line CCD relative to nominal.
    """

    position: np.ndarray
    direction: np.ndarray
    path: np.ndarray
    valid: np.ndarray
    size: float


def _monomials(q: np.ndarray) -> np.ndarray:
    powers = [(a - b, b) for a in range(MAP_ORDER + 1) for b in range(a + 1)]
    return np.stack([q[..., 0] ** a * q[..., 1] ** b for a, b in powers], axis=-1)


class TargetPath:
    """A camera that looks at targets.

    Parameters
    ----------
    assembly
        That holds the camera.
    name
        Prefix of its sequences ``NAME/imaging``, ``NAME/to_stop``, ``NAME/image_to_stop`` ...
    root
        Path of its body.
    model
        Its derived numbers.
    backend
        Where to trace.
    collimator
        What it looks into; None for a far scene.
    shadows
        What stands in its beams; None for a camera alone, or to ignore it.
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
        """Divides target coordinates into angles: the collimator's focal length, or that of the camera along its line,
        so that a far target is measured on the image.
        """
        return self.model.line_principal_distance if self.collimator is None else self.collimator.focal_length

    def directions(self, places: np.ndarray, state: State | None = None) -> np.ndarray:
        """Directions of the light, world, (F, 3), that the camera images at places (F, 2), (along, across), metres, of
        its line CCD; as designed unless a ``state`` is given.
        """
        states = [state or {}]
        placed = self.assembly.place(states)
        body = line_body(self.root)
        local = np.stack([places[:, 1], places[:, 0], np.zeros(len(places))], axis=-1)
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
        """The state as light of another wavelength (metres) than the design's meets it, see
        ``scenes.models.camera_model.coloured``.

        Raises
        ------
        ValueError
            a lens whose glass is not named, or not known there.
        """
        return coloured(self.model.spec, self.root, state, wavelength)

    def places(self, state: State, directions: np.ndarray) -> np.ndarray:
        """Where chief rays of directions (F, 3) meet the line CCD, (F, 2) (along, across).

        In metres of the nominal CCD: its pixels keep their pitch in these coordinates when it grows.

        Raises
        ------
        BeamMissedError
            a chief ray does not reach the line CCD.
        """
        # a chief ray that a mirror in the middle of the beam stops is still the beam's middle
        rays = self.rays(state, directions, np.zeros((1, 2)), edges=False)
        return np.asarray(rays.position[:, 0, 1::-1] / rays.size)

    def rays(self, state: State, directions: np.ndarray, points: np.ndarray, edges: bool = True) -> LineRays:
        """Rays of beams of directions (F, 3), world, through points of the stop in units of its radius.

        Parameters
        ----------
        state : State
            Of the assembly.
        directions : np.ndarray
            Of the light.
        points : np.ndarray
            Of the stop, (N, 2); without ``edges`` also of each beam, (F, N, 2).
        edges : bool
            Whether edges of the camera's surfaces and bodies in the beams stop rays.

        Raises
        ------
        AimError
            a beam does not reach the stop.
        BeamMissedError
            Nothing of one reaches the line CCD.
        """
        placed = self.assembly.place([state])
        systems, to_stop = self._systems(state, len(directions), placed)
        target = self.stop.radius * points + np.array(self.stop.centre)
        launch, _ = aim_collimated(self.backend, to_stop, directions, self._launch(directions), target)
        cut = {name: self.model.mirrors.index(name) for name in (self.model.edges if edges else ())}
        kept = tuple(cut.values())
        traced = trace(self.backend, systems, make_rays(self.backend, launch, directions[:, None]), keep=kept)
        position, leaving, path, valid = traced.numpy()
        if cut:

            def met(name: str) -> np.ndarray:
                size = placed.scale[0, placed.index[f"{self.root}/{name}"]].real
                return np.asarray(traced.hit(cut[name]) / size)

            valid = valid & self.model.uncut(met)
        if edges and self.shadows is not None:
            valid = valid & ~covered(self.shadow_pieces(state, directions), points, SMALLEST)
        require_rays(valid, "the imaging path")
        return LineRays(position, leaving, path, valid, float(systems.size[0]))

    def shadow_pieces(self, state: State, directions: np.ndarray) -> np.ndarray:
        """What bodies take of beams of directions (F, 3): convex polygons on the stop's unit disk, (F, K, V, 2).

        Raises
        ------
        AimError, BeamMissedError
            As ``rays``.
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
        """Beams through nodes of the stop, ``self.nodes`` by default, to the line CCD."""
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
        places: np.ndarray,
        target_shift: float = 0.0,
        wavelength: float | None = None,
    ) -> tuple[PupilFunction, ...]:
        """Pupil of the image of each direction (F, 3), about its own place (F, 2) on the line CCD.

        Its lengths are those of ``places``.

        Parameters
        ----------
        state : State
            Of the assembly.
        directions : np.ndarray
            Of the light, world.
        places : np.ndarray
            As ``places`` gives them for the same state; what they are at the design wavelength is what all colours of
            an image count from.
        target_shift : float
            Of the collimator's target, see ``Collimator.path``.
        wavelength : float | None
            Of the light, metres; the design wavelength by default.

        Raises
        ------
        BeamMissedError, AimError
            The beam does not get through.
        ValueError
            It is vignetted, or a glass is not known at that wavelength.
        """
        colour = self.model.spec.wavelength if wavelength is None else wavelength
        state = self.coloured(state, colour)
        placed, systems, rays = self._imaging(state, directions)
        taken, _ = self._taken(placed, systems, rays, directions)
        turned = self._field(rays, systems, places, colour, target_shift)
        if not self.model.edges or taken is None:
            return fit_pupils(turned, self.nodes, DEGREE, taken)
        points = np.stack([self.nodes.x, self.nodes.y], axis=-1)
        lit = ~covered(taken, points, SMALLEST)
        cut = fit_pupils(turned, self.nodes, DEGREE, taken, lit)
        return tuple(with_enough_nodes(pupil, turned.wavelength) for pupil in cut)

    def _field(
        self, rays: ImagingRays, systems: SystemBatch, places: np.ndarray, wavelength: float, target_shift: float = 0.0
    ) -> PupilField:
        """Field of traced beams in the pupil, along the line CCD and across, with arguments of ``pupils``."""
        origin = systems.size[:, None] * np.stack([places[:, 1], places[:, 0], np.zeros(len(places))], axis=-1)
        collimator = self.collimator
        incoming = None if collimator is None else lambda point: collimator.path(point, target_shift)
        field = pupil_field(rays, wavelength, origin, incoming)
        turned = PupilField(field.v, field.u, field.eikonal, field.amplitude, field.wavelength)
        return turned.scaled_by(systems.size)

    def vignetted_pupils(
        self, state: State, directions: np.ndarray, places: np.ndarray, wavelength: float | None = None
    ) -> tuple[VignettedPupil, ...]:
        """Pupils of a camera with edges for ``optics.waves.line_transfer``; arguments and exceptions as ``pupils``.

        A smooth wavefront needs no more nodes than a free pupil's; any other is traced at those of ``nodes``, and at
        more where polynomials through these do not follow it.
        """
        colour = self.model.spec.wavelength if wavelength is None else wavelength
        for nodes, rest in ((quadrature.disk(RINGS), SMOOTH), (self.nodes, VIGNETTED_RESIDUAL)):
            with suppress(UnphysicalError):
                cut = self._cut_pupils(state, directions, places, colour, nodes)
                if all(one.pupil.eikonal_residual <= rest * colour for one in cut):
                    return cut
        return self._cut_pupils(state, directions, places, colour, quadrature.disk(MORE_RINGS))

    def _cut_pupils(
        self, state: State, directions: np.ndarray, places: np.ndarray, colour: float, nodes: PupilNodes
    ) -> tuple[VignettedPupil, ...]:
        state = self.coloured(state, colour)
        placed, systems, rays = self._imaging(state, directions, nodes)
        owner = np.zeros(len(directions), dtype=int)
        beams = TracedBeams(self.assembly, placed, owner, systems, rays, directions, nodes)
        bodies = np.zeros((len(directions), 0, 3, 2)) if self.shadows is None else self.shadows.cast(beams).pieces
        seen = SeenEdges.of(beams, self.model, self.name, self.backend)
        outlines = seen.outlines(LINE_SIDES) + StopOutlines((), tuple(np.moveaxis(bodies, 1, 0)))
        lit = seen.passed[-1] & ~covered(bodies, np.stack([nodes.x, nodes.y], axis=-1), SMALLEST)
        field = self._field(rays, systems, places, colour)
        cut = vignetted_pupils(fit_pupils(field, nodes, DEGREE, None, lit), field.u, field.v, nodes, outlines, lit)
        for k, pupil in enumerate(cut):
            (x, y), (a, b) = (
                np.linalg.inv(pupil.pupil.axes),
                np.stack([field.u[k], field.v[k]]) - pupil.pupil.centre[:, None],
            )
            off = float(nodes.share @ (unvignetted_at(pupil, (x[0] * a + x[1] * b) + 1j * (y[0] * a + y[1] * b)) != lit[k]))
            if off > WORST_PLACED:
                raise UnphysicalError(f"outlines of its edges are wrong about {off:.2g} of a traced beam's rays")
        return cut

    def shadows_on_stop(self, state: State, directions: np.ndarray) -> tuple[np.ndarray, float]:
        """What edges of the camera's surfaces and bodies take of beams of directions (F, 3).

        Returns
        -------
        tuple[np.ndarray, float]
            Convex polygons on the stop's unit disk that do not overlap, (F, K, V, 2), and how much of its area their
            shares are right to.

        Raises
        ------
        AimError, BeamMissedError
            As ``rays``.
        UnphysicalError
            Edges that no polygons follow.
        """
        taken, error = self._taken(*self._imaging(state, directions), directions)
        return (np.zeros((len(directions), 0, 3, 2)) if taken is None else taken), error

    def _taken(
        self, placed: PlacedBodies, systems: SystemBatch, rays: ImagingRays, directions: np.ndarray
    ) -> tuple[np.ndarray | None, float]:
        """``shadows_on_stop`` of traced beams; None for free ones."""
        owner = np.zeros(len(directions), dtype=int)
        beams = TracedBeams(self.assembly, placed, owner, systems, rays, directions, self.nodes)
        taken = None if self.shadows is None else self.shadows.cast(beams).pieces
        if not self.model.edges:
            return taken, 0.0
        others = () if taken is None else tuple(np.moveaxis(taken, 1, 0))
        seen = SeenEdges.of(beams, self.model, self.name, self.backend)
        return converged_shadows(seen.outlines, len(directions), others)

    def local_map(self, state: State, direction: np.ndarray, reach: float) -> LocalMap:
        """Mapping of target coordinates up to ``reach`` (metres) about a direction (3,) of the light."""
        along, across = self._target_axes(direction)
        step = np.linspace(-reach, reach, MAP_POINTS)
        points = np.stack([a.ravel() for a in np.meshgrid(step, step)], axis=-1)
        around = direction + (points[:, :1] * along + points[:, 1:] * across) / self.target_distance
        around = around / np.linalg.norm(around, axis=-1, keepdims=True)
        places = self.places(state, np.concatenate([direction[None], around]))
        design, wanted = _monomials(points / reach), places[1:] - places[0]
        terms, *_ = np.linalg.lstsq(design, wanted, rcond=None)
        residual = float(np.max(np.linalg.norm(design @ terms - wanted, axis=-1)))
        return LocalMap(reach, terms, residual)

    def _target_axes(self, direction: np.ndarray) -> np.ndarray:
        """Directions in which light turns when its image moves along +Y' and +X', (2, 3).

        With the camera's Z toward the scene, light that travels along -Z + t has its image at +f t; the second axis,
        direction x Y, is then near the camera's X.
        """
        return transverse_axes(direction, self._axes[:, 1])

    def _launch(self, directions: np.ndarray) -> np.ndarray:
        """Points of the beams before the first mirror, world, (F, 3)."""
        first = self.assembly.nominal_pose(f"{self.root}/{self.model.mirrors[0]}").translation
        return np.asarray(first - LAUNCH_DISTANCE * directions)

    def _systems(self, state: State, count: int, placed: PlacedBodies | None = None) -> tuple[SystemBatch, SystemBatch]:
        """The way to the line CCD and the way to the stop, once for every direction."""
        placed = self.assembly.place([state]) if placed is None else placed
        every = np.zeros(count, dtype=int)
        systems, to_stop = (
            assemble(self.assembly, [f"{self.name}/{way}"], [state], placed=placed).take(every)
            for way in ("imaging", "to_stop")
        )
        return systems, to_stop
