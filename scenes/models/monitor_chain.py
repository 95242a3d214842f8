"""Placement of the monitor's prisms, from a camera's leaving beam to a facet of the central prism.

The beam leaves the camera through a part of the pupil. The 180-deg prism receives it at a given distance, returns it
and transfers it to the central prism's side; the rhomboid displaces it by a given amount in the same direction. The
transfer of the 180-deg prism follows from the position of the facet, which is perpendicular to the beam.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from optics.geometry.aperture import Circle
from optics.geometry.pose import Pose, rotation_matrix
from optics.geometry.solid import Solid
from optics.geometry.surface import plane
from optics.geometry.tree import Body, RigidTree
from optics.materials.glass import glass
from optics.numerics.array_math import inner, matvec, norm
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError, RayFan, aim, surviving_rays, transverse_axes
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.reflectors import Mount, Reflector, ReflectorParts
from optics.raytrace.system import SystemBatch, assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import LINE_AXIS, REFERENCE, CameraModel
from scenes.models.instrument_model import MisplacedError, key_of
from scenes.specs.instrument import (
    BASE,
    CENTRAL_KEY,
    CENTRAL_PRISM,
    PRISM_0,
    PRISM_180,
    Channel,
    ChannelParts,
    InstrumentSpec,
    prism_of,
)
from scenes.yaml.errors import KeyPath

_CARRIED = "a field and a pupil_offset whose beam passes all mirrors of the camera"
_FACET = "a position to which the prisms, with their angle_errors, direct the beam"
_OUTLINE = 2000  # points of a clear aperture's edge: a few millimetres apart at most


@dataclass(frozen=True, eq=False)
class LeavingBeam:
    """Beam of a channel in front of its camera, in the base frame.

    Attributes
    ----------
    middle : (3,) ndarray
        Point at which it meets the 180-deg prism's window, in metres.
    direction : (3,) ndarray
        Unit vector of its middle ray, halfway between the beam from the pinhole and the one that would come from the
        middle of the area CCD.
    """

    middle: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True, eq=False)
class MonitorChain:
    """Parts that a channel's beam meets outside the camera.

    Attributes
    ----------
    bodies : tuple[Body, ...]
        Bodies of the prisms and their faces, and of the facet.
    elements : tuple[Element, ...]
        Optical elements in the order in which the leaving beam meets them; the last one is the return face.
    solids : tuple[Solid, ...]
        Solids of the two prisms, or of the reflectors in their place.
    glass : Mapping[str, float]
        Prism -> length of the beam inside it, one way, in metres.
    """

    bodies: tuple[Body, ...]
    elements: tuple[Element, ...]
    solids: tuple[Solid, ...]
    glass: Mapping[str, float]


def leaving_beams(
    model: CameraModel, distances: Mapping[Channel, float], to_base: Pose, backend: Backend
) -> dict[Channel, LeavingBeam]:
    """Trace the channels' beams out of a camera.

    The middle of a beam is the point at which the pinhole's chief ray passes, displaced by the sub-aperture's offset in
    the pupil.

    Parameters
    ----------
    model : CameraModel
        The camera.
    distances : Mapping[Channel, float]
        Channel -> distance from the camera's origin to its 180-deg prism's window, in metres.
    to_base : Pose
        Pose of the camera in the base.
    backend : Backend
        Backend that traces the rays.

    Raises
    ------
    MisplacedError
        Light from the pinholes or the area CCDs misses a mirror's surface.
    """
    out: dict[Channel, LeavingBeam] = {}
    for distance in dict.fromkeys(distances.values()):
        channels = [channel for channel, at in distances.items() if at == distance]
        out.update(zip(channels, _leaving(model, channels, distance, to_base, backend), strict=True))
    return {channel: out[channel] for channel in distances}


def _leaving(
    model: CameraModel, channels: Sequence[Channel], distance: float, to_base: Pose, backend: Backend
) -> list[LeavingBeam]:
    """Return the beams of channels whose prism windows have the same distance from the camera, in metres.

    An error names the first channel without a beam.
    """
    try:
        return _traced_out(model, channels, distance, to_base, backend)
    except MisplacedError:
        for channel in channels:
            try:
                _traced_out(model, [channel], distance, to_base, backend)
            except MisplacedError as error:
                raise MisplacedError(str(error), error.key, error.remedy, (channel.camera, channel.name)) from error
        raise


def _traced_out(
    model: CameraModel, channels: Sequence[Channel], distance: float, to_base: Pose, backend: Backend
) -> list[LeavingBeam]:
    """Trace together the beams of channels whose prism windows have the same distance from the camera, in metres.

    An error names all of these channels.
    """
    frame = model.camera_frame
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
    fan = RayFan.toward(points, -model.image_direction, LINE_AXIS)
    where = " and ".join(c.key for c in channels)
    q = _aimed(backend, to_stop, fan, np.zeros(2), where, ("monitor", "field"))
    position, direction = fan.at(q)
    chief = trace(backend, outgoing, make_rays(backend, position, direction)).numpy()
    if not chief[3].all():
        raise MisplacedError(f"light of the monitor channels {where} misses a mirror", ("monitor", "field"), _CARRIED)
    centres = chief[0][0, 0::2, :2] + np.array([c.pupil_offset for c in channels])
    q = _aimed(backend, outgoing, fan, np.repeat(centres, 2, axis=0)[None], where, ("monitor", "field"), start=q)
    position, direction = fan.at(q)
    traced = trace(backend, outgoing, make_rays(backend, position, direction), world=True)
    assert traced.world is not None
    leaving = traced.numpy(traced.world)[1][0]
    in_base = to_base @ frame.inverse()
    beams = []
    for i, centre in enumerate(centres):
        along = leaving[2 * i] + leaving[2 * i + 1]
        along = matvec(in_base.rotation, along / norm(along))
        beams.append(LeavingBeam(in_base.apply(reference.apply(np.array([*centre, 0.0]))), along))
    return beams


def facet_positions(spec: InstrumentSpec, beams: Mapping[Channel, LeavingBeam]) -> dict[Channel, np.ndarray]:
    """Return the middles of the facets that a camera's beams meet, in the base frame, in metres.

    The first facet of each corner of the block leans toward the origin of its beam and contains the apex, so that it is
    the lowest of all such planes there. Further facets of the same corner, whose beams come from nearly the same
    direction, intersect it halfway between the middles of both.

    Parameters
    ----------
    spec : InstrumentSpec
        The instrument.
    beams : Mapping[Channel, LeavingBeam]
        Beams of one camera.

    Raises
    ------
    InputError
        Two beams share a facet, or a facet would lie under its neighbour: of two in one corner the steeper one has to
        be farther out.
    """
    apex = np.array(spec.reference_prism.position)
    corners: dict[tuple[float, float], list[tuple[Channel, np.ndarray, np.ndarray, float]]] = {}
    out = {}
    for channel, beam in beams.items():
        up, parts = beam.direction, spec.channels_of(channel.camera)[channel.name]
        side = np.sign(up[:2])
        offset = side * np.array(parts.spread)
        lean, height = up[:2] / up[2], 0.0
        for n, (other, position, slope, top) in enumerate(corners.setdefault((side[0], side[1]), [])):
            apart, least = float(norm(offset - position)), 0.5 * float(up[2]) * (channel.aperture + other.aperture)
            if apart < least:
                raise spec.error(
                    f"the facets of {channel.key} and {other.key} overlap: their beams meet the block only "
                    f"{1e3 * apart:.4g} mm apart",
                    spec.key_of(channel.camera, channel.name, (CENTRAL_KEY, "spread")),
                    allowed=f"a position at least {1e3 * least:.4g} mm from that of {other.key}",
                )
            across = float(inner(lean - slope, offset - position))
            if across < 0.0:
                raise spec.error(
                    f"the facets of {channel.key} and {other.key} obstruct one another: the steeper one has to be "
                    "farther out",
                    spec.key_of(channel.camera, channel.name, (CENTRAL_KEY, "spread")),
                    allowed=f"a position on the other side of that of {other.key}",
                )
            level = top + float(inner(lean - slope, 0.5 * (offset + position)))
            height = level if n == 0 else min(height, level)
        corners[side[0], side[1]].append((channel, offset, lean, height))
        out[channel] = apex + np.array([*offset, height - inner(offset, up[:2]) / up[2]])
    return out


def monitor_chain(
    spec: InstrumentSpec, channel: Channel, parts: ChannelParts, beam: LeavingBeam, centre: np.ndarray, to_base: Pose
) -> MonitorChain:
    """Place both prisms and the facet of a channel.

    Parameters
    ----------
    spec : InstrumentSpec
        The instrument.
    channel : Channel
        The channel.
    parts : ChannelParts
        Its parts as the file describes them, with all defaults filled in.
    beam : LeavingBeam
        Its beam as it leaves the camera.
    centre : (3,) ndarray
        Centre of its facet, in the base frame, in metres.
    to_base : Pose
        Pose of the camera in the base.

    Raises
    ------
    InputError
        The central prism is too near the camera's beam for the rhomboid's displacement, or that displacement is too
        small for the rhomboid's width.
    """
    up, large, small = beam.direction, parts.prism_180, parts.prism_0
    apex = np.array(spec.reference_prism.position)
    across = centre - beam.middle
    across = across - inner(across, up) * up
    whole = float(norm(across))
    toward = across / whole
    transfer = whole - small.shift
    off = large.reflector.lateral_offset(large.width)
    shortest = 2.0 * off + large.width
    if transfer < shortest:
        raise spec.error(
            f"the beam of {channel.key} passes only {1e3 * whole:.4g} mm from its facet of the central prism, which "
            f"leaves {1e3 * transfer:.4g} mm for the 180-deg prism after the rhomboid's displacement",
            (CENTRAL_KEY, "position"),
            allowed=f"positions that leave it at least {1e3 * shortest:.4g} mm",
        )
    into_camera = to_base.inverse()
    length = sqrt(transfer**2 - (2.0 * off) ** 2)
    across = np.cross(up, toward)
    # Of the two mirror-image prisms, choose the one that lies more nearly across the line.
    x_axes = {hand: (length * toward + hand * 2.0 * off * across) / transfer for hand in (1.0, -1.0)}
    hand = min(x_axes, key=lambda h: abs(x_axes[h][1]))
    pose = Pose(_columns(x_axes[hand], up), beam.middle + 0.5 * transfer * toward)
    pose = pose @ _tilt_about(large.tilt, large.reflector.null_point(length, large.width))
    names = channel.prism_body(PRISM_180), channel.prism_elements(PRISM_180)
    mount = Mount(names[0], into_camera @ pose, names[1], large.material, length, large.width, hand, large.angle_errors)
    first = _made(spec, channel, PRISM_180, "width", large.reflector, mount)
    pose = Pose(_columns(toward, -up), centre + small.distance * up - 0.5 * small.shift * toward)
    pose = pose @ _tilt_about(small.tilt, small.reflector.null_point(small.shift, small.width))
    names = channel.prism_body(PRISM_0), channel.prism_elements(PRISM_0)
    mount = Mount(
        names[0], into_camera @ pose, names[1], small.material, small.shift, small.width, errors=small.angle_errors
    )
    second = _made(spec, channel, PRISM_0, "shift", small.reflector, mount)
    face = Element(
        f"{channel.key}/return_face", channel.face_body, plane(), Interaction.REFLECT, Circle(0.5 * channel.aperture)
    )
    facet = Body(channel.face_body, Pose(_facet_axes(up), centre - apex))
    return MonitorChain(
        (*first.bodies, *second.bodies, facet),
        (*first.elements, *second.elements, face),
        (*first.solids, *second.solids),
        FrozenMap({PRISM_180: first.path_length, PRISM_0: second.path_length}),
    )


def _made(
    spec: InstrumentSpec, channel: Channel, prism: str, key: str, reflector: Reflector, mount: Mount
) -> ReflectorParts:
    """Return the parts of a reflector. Raises InputError at a key of the prism if it cannot be made."""
    try:
        return reflector.parts(mount)
    except ValueError as error:
        problem, _, least = str(error).partition("; ")
        where = spec.key_of(channel.camera, channel.name, ("monitor", prism, key))
        raise spec.error(problem, where, allowed=least or "dimensions with which the prism can be made") from error


def _tilt_about(tilt: tuple[float, float], about: tuple[float, float, float]) -> Pose:
    """Return the rotation by small angles about x and y, in radians, that leaves the point ``about`` in place."""
    rotation = rotation_matrix(np.array([*tilt, 0.0]))
    return Pose(rotation, np.array(about) - matvec(rotation, np.array(about)))


def check_prisms(spec: InstrumentSpec) -> None:
    """Check that the monitor's prisms can be made and suit the beam.

    Their glasses must have an index at the monitor's wavelength, they must be wide enough for the beam, and all
    channels must have the same kinds.

    Raises
    ------
    InputError
        One of these conditions is not met.
    """
    wavelength = spec.autocollimator.wavelength
    kinds: dict[str, Reflector] = {}
    for camera in spec.cameras:
        for channel, parts in spec.channels_of(camera).items():
            for name, prism in parts.prisms.items():
                if kinds.setdefault(name, prism.reflector) is not prism.reflector:
                    raise spec.error(
                        f"{camera}/{channel} has a different kind of reflector than the channels before it",
                        spec.key_of(camera, channel, ("monitor", name, "kind")),
                        value=prism.kind,
                        allowed="the same kind in all channels of an instrument, which are traced together",
                    )
            face = parts.return_face.aperture
            for name, prism in parts.prisms.items():
                key = spec.key_of(camera, channel, ("monitor", name))
                medium = glass(prism.material) if prism.reflector.transparent else None
                if medium is not None and not medium.shortest <= wavelength <= medium.longest:
                    raise spec.error(
                        f"the index of {prism.material} is not known at the monitor's wavelength of "
                        f"{1e9 * wavelength:.6g} nm",
                        (*key, "material"),
                        value=prism.material,
                        allowed=f"a glass for that wavelength, or a wavelength from {1e9 * medium.shortest:.6g} to "
                        f"{1e9 * medium.longest:.6g} nm",
                    )
                if prism.width < face:
                    raise spec.error(
                        f"the prism is narrower than the beam: {1e3 * prism.width:.4g} mm for a return face of "
                        f"{1e3 * face:.4g} mm",
                        (*key, "width"),
                        allowed=f"at least {1e3 * face:.4g} mm",
                    )


def square_facets(
    assembly: Assembly, channels: Sequence[Channel], cameras: Mapping[str, CameraModel], backend: Backend
) -> Assembly:
    """Return an assembly with every facet rotated so that it sends the pinhole's beam to the middle of its area CCD.

    The normal, found by tracing, bisects the angle between the beam that arrives and the one that would come from the
    CCD's middle, both through the facet's centre, after all prisms with their angle errors.

    Raises
    ------
    MisplacedError
        A beam misses a mirror or a prism; the message names the element.
    """
    poses = {}
    placed = assembly.place()
    for channel in channels:
        names = assembly.sequences[f"{channel.key}/outgoing"]
        start = np.array([placed.translation[0, placed.index[b]] for b in (channel.reticle_body, channel.ccd_body)])[
            None
        ]
        guess = cameras[channel.camera].toward_optics(placed.pose(f"{BASE}/{channel.camera}/focal_plane").rotation)
        fan = RayFan.toward(start, guess)
        arriving = assembly.with_element(Element("arriving", channel.face_body, plane(), Interaction.PASS))
        systems = assemble(arriving, [(*names[:-1], "arriving")])
        q = _aimed(backend, systems, fan, np.zeros(2), channel.key, (CENTRAL_KEY, "position"))
        position, direction = fan.at(q)
        traced = trace(backend, systems, make_rays(backend, position, direction), world=True)
        assert traced.world is not None
        _, leaving, _, valid = traced.numpy(traced.world)
        if not valid.all():
            raise _missed(assembly, channel, backend, position, direction)
        normal = -leaving[0].sum(axis=0)
        block = placed.pose(CENTRAL_PRISM)
        local = matvec(block.rotation.T, normal / norm(normal))
        poses[channel.face_body] = Pose(_facet_axes(local), assembly.tree[channel.face_body].pose.translation)
    bodies = tuple(Body(b.path, poses.get(b.path, b.pose), b.pivots, b.scales) for b in assembly.tree.bodies)
    return Assembly(RigidTree(bodies), assembly.elements, assembly.sequences, assembly.media, assembly.above_d)


def _aimed(
    backend: Backend,
    systems: SystemBatch,
    fan: RayFan,
    target: np.ndarray,
    channels: str,
    key: KeyPath,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Return the parameters, from ``aim``, of the rays that meet a target.

    Raises MisplacedError at ``key`` if there is no such ray.
    """
    try:
        return aim(backend, systems, fan, target, start)[0]
    except (AimError, np.linalg.LinAlgError) as error:
        why = f": {error}" if isinstance(error, AimError) else ""
        choice = _CARRIED if key[0] == "monitor" else _FACET
        raise MisplacedError(f"the light of {channels} does not reach its target{why}", key, choice) from error


