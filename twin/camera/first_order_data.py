"""First-order data of a camera, how its pixels sample the image, and which of its own parts stand in its light.

Rays of a camera by itself, from the scene to the image, are traced here for the layout as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from analysis.arrays import shows
from optics.geometry.aperture import Aperture, Circle, Rectangle
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import transverse_axes
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.first_order import Paraxial, equal_area_radius, first_order, ray_matrix
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.imaging import aim_collimated
from scenes.models.camera_model import (
    IMAGE,
    LINE_AXIS,
    CameraModel,
    axis_data,
    collimated,
    field_direction,
    focal_plane_body,
    pupil_diameter,
)
from scenes.specs.camera import BandSpec, CameraSpec, LineSpec
from twin.camera.camera_optics import CameraOptics, rim
from twin.framework.record import Quantity, Record

EARLIER = 6.0
"""How far before its launch point light is looked at for what stands in it, metres."""

_FIELDS = tuple((x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0))
_RAYS = 4000
"""Number of rays, evenly over the stop, by which shares of a beam are counted: right to some 0.1 %."""


@shows()
@dataclass(frozen=True, eq=False)
class RayPaths:
    """Rays in the prescription frame.

    Attributes
    ----------
    names : tuple[str, ...]
        What they meet, the image last, K.
    points : np.ndarray
        Where they begin and what they meet, (1 + K, F, N, 3), metres.
    """

    names: tuple[str, ...]
    points: np.ndarray


def ray_paths(
    model: CameraModel, backend: Backend, fields: Sequence[tuple[float, float]], stop: np.ndarray, earlier: float = 0.0
) -> RayPaths:
    """Rays of fields (shares of the half field) through points (N, 2) of the stop in units of its radius.

    They begin ``earlier`` metres before their launch points. No aperture limits them.
    """
    spec = model.spec
    bare = model.bare_assembly(apertures=False)
    to_stop = assemble(bare, [model.mirrors[: model.mirrors.index(spec.stop) + 1]])
    directions = np.array([field_direction(spec, x * spec.field.x, y * spec.field.y) for x, y in fields])
    radius = float(model.apertures[spec.stop].bounds[1])
    launch = collimated(backend, to_stop, directions, radius * stop) - earlier * directions[:, None]
    heading = np.broadcast_to(directions[:, None], launch.shape)
    names = (*model.mirrors, IMAGE)
    rays = make_rays(backend, launch.reshape(-1, 3), heading.reshape(-1, 3))
    traced = trace(backend, assemble(bare, ["imaging"]), rays, keep=range(len(names)))
    points = [launch]
    for k, name in enumerate(names):
        points.append(bare.nominal_pose(name).apply(traced.hit(k).reshape(-1, 3)).reshape(launch.shape))
    return RayPaths(names, np.array(points))


def obstacles(model: CameraModel) -> dict[str, Aperture]:
    """What of a camera may stand in its own light, in each body's own x and y: mirrors and lenses with their edges, and
    the line CCDs with as much of an edge.
    """
    spec, margin = model.spec, model.spec.edge_margin
    out: dict[str, Aperture] = {}
    for name, edge in model.apertures.items():
        if spec.mirrors[name].light == "passes":
            continue  # a stop's plate stands where its hole is not
        # the other mirrors' clear apertures have the margin already
        out[name] = _body(model, name, Circle(edge.bounds[1] + margin) if name == spec.stop else edge)
    lines: list[tuple[LineSpec | BandSpec, float]] = [
        (spec.line, 0.0),
        *((band, band.offset) for band in spec.bands.values()),
    ]
    half = 0.5 * max(line.pixels * line.pitch for line, _ in lines) + margin
    low = min(offset - 0.5 * line.pitch for line, offset in lines) - margin
    high = max(offset + 0.5 * line.pitch for line, offset in lines) + margin
    centre = model.image_body.inverse().apply(model.focal_plane.translation)
    out[IMAGE] = Rectangle(half, 0.5 * (high - low), (float(centre[0]), float(centre[1] + 0.5 * (high + low))))
    return out


def _body(model: CameraModel, name: str, edge: Aperture) -> Aperture:
    """A surface with the outer edge and the hole that its file says, else with ``edge``."""
    given = model.edges.get(name, ())
    stated = [one.shape for one in given if not one.blocks and not one.rotation and isinstance(one.shape, Aperture)]
    if stated:
        edge = stated[0]
    holes = [one.shape for one in given if one.blocks and isinstance(one.shape, Circle) and not any(one.shape.centre)]
    if holes and isinstance(edge, Circle) and not any(edge.centre) and edge.inner < holes[0].radius < edge.radius:
        edge = Circle(edge.radius, edge.centre, holes[0].radius)
    return edge


@dataclass(frozen=True)
class InTheWay:
    """What of a camera stands in its own light.

    Attributes
    ----------
    shares : Mapping[str, float]
        Body -> share of a beam that it takes, the largest over the field; a body that takes nothing is not there.
    holes : Mapping[str, float]
        Mirror -> least radius of the hole about its middle that light needs which goes through it, metres: of mirrors
        whose file states no hole and that no light is reflected at there.
    """

    shares: Mapping[str, float]
    holes: Mapping[str, float]


def obscuration(model: CameraModel, backend: Backend) -> InTheWay:
    """Which of the camera's own mirrors and line CCDs stand in a beam, of what edges leave of it, before it is theirs.

    A mirror through whose middle light goes, and whose middle reflects none, has a hole there, whether its file states
    one or not: the first mirror of a telescope about its axis, whose second one shadows that place.
    """
    nodes = quadrature.even_disk(_RAYS)
    paths = ray_paths(model, backend, _FIELDS, np.stack([nodes.x, nodes.y], axis=-1), EARLIER)
    edges, bare = obstacles(model), model.bare_assembly(apertures=False)
    blocked: dict[str, np.ndarray] = {}
    through: dict[str, list[np.ndarray]] = {}
    # light goes straight through planes that it passes, wherever they are told to stand, as at a mirror's vertex
    acting = [k for k, name in enumerate(paths.names) if name == IMAGE or model.spec.mirrors[name].light != "passes"]
    for before, k in pairwise((-1, *acting)):
        # what light comes from or goes to is no obstacle on the way
        ends = {paths.names[end] for end in (before, k) if end >= 0}
        for body, edge in edges.items():
            if body not in ends:
                taken, places = _met(backend, bare, body, edge, paths.points[before + 1], paths.points[k + 1])
                blocked[body] = blocked.get(body, np.zeros(taken.shape, bool)) | taken
                through.setdefault(body, []).append(np.where(taken[..., None], places, np.nan))
    lit = _lit(model, bare, paths)
    holes = _holes(model, bare, paths, blocked, through, lit)
    shares = {
        body: float(np.max((taken & lit) @ nodes.share / (lit @ nodes.share)))
        for body, taken in blocked.items()
        if body not in holes
    }
    return InTheWay(FrozenMap({body: share for body, share in shares.items() if share > 0.0}), FrozenMap(holes))


LEAST_SHARE = 0.005
"""Share of a beam from which on a shadow that no edge states is told: bodies are drawn with margins."""


def unstated_shadows(model: CameraModel, in_the_way: InTheWay) -> str:
    """What of a camera stands in its beam while its file states no shadow at all, and what that means; empty if nothing
    does. A file that states one is taken at its word: the outlines of bodies are those of their clear apertures.
    """
    if any(edge.blocks for edges in model.edges.values() for edge in edges):
        return ""
    told = ", ".join(f"{body} {100.0 * s:.1f}%" for body, s in in_the_way.shares.items() if s >= LEAST_SHARE)
    if not told:
        return ""
    return (
        f"its own parts stand in its beam ({told}) and its file does not say so: wavefront errors, MTF and images are "
        "those of a pupil without that shadow; a plane before them with `light: passes` and `edges: [{blocks: circle, "
        "radius: ...}]` states it"
    )


_SLIVER = 0.01
"""Share of a mirror's light that its hole may take: along the rim of a shadow that turns with the field."""


