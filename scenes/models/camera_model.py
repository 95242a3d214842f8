"""Cameras as traced: bodies, elements, sequences, frames, apertures, stop, pivots and paraxial data of a prescription.

Frames. Prescription frame: z along the parent axis, light enters toward +z, y in the plane of symmetry, x along the
line. A mirror's own frame stands at its vertex, rotated as the file says. Camera frame: Z = line of sight toward the
scene, Y = along the line CCD (= prescription x), X = Y x Z, the flight direction; its origin is the point where the
chief ray of the field's centre meets the first mirror. Focal-plane frame: origin at the line's centre, Y as the
camera's, Z square to the image plane and toward the scene, X = Y x Z.

The axis of a camera (``find_axis``) is the ray about which its paraxial data are taken; a system without a focus is
refused (``AfocalError``). ``check_focal_length`` and ``check_entrance_pupil`` compare the focal length and the entrance
pupil that a camera's file states with those of its surfaces, and name the number that is probably wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Edge, Ellipse, Rectangle, outer_edge
from optics.geometry.pose import Pose, about_axis, rotation_matrix
from optics.geometry.surface import Surface, plane
from optics.geometry.tree import AT_REST, Body, RigidTree, State
from optics.materials.glass import ABBE_LINES
from optics.numerics.array_math import PhysicalError, matvec
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.numerics.quadrature import circle
from optics.raytrace.aim import AimError, direction_of, transverse_axes
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
"""Largest relative difference allowed between the traced and the specified focal length. The library's cameras need 0.5
% along the line and 8 % across it; a wrong sign or unit seldom causes less than a third.
"""

LARGEST_PUPIL_DIFFERENCE = 0.4
"""Largest relative difference allowed between the traced and the specified entrance pupil where the file states the
stop's diameter as well. In off-axis cameras the pupil on the axis differs by up to some 10 % from that of the middle
of the field; the smallest mistake, a radius instead of a diameter, is a factor of two.
"""

SAME_PUPIL = 0.01
"""Largest relative difference between the diameter of the beam that fills the stop and that of the beam from which the
stop's size was computed. They are equal in cameras with an axis of symmetry; cameras with rotated surfaces map a circle
to another curve on the stop and back.
"""


class TracedFocalLengths(NamedTuple):
    """Focal lengths of a camera about the chief ray of the middle of its field, in metres.

    Attributes
    ----------
    image : (2,) ndarray
        Change of image position per angle, along the line and across it, on the plane that the file states, in focus or
        not.
    light : (3,) ndarray
        Focal lengths for parallel light, wherever its focus is: in the two principal directions about that ray
        (infinite without power), and the effective focal length about the axis; negative where light diverges after the
        last surface.
    """

    image: np.ndarray
    light: np.ndarray


FocalLengths = Callable[[CameraSpec], TracedFocalLengths]

_MOST_NAMED = 3  # largest number of possible causes in a message

_UNITS = ((1000.0, "m in place of mm"), (0.001, "mm in place of m"))

_NO_LIGHT = (AimError, BeamMissedError, ArithmeticError, np.linalg.LinAlgError, ValueError)


def check_focal_length(spec: CameraSpec, traced: TracedFocalLengths, focal_lengths: FocalLengths) -> None:
    """Raise InputError if the specified focal length differs from the traced one.

    Agreement in one of the two directions is enough, since cameras with off-axis surfaces differ in them. A camera that
    is merely out of focus passes, because it can be refocused, unless a single wrong number explains the difference.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    traced : TracedFocalLengths
        Its traced focal lengths.
    focal_lengths : callable
        Function that traces the focal lengths of a changed camera; called only to find out which number is wrong.

    Raises
    ------
    InputError
        The two differ by more than ``LARGEST_DIFFERENCE``. The error names the number whose other sign or unit brings
        the focal length to the specified one, where there is one.
    """
    specified, real = spec.focal_length, bool(np.all(traced.light > 0.0))
    at_image, in_focus = (_difference(np.abs(length), specified) <= LARGEST_DIFFERENCE for length in traced)
    if in_focus and at_image and real:
        return
    cause, suggestion = _cause(spec, float(traced.image[0]), focal_lengths, in_focus and real)
    if suggestion is None and in_focus:
        return
    off = float(traced.light[-1] if at_image else traced.image[0])
    problem = f"the stated focal length is {specified:.4g} m, but that of the surfaces is {off:.4g} m"
    allowed = f"the traced focal length within {100 * LARGEST_DIFFERENCE:.0f} %, or surfaces that have the stated one"
    raise spec.error(problem + cause, ("focal_length",), allowed=allowed, suggestion=suggestion)


def check_entrance_pupil(spec: CameraSpec, traced: float) -> None:
    """Raise InputError if the specified entrance pupil differs from the traced diameter, in metres.

    Raises
    ------
    InputError
        The two differ by more than ``LARGEST_PUPIL_DIFFERENCE`` where the file states the stop's diameter. Without a
        specified stop: they differ by more than ``SAME_PUPIL``, because other rays than those of the specified beam
        meet the rim of the stop.
    """
    off = abs(traced / spec.entrance_pupil - 1.0)
    if spec.stop_diameter is None and off > SAME_PUPIL:
        problem = "the rays at the rim of the stop are not those of the stated entrance pupil: the stop is near a focus"
        raise spec.error(
            problem, ("stop",), allowed="a stop away from a focus, which rays of each height meet elsewhere"
        )
    if off > LARGEST_PUPIL_DIFFERENCE:
        specified, actual = (format_quantity(float(f"{d:.4g}"), LENGTH) for d in (spec.entrance_pupil, traced))
        problem = f"a stop of this size has an entrance pupil of {actual} on the axis, but the file states {specified}"
        allowed = f"both within {100 * LARGEST_PUPIL_DIFFERENCE:.0f} %, or the entrance pupil alone"
        raise spec.error(problem, ("stop_diameter",), allowed=allowed)


def _difference(traced: np.ndarray, specified: float) -> float:
    """Return the relative difference of the traced from the specified focal length, the smaller of both directions'."""
    return float(np.min(np.abs(traced / specified - 1.0)))