def _missed(
    assembly: Assembly, channel: Channel, backend: Backend, position: np.ndarray, direction: np.ndarray
) -> MisplacedError:
    """Return an error that names the first element whose clear aperture a channel's outgoing rays miss.

    Parameters
    ----------
    assembly : Assembly
        Assembly with the elements.
    channel : Channel
        The channel.
    backend : Backend
        Backend that traces the rays.
    position, direction : (1, N, 3) ndarray
        Start points, in metres, and unit vectors of N rays in the world.
    """
    names = assembly.sequences[f"{channel.key}/outgoing"]
    for count, (element, alive) in enumerate(surviving_rays(backend, assembly, names, position, direction), 1):
        if alive.all():
            continue
        what = f"the middle of the beam {channel.key} misses {element.name} on {element.body}"
        off = beside(assembly, backend, names[:count], position, direction, ~alive)
        if off is not None:
            what += f": it passes {1e3 * off:.3g} mm beside the clear aperture"
        elif element.interaction is Interaction.TOTAL:
            what += ", or is not totally reflected there"
        choice = "a pupil_offset, monitor.field and angle_errors of the prisms that let it pass"
        if prism_of(element.body) is None and element.body != channel.face_body:
            choice = f"{_CARRIED}, or a camera with another {element.body.rpartition('/')[2]}"
        return MisplacedError(what, key_of(element.body), choice, (channel.camera, channel.name))
    problem = f"the middle of the beam {channel.key} misses its facet"
    return MisplacedError(problem, (CENTRAL_KEY, "position"), _FACET)