def _holes(
    model: CameraModel,
    bare: Assembly,
    paths: RayPaths,
    blocked: Mapping[str, np.ndarray],
    through: Mapping[str, list[np.ndarray]],
    lit: np.ndarray,
) -> dict[str, float]:
    """Radii of the holes of mirrors that light needs, metres."""
    out = {}
    for body in model.mirrors:
        if model.spec.mirrors[body].light is not None or not np.any(blocked.get(body, False)):
            continue
        # what another one takes reaches neither the hole nor the mirror about it; one that takes nearly all of it
        # has a hole itself
        others = [taken for name, taken in blocked.items() if name != body and np.mean(taken) < 0.5]
        left = lit & ~np.any(others, axis=0) if others else lit
        met = np.concatenate([places[left & np.isfinite(places[..., 0])] for places in through[body]])
        used = bare.nominal_pose(body).inverse().apply(paths.points[1 + paths.names.index(body)])[left]
        if met.size and used.size:
            radius = float(np.max(np.hypot(met[:, 0], met[:, 1])))
            if float(np.mean(np.hypot(used[:, 0], used[:, 1]) < radius)) < _SLIVER:
                out[body] = radius
    return out


def _lit(model: CameraModel, bare: Assembly, paths: RayPaths) -> np.ndarray:
    """Which rays edges of surfaces let through, (F, N)."""
    lit = np.ones(paths.points.shape[1:3], dtype=bool)
    if not model.edges:
        return lit
    return lit & model.uncut(
        lambda name: bare.nominal_pose(name).inverse().apply(paths.points[1 + paths.names.index(name)])
    )