def _cause(
    spec: CameraSpec, traced: float, focal_lengths: FocalLengths, surfaces_agree: bool
) -> tuple[str, str | None]:
    """Return the likely mistake as a sentence and as the corrected line of the file.

    The sentence is empty if no single mistake explains the difference.
    """
    for factor, what in _UNITS:
        if abs(factor * traced / spec.focal_length - 1.0) <= LARGEST_DIFFERENCE:
            right = format_quantity(spec.focal_length / factor, LENGTH)
            return f"; the stated one is probably {what}", f"focal_length: {right}"
    # Surfaces with the stated focal length are right: only the position of the image or the field may be wrong.
    for among in (
        (_image_and_field(spec),) if surfaces_agree else (_single(spec), _image_and_field(spec), _together(spec))
    ):
        fits = []
        for words, line, changed in among:
            try:
                off = max(_difference(length, spec.focal_length) for length in focal_lengths(changed))
            except _NO_LIGHT:
                continue
            if off <= LARGEST_DIFFERENCE:
                fits.append((off, words, line))
        if fits:
            fits.sort()
            others = ", ".join(words for _, words, _ in fits[1:_MOST_NAMED])
            also = f" (or {others})" if others else ""
            return f"; the probable cause is {fits[0][1]}{also}", fits[0][2]
    return "", None


Candidates = Iterator[tuple[str, str, CameraSpec]]
"""Possible mistakes in a camera's file: a description, the corrected line, and the camera with the correction."""


def _single(spec: CameraSpec) -> Candidates:
    """Yield the camera with one number of one surface corrected, for each likely mistake."""
    for name, mirror in spec.mirrors.items():
        for key, words, value, text in _changes(mirror):
            mirrors = {**spec.mirrors, name: mirror.model_copy(update={key: value})}
            line = f"{key_text(('mirrors', name, key))}: {text}"
            yield f"{words} of {name}", line, spec.model_copy(update={"mirrors": FrozenMap(mirrors)})


def _together(spec: CameraSpec) -> Candidates:
    """Yield the camera with the opposite sign of all radii, the convention of some other programs."""
    flipped = {name: mirror.model_copy(update={"radius": -mirror.radius}) for name, mirror in spec.mirrors.items()}
    line = "radius of every surface with the other sign: positive if its centre of curvature lies toward +z"
    yield "the sign of every radius", line, spec.model_copy(update={"mirrors": FrozenMap(flipped)})


def _image_and_field(spec: CameraSpec) -> Candidates:
    """Yield the camera with one number of the image plane or of the field corrected, for each likely mistake."""
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
    """Yield key, description of the mistake, corrected value, and that value as text, for every number of a mirror."""
    if math.isfinite(mirror.radius):
        for value, words in _lengths("radius", mirror.radius):
            yield "radius", words, value, format_quantity(value, LENGTH)
    for value, words in _lengths("z", mirror.z):
        yield "z", words, value, format_quantity(value, LENGTH)
    if mirror.conic:
        yield "conic", "the sign of the conic constant", -mirror.conic, f"{-mirror.conic:g}"
    for key, words, kind in (("rotate", "the tilt about", ANGLE), ("decentre", "the decentre along", LENGTH)):
        values = getattr(mirror, key) or ()
        for axis, value in enumerate(values):
            if value:
                other = (*values[:axis], -value, *values[axis + 1 :])
                text = ", ".join(format_quantity(v, kind) for v in other)
                yield key, f"the sign of {words} {'xyz'[axis]}", other, f"[{text}]"


