"""First-order data of a camera, sampling by its pixels, and obscuration by its own parts.

Rays of a camera without an instrument, from the scene to the image, are traced here for the layout as well.
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
from scenes.models.meshes import body_outline
from scenes.specs.camera import BandSpec, CameraSpec, LineSpec
from twin.camera.camera_optics import CameraOptics, rim
from twin.framework.record import Quantity, Record

EARLIER = 6.0
"""Distance by which rays are extended backward from the light's launch point to find obstacles there, metres."""

_FIELDS = tuple((x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0))
_RAYS = 4000
"""Number of rays, evenly over the stop, by which fractions of a beam are counted, accurate to some 0.1 %."""


@shows()
@dataclass(frozen=True, eq=False)
class RayPaths:
    """Ray paths in the prescription frame.

    Attributes
    ----------
    names : tuple of str
        The K surfaces that the rays meet, the image last.
    points : (1 + K, F, N, 3) ndarray
        Starting point and K intersections of N rays of each of F fields, metres.
    """

    names: tuple[str, ...]
    points: np.ndarray


def ray_paths(
    model: CameraModel, backend: Backend, fields: Sequence[tuple[float, float]], stop: np.ndarray, earlier: float = 0.0
) -> RayPaths:
    """Trace rays of fields (fractions of the half field) through N points, (N, 2), of the stop.

    Points are in units of the stop's radius.

    The rays begin ``earlier`` metres before their launch points. No aperture limits them.
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
    """Return the outlines of the camera's parts that may block its light, in each body's x and y.

    They are mirrors and lenses with their edges, and the line CCDs with an edge of equal width.
    """
    spec, margin = model.spec, model.spec.edge_margin
    out: dict[str, Aperture] = {}
    for name, edge in model.apertures.items():
        if spec.mirrors[name].light == "passes":
            continue  # the plate of a stop lies outside its hole
        # the clear apertures of the other mirrors include the margin
        out[name] = body_outline(model, name, Circle(edge.bounds[1] + margin) if name == spec.stop else edge)
    lines: list[tuple[LineSpec | BandSpec, float, int]] = [
        (spec.line, 0.0, spec.line.rows),
        *((band, band.offset, 1) for band in spec.bands.values()),
    ]
    half = 0.5 * max(line.pixels * line.pitch for line, *_ in lines) + margin
    low = min(offset - 0.5 * rows * line.pitch for line, offset, rows in lines) - margin
    high = max(offset + 0.5 * rows * line.pitch for line, offset, rows in lines) + margin
    centre = model.image_body.inverse().apply(model.focal_plane.translation)
    out[IMAGE] = Rectangle(half, 0.5 * (high - low), (float(centre[0]), float(centre[1] + 0.5 * (high + low))))
    return out


@dataclass(frozen=True)
class ObscurationData:
    """Obscuration of a camera by its own parts.

    Attributes
    ----------
    shares : mapping
        Body -> largest fraction of a beam over the field that it blocks; bodies that block nothing are omitted.
    holes : mapping
        Mirror -> smallest radius, metres, of a central hole that the light needs: for mirrors whose file specifies no
        hole and that reflect no light there.
    """

    shares: Mapping[str, float]
    holes: Mapping[str, float]


def obscuration(model: CameraModel, backend: Backend) -> ObscurationData:
    """Compute the fraction of a beam that each mirror and line CCD of the camera blocks before the light reaches it.

    A mirror whose middle the light crosses and which reflects none there has a hole, whether its file specifies one or
    not, like the primary mirror of an on-axis telescope, whose middle the secondary mirror shadows.
    """
    nodes = quadrature.even_disk(_RAYS)
    paths = ray_paths(model, backend, _FIELDS, np.stack([nodes.x, nodes.y], axis=-1), EARLIER)
    edges, bare = obstacles(model), model.bare_assembly(apertures=False)
    blocked: dict[str, np.ndarray] = {}
    through: dict[str, list[np.ndarray]] = {}
    # light passes such planes undeviated, wherever the file places them, for example at a mirror's vertex
    acting = [k for k, name in enumerate(paths.names) if name == IMAGE or model.spec.mirrors[name].light != "passes"]
    for before, k in pairwise((-1, *acting)):
        # the surfaces at the ends of a path do not block it
        ends = {paths.names[end] for end in (before, k) if end >= 0}
        for body, edge in edges.items():
            if body not in ends:
                taken, places = _intersections(backend, bare, body, edge, paths.points[before + 1], paths.points[k + 1])
                blocked[body] = blocked.get(body, np.zeros(taken.shape, bool)) | taken
                through.setdefault(body, []).append(np.where(taken[..., None], places, np.nan))
    illuminated = _passed_edges(model, bare, paths)
    holes = _holes(model, bare, paths, blocked, through, illuminated)
    shares = {
        body: float(np.max((taken & illuminated) @ nodes.share / (illuminated @ nodes.share)))
        for body, taken in blocked.items()
        if body not in holes
    }
    return ObscurationData(FrozenMap({body: share for body, share in shares.items() if share > 0.0}), FrozenMap(holes))


def detector_size(spec: CameraSpec) -> np.ndarray:
    """Return the size of the detector along the line and along the track, (2,), metres."""
    return np.array([spec.line.pixels, spec.line.rows]) * spec.line.pitch


def detector_beyond_field(data: FirstOrderData) -> str:
    """Describe an area detector that is larger than the image of the field; empty for others and for a line CCD."""
    size, image = 1e3 * detector_size(data.spec), 1e3 * np.array(data.image)
    # the image of the field is traced with distortion, so that a detector of its size may exceed it a little
    beyond = size > (1.0 + _SAME_SIZE) * image
    if data.spec.line.rows == 1 or not np.any(beyond):
        return ""
    where = " and ".join(name for name, is_beyond in zip(("along", "across"), beyond, strict=True) if is_beyond)
    return (
        f"The detector, {size[0]:.4g} by {size[1]:.4g} mm, is larger {where} the line than the image of the field, "
        f"{image[0]:.4g} by {image[1]:.4g} mm: image quality is that of the field. To cover the detector, enlarge "
        "`field: {x: ..., y: ...}` in the camera file"
    )


_SAME_SIZE = 0.01
"""Relative excess of a detector over the image of the field up to which both count as equal."""


LEAST_SHARE = 0.005
"""Smallest fraction of a beam blocked by the camera's parts that is reported if the camera's file models no
obscuration.

