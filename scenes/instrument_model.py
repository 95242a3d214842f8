"""From an instrument's YAML to the optical assembly: cameras in the base, monitor channels, the central prism's
faces.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from optics.aim import RayFan, aim, transverse_axes
from optics.aperture import Circle
from optics.assembly import Assembly
from optics.backend import Backend
from optics.element import Element, Interaction
from optics.pose import Pose
from optics.rotation import about_axis
from optics.surface import plane
from optics.system import assemble
from optics.trace import make_rays, require_some, trace
from optics.tree import Body, PlacedBodies, RigidTree
from scenes.camera_model import LINE_AXIS, REFERENCE, CameraModel, derive_camera
from scenes.job import NodeInfo

if TYPE_CHECKING:
    from scenes.instrument import InstrumentSpec

BASE = "base"
SIDES = ("left", "right")
CENTRAL_PRISM = f"{BASE}/central_prism"
IDEAL_PRISMS = ("prism_180", "prism_0")
_FLIP = np.diag([-1.0, 1.0, -1.0])  # area CCD in the focal plane: columns along -X, rows along +Y, facing the light


@dataclass(frozen=True)
class Channel:
    """One monitor channel of one camera.

    Attributes:
        camera, side: e.g. ``forward``, ``left`` (left = the +Y end of the line).
        pinhole, ccd: positions in the focal plane's X, Y, metres.
    """

    camera: str
    side: str
    pinhole: tuple[float, float]
    ccd: tuple[float, float]

    @property
    def key(self) -> str:
        """``<camera>/<side>``, the prefix of the channel's elements and sequences."""
        return f"{self.camera}/{self.side}"

    @property
    def reticle_body(self) -> str:
        """Body path of the pinhole."""
        return f"{BASE}/{self.camera}/focal_plane/{self.side}/reticle"

    @property
    def ccd_body(self) -> str:
        """Body path of the area CCD."""
        return f"{BASE}/{self.camera}/focal_plane/{self.side}/area_ccd"

    @property
    def face_body(self) -> str:
        """Body path of the return face."""
        return f"{CENTRAL_PRISM}/{self.camera}_{self.side}"


@dataclass(frozen=True, eq=False)
class Instrument:
    """An instrument ready to be perturbed and traced.

    Attributes:
        spec: what the YAML says.
        assembly: bodies, elements, sequences.
        cameras: name -> model.
        channels: all monitor channels, camera by camera, left before right.
        nodes: body path -> what may be done to it.
    """

    spec: InstrumentSpec
    assembly: Assembly
    cameras: Mapping[str, CameraModel]
    channels: tuple[Channel, ...]
    nodes: Mapping[str, NodeInfo]

    def camera_axes(self, camera: str) -> np.ndarray:
        """Nominal camera X, Y, Z in the base frame as columns, (3, 3)."""
        return self.assembly.nominal_pose(f"{BASE}/{camera}").rotation

    def toward_optics(self, placed: PlacedBodies, camera: str) -> np.ndarray:
        """Direction from the line's centre along its chief ray, upstream, in each state, world, (S, 3).

        Where rays that start at the focal plane are first sent; it rides on the focal plane.
        """
        model = self.cameras[camera]
        local = model.focal_plane.rotation.T @ -model.image_direction
        return np.asarray(placed.rotation[:, placed.index[f"{BASE}/{camera}/focal_plane"]].real @ local)

    @property
    def separation(self) -> Mapping[str, float]:
        """Camera -> distance of its two area CCDs (the papers' L), metres."""
        out = {}
        for name in self.cameras:
            left, right = (c for c in self.channels if c.camera == name)
            out[name] = abs(left.ccd[1] - right.ccd[1])
        return out