def _lengths(what: str, value: float) -> Iterator[tuple[float, str]]:
    """Yield a length with the opposite sign and in other units, with a description of each mistake."""
    if value:
        yield -value, f"the sign of the {what}"
        for factor, words in _UNITS:
            yield value / factor, f"the unit of the {what} ({words})"


PARENT_AXIS, LINE_AXIS = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
LAUNCH_DISTANCE = 3.0
"""Distance before the prescription's origin at which beams from the scene are launched, in metres."""
AFOCAL = 1000.0
"""Ratio of focal length to the length of the light path from first surface to image above which a system counts as
afocal. The longest telescopes have some 20, and an afocal one whose spacing is rounded to 10 um some 10 000.
"""
_RIM = 48


class AfocalError(PhysicalError, ValueError):
    """Error of an afocal system, which leaves parallel light parallel: no focal length and no image."""


@dataclass(frozen=True, eq=False)
class CameraAxis:
    """Light along the axis of a camera, in the prescription frame.

    Attributes
    ----------
    direction : (3,) ndarray
        Unit vector in which the light travels: along the parent axis, or along the light of the middle of the field
        where no light comes through along that axis.
    base : (3,) ndarray
        Launch point of the ray about which paraxial data are taken, in metres: on the parent axis if all mirrors and
        lenses are centred on it, otherwise that of the ray through the middle of the stop.
    centre : (3,) ndarray
        Launch point of the ray through the middle of the stop, in metres.
    on_axis : bool
        Whether the light travels along the parent axis.
    """

    direction: np.ndarray
    base: np.ndarray
    centre: np.ndarray
    on_axis: bool

    def moved(self, pose: Pose) -> CameraAxis:
        """Return the axis of a camera whose prescription frame has a pose in the world."""
        direction = pose.rotation @ self.direction
        return CameraAxis(direction, pose.apply(self.base), pose.apply(self.centre), self.on_axis)


def find_axis(
    spec: CameraSpec, backend: Backend, to_stop: SystemBatch, imaging: SystemBatch, middle: np.ndarray
) -> tuple[CameraAxis, float]:
    """Return the axis of a camera and the radius of its stop, in metres.

    The stop is as large as the file states. Without a specified diameter, rays along the axis that fill the diameter of
    the entrance pupil before the first surface are traced to the stop, and the area that they enclose there is the
    stop's.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    backend : Backend
        Backend that traces the rays.
    to_stop : SystemBatch
        One system, from the scene to the stop.
    imaging : SystemBatch
        One system, from the scene to the image.
    middle : (3,) ndarray
        Direction of the light of the middle of the field, in the prescription frame.

    Raises
    ------
    AimError, BeamMissedError
        No light comes through, neither along the parent axis nor along that of the middle of the field.
    """
    try:
        return _along(spec, backend, to_stop, imaging, PARENT_AXIS)
    except (AimError, BeamMissedError):
        return _along(spec, backend, to_stop, imaging, middle)


def _along(
    spec: CameraSpec, backend: Backend, to_stop: SystemBatch, imaging: SystemBatch, direction: np.ndarray
) -> tuple[CameraAxis, float]:
    """Return the camera's axis for light along a direction, and the stop's radius in metres.

    Raises
    ------
    AimError, BeamMissedError
        Light along this direction does not come through.
    """
    start, on_axis = -LAUNCH_DISTANCE * direction, np.array_equal(direction, PARENT_AXIS)
    centre = aim_collimated(backend, to_stop, direction[None], start[None], np.zeros((1, 2)))[0][0, 0]
    optics = [mirror for mirror in spec.mirrors.values() if mirror.light != "passes"]
    centred = on_axis and not any(element.decentre or element.rotate or element.sag for element in optics)
    axis = CameraAxis(direction, start if centred else centre, centre, on_axis)
    _require_light(backend, imaging, axis.base[None], direction)
    if spec.stop_diameter is not None:
        return axis, 0.5 * spec.stop_diameter
    ring = centre + 0.5 * spec.entrance_pupil * circle(_RIM) @ transverse_axes(direction, LINE_AXIS)
    return axis, equal_area_radius(_require_light(backend, to_stop, ring, direction))