def beside(
    assembly: Assembly,
    backend: Backend,
    names: Sequence[str],
    position: np.ndarray,
    direction: np.ndarray,
    lost: np.ndarray,
) -> float | None:
    """Return by how much lost rays miss the clear aperture of the last of some elements, in metres.

    It is the largest distance of N rays outside the edge.

    Parameters
    ----------
    assembly : Assembly
        Assembly with the elements.
    backend : Backend
        Backend that traces the rays.
    names : sequence of str
        Names of the elements, in the order of the light.
    position : ndarray
        Start points of the rays, in the world, in metres, broadcastable to (1, N, 3).
    direction : ndarray
        Unit vectors of the rays, likewise.
    lost : (N,) ndarray of bool
        Rays that are lost at the last element.

    Returns
    -------
    float or None
        None where the rays do not meet its surface, or where it has no edge.
    """
    element = assembly.elements[names[-1]]
    bare = assembly.with_element(replace(element, aperture=None))
    traced = trace(backend, assemble(bare, [tuple(names)]), make_rays(backend, position, direction))
    if element.aperture is None or not traced.numpy()[3][0][lost].all():
        return None
    gap = element.aperture.outline(_OUTLINE)[:, None] - traced.xy()[0][lost]
    return float(np.max(np.min(np.linalg.norm(gap, axis=-1), axis=0)))


def _columns(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the rotation matrix whose columns are the unit vector x, z cross x, and the unit vector z."""
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _facet_axes(normal: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a facet's frame: z along its normal, x along the line CCD, toward the base's -Y."""
    x_axis = transverse_axes(normal, np.array([0.0, -1.0, 0.0]))[0]
    return _columns(x_axis, normal)
