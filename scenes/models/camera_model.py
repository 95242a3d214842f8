"""From a camera's prescription to bodies, elements and sequences, frame, apertures, stop and pivots.

Frames. Prescription frame: z along the parent axis, light enters toward +z, y in the plane of symmetry, x along the
line. A mirror's own frame stands at its vertex, turned as the file says. Camera frame: Z = line of sight toward the
scene, Y = along the line CCD (= prescription x), X = Y x Z, the flight direction; its origin is the point where the
centre's chief ray meets the first mirror. Focal-plane frame: origin at the line's centre, Y as the camera's, Z square
to the image plane and toward the scene, X = Y x Z.

The axis of a camera: the ray that its paraxial data are about, the beam along it that the entrance pupil states, and
what has no focus at all.

Shared by the derivation of a camera and by whoever judges one in a state, where the same ray of the scene is traced
through the bodies as they stand.

Are the focal length and the entrance pupil that a camera's file states those of its surfaces, and if not, which
number is wrong?
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from optics.camera.ray_bundle import direction_of
from optics.geometry.aperture import Aperture, Circle, Edge, Ellipse, Rectangle, outer_edge
from optics.geometry.pose import Pose, about_axis, rotation_matrix
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import AT_REST, Body, RigidTree, State
from optics.materials.glass import ABBE_LINES
from optics.numerics.array_math import PhysicalError, matvec
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError, transverse_axes
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.first_order import (
    FirstOrder,
    Paraxial,
    RayMatrix,
    equal_area_radius,
    first_order,
    paraxial,
    ray_matrix,
)
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import BeamMissedError, make_rays, require_rays, trace
from optics.waves.imaging import aim_collimated
from scenes.specs.camera import CameraSpec, MirrorSpec
from scenes.specs.camera_tests import CameraUnderTestSpec
from scenes.specs.perturbation import NodeInfo, perturbation_issues
from scenes.yaml.errors import InputError, KeyPath, key_text
from scenes.yaml.units import ANGLE, LENGTH, format_quantity

LARGEST_DIFFERENCE = 0.1
"""Share by which the traced focal length may differ from the stated one. The library's cameras need 0.5 % along the
line and 8 % across it; a wrong sign or unit is seldom below a third.
"""

LARGEST_PUPIL_DIFFERENCE = 0.4
"""Share by which the traced entrance pupil may differ from the stated one where the stop's diameter is stated as well.
Of off-axis cameras the pupil of the axis is up to some 10 % from that of the field's middle, and the smallest mistake,
a radius in place of a diameter, is a factor of two."""

SAME_PUPIL = 0.01
"""Share by which the beam that fills the stop may differ from the beam that made it: none about an axis; cameras with
turned surfaces map one circle to another curve and back."""


class TracedFocalLengths(NamedTuple):
    """Focal lengths of a camera about the chief ray of its field's middle, metres.

    Attributes
    ----------
    image : np.ndarray
        Change of the image's place per angle, along the line and across it, (2,): on the plane that the file states, in
        focus or not.
    light : np.ndarray
        Of parallel light, wherever its focus is: in the two principal directions about that ray, infinite without
        power, and the effective focal length about the axis, (3,); negative where light diverges after the last
        surface.
    """

    image: np.ndarray
    light: np.ndarray


FocalLengths = Callable[[CameraSpec], TracedFocalLengths]

_MOST_NAMED = 3  # causes in a message

_UNITS = ((1000.0, "m in place of mm"), (0.001, "mm in place of m"))

_NO_LIGHT = (AimError, BeamMissedError, ArithmeticError, np.linalg.LinAlgError, ValueError)


def check_focal_length(spec: CameraSpec, traced: TracedFocalLengths, focal_lengths: FocalLengths) -> None:
    """Check the stated focal length against the traced one.

    Either of the two directions will do, since cameras with surfaces off the axis differ in them. A camera that is only
    out of focus is none of another focal length, unless a single number explains it: it can be refocused.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    traced : TracedFocalLengths
        Its focal lengths.
    focal_lengths : FocalLengths
        How those of a changed camera are traced; asked only to find out what is wrong.

    Raises
    ------
    InputError
        They differ by more than ``LARGEST_DIFFERENCE``; with the number whose other sign or unit brings the focal
        length to the stated one, where there is one.
    """
    stated, real = spec.focal_length, bool(np.all(traced.light > 0.0))
    in_place, in_focus = (_difference(np.abs(one), stated) <= LARGEST_DIFFERENCE for one in traced)
    if in_focus and in_place and real:
        return
    cause, suggestion = _cause(spec, float(traced.image[0]), focal_lengths, in_focus and real)
    if suggestion is None and in_focus:
        return
    off = float(traced.light[-1] if in_place else traced.image[0])
    problem = f"the focal length is stated as {stated:.4g} m, but light through the surfaces has one of {off:.4g} m"
    allowed = f"the traced focal length within {100 * LARGEST_DIFFERENCE:.0f} %, or surfaces that have the stated one"
    raise spec.error(problem + cause, ("focal_length",), allowed=allowed, suggestion=suggestion)


def check_entrance_pupil(spec: CameraSpec, traced: float) -> None:
    """Check the stated entrance pupil of a camera against the traced diameter, metres.

    Raises
    ------
    InputError
        They differ by more than ``LARGEST_PUPIL_DIFFERENCE`` where the stop is stated, else at all: other rays than
        those of the stated beam meet the rim of the stop.
    """
    off = abs(traced / spec.entrance_pupil - 1.0)
    if spec.stop_diameter is None and off > SAME_PUPIL:
        problem = "rays of other heights than the stated beam's meet the rim of the stop, which stands near their focus"
        raise spec.error(problem, ("stop",), allowed="a stop that rays of different heights meet in different places")
    if off > LARGEST_PUPIL_DIFFERENCE:
        stated, found = (format_quantity(float(f"{d:.4g}"), LENGTH) for d in (spec.entrance_pupil, traced))
        problem = f"a stop of this size has an entrance pupil of {found} on the axis; the file states one of {stated}"
        allowed = f"both within {100 * LARGEST_PUPIL_DIFFERENCE:.0f} %, or the entrance pupil alone"
        raise spec.error(problem, ("stop_diameter",), allowed=allowed)


def _difference(traced: np.ndarray, stated: float) -> float:
    """Relative difference of the nearer direction."""
    return float(np.min(np.abs(traced / stated - 1.0)))


def _cause(spec: CameraSpec, traced: float, focal_lengths: FocalLengths, place: bool) -> tuple[str, str | None]:
    """What is likely wrong, in words and as the line that would be right; nothing where no single number is."""
    for factor, what in _UNITS:
        if abs(factor * traced / spec.focal_length - 1.0) <= LARGEST_DIFFERENCE:
            right = format_quantity(spec.focal_length / factor, LENGTH)
            return f"; the stated one is likely {what}", f"focal_length: {right}"
    # surfaces that have the stated focal length are right: only where the image is taken may be wrong
    for among in (_places(spec),) if place else (_single(spec), _places(spec), _together(spec)):
        fits = []
        for words, line, changed in among:
            try:
                off = max(_difference(one, spec.focal_length) for one in focal_lengths(changed))
            except _NO_LIGHT:
                continue
            if off <= LARGEST_DIFFERENCE:
                fits.append((off, words, line))
        if fits:
            fits.sort()
            others = ", ".join(words for _, words, _ in fits[1:_MOST_NAMED])
            also = f" (or {others})" if others else ""
            return f"; the likely cause is {fits[0][1]}{also}", fits[0][2]
    return "", None


Candidates = Iterator[tuple[str, str, CameraSpec]]
"""What may be wrong, the line that would be right, and the camera with it."""


def _single(spec: CameraSpec) -> Candidates:
    """One number of one surface."""
    for name, mirror in spec.mirrors.items():
        for key, words, value, text in _changes(mirror):
            mirrors = {**spec.mirrors, name: mirror.model_copy(update={key: value})}
            line = f"{key_text(('mirrors', name, key))}: {text}"
            yield f"{words} of {name}", line, spec.model_copy(update={"mirrors": FrozenMap(mirrors)})


def _together(spec: CameraSpec) -> Candidates:
    """The sign of all radii, as another program has it."""
    turned = {name: mirror.model_copy(update={"radius": -mirror.radius}) for name, mirror in spec.mirrors.items()}
    line = "radius of every surface with the other sign: positive if its centre of curvature lies toward +z"
    yield "the sign of every radius", line, spec.model_copy(update={"mirrors": FrozenMap(turned)})


def _places(spec: CameraSpec) -> Candidates:
    """One number of the image or the field."""
    image = spec.image
    changes: list[tuple[KeyPath, str, dict[str, Any]]] = []
    for z, words in _lengths("z", image.z):
        changes.append((("image", "z"), words, {"image": image.model_copy(update={"z": z})}))
    if image.tilt:
        tilted = image.model_copy(update={"tilt": -image.tilt})
        changes.append((("image", "tilt"), "the sign of the tilt", {"image": tilted}))
    if spec.field_bias:
        changes.append((("field_bias",), "the sign of the bias", {"field_bias": -spec.field_bias}))
    for key, words, update in changes:
        changed = spec.model_copy(update=update)
        value = changed.field_bias if key == ("field_bias",) else getattr(changed.image, str(key[1]))
        text = format_quantity(value, LENGTH if key[-1] == "z" else ANGLE)
        whose = "field" if key == ("field_bias",) else "image"
        yield f"{words} of the {whose}", f"{key_text(key)}: {text}", changed


def _changes(mirror: MirrorSpec) -> Iterator[tuple[str, str, Any, str]]:
    """Key, what is wrong with it, its other value, and that as text."""
    if math.isfinite(mirror.radius):
        for value, words in _lengths("radius", mirror.radius):
            yield "radius", words, value, format_quantity(value, LENGTH)
    for value, words in _lengths("z", mirror.z):
        yield "z", words, value, format_quantity(value, LENGTH)
    if mirror.conic:
        yield "conic", "the sign of the conic constant", -mirror.conic, f"{-mirror.conic:g}"
    for key, words, kind in (("rotate", "the tilt about", ANGLE), ("decentre", "the decentre along", LENGTH)):
        given = getattr(mirror, key) or ()
        for axis, value in enumerate(given):
            if value:
                other = (*given[:axis], -value, *given[axis + 1 :])
                text = ", ".join(format_quantity(v, kind) for v in other)
                yield key, f"the sign of {words} {'xyz'[axis]}", other, f"[{text}]"


def _lengths(what: str, value: float) -> Iterator[tuple[float, str]]:
    """Other signs and units of a length."""
    if value:
        yield -value, f"the sign of the {what}"
        for factor, words in _UNITS:
            yield value / factor, f"the unit of the {what} ({words})"


PARENT_AXIS, LINE_AXIS = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
LAUNCH_DISTANCE = 3.0
"""How far before the prescription's origin beams from the scene are launched, metres."""
AFOCAL = 1000.0
"""Focal length, over the distance that light goes from the first surface to the image, from which on a system has no
focus: the longest telescopes have some 20, and an afocal one whose spacing is rounded to 10 um some 10 000."""
_RIM = 48