def build_instrument(spec: InstrumentSpec, camera_specs: Mapping[str, object], backend: Backend) -> Instrument:
    """Build an instrument.

    Args:
        spec: the instrument.
        camera_specs: camera file stem -> CameraSpec, for every stem the instrument names.
        backend: where to trace while the geometry is worked out.
    """
    derived: dict[str, CameraModel] = {}
    for site in spec.cameras.values():
        if site.camera not in derived:
            derived[site.camera] = derive_camera(camera_specs[site.camera], backend)  # type: ignore[arg-type]
    bodies = [Body(BASE), Body(CENTRAL_PRISM, Pose(np.eye(3), np.array(spec.central_prism.position)))]
    elements: dict[str, Element] = {}
    sequences: dict[str, tuple[str, ...]] = {}
    channels: list[Channel] = []
    ideal: set[str] = set()
    for name, site in spec.cameras.items():
        model = derived[site.camera]
        root = f"{BASE}/{name}"
        to_base = Pose(about_axis(1, site.look), np.array(site.position))
        camera_channels = _channels(spec, name, model)
        bodies += _camera_bodies(root, to_base, model, camera_channels)
        bodies += [Body(f"{root}/monitor")]
        for channel in camera_channels:
            bodies += [Body(f"{root}/monitor/{channel.side}")]
            bodies += [Body(f"{root}/monitor/{channel.side}/{prism}") for prism in IDEAL_PRISMS]
            ideal |= {f"{root}/monitor/{channel.side}/{prism}" for prism in IDEAL_PRISMS}
        ideal |= {f"{root}/monitor", *(f"{root}/monitor/{c.side}" for c in camera_channels)}
        faces = _return_faces(spec, model, camera_channels, np.array(site.pupil_offset), backend)
        in_camera = to_base @ model.camera_frame.inverse()
        prism = Pose(np.eye(3), np.array(spec.central_prism.position)).inverse()
        bodies += [Body(c.face_body, prism @ in_camera @ face) for c, face in zip(camera_channels, faces, strict=True)]
        channels += camera_channels
        elements.update(_camera_elements(name, root, model, camera_channels, 0.5 * spec.monitor.return_face.aperture))
        sequences.update(_camera_sequences(name, model, camera_channels))
    tree = RigidTree(tuple(bodies))
    assembly = Assembly(tree, elements, sequences)
    cameras = MappingProxyType({name: derived[site.camera] for name, site in spec.cameras.items()})
    return Instrument(spec, assembly, cameras, tuple(channels), MappingProxyType(_nodes(tree, cameras, ideal)))


def _channels(spec: InstrumentSpec, camera: str, model: CameraModel) -> list[Channel]:
    """Where the reticles and area CCDs stand: at +-f tan(field) along the line."""
    half = model.line_focal_length * float(np.tan(spec.monitor.field))
    dx, dy = spec.monitor.area_ccd.offset
    return [
        Channel(camera, side, pinhole=(-dx, sign * half - dy), ccd=(0.0, sign * half))
        for side, sign in zip(SIDES, (1.0, -1.0), strict=True)
    ]


def _camera_bodies(root: str, to_base: Pose, model: CameraModel, channels: list[Channel]) -> list[Body]:
    into_camera = model.camera_frame.inverse()
    bodies = [Body(root, to_base)]
    for mirror in model.mirrors:
        aperture = model.apertures[mirror]
        x, y = aperture.centre
        centre = (x, y, float(model.surfaces[mirror].sag(x, y)))
        pose = into_camera @ Pose(np.eye(3), model.vertex(mirror))
        bodies.append(Body(f"{root}/{mirror}", pose, pivots={"centre": centre}))
    node = model.focal_plane.inverse().apply(model.rear_node)
    plane_root = f"{root}/focal_plane"
    pivots = {"rear_node": tuple(node), "line_centre": (0.0, 0.0, 0.0)}
    bodies.append(Body(plane_root, into_camera @ model.focal_plane, pivots=pivots, scales=False))
    bodies.append(Body(f"{plane_root}/line"))
    for channel in channels:
        board = f"{plane_root}/{channel.side}"
        bodies.append(Body(board, Pose(np.eye(3), np.array([*channel.ccd, 0.0]))))
        offset = np.array([channel.pinhole[0] - channel.ccd[0], channel.pinhole[1] - channel.ccd[1], 0.0])
        bodies.append(Body(channel.reticle_body, Pose(np.eye(3), offset)))
        bodies.append(Body(channel.ccd_body, Pose(_FLIP, np.zeros(3))))
    return bodies


