"""The three reference cameras are what their data sheets say: first order, image quality, no obscuration."""

import numpy as np
import pytest

from optics.geometry.tree import Motion, State
from optics.numerics import quadrature
from optics.raytrace.assembly import points_to_world
from optics.raytrace.first_order import LineChange, chief_rays, line_change
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from optics.waves.imaging import fit_part, path_to_sphere
from scenes.models.camera_model import IMAGE, CameraModel, collimated, field_direction
from tests.tiers import quick

NAMES = ["gf7", "monitor", "gf7_conic"]
NODES = quadrature.disk(12)
POINTS = np.concatenate([np.zeros((1, 2)), np.stack([NODES.x, NODES.y], axis=-1)])
SHARE = NODES.weight / np.pi


def bundle(backend, model: CameraModel, x: float, y: float) -> tuple[np.ndarray, ...]:
    """Position, direction and path from the incoming wavefront, at the image of a field; ray 0 is the chief ray."""
    bare = model.bare_assembly()
    direction = field_direction(model.spec, x, y)
    to_stop = assemble(bare, [model.mirrors[:2]])
    radius = model.apertures[model.spec.stop].bounds[1]
    launch = collimated(backend, to_stop, direction[None], radius * POINTS * (1 - 1e-9))[0]
    position, leaving, path, valid = (
        a[0] for a in trace(backend, assemble(bare, ["imaging"]), make_rays(backend, launch, direction)).numpy()
    )
    assert valid.all()
    return position, leaving, path + launch @ direction


def rms_spot(position: np.ndarray) -> float:
    rays = position[1:, :2]
    return float(np.sqrt(np.sum(SHARE * np.sum((rays - SHARE @ rays) ** 2, axis=-1))))


def wavefront_error(model: CameraModel, rays: tuple[np.ndarray, ...]) -> float:
    """Waves rms at the camera's wavelength, tilt removed."""
    radius = float(model.first_order.exit_pupil_distance[0])
    to_sphere = path_to_sphere(*rays, rays[0][:1], radius)
    return float(fit_part(NODES.x, NODES.y, NODES.weight, to_sphere[0] - to_sphere[1:]).rms) / model.spec.wavelength


def line_geometry(backend, model: CameraModel, states: list[State]) -> LineChange:
    """Principal distance over the line by chief rays from the image; the first state is the nominal one."""
    bare = model.bare_assembly(apertures=False)
    half = model.spec.focal_length * np.tan(model.spec.field.x)
    position = np.linspace(-half, half, 41)
    placed = bare.place(states)
    line = model.focal_plane.apply(np.stack([0 * position, position, 0 * position], axis=-1))
    line[:, 2] -= model.spec.image.z
    backward = model.mirrors[::-1]
    _, sight = chief_rays(
        backend,
        assemble(bare, [backward[:2]], states, placed=placed),
        assemble(bare, [backward], states, placed=placed),
        points_to_world(placed, IMAGE, line),
        -model.image_direction,
        np.array([1.0, 0.0, 0.0]),
    )
    return line_change(sight, position, model.camera_frame.rotation)


@pytest.mark.parametrize(
    ("name", "focal_length", "exact"),
    [("gf7", 5.52, 5.51216), ("monitor", 7.68, 7.72638), ("gf7_conic", 5.52, 5.52449)],
)
def test_principal_distance(backend, camera, name: str, focal_length: float, exact: float) -> None:
    """The focal length that a data sheet states is a round number; distortion over the line makes up to 0.6 %."""
    model = camera(name)
    nominal = line_geometry(backend, model, [{}, {}])
    assert nominal.nominal_distance == pytest.approx(exact, abs=1e-5)
    assert exact == pytest.approx(focal_length, rel=7e-3)
    assert nominal.d_f[0] == 0.0
    # F-number from the entrance pupil; the spec's numbers are the data sheet's
    assert model.spec.focal_length == focal_length
    assert model.spec.focal_length / model.spec.entrance_pupil == pytest.approx(
        {"monitor": 12.0}.get(name, 9.2), rel=1e-3
    )