class AfocalError(PhysicalError, ValueError):
    """Parallel light leaves a system parallel: it has no focal length and makes no image."""


@dataclass(frozen=True, eq=False)
class CameraAxis:
    """The light along the axis of a camera, in the prescription frame.

    Attributes
    ----------
    direction : np.ndarray
        In which it travels, unit, (3,): along the parent axis, or along the light of the field's middle where none
        comes through along that axis.
    base : np.ndarray
        Launch point of the ray that paraxial data are about, (3,), metres: on the parent axis where all mirrors and
        lenses are about it, else that of the ray through the middle of the stop.
    centre : np.ndarray
        Launch point of the ray through the middle of the stop, (3,), metres.
    on_axis : bool
        Whether it travels along the parent axis.
    """

    direction: np.ndarray
    base: np.ndarray
    centre: np.ndarray
    on_axis: bool

    def moved(self, pose: Pose) -> CameraAxis:
        """Return the axis of a camera whose prescription frame has a pose in the world."""
        turned = pose.rotation @ self.direction
        return CameraAxis(turned, pose.apply(self.base), pose.apply(self.centre), self.on_axis)


def find_axis(
    spec: CameraSpec, backend: Backend, to_stop: SystemBatch, imaging: SystemBatch, middle: np.ndarray
) -> tuple[CameraAxis, float]:
    """Return the axis of a camera and the radius of its stop, metres.

    The stop is as large as the file states, or as the beam along the axis makes it that has the diameter of the
    entrance pupil before the first surface: its rays are traced to the stop, and the area that they enclose there is
    the stop's.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    backend : Backend
        Where to trace.
    to_stop : SystemBatch
        One system, from the scene to the stop.
    imaging : SystemBatch
        One system, from the scene to the image.
    middle : np.ndarray
        Direction of the light of the field's middle, prescription frame, (3,).

    Raises
    ------
    AimError, BeamMissedError
        No light comes through, neither along the parent axis nor along the field's middle.
    """
    try:
        return _along(spec, backend, to_stop, imaging, PARENT_AXIS)
    except (AimError, BeamMissedError):
        return _along(spec, backend, to_stop, imaging, middle)