def _met(
    backend: Backend, bare: Assembly, body: str, edge: Aperture, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which of the stretches start..end, (F, N, 3), meet the clear area of a body, (F, N), and where its surface, in
    its own x and y, (F, N, 2).
    """
    way = end - start
    length = np.linalg.norm(way, axis=-1)
    obstacle = Element(body, body, bare.elements[body].surface, Interaction.PASS, edge)
    system = assemble(bare.with_element(obstacle), [(body,)])
    rays = make_rays(backend, start.reshape(-1, 3), (way / np.maximum(length, _NEAR)[..., None]).reshape(-1, 3))
    position, _, path, inside = trace(backend, system, rays).numpy()
    path, inside = path.reshape(length.shape), inside.reshape(length.shape)
    place = position.reshape(*length.shape, 3)[..., :2]
    return np.asarray(inside & (path > _NEAR) & (path < length - _NEAR)), place


_NEAR = 1e-6
"""A ray meets a surface where it starts or ends: so close to it does not count, metres."""


_RIM = 48
"""Rays on the edge of the stop."""


@shows("paraxial.focal_length [m]", "entrance_pupil [m]", "aperture", "obscuration.shares", "obscuration.holes")
@dataclass(frozen=True, eq=False)
class FirstOrderData:
    """First-order data of a camera in one state, traced; lengths in metres, angles in radians.

    Attributes
    ----------
    spec : CameraSpec
        The camera.
    paraxial : Paraxial
        Data about the axis.
    entrance_pupil : float
        Diameter of the entrance pupil.
    principal_distance_line, principal_distance_track : float
        Change of the image's place per angle in the middle of the field, along the line and along the track, where the
        image plane stands.
    aperture : tuple[float, float]
        Numerical apertures along the line and along the track.
    round_aperture : float
        Numerical aperture of the round beam with the same solid angle at the image.
    image : tuple[float, float]
        Length and width of the image of the whole field.
    chief_ray_angle : tuple[float, float]
        Of chief rays against the image's normal: in the middle, and the largest over the field.
    length : float
        Distance along the parent axis between the outermost of the mirrors and the image.
    obscuration : InTheWay
        What of the camera, as designed, stands in its own beam.
    """

    spec: CameraSpec
    paraxial: Paraxial
    entrance_pupil: float
    principal_distance_line: float
    principal_distance_track: float
    aperture: tuple[float, float]
    round_aperture: float
    image: tuple[float, float]
    chief_ray_angle: tuple[float, float]
    length: float
    obscuration: InTheWay

    @property
    def working_f_number_line(self) -> float:
        """F-number along the line by the beam at the image, 1 / (2 NA)."""
        return 0.5 / self.aperture[0]


def _near(value: float) -> float | None:
    """Return a length that is no rounding of an infinite one, metres."""
    return value if abs(value) < _INFINITE else None


_INFINITE = 1e9
"""Distance of an exit pupil, or its diameter, from which on image space is telecentric, metres."""

FIRST_ORDER: Record[FirstOrderData] = Record(
    "First-order data of a camera in the state in which it is judged, at its design wavelength. Focal lengths, F-"
    "number and pupils are paraxial, about the axis; all else is of the field's middle where nothing else is stated.",
    Quantity("focal_length_m", lambda d: d.paraxial.focal_length, "effective focal length, wherever the image stands"),
    Quantity("back_focal_length_m", lambda d: d.paraxial.back_focal_length, "from the last mirror to the focus"),
    Quantity("principal_distance_along_line_m", lambda d: d.principal_distance_line, "image's place per angle"),
    Quantity("principal_distance_along_track_m", lambda d: d.principal_distance_track, "image's place per angle"),
    Quantity("entrance_pupil_m", lambda d: d.entrance_pupil, "diameter of the beam along the axis that fills the stop"),
    Quantity("entrance_pupil_before_first_mirror_m", lambda d: d.paraxial.entrance_pupil, "positive toward the scene"),
    Quantity("exit_pupil_m", lambda d: _near(d.entrance_pupil * d.paraxial.exit_magnification), "diameter"),
    Quantity("exit_pupil_before_image_m", lambda d: _near(d.paraxial.exit_pupil), "none where it is at infinity"),
    Quantity("f_number", lambda d: d.paraxial.focal_length / d.entrance_pupil, "focal length over entrance pupil"),
    Quantity("working_f_number", lambda d: 0.5 / d.round_aperture, "of the round beam with the same solid angle"),
    Quantity("working_f_number_along_line", lambda d: d.working_f_number_line, "1 / (2 NA) at the image"),
    Quantity("working_f_number_along_track", lambda d: 0.5 / d.aperture[1], "1 / (2 NA) at the image"),
    Quantity("field_deg", lambda d: 2.0 * np.array([d.spec.field.x, d.spec.field.y]), "full angles of the field"),
    Quantity("image_mm", lambda d: np.array(d.image), "length and width of the image of the field"),
    Quantity(
        "plate_scale_arcsec_per_mm",
        lambda d: 3.6 * np.degrees(1.0 / d.principal_distance_line),
        "angle per length on the image, along the line",
        converted=False,
    ),
    Quantity("pitch_um", lambda d: d.spec.line.pitch, "pitch of the line's pixels"),
    Quantity("pixel_arcsec", lambda d: d.spec.line.pitch / d.principal_distance_line, "angle that a pixel sees"),
    Quantity("nyquist_per_mm", lambda d: 0.5 / d.spec.line.pitch, "of the line's pixels"),
    Quantity(
        "cutoff_per_mm",
        lambda d: 1.0 / (d.spec.wavelength * d.working_f_number_line),
        "frequency from which diffraction leaves no contrast along the line",
    ),
    Quantity(
        "sampling_lambda_f_per_pixel",
        lambda d: d.spec.wavelength * d.working_f_number_line / d.spec.line.pitch,
        "2 where the pixels' Nyquist frequency is the cut-off",
        converted=False,
    ),
    Quantity(
        "airy_radius_um", lambda d: 1.22 * d.spec.wavelength * 0.5 / d.round_aperture, "first dark ring of a point"
    ),
    Quantity(
        "chief_ray_angle_deg",
        lambda d: np.array(d.chief_ray_angle),
        "of chief rays against the image's normal: in the middle, and the largest over the field",
    ),
    Quantity("length_m", lambda d: d.length, "along the parent axis between the outermost of mirrors and image"),
    Quantity(
        "obscuration", lambda d: d.obscuration.shares, "body of the camera -> largest share of a beam that it takes"
    ),
    Quantity(
        "hole_radius_mm",
        lambda d: d.obscuration.holes,
        "mirror -> least radius of the hole that light needs which goes through it, where its file states none",
    ),
)


def first_order_data(optics: CameraOptics) -> FirstOrderData:
    """Trace what the first-order data of a camera follow from, in its state.

    Raises
    ------
    AimError, BeamMissedError
        Light does not come through.
    AfocalError
        The state brings it to no focus.
    """
    path, model, backend = optics.path, optics.model, optics.path.backend
    state = path.coloured(optics.state, optics.wavelength)
    placed = path.assembly.place([state])
    imaging, to_stop = (
        assemble(path.assembly, [f"{path.name}/{way}"], [state], placed=placed) for way in ("imaging", "to_stop")
    )
    frame = placed.pose(path.root) @ model.camera_frame.inverse()
    axis, first = model.axis.moved(frame), frame.rotation @ LINE_AXIS
    middle = optics.directions([(0.0, 0.0)])
    launch = aim_collimated(backend, to_stop, middle, axis.centre[None], np.zeros((1, 2)))[0][:, 0]
    about = transverse_axes(middle, first[None])
    scale = first_order(ray_matrix(backend, imaging, model.mirrors.index(model.spec.stop), launch, middle, about)).scale
    (_, track), (line, _) = np.abs(scale[0])
    rays = optics.rays(_FIELDS, np.concatenate([np.zeros((1, 2)), rim(_RIM)]))
    at = _FIELDS.index((0.0, 0.0))
    cosines = rays.direction[at, 1:, 1::-1]  # along the line, along the track
    slant = np.arccos(np.clip(np.abs(rays.direction[:, 0, 2]), 0.0, 1.0))
    na_line, na_track = 0.5 * np.ptp(cosines, axis=0)
    length, width = np.ptp(rays.position[:, 0, 1::-1], axis=0)
    image = placed.pose(focal_plane_body(path.root)) @ model.focal_plane.inverse() @ model.image_body
    ends = [placed.pose(f"{path.root}/{mirror}").translation for mirror in model.mirrors] + [image.translation]
    return FirstOrderData(
        spec=model.spec,
        paraxial=axis_data(backend, imaging, model.spec, axis, first),
        entrance_pupil=pupil_diameter(backend, to_stop, axis, path.stop.radius),
        principal_distance_line=float(line),
        principal_distance_track=float(track),
        aperture=(float(na_line), float(na_track)),
        round_aperture=equal_area_radius(cosines),
        image=(float(length), float(width)),
        chief_ray_angle=(float(slant[at]), float(np.max(slant))),
        length=float(np.ptp(frame.inverse().apply(np.array(ends))[:, 2])),
        obscuration=obscuration(model, backend),
    )
