"""Rays of a camera by itself, from the scene to the image: for its layout, and for what stands in its own light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optics.geometry.aperture import Aperture, Circle, Rectangle
from optics.numerics import quadrature
from optics.numerics.backend import Backend
from optics.raytrace.assembly import Assembly, Element, Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import IMAGE, CameraModel, collimated, field_direction

EARLIER = 6.0
"""How far before its launch point light is looked at for what stands in it, metres."""

_FIELDS = tuple((x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0))
_RINGS = 6


@dataclass(frozen=True, eq=False)
class RayPaths:
    """Rays in the prescription frame.

    Attributes:
        names: what they meet, the image last, K.
        points: where they begin and what they meet, (1 + K, F, N, 3), metres.
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
        out[name] = _body(model, name, Circle(edge.radius + margin) if isinstance(edge, Circle) else edge)
    lines = [(spec.line.pixels * spec.line.pitch, 0.0)]
    lines += [(band.pixels * band.pitch, band.offset) for band in spec.bands.values()]
    half = 0.5 * max(length for length, _ in lines) + margin
    offsets = [offset for _, offset in lines]
    low, high = min(offsets) - margin, max(offsets) + margin
    centre = model.image_body.inverse().apply(model.focal_plane.translation)
    out[IMAGE] = Rectangle(half, 0.5 * (high - low), (float(centre[0]), float(centre[1] + 0.5 * (high + low))))
    return out


def _body(model: CameraModel, name: str, edge: Aperture) -> Aperture:
    """A surface with the outer edge and the hole that its file says, else with ``edge``."""
    given = model.edges.get(name, ())
    stated = [one.shape for one in given if not one.blocks and not one.turn and isinstance(one.shape, Aperture)]
    if stated:
        edge = stated[0]
    holes = [one.shape for one in given if one.blocks and isinstance(one.shape, Circle) and not any(one.shape.centre)]
    if holes and isinstance(edge, Circle) and not any(edge.centre) and edge.inner < holes[0].radius < edge.radius:
        edge = Circle(edge.radius, edge.centre, holes[0].radius)
    return edge


def obscuration(model: CameraModel, backend: Backend) -> Mapping[str, float]:
    """Share of a beam, of what edges leave of it, that the camera's own mirrors and line CCDs take before it is theirs:
    body -> the largest over the field. A body that takes nothing is not there.
    """
    nodes = quadrature.disk(_RINGS)
    paths = ray_paths(model, backend, _FIELDS, np.stack([nodes.x, nodes.y], axis=-1), EARLIER)
    edges, bare = obstacles(model), model.bare_assembly(apertures=False)
    blocked: dict[str, np.ndarray] = {}
    for k in range(len(paths.names)):
        ends = paths.names[max(k - 1, 0) : k + 1] if k else paths.names[:1]
        for body, edge in edges.items():
            if body not in ends:
                taken = _met(backend, bare, body, edge, paths.points[k], paths.points[k + 1])
                blocked[body] = blocked.get(body, np.zeros(taken.shape, bool)) | taken
    lit = _lit(model, bare, paths)
    shares = {body: float(np.max((taken & lit) @ nodes.share / (lit @ nodes.share))) for body, taken in blocked.items()}
    return {body: share for body, share in shares.items() if share > 0.0}


def _lit(model: CameraModel, bare: Assembly, paths: RayPaths) -> np.ndarray:
    """Which rays edges of surfaces let through, (F, N)."""
    lit = np.ones(paths.points.shape[1:3], dtype=bool)
    if not model.edges:
        return lit
    return lit & model.uncut(
        lambda name: bare.nominal_pose(name).inverse().apply(paths.points[1 + paths.names.index(name)])
    )


def _met(backend: Backend, bare: Assembly, body: str, edge: Aperture, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Which of the stretches start..end, (F, N, 3), meet the clear area of a body, (F, N)."""
    way = end - start
    length = np.linalg.norm(way, axis=-1)
    obstacle = Element(body, body, bare.elements[body].surface, Interaction.PASS, edge)
    system = assemble(bare.with_element(obstacle), [(body,)])
    rays = make_rays(backend, start.reshape(-1, 3), (way / length[..., None]).reshape(-1, 3))
    _, _, path, inside = trace(backend, system, rays).numpy()
    path, inside = path.reshape(length.shape), inside.reshape(length.shape)
    return np.asarray(inside & (path > _NEAR) & (path < length - _NEAR))


_NEAR = 1e-6
"""A ray meets a surface where it starts or ends: so close to it does not count, metres."""