Outlines of parts include margins, so that smaller fractions mean little.
"""


def unmodelled_obscuration(model: CameraModel, obscured: ObscurationData) -> str:
    """Describe the obscuration by the camera's parts if its file models none; empty otherwise.

    A file that models any obscuration is trusted, as the outlines of bodies are those of their clear apertures.
    """
    if any(edge.blocks for edges in model.edges.values() for edge in edges):
        return ""
    blocking = ", ".join(f"{body} blocks {100.0 * s:.1f} %" for body, s in obscured.shares.items() if s >= LEAST_SHARE)
    if not blocking:
        return ""
    return (
        f"{blocking} of the beam, but the file does not model this obscuration: wavefront errors, MTF and images are "
        "those of a pupil without that shadow. Model it with a plane before these parts with `light: passes` and "
        "`edges: [{blocks: circle, radius: ...}]`"
    )


_SLIVER = 0.01
"""Largest fraction of a mirror's light that may fall into a central hole assumed to be there.

Some light along the rim of a shadow does, as the shadow moves with the field.
"""


def _holes(
    model: CameraModel,
    bare: Assembly,
    paths: RayPaths,
    blocked: Mapping[str, np.ndarray],
    through: Mapping[str, list[np.ndarray]],
    illuminated: np.ndarray,
) -> dict[str, float]:
    """Return the radii of central holes, metres, without which mirrors would block the light that crosses their middle.

    Only mirrors count whose file specifies no hole and whose middle reflects no light.
    """
    out = {}
    for body in model.mirrors:
        if model.spec.mirrors[body].light is not None or not np.any(blocked.get(body, False)):
            continue
        # light that another body blocks reaches neither the hole nor the mirror around it; a body that blocks nearly
        # all light has a hole itself
        others = [taken for name, taken in blocked.items() if name != body and np.mean(taken) < 0.5]
        remaining = illuminated & ~np.any(others, axis=0) if others else illuminated
        crossings = np.concatenate([places[remaining & np.isfinite(places[..., 0])] for places in through[body]])
        used = bare.nominal_pose(body).inverse().apply(paths.points[1 + paths.names.index(body)])[remaining]
        if crossings.size and used.size:
            radius = float(np.max(np.hypot(crossings[:, 0], crossings[:, 1])))
            if float(np.mean(np.hypot(used[:, 0], used[:, 1]) < radius)) < _SLIVER:
                out[body] = radius
    return out


def _passed_edges(model: CameraModel, bare: Assembly, paths: RayPaths) -> np.ndarray:
    """Return a mask of the rays that pass the edges of all surfaces, (F, N) for N rays of each of F fields."""
    passed = np.ones(paths.points.shape[1:3], dtype=bool)
    if not model.edges:
        return passed
    return passed & model.unvignetted(
        lambda name: bare.nominal_pose(name).inverse().apply(paths.points[1 + paths.names.index(name)])
    )


def _intersections(
    backend: Backend, bare: Assembly, body: str, edge: Aperture, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which ray segments from ``start`` to ``end`` meet the clear area of a body, and where.

    Both ends are (F, N, 3) for N rays of each of F fields.

    Returns
    -------
    tuple of ndarray
        Blocked rays, (F, N), and their positions in the body's x and y, (F, N, 2), metres.
    """
    path_vector = end - start
    length = np.linalg.norm(path_vector, axis=-1)
    obstacle = Element(body, body, bare.elements[body].surface, Interaction.PASS, edge)
    system = assemble(bare.with_element(obstacle), [(body,)])
    rays = make_rays(backend, start.reshape(-1, 3), (path_vector / np.maximum(length, _NEAR)[..., None]).reshape(-1, 3))
    position, _, path, inside = trace(backend, system, rays).numpy()
    path, inside = path.reshape(length.shape), inside.reshape(length.shape)
    place = position.reshape(*length.shape, 3)[..., :2]
    return np.asarray(inside & (path > _NEAR) & (path < length - _NEAR)), place


