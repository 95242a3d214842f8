"""Reflectors of a monitor's beam, by kind: their bodies and faces, optical elements and clear apertures.

A monitor is an autocollimator in a camera's focal plane; these reflectors lead its beam, which leaves the camera, to
the mirror facet that sends it back. One kind returns a beam antiparallel and displaced (as the 180-deg prism), the
other displaces it and keeps its direction (as the 0-deg prism).

The 180-deg prism is a slice of a corner cube. Its frame has z along the beam that enters, x along the transfer, the
origin in the middle of its window:

    z ^        mirror ________________________ roof_a, roof_b
      |              /                        |    (seen along y, the two roof faces
      |             /                         |     are at +-45 deg about the ridge)
      +---> x       |__entry____________exit__|
                             window

A ray that enters at (x, y) leaves at (-x, -y), antiparallel: point reflection at the apex (0, 0, z_apex), whatever the
prism's attitude. The beam passes at a distance ``roof_offset`` from the ridge, so that all of it meets roof_a first.

The 0-deg prism is a rhomboid, its frame's z along the beam, x along the displacement, the origin in its middle.

Both have a hollow counterpart without glass in the beam: plane mirrors on plates, held by a bar of the same material.
Bar and plates are one body for heat; the bar is the reflector's own body, which carries the plates.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from math import sqrt

import numpy as np

from optics.geometry.aperture import Ellipse
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Coating, Face, Solid
from optics.geometry.surface import plane
from optics.geometry.tree import Body
from optics.numerics.array_math import UnphysicalError, inner, norm
from optics.numerics.extension_table import ExtensionTable
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.assembly import Element, Interaction

EDGE_MARGIN = 0.003
"""Margin of glass and mirrors beyond their clear apertures, metres."""
BOND_GAP = 1e-4
"""Gap between the plate of a mirror and the frame that holds it, metres."""


@dataclass(frozen=True, eq=False)
class Passage:
    """Interaction of the beam with one optical face.

    Attributes
    ----------
    name : str
        Name of the element within the prism, e.g. ``entry``.
    face : str
        Name of the face (its body is ``<solid>/<face>``, with a child for each passage if there are several).
    interaction : Interaction
        Refraction, reflection or total reflection.
    position : (3,) ndarray
        Centre of the beam on the face, in the solid's frame, metres.
    direction : (3,) ndarray
        Direction of the beam when it arrives, in the solid's frame.
    """

    name: str
    face: str
    interaction: Interaction
    position: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True, eq=False)
class Mount:
    """Pose and required geometry of a reflector.

    Its frame has z along the entering beam, x along the beam's displacement.

    Attributes
    ----------
    path : str
        Path of its body; all its other bodies are below it.
    pose : Pose
        Pose of that body in the body that carries it.
    key : str
        Prefix of its elements' names.
    material : str
        Material of its glass, or of the frame and the mirrors that it holds.
    length : float
        Distance along x from the centre of the entering to that of the leaving beam, metres.
    width : float
        Width of the clear apertures, metres.
    hand : float
        Handedness of a reflector that returns the beam; +1: the beam enters at +y of the middle; -1: the mirror image.
    errors : mapping of str to (float, float)
        Face -> manufacturing tilt about its x and y, radians.
    """

    path: str
    pose: Pose
    key: str
    material: str
    length: float
    width: float
    hand: float = 1.0
    errors: Mapping[str, tuple[float, float]] = field(default_factory=FrozenMap)


@dataclass(frozen=True, eq=False)
class ReflectorParts:
    """Bodies, elements and solids of a reflector, ready for the assembly.

    Attributes
    ----------
    bodies : tuple of Body
        Its own body and its faces'; the first has the pivots ``apex`` and ``centre``.
    elements : tuple of Element
        Elements with clear apertures, in the order in which the beam that leaves the camera meets them.
    solids : tuple of Solid
        Its glass, or its frame and mirrors; solids whose body is carried by another one's are one piece with it.
    path_length : float
        Length of the beam's central ray inside the glass, metres.
    apex : tuple of float
        For a reflector that returns the beam, the point about which rotations leave the beam unchanged; else its
        middle; in its frame, metres.
    """

    bodies: tuple[Body, ...]
    elements: tuple[Element, ...]
    solids: tuple[Solid, ...]
    path_length: float
    apex: tuple[float, float, float]


def _no_offset(width: float) -> float:
    """Return 0, the lateral distance of the beam from the middle of a reflector that it passes in the middle."""
    return 0.0


def _origin(length: float, width: float) -> tuple[float, float, float]:
    """Return (0, 0, 0), the point about which rotations leave the beam unchanged if it is the frame's origin."""
    return (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Reflector:
    """Kind of reflector that the monitor of an instrument's file may name.

    Attributes
    ----------
    returns : bool
        True: the beam returns antiparallel, from (x, y) to (-x, -y) (like the 180-deg prism); False: it keeps its
        direction, displaced by ``Mount.length`` along x (like the 0-deg prism).
    faces : tuple of str
        Names of the faces that may have a manufacturing tilt.
    parts : callable
        Mount -> ReflectorParts; raises ValueError where the reflector is impossible for its mount.
    lateral_offset : callable
        Width -> distance of the beam from the middle along y, metres.
    null_point : callable
        Length and width -> point about which rotations leave the beam's direction and position unchanged, in its frame,
        metres.
    transparent : bool
        True for a reflector of glass that the beam passes through, whose index has to be known; False for any material.
    """

    returns: bool
    faces: tuple[str, ...]
    parts: Callable[[Mount], ReflectorParts]
    lateral_offset: Callable[[float], float] = _no_offset
    null_point: Callable[[float, float], tuple[float, float, float]] = _origin
    transparent: bool = True


Plane = tuple[str, tuple[float, float, float], tuple[float, float, float], Coating]
"""Plane of a face of a solid: name, outward normal (any length), a point on it (metres), and coating."""

_S = 1.0 / sqrt(2.0)


def prism_180(mount: Mount) -> ReflectorParts:
    """Return the parts of the 180-deg prism, which returns the beam antiparallel and displaced along x."""
    length, width, hand = mount.length, mount.width, mount.hand
    off = roof_offset(width)
    half = 0.5 * width
    height = _beam_height(width)
    apex = null_point(length, width)
    end, side = 0.5 * length + half + EDGE_MARGIN, off + half + EDGE_MARGIN
    planes: list[Plane] = [
        ("window", (0, 0, -1), (0, 0, 0), Coating.TRANSMITTING),
        ("mirror", (-1, 0, 1), apex, Coating.MIRROR),
        ("roof_a", (_S, hand, _S), apex, Coating.TOTAL),
        ("roof_b", (_S, -hand, _S), apex, Coating.TOTAL),
        ("top", (0, 0, 1), (0, 0, height + half + EDGE_MARGIN), Coating.GROUND),
        ("side_a", (0, 1, 0), (0, side, 0), Coating.GROUND),
        ("side_b", (0, -1, 0), (0, -side, 0), Coating.GROUND),
        ("end_a", (-1, 0, 0), (-end, 0, 0), Coating.GROUND),
        ("end_b", (1, 0, 0), (end, 0, 0), Coating.GROUND),
    ]
    x = 0.5 * length
    up, along, reflected = np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.array([0.5, -hand * _S, -0.5])
    point, y = np.array, hand * off
    passages = [
        Passage("entry", "window", Interaction.REFRACT, point([-x, y, 0.0]), up),
        Passage("mirror", "mirror", Interaction.REFLECT, point([-x, y, height]), up),
        Passage("roof_a", "roof_a", Interaction.TOTAL, point([x - sqrt(2.0) * off, y, height]), along),
        Passage("roof_b", "roof_b", Interaction.TOTAL, point([x, -y, height - sqrt(2.0) * off]), reflected),
        Passage("exit", "window", Interaction.REFRACT, point([x, -y, 0.0]), -up),
    ]
    return _parts(mount, planes, passages, apex, {"window": (0.0, 0.0, 0.0)})


def _beam_height(width: float) -> float:
    """Return the height of the transferred beam above the window, metres.

    It is so large that the returning beam clears the window's edge.
    """
    return sqrt(2.0) * roof_offset(width) + sqrt(3.0) * 0.5 * width + EDGE_MARGIN


def null_point(length: float, width: float) -> tuple[float, float, float]:
    """Return the point about which rotations of the 180-deg prism leave the beam unchanged, in its frame, metres.

    It is the apex in which the planes of the prism's reflecting faces meet.
    """
    return (0.0, 0.0, _beam_height(width) + 0.5 * length)


def roof_offset(width: float) -> float:
    """Return the beam's distance from the ridge of the 180-deg prism, metres.

    It is so large that no clear aperture extends over the ridge.
    """
    return 0.5 * width + EDGE_MARGIN


def prism_0(mount: Mount) -> ReflectorParts:
    """Return the parts of the 0-deg prism, a rhomboid that displaces the beam and keeps its direction.

    Raises
    ------
    ValueError
        The displacement is too small for the width, so that the rhomboid would vignette the beam.
    """
    shift, width = mount.length, mount.width
    half = 0.5 * width + EDGE_MARGIN
    _require_length(mount, "a rhomboid", "displace", half + 0.5 * width)
    x = 0.5 * shift
    planes: list[Plane] = [
        ("entry", (0, 0, -1), (-x, 0, -half), Coating.TRANSMITTING),
        ("mirror_a", (-1, 0, 1), (-x, 0, 0), Coating.TOTAL),
        ("mirror_b", (1, 0, -1), (x, 0, 0), Coating.TOTAL),
        ("exit", (0, 0, 1), (x, 0, half), Coating.TRANSMITTING),
        ("side_a", (0, 1, 0), (0, half, 0), Coating.GROUND),
        ("side_b", (0, -1, 0), (0, -half, 0), Coating.GROUND),
    ]
    along_z, along_x = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    passages = [
        Passage("entry", "entry", Interaction.REFRACT, np.array([-x, 0, -half]), along_z),
        Passage("mirror_a", "mirror_a", Interaction.TOTAL, np.array([-x, 0, 0.0]), along_z),
        Passage("mirror_b", "mirror_b", Interaction.TOTAL, np.array([x, 0, 0.0]), along_x),
        Passage("exit", "exit", Interaction.REFRACT, np.array([x, 0, half]), along_z),
    ]
    return _parts(mount, planes, passages, (0.0, 0.0, 0.0), {})


def hollow_transfer(mount: Mount) -> ReflectorParts:
    """Return the parts of three mutually perpendicular mirrors: a slice of a hollow corner cube.

    Raises
    ------
    ValueError
        The mirrors are so close that one would block another's beam.
    """
    length, width, hand = mount.length, mount.width, mount.hand
    off, half, apex = hollow_offset(width), 0.5 * width, hollow_null_point(length, width)
    x, y, height = 0.5 * length, hand * off, apex[2] - 0.5 * length
    # extent of roof_a back along the transfer, on the ridge's side, and of the mirror toward it
    least = sqrt(2.0) * off + (sqrt(3.0) + 1.0) * half + 3.0 * (EDGE_MARGIN + _thickness(width))
    _require_length(mount, "mirrors", "transfer", least)
    up, along, reflected = np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.array([0.5, -hand * _S, -0.5])
    mirrors = [
        (_mirror("mirror", [-x, y, height], up), (1, 0, -1)),
        (_mirror("roof_a", [x - sqrt(2.0) * off, y, height], along), (-_S, -hand, -_S)),
        (_mirror("roof_b", [x, -y, height - sqrt(2.0) * off], reflected), (-_S, hand, -_S)),
    ]
    return _on_frame(mount, mirrors, apex, 2)


def hollow_offset(width: float) -> float:
    """Return the beam's distance from the ridge of the hollow transfer, metres.

    It is so large that the plates of the roof do not touch at the ridge.
    """
    return roof_offset(width) + 2.0 * EDGE_MARGIN + _thickness(width)


def hollow_null_point(length: float, width: float) -> tuple[float, float, float]:
    """Return the intersection of the three mirror planes, in the frame of the hollow transfer, metres.

    It is so high that no mirror extends below z = 0.
    """
    height = sqrt(2.0) * hollow_offset(width) + sqrt(3.0) * 0.5 * width + 3.0 * EDGE_MARGIN
    return (0.0, 0.0, height + 0.5 * length)


def periscope(mount: Mount) -> ReflectorParts:
    """Return the parts of two parallel mirrors that displace the beam and keep its direction.

    Raises
    ------
    ValueError
        The displacement is so small that one mirror would block the other's beam.
    """
    shift, width = mount.length, mount.width
    _require_length(mount, "mirrors", "displace", width + 2.0 * (EDGE_MARGIN + _thickness(width)))
    x, along_z, along_x = 0.5 * shift, np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    mirrors = [
        (_mirror("mirror_a", [-x, 0.0, 0.0], along_z), (1, 0, -1)),
        (_mirror("mirror_b", [x, 0.0, 0.0], along_x), (-1, 0, 1)),
    ]
    return _on_frame(mount, mirrors, (0.0, 0.0, 0.0), 1)


def _require_length(mount: Mount, parts: str, verb: str, least: float) -> None:
    """Raise UnphysicalError if the reflector displaces the beam by less than ``least`` metres and would vignette it.

    ``parts`` and ``verb`` are the subject and verb of the message.
    """
    if mount.length < least:
        width, length = 1e3 * mount.width, 1e3 * mount.length
        text = f"{mount.path}: {parts} of width {width:.4g} mm cannot {verb} the beam by only {length:.4g} mm"
        raise UnphysicalError(f"{text}; at least {1e3 * least:.4g} mm")


def _thickness(width: float) -> float:
    """Return the thickness of a mirror's plate, metres.

    It is an eighth of the plate's length, which is sqrt(2) times the beam's width.
    """
    return 0.18 * width


def _mirror(name: str, position: Sequence[float], direction: np.ndarray) -> Passage:
    """Return the reflection of the beam at a mirror that is a face by itself.

    ``position`` is the beam's centre on the mirror, metres, and ``direction`` is its direction when it arrives.
    """
    return Passage(name, name, Interaction.REFLECT, np.array(position), direction)


def _on_frame(
    mount: Mount,
    mirrors: Sequence[tuple[Passage, tuple[float, float, float]]],
    apex: tuple[float, float, float],
    axis: int,
) -> ReflectorParts:
    """Return the parts of a hollow reflector: mirrors on plates, held by a bar beyond all of them along axis ``axis``.

    ``mirrors`` are the beam's reflections, each with the mirror's normal toward the light, and ``apex`` is the point
    about which rotations leave the beam unchanged.
    """
    passages = [passage for passage, _ in mirrors]
    planes: list[Plane] = [
        (p.face, normal, (p.position[0], p.position[1], p.position[2]), Coating.MIRROR) for p, normal in mirrors
    ]
    bodies, elements, _ = _faces(mount, planes, passages, apex, {}, None)
    plates, corners = [], []
    for body, element in zip(bodies[1:], elements, strict=True):
        assert isinstance(element.aperture, Ellipse)
        high = np.array([element.aperture.half_x + EDGE_MARGIN, element.aperture.half_y + EDGE_MARGIN, 0.0])
        low = np.array([-high[0], -high[1], -_thickness(mount.width)])
        faces = _box(body.path, low, high, Coating.MIRROR)
        plates.append(Solid(body.path, mount.material, faces, transparent=False))
        corners += [body.pose.apply(np.where(np.array(c) == 1, high, low)) for c in product((0, 1), repeat=3)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    middle, half = 0.5 * (low + high), 0.5 * mount.width
    other = 3 - axis  # the bar lies along x
    low[other], high[other] = middle[other] - half, middle[other] + half
    low[axis] = high[axis] + BOND_GAP
    high[axis] = low[axis] + _thickness(mount.width)
    frame = Solid(mount.path, mount.material, _box(mount.path, low, high), transparent=False)
    return ReflectorParts(bodies, elements, (frame, *plates), 0.0, apex)


def _box(body: str, low: np.ndarray, high: np.ndarray, front: Coating = Coating.GROUND) -> tuple[Face, ...]:
    """Return the faces of a box between two corners in a body's frame, metres.

    ``front`` is the coating of the face toward +z.
    """
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    out = []
    for name, axis, sign in (("front", 2, 1.0), ("back", 2, -1.0), *_SIDES):
        normal = sign * np.eye(3)[axis]
        coating = front if name == "front" else Coating.GROUND
        out.append(Face(name, body, coating, Pose(_axes(normal, None), middle + half * normal)))
    return tuple(out)


_SIDES = (("end_a", 0, -1.0), ("end_b", 0, 1.0), ("side_a", 1, 1.0), ("side_b", 1, -1.0))


def _parts(
    mount: Mount,
    planes: list[Plane],
    passages: list[Passage],
    apex: tuple[float, float, float],
    origins: Mapping[str, tuple[float, float, float]],
) -> ReflectorParts:
    """Return bodies, optical elements and glass solid of a prism, from the planes of its faces and the beam's passages.

    ``origins`` gives the origin of the frame of a face that two passages share.
    """
    bodies, elements, faces = _faces(mount, planes, passages, apex, origins, mount.path)
    inside = sum(float(norm(b.position - a.position)) for a, b in pairwise(passages))
    return ReflectorParts(bodies, elements, (Solid(mount.path, mount.material, faces),), inside, apex)


def _faces(
    mount: Mount,
    planes: list[Plane],
    passages: list[Passage],
    apex: tuple[float, float, float],
    origins: Mapping[str, tuple[float, float, float]],
    solid: str | None,
) -> tuple[tuple[Body, ...], tuple[Element, ...], tuple[Face, ...]]:
    """Return bodies, optical elements and all faces, from the planes of the faces and the beam's passages through them.

    ``solid`` is the path of the glass that light passes through.
    """
    path, width, errors = mount.path, mount.width, mount.errors
    used = {p.face: p for p in reversed(passages)}
    shared = {face for face in used if sum(p.face == face for p in passages) > 1}
    unknown = set(errors) - set(used)
    if unknown:
        raise ValueError(f"{path}: no such face: {', '.join(sorted(unknown))}; faces are {', '.join(used)}")
    bodies = [Body(path, mount.pose, pivots={"apex": apex, "centre": _centre(passages)})]
    faces, frames = [], {}
    for name, normal, point, coating in planes:
        if name not in used:
            faces.append(Face(name, path, coating, Pose(_axes(np.array(normal, float), None), np.array(point, float))))
            continue
        passage = used[name]
        origin = np.array(origins[name]) if name in origins else passage.position
        frame = Pose(_axes(np.array(normal, float), passage.direction), origin)
        tilted = frame @ Pose(rotation_matrix(np.array([*errors.get(name, (0.0, 0.0)), 0.0])))
        bodies.append(Body(f"{path}/{name}", tilted))
        faces.append(Face(name, f"{path}/{name}", coating))
        frames[name] = frame
        # two footprints far apart on one face tilt differently when it bends, so each has a body of its own
        bodies += [
            Body(_footprint(path, p, shared), Pose(np.eye(3), frame.inverse().apply(p.position)))
            for p in passages
            if p.face == name and name in shared
        ]
    elements = []
    for passage in passages:
        frame = frames[passage.face]
        centre = np.zeros(3) if passage.face in shared else frame.inverse().apply(passage.position)
        cosine = abs(float(inner(frame.rotation[:, 2], passage.direction)))
        aperture = Ellipse(0.5 * width / cosine, 0.5 * width, (float(centre[0]), float(centre[1])))
        name, body = f"{mount.key}/{passage.name}", _footprint(path, passage, shared)
        elements.append(Element(name, body, plane(), passage.interaction, aperture, solid=solid))
    return tuple(bodies), tuple(elements), tuple(faces)


def _footprint(path: str, passage: Passage, shared: set[str]) -> str:
    """Return the path of the body that carries the optical element where the beam meets a face.

    It is the face's body, or a child of it if the beam meets the face twice.
    """
    face = f"{path}/{passage.face}"
    return f"{face}/{passage.name}" if passage.face in shared else face


def _centre(passages: list[Passage]) -> tuple[float, float, float]:
    """Return the mean of the beam's positions on the faces, metres."""
    middle = np.mean([p.position for p in passages], axis=0)
    return (float(middle[0]), float(middle[1]), float(middle[2]))


def _axes(normal: np.ndarray, direction: np.ndarray | None) -> np.ndarray:
    """Return the axes of a face's frame as columns (3, 3): z along the normal, x along the beam's tangential part.

    ``direction`` is the direction of the beam that arrives; without one, x is arbitrary.
    """
    z = normal / norm(normal)
    lean = np.zeros(3) if direction is None else direction - inner(direction, z) * z
    if norm(lean) < 1e-6:
        lean = np.eye(3)[0 if abs(z[0]) < 0.9 else 1]
        lean = lean - inner(lean, z) * z
    x = lean / norm(lean)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def facet_block(
    path: str, material: str, facets: Mapping[str, str], spread: tuple[float, float], height: float
) -> Solid:
    """Return the central prism: a solid whose facets are mirrors, with side walls and a bottom.

    Each mirror facet has a body of its own (``facets``: name -> path). The walls are as far behind the centres of the
    facets as those are from the apex.
    """
    x, y = 2.0 * spread[0], 2.0 * spread[1]
    walls: list[Plane] = [
        ("wall_front", (1, 0, 0), (x, 0, 0), Coating.GROUND),
        ("wall_back", (-1, 0, 0), (-x, 0, 0), Coating.GROUND),
        ("wall_left", (0, 1, 0), (0, y, 0), Coating.GROUND),
        ("wall_right", (0, -1, 0), (0, -y, 0), Coating.GROUND),
        ("bottom", (0, 0, -1), (0, 0, -height), Coating.GROUND),
    ]
    faces = [Face(name, body, Coating.MIRROR) for name, body in facets.items()]
    for name, normal, point, coating in walls:
        faces.append(Face(name, path, coating, Pose(_axes(np.array(normal, float), None), np.array(point, float))))
    return Solid(path, material, tuple(faces), transparent=False)


_REFLECTORS: dict[str, Reflector] = {
    "lateral_transfer": Reflector(True, ("window", "mirror", "roof_a", "roof_b"), prism_180, roof_offset, null_point),
    "rhomboid": Reflector(False, ("entry", "mirror_a", "mirror_b", "exit"), prism_0),
    "hollow_transfer": Reflector(
        True, ("mirror", "roof_a", "roof_b"), hollow_transfer, hollow_offset, hollow_null_point, transparent=False
    ),
    "periscope": Reflector(False, ("mirror_a", "mirror_b"), periscope, transparent=False),
}
REFLECTORS = ExtensionTable("reflectors", _REFLECTORS, Reflector)
"""Kinds of reflectors by the name that an instrument's file writes as ``kind``.

Kinds that return the beam belong to ``monitor.prism_180``, others to ``monitor.prism_0``. A new kind is added here: the
file reader, the instrument, its images, heat, stray light and pictures use this table.
"""
