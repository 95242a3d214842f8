"""The camera that the design program made, gf7_short, in batoid: wavefront, focal length, envelope, free beams."""

import numpy as np
import pytest

from optics.geometry.aperture import Circle
from optics.numerics import quadrature
from scenes.models.camera_model import IMAGE, CameraModel, field_direction
from tests.oracles.peers import batoid_camera

batoid = pytest.importorskip("batoid")
pytestmark = pytest.mark.oracle

NODES = quadrature.disk(10)
LAUNCH = 9.0
"""Beams start so far before the origin, metres."""
FIELDS = [(x, y) for x in (-1.0, -0.5, 0.0, 0.5, 1.0) for y in (-1.0, 0.0, 1.0)]
WORST = 0.05


def rays_of(position: np.ndarray, direction: np.ndarray):
    columns = [
        np.ascontiguousarray(a[:, i]) for a in (position, np.broadcast_to(direction, position.shape)) for i in range(3)
    ]
    return batoid.RayVector(*columns, np.zeros(len(position)), np.full(len(position), 650e-9))


def stations(model: CameraModel, position: np.ndarray, direction: np.ndarray) -> tuple[list[np.ndarray], object]:
    """Launch points, hits on each mirror and the image, all in the prescription frame; the rays at the image."""
    peer, rays = batoid_camera(model), rays_of(position, direction)
    out = [position]
    for name in (*model.mirrors, IMAGE):
        item = peer.itemDict[f"{model.spec.name}.{name}"]
        item.trace(rays)
        assert not rays.failed.any()
        out.append(batoid.CoordTransform(rays.coordSys, batoid.globalCoordSys).applyForwardArray(*rays.r.T).T)
    return [np.reshape(p, (-1, 3)) for p in out], rays