_NEAR = 1e-6
"""Distance from the ends of a ray segment within which an intersection does not count, metres."""


_RIM = 48
"""Number of rays on the edge of the stop."""


@shows("paraxial.focal_length [m]", "entrance_pupil [m]", "aperture", "obscuration.shares", "obscuration.holes")
@dataclass(frozen=True, eq=False)
class FirstOrderData:
    """First-order data of a camera in one state, by ray trace; lengths in metres, angles in radians.

    Attributes
    ----------
    spec : CameraSpec
        Camera.
    paraxial : Paraxial
        Paraxial data about the axis.
    entrance_pupil : float
        Diameter of the entrance pupil.
    principal_distance_line, principal_distance_track : float
        Change of image position per angle in the middle of the field, along the line and along the track, on the actual
        image plane.
    aperture : tuple of float
        Numerical apertures along the line and along the track.
    round_aperture : float
        Numerical aperture of the circular beam with the same solid angle at the image.
    image : tuple of float
        Length and width of the image of the whole field.
    chief_ray_angle : tuple of float
        Angle between chief ray and image normal: in the middle, and the largest over the field.
    length : float
        Distance along the parent axis between the outermost of the mirrors and the image.
    obscuration : ObscurationData
        Obscuration by the parts of the nominal camera.
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
    obscuration: ObscurationData

    @property
    def working_f_number_line(self) -> float:
        """F-number along the line of the beam at the image, 1 / (2 NA) with its numerical aperture NA."""
        return 0.5 / self.aperture[0]


def _near(value: float) -> float | None:
    """Return a length in metres, or None if it is infinite (beyond 1e9 m)."""
    return value if abs(value) < _INFINITE else None


_INFINITE = 1e9
"""Distance or diameter of an exit pupil beyond which image space counts as telecentric, metres."""

FIRST_ORDER: Record[FirstOrderData] = Record(
    "First-order data of a camera in the analysed state, at its design wavelength. Focal lengths, F-"
    "number and pupils are paraxial, about the axis; all else refers to the middle of the field unless specified.",
    Quantity(
        "focal_length_m",
        lambda d: d.paraxial.focal_length,
        "effective focal length, independent of the image plane's position",
    ),
    Quantity(
        "back_focal_length_m", lambda d: d.paraxial.back_focal_length, "distance from the last mirror to the focus"
    ),
    Quantity("principal_distance_along_line_m", lambda d: d.principal_distance_line, "image position per angle"),
    Quantity("principal_distance_along_track_m", lambda d: d.principal_distance_track, "image position per angle"),
    Quantity("entrance_pupil_m", lambda d: d.entrance_pupil, "diameter of the beam along the axis that fills the stop"),
    Quantity("entrance_pupil_before_first_mirror_m", lambda d: d.paraxial.entrance_pupil, "positive toward the scene"),
    Quantity("exit_pupil_m", lambda d: _near(d.entrance_pupil * d.paraxial.exit_magnification), "diameter"),
    Quantity("exit_pupil_before_image_m", lambda d: _near(d.paraxial.exit_pupil), "distance; null at infinity"),
    Quantity("f_number", lambda d: d.paraxial.focal_length / d.entrance_pupil, "focal length over entrance pupil"),
    Quantity(
        "working_f_number", lambda d: 0.5 / d.round_aperture, "F-number of the circular beam with the same solid angle"
    ),
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
    Quantity(
        "detector_mm",
        lambda d: detector_size(d.spec) if d.spec.line.rows > 1 else None,
        "size of an area detector along the line and along the track",
        where_known=True,
    ),
    Quantity("pixel_arcsec", lambda d: d.spec.line.pitch / d.principal_distance_line, "angle of a pixel"),
    Quantity("nyquist_per_mm", lambda d: 0.5 / d.spec.line.pitch, "Nyquist frequency of the line's pixels"),
    Quantity(
        "cutoff_per_mm",
        lambda d: 1.0 / (d.spec.wavelength * d.working_f_number_line),
        "cut-off frequency of diffraction along the line",
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
        "angle between chief ray and image normal: in the middle, and the largest over the field",
    ),
    Quantity("length_m", lambda d: d.length, "along the parent axis between the outermost of mirrors and image"),
    Quantity(
        "obscuration", lambda d: d.obscuration.shares, "body of the camera -> largest fraction of a beam that it blocks"
    ),
    Quantity(
        "hole_radius_mm",
        lambda d: d.obscuration.holes,
        "mirror -> least radius of the central hole that the light needs, where the file specifies none",
    ),
)


def first_order_data(optics: CameraOptics) -> FirstOrderData:
    """Trace the rays of the first-order data of a camera in its state.

    Raises
    ------
    AimError, BeamMissedError
        Light does not pass.
    AfocalError
        The light of this state has no focus.
    """
    path, model, backend = optics.path, optics.model, optics.path.backend
    state = path.coloured(optics.state, optics.wavelength)
    placed = path.assembly.place([state])
    imaging, to_stop = (
        assemble(path.assembly, [f"{path.name}/{beams}"], [state], placed=placed) for beams in ("imaging", "to_stop")
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