def _return_faces(
    spec: InstrumentSpec, model: CameraModel, channels: list[Channel], pupil_offset: np.ndarray, backend: Backend
) -> list[Pose]:
    """Poses, in the prescription frame, of the faces that send each pinhole's beam to the middle of its area CCD.

    The face stands at the given distance along the line of sight, where the pinhole's chief ray passes, displaced by
    the sub-aperture's offset in the pupil. Its normal halves the angle between the outgoing beam and the beam that
    would come from the CCD's middle, both taken through the face's centre, so that pupil aberration does not shift
    the spot.
    """
    frame = model.camera_frame
    distance = spec.monitor.return_face.distance
    reference = Pose(frame.rotation, frame.apply(np.array([0.0, 0.0, distance])))
    bare = model.bare_assembly(apertures=False)
    tree = RigidTree((*bare.tree.bodies, Body(REFERENCE, reference)))
    element = Element(REFERENCE, REFERENCE, plane(), Interaction.PASS)
    bare = Assembly(tree, {**bare.elements, REFERENCE: element}, {})
    backward = tuple(reversed(model.mirrors))
    stop = backward.index(model.spec.stop)
    to_stop = assemble(bare, [backward[: stop + 1]])
    outgoing = assemble(bare, [(*backward, REFERENCE)])

    spots = np.array([[*p, 0.0] for c in channels for p in (c.pinhole, c.ccd)])
    points = model.focal_plane.apply(spots)[None]
    guess = np.broadcast_to(-model.image_direction, points.shape)
    fan = RayFan(points, guess, transverse_axes(guess, np.broadcast_to(LINE_AXIS, guess.shape)))
    q, _ = aim(backend, to_stop, fan, np.zeros(2))
    position, direction = fan.at(q)
    chief = trace(backend, outgoing, make_rays(backend, position, direction)).numpy()
    require_some(chief[3], "the monitor's outgoing path")
    centres = chief[0][0, 0::2, :2] + pupil_offset
    q, _ = aim(backend, outgoing, fan, np.repeat(centres, 2, axis=0)[None], start=q)
    position, direction = fan.at(q)
    traced = trace(backend, outgoing, make_rays(backend, position, direction), world=True)
    assert traced.world is not None
    leaving = traced.numpy(traced.world)[1][0]
    faces = []
    for i, centre in enumerate(centres):
        normal = -(leaving[2 * i] + leaving[2 * i + 1])  # toward the camera
        normal = normal / np.linalg.norm(normal)
        x_axis = transverse_axes(normal, -LINE_AXIS)[0]
        rotation = np.stack([x_axis, np.cross(normal, x_axis), normal], axis=-1)
        faces.append(Pose(rotation, reference.apply(np.array([*centre, 0.0]))))
    return faces


def _camera_elements(
    name: str, root: str, model: CameraModel, channels: list[Channel], face_radius: float
) -> dict[str, Element]:
    out = {}
    for mirror in model.mirrors:
        key = f"{name}/{mirror}"
        out[key] = Element(
            key, f"{root}/{mirror}", model.surfaces[mirror], Interaction.REFLECT, model.apertures[mirror]
        )
    key = f"{name}/focal_plane"
    out[key] = Element(key, f"{root}/focal_plane", plane(), Interaction.PASS)
    for channel in channels:
        key = f"{channel.key}/return_face"
        out[key] = Element(key, channel.face_body, plane(), Interaction.REFLECT, Circle(face_radius))
        key = f"{channel.key}/area_ccd"
        out[key] = Element(key, channel.ccd_body, plane(), Interaction.PASS)
    return out


def _camera_sequences(name: str, model: CameraModel, channels: list[Channel]) -> dict[str, tuple[str, ...]]:
    forward = tuple(f"{name}/{m}" for m in model.mirrors)
    backward = forward[::-1]
    stop = backward.index(f"{name}/{model.spec.stop}")
    out = {
        f"{name}/imaging": (*forward, f"{name}/focal_plane"),
        f"{name}/image_to_stop": backward[: stop + 1],
        f"{name}/image_to_object": backward,
    }
    for channel in channels:
        face = f"{channel.key}/return_face"
        out[f"{channel.key}/outgoing"] = (*backward, face)
        out[f"{channel.key}/monitor"] = (*backward, face, *forward, f"{channel.key}/area_ccd")
    return out


def _nodes(tree: RigidTree, cameras: Mapping[str, CameraModel], ideal: set[str]) -> dict[str, NodeInfo]:
    """Which motions each body takes; the base itself is the frame of everything and is not moved."""
    out = {}
    mirrors = {f"{BASE}/{name}/{mirror}" for name, model in cameras.items() for mirror in model.mirrors}
    roots = {f"{BASE}/{name}" for name in cameras}
    for body in tree.bodies:
        if body.path == BASE:
            continue
        allows = {"rotate", "shift"}
        if body.path in mirrors:
            allows.add("figure")
        if body.path in roots:
            allows.add("scale")
        out[body.path] = NodeInfo(tuple(body.pivots), frozenset(allows), body.path in ideal)
    return out