def beam(model: CameraModel, x: float, y: float, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Launch points whose rays meet the stop at given points (N, 2), found by Newton's method in batoid; direction."""
    direction = field_direction(model.spec, x * model.spec.field.x, y * model.spec.field.y)
    e1 = np.cross([0.0, 1.0, 0.0], direction)
    e1 /= np.linalg.norm(e1)
    axes = np.stack([e1, np.cross(direction, e1)])
    index = 1 + model.mirrors.index(model.spec.stop)

    def hit(q: np.ndarray) -> np.ndarray:
        return stations(model, -LAUNCH * direction + q @ axes, direction)[0][index][:, :2]

    q = np.tile(stations_start(model, direction, axes), (len(stop), 1))
    for _ in range(12):
        here = hit(q)
        if np.max(np.abs(stop - here)) < 1e-11:
            return -LAUNCH * direction + q @ axes, direction
        slope = np.stack([(hit(q + 1e-6 * np.eye(2)[k]) - here) / 1e-6 for k in range(2)], axis=-1)
        q = q + np.linalg.solve(slope, (stop - here)[..., None])[..., 0]
    raise AssertionError("not aimed")


def stations_start(model: CameraModel, direction: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Where the beam's middle crosses its launch plane: through the middle of the first mirror."""
    x, y = model.apertures[model.mirrors[0]].centre
    return axes @ (np.array([x, y, 0.0]) - direction * (direction @ [x, y, 0.0]))


@pytest.fixture(scope="module")
def short(camera) -> CameraModel:
    return camera("gf7_short")


def stop_points(model: CameraModel, rim: int = 48) -> np.ndarray:
    """The middle of the stop, nodes of a quadrature, the rim; (N, 2)."""
    angle = 2.0 * np.pi * np.arange(rim) / rim
    nodes = np.stack([NODES.x, NODES.y], axis=-1)
    points = np.concatenate([np.zeros((1, 2)), nodes, np.stack([np.cos(angle), np.sin(angle)], axis=-1)])
    return model.apertures[model.spec.stop].radius * points


@pytest.fixture(scope="module")
def bundles(short):
    """For each field the stations and the rays at the image."""
    out = {}
    for field in FIELDS:
        launch, direction = beam(short, *field, stop_points(short))
        out[field] = (*stations(short, launch, direction), launch @ direction)
    return out


def test_wavefront_error_on_and_off_the_line(short, bundles) -> None:
    """Paths on plane waves through the chief ray's image, less piston and tilt, over the pupil's exact quadrature."""
    errors = []
    own = slice(1, 1 + NODES.count)
    root = np.sqrt(NODES.share)
    basis = np.stack([np.ones(NODES.count), NODES.x, NODES.y], axis=-1) * root[:, None]
    for _, rays, phase in bundles.values():
        path = rays.t + phase
        eikonal = path - np.sum(rays.v * (rays.r - rays.r[0]), axis=-1)
        value = (eikonal[own] - path[0]) * root
        rest = value - basis @ np.linalg.lstsq(basis, value, rcond=None)[0]
        errors.append(float(np.linalg.norm(rest)) / 650e-9)
    assert len(errors) == 15
    assert max(errors) < WORST
    # what the design program says of its result
    assert max(errors) == pytest.approx(0.0231, abs=0.0003)
    # and what its file says: on the line it is better than gf7, whose design errors there are 0.0145 to 0.0182
    assert errors[1::3] == pytest.approx([0.0113, 0.0087, 0.0093, 0.0087, 0.0113], abs=0.0002)
    # mirror symmetric fields
    np.testing.assert_allclose(errors[:6], [*errors[12:15], *errors[9:12]], rtol=1e-4)


def test_chief_rays_are_not_telecentric(bundles) -> None:
    """0.85 deg in the plane of symmetry, as the file says; they spread by 0.18 deg to the line's ends."""
    (_, middle, _), (_, end, _) = bundles[0.0, 0.0], bundles[1.0, 0.0]
    slopes = [np.degrees(np.arctan(rays.v[0, :2] / rays.v[0, 2])) for rays in (middle, end)]
    assert abs(slopes[0][1]) == pytest.approx(0.85, abs=0.01)
    assert abs(slopes[0][0]) < 1e-6
    assert abs(slopes[1][0]) == pytest.approx(0.18, abs=0.01)


def test_focal_length_is_that_of_gf7(camera, bundles, short) -> None:
    """Principal distance over the line, by the chief rays: f = sum(L tan W) / sum(tan^2 W)."""

    def distance(model: CameraModel, points: dict[float, float]) -> float:
        tangent = {x: np.tan(x * model.spec.field.x) * np.cos(model.spec.field_bias) for x in points}
        return abs(sum(points[x] * tangent[x] for x in points)) / sum(t**2 for t in tangent.values())

    chief = {x: bundles[x, 0.0][0][-1][0, 0] for x in (-1.0, -0.5, 0.5, 1.0)}
    gf7 = camera("gf7")
    old = {x: stations(gf7, *beam(gf7, x, 0.0, np.zeros((1, 2))))[0][-1][0, 0] for x in chief}
    assert distance(short, chief) == pytest.approx(distance(gf7, old), abs=5e-6)
    assert distance(short, chief) == pytest.approx(5.52, rel=2e-3)
    assert short.spec.entrance_pupil == gf7.spec.entrance_pupil


def extent(model: CameraModel) -> float:
    """Along z, from the hindmost to the foremost point of all clear apertures and the image, metres."""
    heights = [model.spec.image.z]
    for name, aperture in model.apertures.items():
        x, y = aperture.outline(400).T
        heights += list(model.spec.mirrors[name].z + model.surfaces[name].sag(x, y))
        heights.append(model.spec.mirrors[name].z + float(model.surfaces[name].sag(*aperture.centre)))
    return max(heights) - min(heights)


def test_a_fifth_shorter(camera, short) -> None:
    assert extent(short) <= 0.80 * extent(camera("gf7"))
    assert extent(short) > 1.5  # mirrors do stand apart


def test_nothing_stands_in_the_light(short, bundles) -> None:
    """Every stretch of every ray against the mirrors that it does not meet, with their margins, and the focal plane."""
    spec, peer, tested = short.spec, batoid_camera(short), 0
    names = ("scene", *short.mirrors, IMAGE)
    half = spec.focal_length * np.tan([spec.field.x, spec.field.y]) + spec.edge_margin
    for points, _, _ in bundles.values():
        for k in range(len(points) - 1):
            for name in names[1:]:
                if name in (names[k], names[k + 1]):
                    continue
                way = points[k + 1] - points[k]
                reach = np.linalg.norm(way, axis=-1)
                rays = rays_of(points[k], way / reach[:, None])
                item = peer.itemDict[f"{spec.name}.{name}"]
                batoid.intersect(item.surface, rays, item.coordSys)
                local = rays.r
                if name == IMAGE:
                    inside = np.all(np.abs(local[:, :2] - short.focal_plane.translation[:2]) <= half, axis=-1)
                elif isinstance(short.apertures[name], Circle):
                    inside = np.hypot(*local[:, :2].T) <= short.apertures[name].radius + spec.edge_margin
                else:
                    inside = short.apertures[name].contains(*local[:, :2].T)
                within = (rays.t > 1e-6) & (rays.t < reach - 1e-6) & ~rays.failed
                assert not np.any(inside & within), f"{name} blocks the way from {names[k]} to {names[k + 1]}"
                tested += len(reach)
    assert tested > 40_000