@pytest.mark.second
@pytest.mark.parametrize(
    ("name", "low", "high"),
    quick(1, [("gf7", 0.0145, 0.0182), ("monitor", 0.0105, 0.0162), ("gf7_short", 0.0085, 0.0115)]),
)
def test_wavefront_error_along_the_line(backend, camera, name: str, low: float, high: float) -> None:
    model = camera(name)
    errors = [
        wavefront_error(model, bundle(backend, model, x * model.spec.field.x, 0.0)) for x in np.linspace(-1, 1, 9)
    ]
    assert low <= min(errors) <= max(errors) <= high
    np.testing.assert_allclose(errors, errors[::-1], rtol=1e-6)  # the prescription is symmetric
    assert model.spec.wavelength == 650e-9


@pytest.mark.parametrize(
    ("x", "y", "spot", "sheet"), [(0, 0, 0.852e-6, 0.81e-6), (1, 0, 0.904e-6, 0.89e-6), (1, 1, 1.312e-6, 1.31e-6)]
)
def test_spots_of_the_conic_camera(backend, camera, x: float, y: float, spot: float, sheet: float) -> None:
    """Exact pupil integrals; the sheet's come from a coarse grid of rays, which misses a little of the edge."""
    model = camera("gf7_conic")
    corners = [rms_spot(bundle(backend, model, x * model.spec.field.x, s * y * model.spec.field.y)[0]) for s in (1, -1)]
    assert max(corners) == pytest.approx(spot, abs=0.001e-6)
    assert spot == pytest.approx(sheet, rel=0.06)


@pytest.mark.second
def test_gf7_short_is_a_fifth_shorter_at_the_same_focal_length(backend, camera) -> None:
    """By clear apertures and the image along z; its worst wavefront error over the field is what its file states."""
    lengths, distances = {}, {}
    for name in ("gf7", "gf7_short"):
        model = camera(name)
        heights = [model.spec.image.z]
        for mirror, aperture in model.apertures.items():
            points = np.concatenate([aperture.outline(400), [aperture.centre]])
            heights += list(model.spec.mirrors[mirror].z + model.surfaces[mirror].sag(*points.T))
        lengths[name] = max(heights) - min(heights)
        distances[name] = line_geometry(backend, model, [{}, {}]).nominal_distance
    assert 1.5 < lengths["gf7_short"] <= 0.80 * lengths["gf7"]
    assert distances["gf7_short"] == pytest.approx(distances["gf7"], abs=2e-3)  # distortion along the line is another
    field = camera("gf7_short").spec.field
    errors = [
        wavefront_error(camera("gf7_short"), bundle(backend, camera("gf7_short"), x * field.x, y * field.y))
        for x, y in ((1.0, -1.0), (1.0, 1.0), (0.5, -1.0), (0.5, 1.0))
    ]
    assert max(errors) == pytest.approx(0.0231, abs=0.0003)


def test_a_piston_of_the_conic_cameras_focal_plane_changes_its_principal_distance(backend, camera) -> None:
    model = camera("gf7_conic")
    states: list[State] = [{}, {IMAGE: Motion(shift=(0, 0, -1e-3))}, {IMAGE: Motion(shift=(0, 0, 1e-3))}]
    change = line_geometry(backend, model, states)
    # away from M3, along the light: the image grows, by the image distance over that to the exit pupil
    np.testing.assert_allclose(np.abs(change.d_f), 0.33e-3, atol=0.006e-3)
    assert change.d_f[0] > 0.0 > change.d_f[1]
    ratio = change.nominal_distance / float(model.first_order.exit_pupil_distance[0])
    assert change.d_f[0] * 1e3 == pytest.approx(ratio, rel=0.02)