def _along(
    spec: CameraSpec, backend: Backend, to_stop: SystemBatch, imaging: SystemBatch, direction: np.ndarray
) -> tuple[CameraAxis, float]:
    """``find_axis`` along one direction. Raises AimError, BeamMissedError."""
    start, on_axis = -LAUNCH_DISTANCE * direction, np.array_equal(direction, PARENT_AXIS)
    centre = aim_collimated(backend, to_stop, direction[None], start[None], np.zeros((1, 2)))[0][0, 0]
    optics = [mirror for mirror in spec.mirrors.values() if mirror.light != "passes"]
    centred = on_axis and not any(one.decentre or one.rotate or one.sag for one in optics)
    axis = CameraAxis(direction, start if centred else centre, centre, on_axis)
    _require_light(backend, imaging, axis.base[None], direction)
    if spec.stop_diameter is not None:
        return axis, 0.5 * spec.stop_diameter
    ring = centre + 0.5 * spec.entrance_pupil * _ring() @ transverse_axes(direction, LINE_AXIS)
    return axis, equal_area_radius(_require_light(backend, to_stop, ring, direction))


def _ring() -> np.ndarray:
    turn = 2.0 * np.pi * np.arange(_RIM) / _RIM
    return np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def _require_light(backend: Backend, systems: SystemBatch, launch: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return where rays from launch points (N, 3) end on the last surface, (N, 2). Raises BeamMissedError."""
    place, _, _, valid = trace(backend, systems, make_rays(backend, launch, direction)).numpy()
    if not np.all(valid):
        raise BeamMissedError("the beam along the axis misses a surface")
    return np.asarray(place[0, :, :2])


def pupil_diameter(backend: Backend, to_stop: SystemBatch, axis: CameraAxis, radius: float) -> float:
    """Return the diameter of the entrance pupil: that of the round beam along the axis with the area of the light,
    before the first surface, that fills the stop, metres.

    Parameters
    ----------
    backend : Backend
        Where to trace.
    to_stop : SystemBatch
        One system, from the scene to the stop.
    axis : CameraAxis
        In the same frame as the system.
    radius : float
        Of the stop, metres.

    Raises
    ------
    AimError
        The beam does not reach the stop.
    """
    rays, axes = aim_collimated(backend, to_stop, axis.direction[None], axis.centre[None], radius * _ring())
    return 2.0 * equal_area_radius(rays[0] @ axes[0].T)


def axis_data(
    backend: Backend, imaging: SystemBatch, spec: CameraSpec, axis: CameraAxis, first: np.ndarray
) -> Paraxial:
    """Return the paraxial data about the axis of a camera.

    Parameters
    ----------
    backend : Backend
        Where to trace.
    imaging : SystemBatch
        One system, from the scene to the image.
    spec : CameraSpec
        The camera.
    axis : CameraAxis
        In the same frame as the system.
    first : np.ndarray
        Near this direction of that frame lies the first axis of the launch plane, (3,).

    Raises
    ------
    AfocalError
        Parallel light leaves the system parallel.
    """
    count, launch, direction = len(imaging.structure), axis.base[None], axis.direction[None]
    traced = trace(backend, imaging, make_rays(backend, launch, axis.direction), keep=range(count))
    hits = np.stack([traced.hit(k)[0, 0] for k in range(count)])
    world = np.einsum("kij,kj->ki", imaging.world.rotation[0], hits) + imaging.world.translation[0]
    steps = np.linalg.norm(np.diff(np.concatenate([launch, world]), axis=0), axis=-1)
    used = [k for k, mirror in enumerate(spec.mirrors.values()) if mirror.light != "passes"]
    behind = float(np.sum(steps[used[-1] + 1 :])) if used else 0.0
    before = float(np.sum(steps[: used[0] + 1])) if used else 0.0
    stop = list(spec.mirrors).index(spec.stop)
    matrix = ray_matrix(backend, imaging, stop, launch, direction, transverse_axes(direction, first[None]))
    data = paraxial(matrix, before, behind)
    # what is no number is afocal as well
    if not data.focal_length < AFOCAL * (np.sum(steps) - before):
        raise AfocalError(
            f"the system is afocal, with an angular magnification of {data.angular_magnification:.5g}: parallel light "
            "leaves it parallel, so that it has no focal length and makes no image"
        )
    return data


def focal_plane_body(root: str) -> str:
    """Path of the focal-plane assembly of the camera at ``root``."""
    return f"{root}/focal_plane"


def line_body(root: str) -> str:
    """Path of the line CCDs on the focal-plane assembly of the camera at ``root``."""
    return f"{focal_plane_body(root)}/line"


def camera_bodies(root: str, pose: Pose, model: CameraModel) -> list[Body]:
    """The camera's structure at ``pose`` relative to its parent, mirrors, focal-plane assembly and line CCD."""
    into_camera = model.camera_frame.inverse()
    bodies = [Body(root, pose)]
    for mirror in model.mirrors:
        x, y = model.clear_aperture(mirror).centre
        centre = (x, y, float(model.surfaces[mirror].sag(x, y)))
        own = into_camera @ model.mirror_pose(mirror)
        bodies.append(Body(f"{root}/{mirror}", own, pivots={"centre": centre}))
    x, y, z = model.focal_plane.inverse().apply(model.rear_node)
    pivots = {"rear_node": (float(x), float(y), float(z)), "line_centre": (0.0, 0.0, 0.0)}
    plane_root = focal_plane_body(root)
    bodies.append(Body(plane_root, into_camera @ model.focal_plane, pivots=pivots, scales=False))
    bodies.append(Body(line_body(root)))
    return bodies


def camera_elements(name: str, root: str, model: CameraModel) -> dict[str, Element]:
    """Mirrors and line CCD, by ``NAME/M1`` ... and ``NAME/line``."""
    out = {}
    glass = lenses(model.spec)
    for mirror in model.mirrors:
        key = f"{name}/{mirror}"
        surface, aperture = model.surfaces[mirror], model.apertures[mirror]
        how = LIGHT[model.spec.mirrors[mirror].light]
        solid = f"{root}/{glass[mirror]}" if mirror in glass else None
        edges = model.edges.get(mirror, ())
        out[key] = Element(key, f"{root}/{mirror}", surface, how, aperture, solid=solid, edges=edges)
    key = f"{name}/line"
    out[key] = Element(key, line_body(root), plane(), Interaction.PASS)
    return out


def camera_sequences(name: str, model: CameraModel) -> dict[str, tuple[str, ...]]:
    """Ways of the light: from the scene to the line CCD and to the stop, and back from the image."""
    forward = tuple(f"{name}/{m}" for m in model.mirrors)
    backward = forward[::-1]
    stop = f"{name}/{model.spec.stop}"
    return {
        f"{name}/imaging": (*forward, f"{name}/line"),
        f"{name}/to_stop": forward[: forward.index(stop) + 1],
        f"{name}/image_to_stop": backward[: backward.index(stop) + 1],
        f"{name}/image_to_object": backward,
    }


def shape_changes(model: CameraModel, root: str) -> dict[str, tuple[str, ...]]:
    """What may change of the shapes and glasses of a camera's surfaces.

    Parameters
    ----------
    model : CameraModel
        Of the camera.
    root : str
        Path of its body.

    Returns
    -------
    dict[str, tuple[str, ...]]
        Body -> which of "figure", "radius", "conic", "index" and "abbe"; surfaces that light passes have none.
    """
    glass, dispersive = lenses(model.spec), above_d_line(model.spec)
    out = {}
    for name, surface in model.surfaces.items():
        if LIGHT[model.spec.mirrors[name].light] is not Interaction.PASS:
            curved = () if surface.is_plane or surface.curvature == 0.0 else ("radius", "conic")
            lens = ("index", *(("abbe",) if name in dispersive else ())) if glass.get(name) == name else ()
            out[f"{root}/{name}"] = ("figure", *curved, *lens)
    return out


ROOT = "camera"


def camera_alone(model: CameraModel) -> Assembly:
    """The camera by itself: bodies ``camera/M1`` ... ``camera/focal_plane``, sequences ``camera/imaging`` ..."""
    tree = RigidTree(tuple(camera_bodies(ROOT, Pose(), model)))
    index = {f"{ROOT}/{lens}": n for lens, n in glass_indices(model.spec).items()}
    above_d = {f"{ROOT}/{lens}": step for lens, step in above_d_line(model.spec).items()}
    return Assembly(tree, camera_elements(ROOT, ROOT, model), camera_sequences(ROOT, model), index, above_d)


@dataclass(frozen=True, eq=False)
class CameraUnderTest:
    """A camera ready to be traced.

    Attributes
    ----------
    model : CameraModel
        Derived numbers of the prescription.
    assembly : Assembly
        Bodies ``camera/M1`` ... ``camera/focal_plane``, sequences ``camera/imaging`` ...
    as_built : State
        How it departs from the prescription.
    """

    model: CameraModel
    assembly: Assembly
    as_built: State


def build_camera_under_test(test: CameraUnderTestSpec, camera: CameraSpec, backend: Backend) -> CameraUnderTest:
    """Build the camera and check what the test says of it.

    Raises
    ------
    InputError
        ``as_built`` names what the camera does not have.
    """
    camera.require_mirrors("a camera under test")
    model = derive_camera(camera, backend)
    assembly = camera_alone(model)
    shaped = shape_changes(model, ROOT)
    nodes = {
        body.path.removeprefix(f"{ROOT}/"): NodeInfo(
            tuple(body.pivots), frozenset({"rotate", "shift", *shaped.get(body.path, ())})
        )
        for body in assembly.tree.bodies
        if body.path != ROOT
    }
    issues = [
        issue
        for path, what in test.as_built.items()
        for issue in perturbation_issues(test, nodes, path, what, ("as_built", path))
    ]
    if issues:
        raise InputError(*issues)
    as_built = {f"{ROOT}/{path}": what.motion() for path, what in test.as_built.items()}
    return CameraUnderTest(model, assembly, as_built)


IMAGE = "image"
REFERENCE = "reference"
_RIM_POINTS = 24


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera's derived numbers; poses and points are in the prescription frame, metres and radians.

    Attributes
    ----------
    spec : CameraSpec
        The prescription.
    surfaces : Mapping[str, Surface]
        Mirror name -> shape.
    apertures : Mapping[str, Aperture]
        Mirror name -> clear aperture (the stop's is the stop itself).
    camera_frame : Pose
        The camera frame in the prescription frame.
    focal_plane : Pose
        The focal-plane frame in the prescription frame.
    first_order : FirstOrder
        Parabasal quantities about the centre's chief ray.
    image_direction : np.ndarray
        Direction of the centre's chief ray at the image.
    rear_node : np.ndarray
        Point one principal distance (along the line) upstream of the line's centre along that ray.
    axis : CameraAxis
        Light along its axis.
    paraxial : Paraxial
        Paraxial data about that axis.
    entrance_pupil : float
        Diameter of the entrance pupil, metres: of the beam along the axis that fills the stop.
    """

    spec: CameraSpec
    surfaces: Mapping[str, Surface]
    apertures: Mapping[str, Aperture]
    camera_frame: Pose
    focal_plane: Pose
    first_order: FirstOrder
    image_direction: np.ndarray
    rear_node: np.ndarray
    axis: CameraAxis
    paraxial: Paraxial
    entrance_pupil: float

    @property
    def mirrors(self) -> tuple[str, ...]:
        """Mirror names in the order of the light from the scene."""
        return tuple(self.spec.mirrors)

    @cached_property
    def edges(self) -> Mapping[str, tuple[Edge, ...]]:
        """Mirror name -> what cuts light there beside the stop, of those that have it."""
        given = {name: mirror.edges for name, mirror in self.spec.mirrors.items()}
        return {name: tuple(edge.to_edge() for edge in edges) for name, edges in given.items() if edges}

    def clear_aperture(self, mirror: str) -> Aperture:
        """Return the outer edge of a surface's clear aperture, over which its figures are."""
        outer = outer_edge(self.apertures[mirror], self.edges.get(mirror, ()))
        assert outer is not None
        return outer

    def uncut(self, met: Callable[[str], np.ndarray]) -> np.ndarray | bool:
        """Which rays all edges let through; True where there are none.

        Parameters
        ----------
        met : Callable[[str], np.ndarray]
            Mirror name -> (..., 2 or 3) where rays meet it, in its own frame, metres of the nominal mirror.
        """
        through: np.ndarray | bool = True
        for name, edges in self.edges.items():
            place = met(name)
            for edge in edges:
                through = through & edge.passes(place[..., 0], place[..., 1])
        return through

    @property
    def line_principal_distance(self) -> float:
        """Local principal distance along the line about the centre's chief ray, metres (the papers' f)."""
        return float(abs(self.first_order.scale[0, 0, 0]))

    def vertex(self, mirror: str) -> np.ndarray:
        """Vertex of a mirror's parent surface in the prescription frame, metres."""
        return self.mirror_pose(mirror).translation

    def mirror_pose(self, mirror: str) -> Pose:
        """Pose of a mirror's own frame in the prescription frame."""
        return mirror_pose(self.spec.mirrors[mirror])

    @property
    def image_body(self) -> Pose:
        """Pose of the image plane in the prescription frame: its origin is on the parent axis."""
        return image_pose(self.spec)

    def toward_optics(self, focal_plane: np.ndarray) -> np.ndarray:
        """Direction from the line's centre along its chief ray, upstream, for rotations (..., 3, 3) of the focal plane
        in the world.
        """
        return matvec(focal_plane, matvec(self.focal_plane.rotation.T, -self.image_direction))

    def bare_assembly(self, apertures: bool = True) -> Assembly:
        """The camera alone, in the prescription frame: mirrors and image plane."""
        return _bare(self.spec, self.surfaces, self.apertures if apertures else {})


def field_direction(spec: CameraSpec, x: float, y: float) -> np.ndarray:
    """Direction in which light of field (x, y) travels, prescription frame; y counts from the biased centre,
    radians.
    """
    return direction_of((x, spec.field_bias + y))


def mirror_pose(mirror: MirrorSpec) -> Pose:
    """Pose of a mirror's own frame in the prescription frame: its vertex, and the axes of its shape."""
    x, y = mirror.decentre or (0.0, 0.0)
    rotation = rotation_matrix(mirror.rotate) if mirror.rotate and any(mirror.rotate) else np.eye(3)
    return Pose(rotation, np.array([x, y, mirror.z]))


def image_pose(spec: CameraSpec) -> Pose:
    """Pose of the image plane's body in the prescription frame: on the parent axis, turned by the plane's tilt."""
    rotation = about_axis(0, spec.image.tilt) if spec.image.tilt else np.eye(3)
    return Pose(rotation, np.array([0.0, 0.0, spec.image.z]))


def collimated(backend: Backend, to_stop: SystemBatch, directions: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Launch points of collimated beams that meet the stop at given points.

    Parameters
    ----------
    backend : Backend
        Where to trace.
    to_stop : SystemBatch
        One system, from the scene to the stop.
    directions : np.ndarray
        (F, 3) beam directions.
    targets : np.ndarray
        (N, 2) stop coordinates, metres, the same for every beam.

    Returns
    -------
    np.ndarray
        (F, N, 3) points on a plane before the first mirror, prescription frame.
    """
    every = to_stop.take(np.zeros(len(directions), dtype=int))
    return aim_collimated(backend, every, directions, -LAUNCH_DISTANCE * directions, targets)[0]


def derive_camera(spec: CameraSpec, backend: Backend, stated: bool = True) -> CameraModel:
    """Trace a prescription and work out frames, stop, apertures and first-order numbers.

    Parameters
    ----------
    spec : CameraSpec
        The prescription.
    backend : Backend
        Where to trace.
    stated : bool
        Whether its focal length is held against the traced one; it is not while a file is made, whose focal length
        follows from the trace.

    Raises
    ------
    InputError
        The prescription does not bring the light of its field through the stop to the image, or has another focal
        length than it states.
    """
    try:
        return _derived(spec, backend, stated)
    except AfocalError as error:
        raise spec.error(str(error), ("mirrors",), allowed="surfaces that focus light on the image") from error
    except (AimError, BeamMissedError) as error:
        reason = str(error).partition(";")[0]
        problem = f"no light of the whole field comes through the stop to the image: {reason}"
        allowed = "mirrors, image, field and stop that belong together"
        raise spec.error(problem, ("mirrors",), allowed=allowed) from error


def _focal_lengths(chief: RayMatrix, about_axis: Paraxial) -> TracedFocalLengths:
    """About a chief ray, and the effective focal length about the axis."""
    power = np.linalg.svd(chief.direction_by_position[0], compute_uv=False)
    with np.errstate(divide="ignore"):
        light = np.copysign([*1.0 / power, about_axis.focal_length], about_axis.back_focal_length)
        return TracedFocalLengths(np.abs(np.diagonal(first_order(chief).scale[0])), light)


def _traced_focal_lengths(spec: CameraSpec, backend: Backend) -> TracedFocalLengths:
    """`_focal_lengths` of a prescription. Raises AimError, BeamMissedError, AfocalError."""
    bare = _bare(spec, {name: surface_of(mirror) for name, mirror in spec.mirrors.items()}, {})
    to_stop, imaging, _, matrix = _chief(spec, backend, bare)
    axis, _ = find_axis(spec, backend, to_stop, imaging, field_direction(spec, 0.0, 0.0))
    return _focal_lengths(matrix, axis_data(backend, imaging, spec, axis, LINE_AXIS))


def _chief(
    spec: CameraSpec, backend: Backend, bare: Assembly
) -> tuple[SystemBatch, SystemBatch, np.ndarray, RayMatrix]:
    """Return the systems to the stop and to the image, the launch point (1, 3) of the centre's chief ray, and its
    derivatives.
    """
    names = tuple(spec.mirrors)
    stop = names.index(spec.stop)
    centre = field_direction(spec, 0.0, 0.0)
    to_stop, imaging = assemble(bare, [names[: stop + 1]]), assemble(bare, [(*names, IMAGE)])
    launch = collimated(backend, to_stop, centre[None], np.zeros((1, 2)))[0]
    axes = transverse_axes(centre[None], LINE_AXIS[None])
    return to_stop, imaging, launch, ray_matrix(backend, imaging, stop, launch, centre[None], axes)


def _derived(spec: CameraSpec, backend: Backend, stated: bool) -> CameraModel:
    """Return the model as `derive_camera` does. Raises AimError, BeamMissedError, AfocalError."""
    surfaces = {name: surface_of(mirror) for name, mirror in spec.mirrors.items()}
    names = tuple(spec.mirrors)
    bare = _bare(spec, surfaces, {})
    to_stop, imaging, launch, matrix = _chief(spec, backend, bare)
    chief = first_order(matrix)
    centre = field_direction(spec, 0.0, 0.0)
    axis, stop_radius = find_axis(spec, backend, to_stop, imaging, centre)
    about_axis = axis_data(backend, imaging, spec, axis, LINE_AXIS)
    pupil = pupil_diameter(backend, to_stop, axis, stop_radius)
    if stated:
        traced_here = _focal_lengths(matrix, about_axis)
        check_focal_length(spec, traced_here, lambda other: _traced_focal_lengths(other, backend))

    traced = trace(backend, imaging, make_rays(backend, launch, centre), keep=range(len(names)), world=True)
    assert traced.world is not None
    position, direction, _, valid = traced.numpy(traced.world)
    require_rays(valid, f"camera {spec.name}")
    image_centre, image_direction = position[0, 0], direction[0, 0]

    sight = -centre
    across = np.cross(LINE_AXIS, sight)
    # baffles may stand before it
    first = next(k for k, name in enumerate(names) if name == spec.stop or spec.mirrors[name].light != "passes")
    origin = mirror_pose(spec.mirrors[names[first]]).apply(traced.hit(first)[0, 0])
    camera_frame = Pose(np.stack([across, LINE_AXIS, sight], axis=-1), origin)
    normal = np.sign(sight[2]) * image_pose(spec).rotation[:, 2]
    focal_plane = Pose(np.stack([np.cross(LINE_AXIS, normal), LINE_AXIS, normal], axis=-1), image_centre)

    apertures = _apertures(spec, backend, to_stop, imaging, stop_radius)
    distance = float(abs(chief.scale[0, 0, 0]))  # along the line, as the papers use it
    rear_node = image_centre - distance * image_direction
    if stated or spec.stop_diameter is None:
        check_entrance_pupil(spec, pupil)
    frames = (camera_frame, focal_plane, chief, image_direction, rear_node)
    return CameraModel(spec, surfaces, apertures, *frames, axis, about_axis, pupil)


def surface_of(mirror: MirrorSpec) -> Surface:
    """The shape of a mirror of a camera's file; terms A4, A6, ... that stand between others and are not given are 0."""
    last = max((int(name[1:]) for name in mirror.aspheric), default=2)
    even = tuple(float(mirror.aspheric.get(f"A{n}", 0.0)) for n in range(4, last + 1, 2))
    return Surface(1.0 / mirror.radius, mirror.conic, even, terms=tuple((mirror.sag or {}).values()))


LIGHT = {None: Interaction.REFLECT, "refracts": Interaction.REFRACT, "passes": Interaction.PASS}


def lenses(spec: CameraSpec) -> dict[str, str]:
    """Face -> the lens that it is a face of, called by its first face; so light may go either way."""
    out, inside = {}, ""
    for name, mirror in spec.mirrors.items():
        if mirror.light == "refracts":
            out[name] = inside or name
            inside = "" if inside else name
    return out


def glass_indices(spec: CameraSpec, wavelength: float | None = None) -> dict[str, float]:
    """Lens -> its refractive index at a wavelength, metres; at that of the design by default.

    Raises
    ------
    ValueError
        a lens whose glass is not named, or not known there.
    """
    return {name: spec.index_behind(name, wavelength) for name in dict.fromkeys(lenses(spec).values())}


def above_d_line(spec: CameraSpec) -> dict[str, float]:
    """Lens whose glass has an Abbe number -> its index at the design wavelength less that at the d line.

    A glass has one where it is known at the lines d, F and C.
    """
    out = {}
    for name, index in glass_indices(spec).items():
        with suppress(ValueError):
            at_d, _, _ = (spec.index_behind(name, line) for line in ABBE_LINES)
            out[name] = index - at_d
    return out


def coloured(spec: CameraSpec, root: str, state: State, wavelength: float) -> State:
    """A state as light of another wavelength than the design's meets it: its lenses have other indices.

    What the state itself says of an index, as heat does, is added to that of the wavelength.

    Parameters
    ----------
    spec : CameraSpec
        Of the camera.
    root : str
        Path of its body; empty for a bare camera.
    state : State
        Body path -> motion.
    wavelength : float
        metres.

    Returns
    -------
    State
        The state, with the change of index of every lens; the same one for a camera without lenses, and at the design
        wavelength.

    Raises
    ------
    ValueError
        As ``glass_indices``.
    """
    return in_glass(state, glass_steps(spec, root, wavelength))


def glass_steps(spec: CameraSpec, root: str, wavelength: float) -> dict[str, float]:
    """Body of a lens -> its index at a wavelength less that of the design wavelength; empty for none.

    Arguments and exceptions as of ``coloured``.
    """
    if wavelength == spec.wavelength or not lenses(spec):
        return {}
    design = glass_indices(spec)
    at_colour = glass_indices(spec, wavelength)
    return {f"{root}/{lens}" if root else lens: index - design[lens] for lens, index in at_colour.items()}


def in_glass(state: State, steps: Mapping[str, float]) -> State:
    """A state as light meets it whose indices are those of the design's wavelength and ``steps``.

    A glass with another Abbe number disperses more or less than the catalogue's.

    Parameters
    ----------
    state : State
        Body path -> motion.
    steps : Mapping[str, float]
        Of ``glass_steps``.
    """
    if not steps:
        return state
    moved = dict(state)
    for path, step in steps.items():
        motion = moved.get(path, AT_REST)
        moved[path] = replace(motion, index=motion.index + step * (1.0 + motion.dispersion))
    return FrozenMap(moved)


def _bare(spec: CameraSpec, surfaces: Mapping[str, Surface], apertures: Mapping[str, Aperture]) -> Assembly:
    bodies = [Body(name, mirror_pose(m)) for name, m in spec.mirrors.items()]
    bodies.append(Body(IMAGE, image_pose(spec)))
    glass = lenses(spec)
    elements = {
        name: Element(name, name, surface, LIGHT[spec.mirrors[name].light], apertures.get(name), solid=glass.get(name))
        for name, surface in surfaces.items()
    }
    elements[IMAGE] = Element(IMAGE, IMAGE, plane(), Interaction.PASS)
    sequences = {"imaging": (*spec.mirrors, IMAGE)}
    return Assembly(RigidTree(tuple(bodies)), elements, sequences, glass_indices(spec))


def _apertures(
    spec: CameraSpec, backend: Backend, to_stop: SystemBatch, imaging: SystemBatch, stop_radius: float
) -> dict[str, Aperture]:
    """Return the clear apertures: the stop, and of the other surfaces the outline of the beams of the whole field with
    the margin about them. A mirror or a lens about its own axis is round, as it is made: a circle about its vertex,
    and an ellipse where it is flat, as a slanted flat is that light meets round. Others have a box.
    """
    angle = 2.0 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    rim = stop_radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    fields = [
        (x, y) for x in np.linspace(-spec.field.x, spec.field.x, 5) for y in np.linspace(-spec.field.y, spec.field.y, 3)
    ]
    directions = np.array([field_direction(spec, x, y) for x, y in fields])
    launch = collimated(backend, to_stop, directions, rim)
    rays = make_rays(backend, launch.reshape(-1, 3), np.repeat(directions, _RIM_POINTS, axis=0))
    traced = trace(backend, imaging, rays, keep=range(len(spec.mirrors)))
    valid = traced.numpy()[3]
    require_rays(valid, f"camera {spec.name} at its field edges")
    out: dict[str, Aperture] = {}
    for i, name in enumerate(spec.mirrors):
        if name == spec.stop:
            out[name] = Circle(stop_radius)
            continue
        points = traced.hit(i)[0, valid[0], :2]
        low, high = points.min(axis=0) - spec.edge_margin, points.max(axis=0) + spec.edge_margin
        half, middle = 0.5 * (high - low), 0.5 * (high + low)
        box = Rectangle(float(half[0]), float(half[1]), (float(middle[0]), float(middle[1])))
        hits = np.where(valid[0, :, None], traced.hit(i)[0, :, :2], np.nan).reshape(len(fields), _RIM_POINTS, 2)
        hits = hits[~np.isnan(hits).all(axis=(1, 2))]  # fields whose light is lost say nothing of an outline
        out[name] = box if spec.mirrors[name].light == "passes" else _made(box, hits, spec, name)
    return out


_ABOUT_AXIS = 0.5
"""Distance of the middle of all beams from a surface's vertex, of their half-width, up to which the surface is about
its own axis: below 0.13 for mirrors of telescopes on their axis, above 1 for off-axis ones."""


def _made(box: Rectangle, hits: np.ndarray, spec: CameraSpec, name: str) -> Aperture:
    """Return the outline of a surface as it is made for beams whose rims meet it at (F, N, 2), NaN for lost rays."""
    margin = spec.edge_margin
    if np.hypot(*box.centre) > _ABOUT_AXIS * min(box.half_x, box.half_y):
        return box
    if surface_of(spec.mirrors[name]).is_plane:
        half = np.array([box.half_x, box.half_y]) - margin
        half *= np.nanmax(np.hypot(*np.moveaxis((hits - box.centre) / half, -1, 0)))
        return Ellipse(float(half[0] + margin), float(half[1] + margin), box.centre)
    # a rim between the traced points is no farther off than the beam's middle and radius together
    middle = np.nanmean(hits, axis=1)
    radius = np.nanmax(np.hypot(*np.moveaxis(hits - middle[:, None], -1, 0)), axis=1) + np.hypot(*middle.T)
    return Circle(float(np.nanmax(radius)) + margin)
