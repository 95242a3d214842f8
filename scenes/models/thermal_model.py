"""Thermal model: from temperatures of bodies to motions, deformed faces and refractive indices.

A body without a temperature of its own has the field of the body that carries it. Every body is held at its mount (the
pivot ``centre`` if there is one, else the origin) and expands freely about it; structures carry the mounts of the
bodies on them. Mirrors and prisms deform by a finite-element solution for a unit gradient along each axis, held at
three points; the solution is linear, so that one factorisation serves all temperatures. Mirrors on a frame of the same
material form one free body with it, whose exact deformation is known. Glass changes its index by dn/dT.

The faces of a lens are separate bodies, which move as the one piece of glass between them. The lens is named by its
first face, whose temperature it has. It is held at its middle, half way between the centres of its faces, and expands
freely about it; nothing bends it, so that a linear field deforms it by a formula.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat
from typing import TypeVar

import numpy as np
from scipy.spatial import ConvexHull

from optics.geometry.aperture import Aperture
from optics.geometry.pose import Pose, rotation_matrix, triple
from optics.geometry.solid import Solid, solid_mesh
from optics.geometry.surface import Surface
from optics.geometry.tree import ORIGIN, Body, Motion, State, compose_each
from optics.materials.glass import WarmGlass, glass
from optics.materials.material import Material, TemperatureRange, material
from optics.numerics.array_math import PhysicalError, matvec
from optics.thermal.elastic_mesh import mirror_mesh, polyhedron_mesh
from optics.thermal.heat import Temperature, Temperatures, carried_motion
from optics.thermal.thermo_elastic import (
    Displaced,
    ElasticBody,
    FaceChange,
    Formula,
    Kinematic,
    face_change,
    free_linear_field,
)
from scenes.models.camera_model import CameraModel, lenses
from scenes.models.instrument_model import Instrument
from scenes.models.meshes import THICKNESS, behind
from scenes.specs.instrument import BASE


@dataclass(frozen=True, eq=False)
class Lens:
    """Lens of an instrument.

    Attributes
    ----------
    path : str
        Path of the body of its first face, which names the lens.
    faces : Mapping[str, Pose]
        Body of each face -> its pose in the frame of the first.
    parent : Pose
        Pose of the first face in the frame of the body that carries it.
    middle : (3,) ndarray
        Point at which it is held, in the frame of the first face, in metres.
    glass : WarmGlass or None
        Thermal data of its glass; None if there are none.
    unknown : str
        Description of missing data; empty if they are complete.
    """

    path: str
    faces: Mapping[str, Pose]
    parent: Pose
    middle: np.ndarray
    glass: WarmGlass | None
    unknown: str

    @property
    def mount(self) -> np.ndarray:
        """Point at which it is held, (3,), in the frame of the body that carries it, in metres."""
        return np.asarray(self.parent.apply(self.middle))

    def expanded(self, expansion: float) -> dict[str, Motion]:
        """Return face -> its motion when the lens expands about its middle by a relative amount."""
        return {
            face: Motion(
                shift=triple(expansion * (pose.rotation.T @ (pose.translation - self.middle))), expansion=expansion
            )
            for face, pose in self.faces.items()
        }

    def carried(self, rotation: np.ndarray, offset: np.ndarray, expansion: float) -> dict[str, Motion]:
        """Return face -> its motion due to the motion and expansion of the body that carries the lens.

        All arguments are in the frame of the carrier.

        Parameters
        ----------
        rotation : (3,) ndarray
            Rotation vector of the lens about the point at which it is held, in radians.
        offset : (3,) ndarray
            Displacement of that point, in metres, without that due to the carrier's uniform expansion.
        expansion : float
            Relative expansion of the carrier, which moves the origins of the faces in the tree; the lens follows the
            displacement of its middle.
        """
        out = {}
        for face, pose in self.faces.items():
            arm = self.parent.rotation @ (pose.translation - self.middle)
            to_face = (self.parent.rotation @ pose.rotation).T
            shift = offset - expansion * arm + (rotation_matrix(rotation) - np.eye(3)) @ arm
            if np.any(rotation) or np.any(shift):
                out[face] = Motion(rotate=triple(to_face @ rotation), shift=triple(to_face @ shift))
        return out


def lenses_of(name: str, model: CameraModel, bodies: Mapping[str, Body]) -> list[Lens]:
    """Return the lenses of a camera, with their faces and thermal data.

    Parameters
    ----------
    name : str
        Name of the camera in its instrument.
    model : CameraModel
        Derived numbers of the camera.
    bodies : Mapping[str, Body]
        Bodies of the instrument, by path.
    """
    root, groups = f"{BASE}/{name}", dict[str, list[str]]()
    for face, first in lenses(model.spec).items():
        groups.setdefault(first, []).append(face)
    out = []
    for first, faces in groups.items():
        lens_pose = bodies[f"{root}/{first}"].pose
        poses = {f"{root}/{face}": lens_pose.inverse() @ bodies[f"{root}/{face}"].pose for face in faces}
        centres = [pose.apply(np.array(bodies[face].pivots["centre"])) for face, pose in poses.items()]
        glass, unknown = None, ""
        try:
            glass = model.spec.warm_glass(first)
        except ValueError as error:
            unknown = str(error)
        out.append(Lens(f"{root}/{first}", poses, lens_pose, np.mean(centres, axis=0), glass, unknown))
    return out


SPACING = 0.25
"""Longest edge of the finite elements in a prism, in metres. Any mesh represents a linear field exactly."""
CELLS = 8
"""Number of finite elements across a mirror."""
TERMS = 15
"""Number of Zernike terms by which a deformed face is described: all up to fourth order."""


@dataclass(frozen=True, eq=False)
class _Response:
    """Response of a body's optical faces to temperature gradients of 1 K/m along its x, y and z.

    Attributes
    ----------
    terms : Mapping[str, tuple[int, ...]]
        Body of each face -> Noll indices of its figure terms.
    numbers : (n, 3) ndarray
        Rotation vector, shift and figure terms of one face after the other, in radians and metres; a column per
        gradient.
    """

    terms: Mapping[str, tuple[int, ...]]
    numbers: np.ndarray

    @classmethod
    def of(cls, units: Sequence[Mapping[str, FaceChange]]) -> _Response:
        """Return the response computed from the changes of all faces due to the three unit gradients."""
        terms = {face: tuple(sorted({j for unit in units for j in unit[face].figure})) for face in units[0]}
        numbers = [
            [
                n
                for f, figure in terms.items()
                for n in (*u[f].rotate, *u[f].shift, *(u[f].figure.get(j, 0.0) for j in figure))
            ]
            for u in units
        ]
        return cls(terms, np.array(numbers).T)

    def to(self, gradient: np.ndarray) -> dict[str, list[Motion | None]]:
        """Return the motions of the faces due to temperature gradients in S states.

        Parameters
        ----------
        gradient : (S, 3) ndarray
            Gradients along the body's axes, in K/m.

        Returns
        -------
        dict[str, list[Motion or None]]
            Body of each face -> its S motions; None in a state without a gradient.
        """
        rows, bent = matvec(self.numbers, gradient).tolist(), np.any(gradient, axis=1).tolist()
        out: dict[str, list[Motion | None]] = {}
        start = 0
        for face, terms in self.terms.items():
            a, b, c = start, start + 3, start + 6
            start = c + len(terms)
            out[face] = [
                Motion(tuple(n[a:b]), tuple(n[b:c]), figure={j: x for j, x in zip(terms, n[c:start], strict=True) if x})
                if yes
                else None
                for n, yes in zip(rows, bent, strict=True)
            ]
        return out


Held = tuple[ElasticBody, Kinematic]
"""Finite elements of a body and the kinematic support that holds it."""
_Field = TypeVar("_Field", Temperature, Temperatures)
_Moves = Mapping[str, Sequence[Motion | None]]
"""Body path -> its motion in each state, None where it has none."""


class TemperatureError(PhysicalError, ValueError):
    """Error of a temperature that is impossible or outside the data of a material.

    Attributes
    ----------
    origin
        Path of the body whose temperature was specified (bodies that it carries inherit it).
    allowed
        Text of the allowed values.
    """

    def __init__(self, problem: str, origin: str, allowed: str) -> None:
        super().__init__(problem)
        self.origin, self.allowed = origin, allowed


@dataclass(frozen=True, eq=False)
class _Carried:
    """Bodies mounted on a body: lenses, and N other bodies.

    Attributes
    ----------
    lenses : tuple[Lens, ...]
        The lenses.
    bodies : tuple[Body, ...]
        The N other bodies.
    mount : (N, 3) ndarray
        Points at which those bodies are held, in their own frames, in metres.
    position : (N, 3) ndarray
        The same points in the carrier's frame, in metres.
    inward : (N, 3, 3) ndarray
        Rotation matrices from the carrier's frame to theirs.
    """

    lenses: tuple[Lens, ...]
    bodies: tuple[Body, ...]
    mount: np.ndarray
    position: np.ndarray
    inward: np.ndarray


class ThermalModel:
    """Conversion of temperatures of an instrument's bodies into a perturbed state.

    Parameters
    ----------
    instrument : Instrument
        The instrument.
    """

    def __init__(self, instrument: Instrument) -> None:
        self.instrument = instrument
        self.reference: float = instrument.spec.temperature
        self._placed = instrument.assembly.place()
        self._bodies = {body.path: body for body in instrument.assembly.tree.bodies}
        self.solids = {solid.path: solid for solid in instrument.solids}
        self.mirrors = {
            f"{BASE}/{name}/{mirror}": (name, mirror)
            for name, model in instrument.cameras.items()
            for mirror in model.mirrors
            if model.spec.mirrors[mirror].light is None
        }
        lenses = (lens for name, model in instrument.cameras.items() for lens in lenses_of(name, model, self._bodies))
        self.lenses: dict[str, Lens] = {lens.path: lens for lens in lenses}
        self._lens_of = {face: lens for lens in self.lenses.values() for face in lens.faces}
        self._responses: dict[str, _Response] = {}
        self._extents: dict[str, np.ndarray] = {}
        self._carried: dict[str, _Carried] = {}
        self._inside: dict[str, tuple[str, ...]] = {}
        self._owners: dict[str, str | None] = {}

    @cached_property
    def materials(self) -> Mapping[str, Material | WarmGlass]:
        """Body path -> its material, for all bodies except faces of solids and lenses without thermal data."""
        named = self.instrument.spec.materials
        out: dict[str, Material | WarmGlass] = {}
        for path in self._bodies:
            parts = path.split("/")
            if self._owner(path) not in (None, path):
                continue
            if path in self.lenses:
                if (glass := self.lenses[path].glass) is not None:
                    out[path] = glass
                continue
            if path in self.solids:
                name = self.solids[path].material
            elif path in self.mirrors:
                name = named.mirror
            elif "focal_plane" in parts:
                name = named.board if len(parts) > 3 and parts[3] != "line" else named.focal_plane
            else:
                name = named.base if path == BASE else named.camera
            out[path] = material(name)
        return out

    def _owner(self, path: str) -> str | None:
        """Return the path of the solid or lens that a body belongs to, or None.

        Of nested solids it is the outermost, of which the others are parts; a lens is represented by its first face.
        """
        if path not in self._owners:
            outermost = next((p for p in reversed(list(_upward(path))) if p in self.solids), None)
            self._owners[path] = self._lens_of[path].path if path in self._lens_of else outermost
        return self._owners[path]

    def _pieces(self, path: str) -> list[Solid]:
        """Return a solid (a glass body) together with the smaller solids that are parts of it."""
        return [solid for piece, solid in self.solids.items() if self._owner(piece) == path]

    def fields(self, temperatures: Mapping[str, _Field], pieces: bool = True) -> dict[str, _Field]:
        """Return path of each heated body -> its temperature field in its own frame, specified or inherited.

        Parameters
        ----------
        temperatures : Mapping[str, Temperature or Temperatures]
            Fields of the bodies that have one of their own.
        pieces : bool
            Whether bodies that are parts of a solid or a lens are included.
        """
        out: dict[str, _Field] = {}
        for path, body in self._bodies.items():
            if not pieces and self._owner(path) not in (None, path):
                continue
            if path in temperatures:
                out[path] = temperatures[path]
            elif body.parent in out:
                out[path] = out[body.parent].seen_from(body.pose)
        for lens in self.lenses.values() if pieces else ():
            if lens.path in out:
                out.update({face: out[lens.path].seen_from(pose) for face, pose in lens.faces.items()})
        return out

    def check(self, temperatures: Mapping[str, Temperature]) -> None:
        """Check that all temperatures lie within the data of the bodies' materials: expansion and, for glass, index.

        Raises
        ------
        TemperatureError
            A temperature is outside the data; the message names the body.
        """
        for path, field in self.fields(temperatures).items():
            if self._owner(path) not in (None, path):
                continue
            origin = next(p for p in _upward(path) if p in temperatures)
            if not self.coldest(path, field) > 0.0:
                raise TemperatureError(
                    f"{path} would be at {self.coldest(path, field):.4g} K, which is not above absolute zero",
                    origin,
                    f"changes from the instrument's {self.reference:.6g} K to above 0 K everywhere on the body",
                )
            if path in self.lenses and self.lenses[path].unknown and field != Temperature():
                remedy = (
                    "its thermal data of a glass catalogue in the camera's file, or `temperature: 0 K` of this lens"
                )
                raise TemperatureError(f"{path}: {self.lenses[path].unknown}", origin, remedy)
            self._check_known(path, field, origin)
            if path in self.solids and self.solids[path].transparent and field != Temperature():
                try:
                    list(self._indices(path, Temperatures.of([field])))
                except ValueError as error:
                    raise TemperatureError(f"{path}: {error}", origin, "a glass with known dn/dT") from error

    def _check_known(self, path: str, field: Temperature, origin: str) -> None:
        """Raise TemperatureError if a field is outside the temperatures for which a body's material is known."""
        if field == Temperature():
            return
        coldest, hottest, known = self.coldest(path, field), self.hottest(path, field), self.known(path)
        if not known.contains(coldest, hottest):
            reached = coldest if coldest < known.coldest else hottest
            raise TemperatureError(
                f"{path} would be at {reached:.6g} K, where the expansion of {self.materials[path].name} is not known",
                origin,
                f"{known.text} on all of {path} ({known.source}), or another material for it in the instrument",
            )

    def known(self, path: str) -> TemperatureRange:
        """Return the temperature range in which the data of a body's material hold: expansion and, for glass, index."""
        data = self.materials[path].known
        if path in self.solids and self.solids[path].transparent:
            thermal = glass(self.solids[path].material).thermal
            if thermal is not None:
                low, high = (max(data.coldest, thermal.known.coldest), min(data.hottest, thermal.known.hottest))
                source = data.source if (low, high) == (data.coldest, data.hottest) else thermal.known.source
                return TemperatureRange(low, high, source)
        return data

    def coldest(self, path: str, field: Temperature) -> float:
        """Return the lowest absolute temperature of a field on a body, in kelvin.

        It is evaluated at the corners of optics, and at the origin of other bodies.
        """
        return float(self.reference + field.change + np.min(self.extent(path) @ np.array(field.gradient)))

    def hottest(self, path: str, field: Temperature) -> float:
        """Return the highest absolute temperature of a field on a body, in kelvin.

        It is evaluated at the corners of optics, and at the origin of other bodies.
        """
        return float(self.reference + field.change + np.max(self.extent(path) @ np.array(field.gradient)))

    def extent(self, path: str) -> np.ndarray:
        """Return P points that enclose a body, (P, 3), in its frame, in metres; cached for series of states."""
        if path not in self._extents:
            if path in self.solids:
                to_body = self._placed.pose(path).inverse()
                meshes = ((p.path, solid_mesh(p, self._placed).vertices) for p in self._pieces(path))
                points = np.concatenate([to_body.apply(self._placed.pose(name).apply(mesh)) for name, mesh in meshes])
            elif path in self.mirrors:
                points = self._mirror_outline(path)
            elif path in self.lenses:
                faces = self.lenses[path].faces
                points = np.concatenate([pose.apply(self._mirror_outline(face)) for face, pose in faces.items()])
            else:
                points = np.zeros((1, 3))
            self._extents[path] = np.asarray(points, np.float64)
        return self._extents[path]

    def state(
        self,
        temperatures: Mapping[str, Temperature],
        motions: State | None = None,
        progress: Callable[[str], None] = lambda path: None,
    ) -> State:
        """Return the perturbed state in which bodies have given temperatures and, in addition, given motions.

        Parameters
        ----------
        temperatures : Mapping[str, Temperature]
            Path of each heated body -> temperature field in its own frame.
        motions : State or None
            Other motions, which act on top of the thermal motion of the same body.
        progress : callable
            Function called with the path of each body whose finite-element solution begins.
        """
        heat = {path: Temperatures.of([field]) for path, field in temperatures.items()}
        return self.states(heat, [motions or {}], progress)[0]

    def states(
        self,
        temperatures: Mapping[str, Temperatures],
        motions: Sequence[State],
        progress: Callable[[str], None] = lambda path: None,
    ) -> list[State]:
        """Return S perturbed states at once, in which bodies have given temperatures.

        Parameters
        ----------
        temperatures : Mapping[str, Temperatures]
            Path of each heated body -> its temperature fields in the S states, in its own frame.
        motions : sequence of State
            Other motions in each state, which act on top of the thermal motion of the same body.
        progress : callable
            Function called with the path of each body whose finite-element solution begins.
        """
        fields = self.fields(temperatures, pieces=False)
        change, gradient = (np.array([getattr(f, n) for f in fields.values()]) for n in ("change", "gradient"))
        warm = (change != 0.0) | np.any(gradient, axis=-1)
        thermal: list[list[State]] = [[] for _ in motions]
        for (path, field), states in zip(fields.items(), warm, strict=True):
            heated = np.flatnonzero(states)
            for part in self._warmed(path, field[heated], progress) if len(heated) else ():
                for k, s in enumerate(heated.tolist()):
                    thermal[s].append({moved: m for moved, each in part.items() if (m := each[k]) is not None})
        return compose_each([[*heat, more] for heat, more in zip(thermal, motions, strict=True)], self._bodies)

    def _warmed(self, path: str, field: Temperatures, progress: Callable[[str], None]) -> list[_Moves]:
        """Return the motions that a body's temperature fields cause: of its faces, of itself and of what it carries."""
        if path in self.lenses:
            return self._warmed_lens(self.lenses[path], field, progress)
        body, data = self._bodies[path], self.materials[path]
        pivot = _mount(body)
        about = np.array(body.pivots[pivot])
        expansion = data.expansion * field.at(about)
        expansions = expansion.tolist()
        is_glass = path in self.solids and self.solids[path].transparent
        indices = self._indices(path, field) if is_glass else repeat((0.0, (0.0, 0.0, 0.0)), len(expansions))
        out: dict[str, Sequence[Motion | None]] = {
            path: [
                Motion(pivot=pivot, expansion=scale, index=change, index_gradient=slope)
                for scale, (change, slope) in zip(expansions, indices, strict=True)
            ]
        }
        if path in self.solids or path in self.mirrors:
            # An expansion in the tree moves carried bodies without enlarging them; faces and footprints expand as well.
            inside = tuple(Motion(expansion=scale) for scale in expansions)
            out.update(dict.fromkeys(self._within(path), inside))
            return [*self._bent(path, field.gradient, progress), out]
        carried = self._carried_by(path)
        for lens in carried.lenses:
            moves = zip(*carried_motion(data.expansion, field.gradient, lens.mount - about), expansions, strict=True)
            faces = [lens.carried(*each) for each in moves]
            out.update({face: [motions.get(face) for motions in faces] for face in lens.faces})
        rotation, move = carried_motion(data.expansion, field.gradient[:, None], carried.position - about)
        # The expansion in the tree moves the child's origin, but it is the child's mount that moves with this body.
        rotate = matvec(carried.inward, rotation)
        shift = matvec(carried.inward, move) + expansion[:, None, None] * carried.mount
        moved = np.any(rotation, axis=2) | np.any(shift, axis=2)
        for k in np.flatnonzero(np.any(moved, axis=0)).tolist():
            child, values = carried.bodies[k], zip(*(a[:, k].tolist() for a in (moved, rotate, shift)), strict=True)
            out[child.path] = [Motion(tuple(r), tuple(s), _mount(child)) if yes else None for yes, r, s in values]
        return [out]

    def _carried_by(self, path: str) -> _Carried:
        """Return the bodies mounted on a body, from a cache."""
        if path not in self._carried:
            bodies = [body for body in self._bodies.values() if body.parent == path]
            lenses = [self.lenses[body.path] for body in bodies if body.path in self.lenses]
            others = [body for body in bodies if body.path not in self._lens_of]
            mount = np.array([body.pivots[_mount(body)] for body in others]).reshape(-1, 3)
            position = np.array([body.pose.apply(at) for body, at in zip(others, mount, strict=True)]).reshape(-1, 3)
            inward = np.array([body.pose.rotation.T for body in others]).reshape(-1, 3, 3)
            self._carried[path] = _Carried(tuple(lenses), tuple(others), mount, position, inward)
        return self._carried[path]

    def _within(self, path: str) -> tuple[str, ...]:
        """Return the bodies that a body carries, directly or through others."""
        if path not in self._inside:
            self._inside[path] = tuple(other for other in self._bodies if other.startswith(f"{path}/"))
        return self._inside[path]

    def _warmed_lens(self, lens: Lens, field: Temperatures, progress: Callable[[str], None]) -> list[_Moves]:
        """Return the motions and index changes of a lens that its temperature fields cause."""
        assert lens.glass is not None
        here = (self.reference + field.change).tolist()
        motions = [lens.expanded(expansion) for expansion in (lens.glass.expansion * field.at(lens.middle)).tolist()]
        for moves, temperature, gradient in zip(motions, here, field.gradient, strict=True):
            index = lens.glass.change(self.reference, temperature), triple(lens.glass.slope(temperature) * gradient)
            moves[lens.path] = replace(moves[lens.path], index=index[0], index_gradient=index[1])
        return [
            *self._bent(lens.path, field.gradient, progress),
            {face: [moves[face] for moves in motions] for face in lens.faces},
        ]

    def _indices(self, path: str, field: Temperatures) -> Iterator[tuple[float, tuple[float, float, float]]]:
        """Yield, for each state, the change of index at a solid's origin and the gradient of the index, in 1/m."""
        kind, wavelength = glass(self.solids[path].material), self.instrument.spec.autocollimator.wavelength
        at_rest = kind.vacuum_index(wavelength, self.reference)
        for here, gradient in zip((self.reference + field.change).tolist(), field.gradient, strict=True):
            slope = kind.dn_dt(wavelength, here)
            yield kind.vacuum_index(wavelength, here) - at_rest, triple(slope * gradient)

    def _bent(self, path: str, gradient: np.ndarray, progress: Callable[[str], None]) -> list[_Moves]:
        """Return the motions of a body's faces due to temperature gradients in S states.

        Parameters
        ----------
        path : str
            Path of the body.
        gradient : (S, 3) ndarray
            Gradients along the body's axes, in K/m.
        progress : callable
            Function called with the path of the body when its finite-element solution begins.

        Returns
        -------
        list
            One mapping from body to its motions; empty if nothing bends the body.
        """
        if self.materials[path].expansion == 0.0 or not np.any(gradient):
            return []
        if path not in self._responses:
            progress(path)
            self._responses[path] = _Response.of([self.changes(path, at) for at in self.unit_displacements(path)])
        return [self._responses[path].to(gradient)]

    def surface(self, face: str) -> Surface:
        """Return the nominal shape of the optical face of a body."""
        return next(e.surface for e in self.instrument.assembly.elements.values() if e.body == face)

    def face_radii(self, path: str) -> dict[str, float]:
        """Return each optical face of a body -> radius of the disk on which its figure terms are defined, in metres."""
        return {
            face: self.surface(face).figure_disk(face_shape).radius
            for face, (face_shape, _) in self.faces_of(path).items()
        }

    def index_path(self, path: str, field: Temperature, rest: float) -> float:
        """Return the largest change of optical path that residual temperatures may cause in a body's glass, in metres.

        The path goes there and back along the body's longest side; it is 0 for bodies that are not glass.

        Parameters
        ----------
        path : str
            Path of the body.
        field : Temperature
            Linear temperature field of the body, at which dn/dT is taken.
        rest : float
            Largest departure of the temperature from that field, in kelvin.
        """
        if path not in self.solids or not self.solids[path].transparent:
            return 0.0
        here = self.reference + field.change
        slope = glass(self.solids[path].material).dn_dt(self.instrument.spec.autocollimator.wavelength, here)
        return float(abs(slope) * rest * 2.0 * np.max(np.ptp(self.extent(path), axis=0)))

    def faces_of(self, path: str) -> Mapping[str, tuple[Aperture, Pose]]:
        """Return each optical face of a mirror or a solid -> its aperture and its nominal pose in the body's frame."""
        if path in self.mirrors:
            return {path: (self._aperture(path), Pose())}
        if path in self.lenses:
            return {face: (self._aperture(face), pose) for face, pose in self.lenses[path].faces.items()}
        return {
            element.body: (element.aperture, self._placed.pose(path).inverse() @ self._placed.pose(element.body))
            for element in self.instrument.assembly.elements.values()
            if self._owner(element.body) == path and element.aperture is not None
        }

    def elastic(self, path: str, cells: int = CELLS, spacing: float = SPACING) -> Held | None:
        """Return finite elements of a mirror or a solid in its own frame, and its three-point support.

        Parameters
        ----------
        path : str
            Path of the body.
        cells : int
            Number of elements across a mirror.
        spacing : float
            Longest edge in a solid, in metres.

        Returns
        -------
        tuple[ElasticBody, Kinematic] or None
            None for a body without finite elements: one without a shape, or made of several parts.
        """
        if path in self.mirrors:
            camera, name = self.mirrors[path]
            model = self.instrument.cameras[camera]
            surface, aperture = model.surfaces[name], model.clear_aperture(name)
            side = behind(model, name)
            outline = self._mirror_outline(path)
            low, high = outline.min(axis=0), outline.max(axis=0)
            thickness = THICKNESS * float(max(high[:2] - low[:2]))
            back = high[2] + 0.5 * thickness if side > 0 else low[2] - 0.5 * thickness
            x, y = aperture.centre
            radius = 0.25 * float(min(high[:2] - low[:2]))
            support = np.array([[x + radius * c, y + radius * s, back] for c, s in _THREE])
            mesh = mirror_mesh(surface, aperture, thickness, side, cells)
            return ElasticBody(mesh, self._elastic_material(path)), Kinematic(support)
        if path not in self.solids or len(self._pieces(path)) > 1:
            return None
        corners = solid_mesh(self.solids[path], self._placed).vertices
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle, half = corners.mean(axis=0), 0.5 * (high - low)
        # Three points around the middle, 120 deg apart in the plane of the two longest sides.
        a, b = np.argsort(half)[:0:-1][:2]
        arms = np.array([0.5 * half[a] * np.eye(3)[a] * c + 0.5 * half[b] * np.eye(3)[b] * s for c, s in _THREE])
        support = middle + _within(corners, middle, arms) * arms
        return ElasticBody(polyhedron_mesh(corners, spacing), self._elastic_material(path)), Kinematic(support)

    def _elastic_material(self, path: str) -> Material:
        """Return the material, with elastic constants, of a body's finite elements."""
        elastic = self.materials[path]
        assert isinstance(elastic, Material)
        return elastic

    def unit_displacements(self, path: str) -> Sequence[Displaced]:
        """Return the displacements of a body's material due to gradients of 1 K/m along its x, y and z, in its frame.

        The temperature change is zero at its middle.

        Parameters
        ----------
        path : str
            Path of a mirror or a solid.
        """
        held = self.elastic(path)
        if held is None:
            return [self._free(path, axis) for axis in range(3)]
        about = np.array(self._bodies[path].pivots.get("centre", (0.0, 0.0, 0.0)))
        return held[0].solve_many([_unit_load(axis, about) for axis in range(3)], held[1])

    def _free(self, path: str, axis: int) -> Formula:
        """Return the displacement field of a free body due to a temperature gradient of 1 K/m along an axis.

        Displacement and rotation are zero at the point at which the body is held.
        """
        about = self._bodies[path].pivots[_mount(self._bodies[path])]
        if path in self.lenses:
            about = triple(self.lenses[path].middle)
        return Formula(free_linear_field(self.materials[path].expansion, 0.0, np.eye(3)[axis], about))

    def changes(self, path: str, displaced: Displaced, terms: int = TERMS) -> dict[str, FaceChange]:
        """Return each optical face of a mirror or a solid -> its change when the body's material is displaced.

        Parameters
        ----------
        path : str
            Path of the body.
        displaced : Displaced
            Displacement field in its frame, in metres.
        terms : int
            Highest Noll index of the figures.
        """
        return {
            face: face_change(displaced, self.surface(face), aperture, pose, terms)
            for face, (aperture, pose) in self.faces_of(path).items()
        }

    def _aperture(self, path: str) -> Aperture:
        """Return the clear aperture of a mirror or a face of a lens."""
        _, camera, name = path.split("/")
        return self.instrument.cameras[camera].clear_aperture(name)

    def _mirror_outline(self, path: str) -> np.ndarray:
        """Return P points on the rim of a mirror's or lens face's clear aperture, (P, 3), in metres."""
        _, camera, name = path.split("/")
        model = self.instrument.cameras[camera]
        xy = model.clear_aperture(name).outline()
        return np.column_stack([xy, model.surfaces[name].sag(xy[:, 0], xy[:, 1])])