def _require_light(backend: Backend, systems: SystemBatch, launch: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Trace N rays to the last element and raise BeamMissedError if one is lost.

    Parameters
    ----------
    backend : Backend
        Backend that traces the rays.
    systems : SystemBatch
        One system.
    launch : (N, 3) ndarray
        Launch points, in metres.
    direction : (3,) ndarray
        Unit vector of all rays.

    Returns
    -------
    (N, 2) ndarray
        Points at which the rays meet the last element, in its x and y, in metres.
    """
    position, _, _, valid = trace(backend, systems, make_rays(backend, launch, direction)).numpy()
    if not np.all(valid):
        raise BeamMissedError("the beam along the axis misses a surface")
    return np.asarray(position[0, :, :2])


def pupil_diameter(backend: Backend, to_stop: SystemBatch, axis: CameraAxis, radius: float) -> float:
    """Return the diameter of the entrance pupil, in metres.

    It is the diameter of the round beam along the axis that has the same area, before the first surface, as the light
    that fills the stop.

    Parameters
    ----------
    backend : Backend
        Backend that traces the rays.
    to_stop : SystemBatch
        One system, from the scene to the stop.
    axis : CameraAxis
        Axis of the camera, in the same frame as the system.
    radius : float
        Radius of the stop, in metres.

    Raises
    ------
    AimError
        The beam does not reach the stop.
    """
    rays, axes = aim_collimated(backend, to_stop, axis.direction[None], axis.centre[None], radius * circle(_RIM))
    return 2.0 * equal_area_radius(rays[0] @ axes[0].T)


def axis_data(
    backend: Backend, imaging: SystemBatch, spec: CameraSpec, axis: CameraAxis, first: np.ndarray
) -> Paraxial:
    """Return the paraxial data (focal length, focus, pupils) about the axis of a camera.

    Parameters
    ----------
    backend : Backend
        Backend that traces the rays.
    imaging : SystemBatch
        One system, from the scene to the image.
    spec : CameraSpec
        The camera.
    axis : CameraAxis
        Axis of the camera, in the same frame as the system.
    first : (3,) ndarray
        Direction of that frame whose projection is the first axis of the launch plane.

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
    used = [k for k, mirror in enumerate(spec.mirrors.values()) if mirror.light != "passes"] or [0]
    # along the ray, since a plane that light passes may lie before the launch point
    behind = float(np.linalg.norm(world[-1] - world[used[-1]]))
    before = float((world[used[0]] - launch[0]) @ direction[0])
    stop = list(spec.mirrors).index(spec.stop)
    matrix = ray_matrix(backend, imaging, stop, launch, direction, transverse_axes(direction, first[None]))
    data = paraxial(matrix, before, behind)
    # A focal length that is not a number is afocal as well.
    if not data.focal_length < AFOCAL * np.sum(steps[used[0] + 1 :]):
        raise AfocalError(
            f"the system is afocal, with an angular magnification of {data.angular_magnification:.5g}: it has no focal "
            "length and makes no image"
        )
    return data


def focal_plane_body(root: str) -> str:
    """Return the path of the focal-plane assembly of the camera whose body is ``root``."""
    return f"{root}/focal_plane"


def line_body(root: str) -> str:
    """Return the path of the line CCD on the focal-plane assembly of the camera whose body is ``root``."""
    return f"{focal_plane_body(root)}/line"


def camera_bodies(root: str, pose: Pose, model: CameraModel) -> list[Body]:
    """Return the bodies of a camera: structure (at ``pose`` in its parent), mirrors, focal-plane assembly, line CCD."""
    into_camera = model.camera_frame.inverse()
    bodies = [Body(root, pose)]
    for mirror in model.mirrors:
        x, y = model.clear_aperture(mirror).centre
        centre = (x, y, float(model.surfaces[mirror].sag(x, y)))
        pose_in_camera = into_camera @ model.mirror_pose(mirror)
        bodies.append(Body(f"{root}/{mirror}", pose_in_camera, pivots={"centre": centre}))
    x, y, z = model.focal_plane.inverse().apply(model.rear_node)
    pivots = {"rear_node": (float(x), float(y), float(z)), "line_centre": (0.0, 0.0, 0.0)}
    plane_root = focal_plane_body(root)
    bodies.append(Body(plane_root, into_camera @ model.focal_plane, pivots=pivots, scales=False))
    bodies.append(Body(line_body(root)))
    return bodies


def camera_elements(name: str, root: str, model: CameraModel) -> dict[str, Element]:
    """Return the optical elements of a camera by name: ``NAME/M1`` ... and ``NAME/line``."""
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
    """Return the sequences in which light meets the elements.

    They run from the scene to the line CCD, from the scene to the stop, from the image to the stop, and from the image
    to the scene.

    Returns
    -------
    dict[str, tuple[str, ...]]
        Name of a sequence, such as ``NAME/imaging`` -> names of its elements.
    """
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
    """Return the shape and glass parameters that may change on each surface of a camera.

    Parameters
    ----------
    model : CameraModel
        The camera.
    root : str
        Path of its body.

    Returns
    -------
    dict[str, tuple[str, ...]]
        Path of each surface's body -> some of "figure", "radius", "conic", "index" and "abbe". Surfaces that light only
        passes are not listed.
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
    """Return the assembly of a single camera, with bodies ``camera/M1`` ... and sequences ``camera/imaging`` ..."""
    tree = RigidTree(tuple(camera_bodies(ROOT, Pose(), model)))
    index = {f"{ROOT}/{lens}": n for lens, n in glass_indices(model.spec).items()}
    above_d = {f"{ROOT}/{lens}": step for lens, step in above_d_line(model.spec).items()}
    return Assembly(tree, camera_elements(ROOT, ROOT, model), camera_sequences(ROOT, model), index, above_d)


@dataclass(frozen=True, eq=False)
class CameraUnderTest:
    """Camera ready to be traced, with its departures from the prescription.

    Attributes
    ----------
    model : CameraModel
        Derived numbers of the prescription.
    assembly : Assembly
        Bodies ``camera/M1`` ... ``camera/focal_plane``, sequences ``camera/imaging`` ...
    as_built : State
        Departures of the camera from the prescription.
    """

    model: CameraModel
    assembly: Assembly
    as_built: State


def build_camera_under_test(test: CameraUnderTestSpec, camera: CameraSpec, backend: Backend) -> CameraUnderTest:
    """Build the camera of a laboratory test and check that the test's ``as_built`` fits it.

    Raises
    ------
    InputError
        ``as_built`` names a part that the camera does not have.
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
    """Traced camera: its prescription with shapes, apertures, frames and paraxial data derived from it.

    Poses and points are in the prescription frame, in metres and radians.

    Attributes
    ----------
    spec : CameraSpec
        The prescription.
    surfaces : Mapping[str, Surface]
        Mirror name -> shape.
    apertures : Mapping[str, Aperture]
        Mirror name -> clear aperture; for the stop surface, the stop itself.
    camera_frame : Pose
        The camera frame in the prescription frame.
    focal_plane : Pose
        The focal-plane frame in the prescription frame.
    first_order : FirstOrder
        Parabasal quantities about the chief ray of the field's centre.
    image_direction : (3,) ndarray
        Unit vector of that chief ray at the image.
    rear_node : (3,) ndarray
        Point one principal distance (along the line) upstream of the line's centre along that ray.
    axis : CameraAxis
        Light along the camera's axis.
    paraxial : Paraxial
        Paraxial data about that axis.
    entrance_pupil : float
        Diameter of the entrance pupil, in metres: of the beam along the axis that fills the stop.
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
        """Names of all surfaces (mirrors, lens faces and stop) in the order of the light from the scene."""
        return tuple(self.spec.mirrors)

    @cached_property
    def edges(self) -> Mapping[str, tuple[Edge, ...]]:
        """Mirror name -> edges other than the stop that vignette light there; only for surfaces that have any."""
        listed = {name: mirror.edges for name, mirror in self.spec.mirrors.items()}
        return {name: tuple(edge.to_edge() for edge in edges) for name, edges in listed.items() if edges}

    def clear_aperture(self, mirror: str) -> Aperture:
        """Return the outer edge of a surface's clear aperture, over which its figure terms are defined."""
        outer = outer_edge(self.apertures[mirror], self.edges.get(mirror, ()))
        assert outer is not None
        return outer

    def unvignetted(self, hits: Callable[[str], np.ndarray]) -> np.ndarray | bool:
        """Return a mask of the rays that pass all edges, or True if the camera has no edges.

        Parameters
        ----------
        hits : callable
            Function from a mirror's name to the points at which rays meet it: (..., 2 or 3) array of x, y (and z) in
            the mirror's own frame, in metres; for a mirror changed by heat, divided by its expansion.
        """
        through: np.ndarray | bool = True
        for name, edges in self.edges.items():
            points = hits(name)
            for edge in edges:
                through = through & edge.passes(points[..., 0], points[..., 1])
        return through

    @property
    def line_principal_distance(self) -> float:
        """Principal distance along the line about the central chief ray, in metres.

        It is the image shift per field angle in radians; the papers listed in docs/conventions.md call it f.
        """
        return float(abs(self.first_order.scale[0, 0, 0]))

    def vertex(self, mirror: str) -> np.ndarray:
        """Return the vertex of a mirror's parent surface in the prescription frame, in metres."""
        return self.mirror_pose(mirror).translation

    def mirror_pose(self, mirror: str) -> Pose:
        """Return the pose of a mirror's own frame in the prescription frame."""
        return mirror_pose(self.spec.mirrors[mirror])

    @property
    def image_body(self) -> Pose:
        """Pose of the image plane in the prescription frame, with its origin on the parent axis."""
        return image_pose(self.spec)

    def toward_optics(self, focal_plane: np.ndarray) -> np.ndarray:
        """Return the unit vector from the line's centre back along its chief ray, toward the optics, in the world.

        Parameters
        ----------
        focal_plane : (..., 3, 3) ndarray
            Rotation matrices of the focal plane in the world.

        Returns
        -------
        (..., 3) ndarray
            Unit vectors.
        """
        return matvec(focal_plane, matvec(self.focal_plane.rotation.T, -self.image_direction))

    def bare_assembly(self, apertures: bool = True) -> Assembly:
        """Return the assembly of mirrors and image plane alone, in the prescription frame."""
        return _bare(self.spec, self.surfaces, self.apertures if apertures else {})


def field_direction(spec: CameraSpec, x: float, y: float) -> np.ndarray:
    """Return the unit vector in which light of a field point travels, in the prescription frame.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    x, y : float
        Field angles along and across the line, in radians; y counts from the biased centre of the field.
    """
    return direction_of((x, spec.field_bias + y))


def mirror_pose(mirror: MirrorSpec) -> Pose:
    """Return the pose of a mirror's own frame, vertex and axes of its shape, in the prescription frame."""
    x, y = mirror.decentre or (0.0, 0.0)
    rotation = rotation_matrix(mirror.rotate) if mirror.rotate and any(mirror.rotate) else np.eye(3)
    return Pose(rotation, np.array([x, y, mirror.z]))


def image_pose(spec: CameraSpec) -> Pose:
    """Return the pose of the image plane, tilted on the parent axis, in the prescription frame."""
    rotation = about_axis(0, spec.image.tilt) if spec.image.tilt else np.eye(3)
    return Pose(rotation, np.array([0.0, 0.0, spec.image.z]))


def collimated(backend: Backend, to_stop: SystemBatch, directions: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return launch points of F collimated beams whose rays meet the stop at N given points.

    Parameters
    ----------
    backend : Backend
        Backend that traces the rays.
    to_stop : SystemBatch
        One system, from the scene to the stop.
    directions : (F, 3) ndarray
        Unit vectors of the beams.
    targets : (N, 2) ndarray
        Points in the stop's x and y, in metres, the same for every beam.

    Returns
    -------
    (F, N, 3) ndarray
        Points on a plane before the first mirror, in the prescription frame, in metres.
    """
    systems = to_stop.take(np.zeros(len(directions), dtype=int))
    return aim_collimated(backend, systems, directions, -LAUNCH_DISTANCE * directions, targets)[0]


def derive_camera(spec: CameraSpec, backend: Backend, check_stated: bool = True) -> CameraModel:
    """Trace a prescription and derive frames, stop, apertures and first-order numbers from it.

    Parameters
    ----------
    spec : CameraSpec
        The prescription.
    backend : Backend
        Backend that traces the rays.
    check_stated : bool
        Whether the specified focal length is compared with the traced one; False while a file is made, whose focal
        length follows from the trace.

    Raises
    ------
    InputError
        The prescription does not bring the light of its field through the stop to the image, or its focal length
        differs from the specified one.
    """
    try:
        return _derived(spec, backend, check_stated)
    except AfocalError as error:
        raise spec.error(str(error), ("mirrors",), allowed="surfaces that focus light on the image") from error
    except (AimError, BeamMissedError) as error:
        reason = str(error).partition(";")[0]
        problem = f"light of the full field does not reach the image through the stop: {reason}"
        allowed = "consistent mirrors, image, field and stop"
        raise spec.error(problem, ("mirrors",), allowed=allowed) from error


def _focal_lengths(chief: RayMatrix, about_axis: Paraxial) -> TracedFocalLengths:
    """Return the focal lengths about a chief ray and the effective focal length about the axis, in metres."""
    power = np.linalg.svd(chief.direction_by_position[0], compute_uv=False)
    with np.errstate(divide="ignore"):
        light = np.copysign([*1.0 / power, about_axis.focal_length], about_axis.back_focal_length)
        return TracedFocalLengths(np.abs(np.diagonal(first_order(chief).scale[0])), light)


def _traced_focal_lengths(spec: CameraSpec, backend: Backend) -> TracedFocalLengths:
    """Trace the focal lengths of a prescription.

    Raises
    ------
    AimError, BeamMissedError, AfocalError
        Light does not come through, or parallel light leaves the system parallel.
    """
    bare = _bare(spec, {name: surface_of(mirror) for name, mirror in spec.mirrors.items()}, {})
    to_stop, imaging, _, matrix = _chief(spec, backend, bare)
    axis, _ = find_axis(spec, backend, to_stop, imaging, field_direction(spec, 0.0, 0.0))
    return _focal_lengths(matrix, axis_data(backend, imaging, spec, axis, LINE_AXIS))


def _chief(
    spec: CameraSpec, backend: Backend, bare: Assembly
) -> tuple[SystemBatch, SystemBatch, np.ndarray, RayMatrix]:
    """Trace the chief ray of the field's centre.

    Returns
    -------
    tuple
        System to the stop, system to the image, launch point of the ray, (1, 3) in metres, and its ray matrix: the
        derivatives of position and direction at the image with respect to those at the launch.
    """
    names = tuple(spec.mirrors)
    stop = names.index(spec.stop)
    centre = field_direction(spec, 0.0, 0.0)
    to_stop, imaging = assemble(bare, [names[: stop + 1]]), assemble(bare, [(*names, IMAGE)])
    launch = collimated(backend, to_stop, centre[None], np.zeros((1, 2)))[0]
    axes = transverse_axes(centre[None], LINE_AXIS[None])
    return to_stop, imaging, launch, ray_matrix(backend, imaging, stop, launch, centre[None], axes)


def _derived(spec: CameraSpec, backend: Backend, check_specified: bool) -> CameraModel:
    """Trace a prescription and return its camera model; errors of the ray trace are raised unchanged.

    `derive_camera` reports them as input errors.
    """
    surfaces = {name: surface_of(mirror) for name, mirror in spec.mirrors.items()}
    names = tuple(spec.mirrors)
    bare = _bare(spec, surfaces, {})
    to_stop, imaging, launch, matrix = _chief(spec, backend, bare)
    chief = first_order(matrix)
    centre = field_direction(spec, 0.0, 0.0)
    axis, stop_radius = find_axis(spec, backend, to_stop, imaging, centre)
    about_axis = axis_data(backend, imaging, spec, axis, LINE_AXIS)
    pupil = pupil_diameter(backend, to_stop, axis, stop_radius)
    if check_specified:
        focal_lengths = _focal_lengths(matrix, about_axis)
        check_focal_length(spec, focal_lengths, lambda other: _traced_focal_lengths(other, backend))

    traced = trace(backend, imaging, make_rays(backend, launch, centre), keep=range(len(names)), world=True)
    assert traced.world is not None
    position, direction, _, valid = traced.numpy(traced.world)
    require_rays(valid, f"camera {spec.name}")
    image_centre, image_direction = position[0, 0], direction[0, 0]

    sight = -centre
    across = np.cross(LINE_AXIS, sight)
    # Baffles may precede the first mirror.
    first = next(k for k, name in enumerate(names) if name == spec.stop or spec.mirrors[name].light != "passes")
    origin = mirror_pose(spec.mirrors[names[first]]).apply(traced.hit(first)[0, 0])
    camera_frame = Pose(np.stack([across, LINE_AXIS, sight], axis=-1), origin)
    normal = np.sign(sight[2]) * image_pose(spec).rotation[:, 2]
    focal_plane = Pose(np.stack([np.cross(LINE_AXIS, normal), LINE_AXIS, normal], axis=-1), image_centre)

    apertures = _apertures(spec, backend, to_stop, imaging, stop_radius)
    distance = float(abs(chief.scale[0, 0, 0]))  # along the line, as in the papers
    rear_node = image_centre - distance * image_direction
    if check_specified or spec.stop_diameter is None:
        check_entrance_pupil(spec, pupil)
    frames = (camera_frame, focal_plane, chief, image_direction, rear_node)
    return CameraModel(spec, surfaces, apertures, *frames, axis, about_axis, pupil)


def surface_of(mirror: MirrorSpec) -> Surface:
    """Return the shape of a mirror of a camera's file; even terms A4, A6, ... that the file skips are 0."""
    last = max((int(name[1:]) for name in mirror.aspheric), default=2)
    even = tuple(float(mirror.aspheric.get(f"A{n}", 0.0)) for n in range(4, last + 1, 2))
    return Surface(1.0 / mirror.radius, mirror.conic, even, terms=tuple((mirror.sag or {}).values()))


LIGHT = {None: Interaction.REFLECT, "refracts": Interaction.REFRACT, "passes": Interaction.PASS}


def lenses(spec: CameraSpec) -> dict[str, str]:
    """Return name of each refracting face -> name of its lens, which is that of the lens's first face."""
    out, inside = {}, ""
    for name, mirror in spec.mirrors.items():
        if mirror.light == "refracts":
            out[name] = inside or name
            inside = "" if inside else name
    return out


def glass_indices(spec: CameraSpec, wavelength: float | None = None) -> dict[str, float]:
    """Return the refractive index of each lens at a wavelength in metres, by default the design wavelength.

    Raises
    ------
    ValueError
        The glass of a lens is not named, or its index is not known at the wavelength.
    """
    return {name: spec.index_behind(name, wavelength) for name in dict.fromkeys(lenses(spec).values())}


def above_d_line(spec: CameraSpec) -> dict[str, float]:
    """Return the index at the design wavelength minus that at the d line, for each lens with an Abbe number.

    A glass has an Abbe number where its index is known at the lines d, F and C.
    """
    out = {}
    for name, index in glass_indices(spec).items():
        with suppress(ValueError):
            at_d, _, _ = (spec.index_behind(name, line) for line in ABBE_LINES)
            out[name] = index - at_d
    return out


def coloured(spec: CameraSpec, root: str, state: State, wavelength: float) -> State:
    """Return a state for light of another wavelength than the design's, in which the lenses have other indices.

    Changes of index in the state itself, such as those due to heat, are added to the change due to the wavelength.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    root : str
        Path of its body; empty for a bare camera.
    state : State
        Path of each moved body -> its motion.
    wavelength : float
        Wavelength of the light, in metres.

    Returns
    -------
    State
        The state with the change of index of every lens; unchanged for a camera without lenses, and at the design
        wavelength.

    Raises
    ------
    ValueError
        The glass of a lens is not named, or its index is not known at the wavelength.
    """
    return in_glass(state, glass_steps(spec, root, wavelength))


def glass_steps(spec: CameraSpec, root: str, wavelength: float) -> dict[str, float]:
    """Return path of each lens's body -> its index at a wavelength minus that at the design wavelength.

    Parameters
    ----------
    spec : CameraSpec
        The camera.
    root : str
        Path of its body; empty for a bare camera.
    wavelength : float
        Wavelength of the light, in metres.

    Returns
    -------
    dict[str, float]
        Empty if no index changes.

    Raises
    ------
    ValueError
        The glass of a lens is not named, or its index is not known at the wavelength.
    """
    if wavelength == spec.wavelength or not lenses(spec):
        return {}
    design = glass_indices(spec)
    at_colour = glass_indices(spec, wavelength)
    return {f"{root}/{lens}" if root else lens: index - design[lens] for lens, index in at_colour.items()}


def in_glass(state: State, steps: Mapping[str, float]) -> State:
    """Return a state with changes of the lenses' refractive indices added to it.

    Each change is multiplied by 1 + ``dispersion``, the relative change of the glass's dispersion in the state, which a
    changed Abbe number causes.

    Parameters
    ----------
    state : State
        Path of each moved body -> its motion.
    steps : Mapping[str, float]
        Path of each lens's body -> change of its index, from ``glass_steps``.
    """
    if not steps:
        return state
    moved = dict(state)
    for path, step in steps.items():
        motion = moved.get(path, AT_REST)
        moved[path] = replace(motion, index=motion.index + step * (1.0 + motion.dispersion))
    return FrozenMap(moved)


def _bare(spec: CameraSpec, surfaces: Mapping[str, Surface], apertures: Mapping[str, Aperture]) -> Assembly:
    """Return the assembly of mirrors and image plane with these surfaces and apertures."""
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
    """Return the clear apertures of all surfaces.

    That of the stop surface is the stop. The others enclose the beams of the whole field with the edge margin around
    them. A mirror or a lens centred on its own axis is round, as it is made: a circle about its vertex, or an ellipse
    where it is flat, like a slanted flat in a round beam. The remaining ones are rectangles.
    """
    rim = stop_radius * circle(_RIM_POINTS)
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
        hits = hits[~np.isnan(hits).all(axis=(1, 2))]  # fields without light do not determine an outline
        out[name] = box if spec.mirrors[name].light == "passes" else _manufactured_outline(box, hits, spec, name)
    return out


_ABOUT_AXIS = 0.5
"""Largest distance of the middle of all beams from a surface's vertex, relative to their half-width, at which the
surface counts as centred on its own axis. Mirrors of on-axis telescopes are below 0.13, off-axis ones above 1.
"""


def _manufactured_outline(box: Rectangle, hits: np.ndarray, spec: CameraSpec, name: str) -> Aperture:
    """Return the outline of a surface as it is manufactured: circle, ellipse or rectangle.

    Parameters
    ----------
    box : Rectangle
        Rectangle around all beams.
    hits : (F, N, 2) ndarray
        Points at which the N rim rays of F beams meet the surface, in its x and y, in metres; NaN for lost rays.
    spec : CameraSpec
        The camera.
    name : str
        Name of the surface.
    """
    margin = spec.edge_margin
    if np.hypot(*box.centre) > _ABOUT_AXIS * min(box.half_x, box.half_y):
        return box
    if surface_of(spec.mirrors[name]).is_plane:
        half = np.array([box.half_x, box.half_y]) - margin
        half *= np.nanmax(np.hypot(*np.moveaxis((hits - box.centre) / half, -1, 0)))
        return Ellipse(float(half[0] + margin), float(half[1] + margin), box.centre)
    # Between the traced points the rim is no farther away than the beam's middle and radius together.
    middle = np.nanmean(hits, axis=1)
    radius = np.nanmax(np.hypot(*np.moveaxis(hits - middle[:, None], -1, 0)), axis=1) + np.hypot(*middle.T)
    return Circle(float(np.nanmax(radius)) + margin)