_THREE = tuple((float(np.cos(t)), float(np.sin(t))) for t in np.radians([90.0, 210.0, 330.0]))


def _within(corners: np.ndarray, middle: np.ndarray, arms: np.ndarray) -> float:
    """Return the factor, at most 1, by which vectors must be shortened to stay inside a convex body.

    Parameters
    ----------
    corners : (P, 3) ndarray
        P corners of the body, in metres.
    middle : (3,) ndarray
        Common start point of the vectors, in metres.
    arms : (N, 3) ndarray
        N vectors, in metres.
    """
    sides = ConvexHull(corners).equations
    room, advance = -(sides[:, :3] @ middle + sides[:, 3]), arms @ sides[:, :3].T
    longest = np.min(np.where(advance > 0.0, room / np.where(advance > 0.0, advance, 1.0), np.inf))
    return 1.0 if longest > 1.0 else 0.5 * float(longest)


def _mount(body: Body) -> str:
    """Return the name of the pivot at which a body is held: ``centre`` if it has one, else its origin."""
    return "centre" if "centre" in body.pivots else ORIGIN


def _upward(path: str) -> Iterator[str]:
    """Yield a body's path, then its parent's, and so on up to the root."""
    while path:
        yield path
        path = path.rpartition("/")[0]


def _unit_load(axis: int, about: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from points to temperatures for a gradient of 1 K/m along an axis.

    The temperature change is zero at the point ``about``.
    """
    # The load is zero at the point about which the uniform part, the body's expansion, is taken.
    return lambda points: points[:, axis] - about[axis]
