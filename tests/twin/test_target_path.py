"""Chief rays from directions to the focal plane and back, the senses of the axes, and the pupils."""

from dataclasses import replace

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.raytrace.assembly import points_to_world
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.models.camera_model import ROOT, build_camera_under_test, camera_alone
from scenes.specs.camera import BandSpec
from scenes.specs.camera_tests import CameraUnderTestSpec, CollimatorSpec
from scenes.specs.load import load_camera, load_detector
from tests.scenes.lens.colour_cameras import colour_camera
from twin.camera.camera_optics import CameraOptics
from twin.camera.colour import spectral_mtfs
from twin.sensors.line_ccd import LineCcd
from twin.targets.band_light import WORST_CHANGE
from twin.targets.target_images import ALONG, TargetCamera
from twin.targets.target_measurement import CURVE, read_edge
from twin.targets.target_path import TargetPath

FOCAL_PLANE = f"{ROOT}/focal_plane"
PLACES = np.array([[0.0, 0.0], [0.1, 0.0], [-0.1, 0.01], [0.05, -0.01], [-0.03, 0.004]])
"""(along, across), metres."""
LONG = 20.0


@pytest.fixture(scope="module")
def path(backend) -> TargetPath:
    test = build_camera_under_test(CameraUnderTestSpec(camera="gf7"), load_camera("gf7"), backend)
    collimator = CollimatorSpec(focal_length="20 m", aperture="0.8 m").model  # type: ignore[arg-type]
    return TargetPath(test.assembly, ROOT, ROOT, test.model, backend, collimator)


def test_there_and_back(path) -> None:
    """Both ways are traced to 1e-12 m on the stop; the image is that much nearer."""
    np.testing.assert_allclose(path.places({}, path.directions(PLACES)), PLACES, rtol=0.0, atol=1e-12)


def test_sense_of_the_axes(path) -> None:
    """An image at +Y' (+X') is made by light that travels toward +Y (+X) of the camera, whose Z looks at the scene: the
    target stands at -Y (-X). Both by one focal length.
    """
    middle, along, across = path.directions(np.array([[0.0, 0.0], [1e-3, 0.0], [0.0, 1e-3]]))
    axes = path.assembly.nominal_pose(ROOT).rotation
    np.testing.assert_allclose(middle, -axes[:, 2], rtol=0.0, atol=1e-12)
    f_along, f_across = np.abs(np.diag(path.model.first_order.scale[0]))
    assert (along - middle) @ axes[:, 1] == pytest.approx(1e-3 / f_along, rel=1e-3)
    assert (across - middle) @ axes[:, 0] == pytest.approx(1e-3 / f_across, rel=1e-3)
    # the focal-plane frame has its Y along the camera's, and X nearly
    place = path.assembly.nominal_pose(FOCAL_PLANE).rotation
    assert place[:, 1] @ axes[:, 1] == pytest.approx(1.0, abs=1e-12)
    assert place[:, 0] @ axes[:, 0] > 0.99


def test_first_order_of_the_map(path) -> None:
    """Derivative of the chief rays' map in the middle against forward-mode derivatives of the trace at the stop's
    centre; upright in the target's coordinates.
    """
    local = path.local_map({}, path.directions(PLACES[:1])[0], 0.5e-3)
    scale = path.model.first_order.scale[0]
    np.testing.assert_allclose(np.diag(local.jacobian) * LONG, np.abs(np.diag(scale)), rtol=1e-9)
    np.testing.assert_allclose(local.jacobian[[0, 1], [1, 0]] * LONG, 0.0, atol=1e-8)


@pytest.mark.parametrize("number", range(len(PLACES)))
def test_local_map_between_its_points(path, number: int) -> None:
    """Chief rays of 40 random directions inside the map's reach, in a bent camera."""
    state = {f"{ROOT}/M3": Motion(rotate=(3e-5, -2e-5, 0.0), figure={7: 50e-9})}
    direction = path.directions(PLACES)[number]
    reach = 2e-3
    local = path.local_map(state, direction, reach)
    points = np.random.default_rng(number).uniform(-reach, reach, (40, 2))
    axes = path.assembly.nominal_pose(ROOT).rotation
    first = axes[:, 1] - direction * (axes[:, 1] @ direction)
    first = first / np.linalg.norm(first)
    second = np.cross(direction, first)
    assert second @ axes[:, 0] > 0.99
    turned = direction + (points[:, :1] * first + points[:, 1:] * second) / LONG
    turned = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
    places = path.places(state, np.concatenate([direction[None], turned]))
    np.testing.assert_allclose(local(points), places[1:] - places[0], rtol=0.0, atol=1e-9)
    assert local.residual < 1e-9


def test_pupils_head_where_the_chief_rays_go(path) -> None:
    """Mean direction of the pupil, (Y', X'), against a chief ray traced through the stop's centre; they differ by the
    pupil's coma, 1% of its radius.
    """
    directions = path.directions(PLACES)
    pupils = path.pupils({}, directions, PLACES)
    systems = assemble(path.assembly, [f"{ROOT}/image_to_stop"])
    placed = path.assembly.place()
    local = np.stack([PLACES[:, 1], PLACES[:, 0], np.zeros(len(PLACES))], axis=-1)
    start = points_to_world(placed, FOCAL_PLANE, local).real[0]
    frame = path.assembly.nominal_pose(FOCAL_PLANE).rotation
    radius = np.linalg.norm(pupils[0].axes, ord=2)
    checked = 0
    for pupil, point in zip(pupils, start.reshape(-1, 3), strict=True):
        v, u = pupil.centre
        back = -(frame @ np.array([u, v, np.sqrt(1.0 - u * u - v * v)]))
        hit, _, _, valid = trace(path.backend, systems, make_rays(path.backend, point[None], back[None])).numpy()
        assert valid.all()
        assert np.linalg.norm(hit[0, 0, :2]) < 0.01 * path.stop.radius
        checked += 1
    assert checked == len(PLACES)
    assert 0.05 < radius < 0.06


def test_a_focal_plane_that_moves_sideways(path) -> None:
    """Places are on the focal plane, which has moved: they go the other way, and the pupils do not change."""
    shift = (0.2e-3, -0.3e-3, 0.0)
    directions = path.directions(PLACES)
    moved = path.places({FOCAL_PLANE: Motion(shift=shift)}, directions)
    np.testing.assert_allclose(moved - PLACES, [[-shift[1], -shift[0]]] * len(PLACES), rtol=0.0, atol=1e-12)


def test_a_focal_plane_that_moves_downstream(path) -> None:
    """Places follow the chief rays' slope, which is below 1e-3 in this nearly telecentric camera."""
    directions = path.directions(PLACES)
    moved = path.places({FOCAL_PLANE: Motion(shift=(0.0, 0.0, 1e-3))}, directions)
    slope = (moved - PLACES) / 1e-3
    centres = np.array([pupil.centre for pupil in path.pupils({}, directions, PLACES)])
    # coma moves the pupil's middle off the chief ray, here by 3e-5, which is 0.06% of its radius
    np.testing.assert_allclose(slope, centres, rtol=0.0, atol=5e-5)
    assert np.all(np.abs(slope) < 2e-3)


REGION = 112


def target_camera(backend, spectrum: list[str]) -> tuple[TargetCamera, CameraOptics]:
    band = BandSpec.model_validate({"pixels": 2000, "pitch": "7 um", "spectrum": spectrum, "detector": "gf7_pan"})
    optics = CameraOptics.alone(colour_camera("achromat"), backend)
    path = TargetPath(camera_alone(optics.model), ROOT, ROOT, optics.model, backend)
    return TargetCamera(path, LineCcd.from_specs(band, load_detector("gf7_pan")), REGION), optics


@pytest.fixture(scope="module")
def seen(backend):
    return target_camera(backend, ["440 nm", "680 nm"])


@pytest.mark.second
def test_a_view_has_the_mtf_over_its_light(seen) -> None:
    """Two ways to it: of the camera at its fields, and of the place on the line that images the target."""
    camera, optics = seen
    place = camera.views({})["centre"]
    frequency = np.linspace(0.0, 1.0, 6)[1:] * place.band.nyquist
    (told,) = spectral_mtfs(optics, [(0.0, 0.0)], place.band.spectrum, frequency)
    for axis in range(2):
        asked = frequency[:, None] * np.eye(2)[axis]
        found = np.abs(place.light.transfer(asked, np.zeros(1))[0])
        # both stop at a rule of wavelengths by which no MTF changes by more than this
        np.testing.assert_allclose(found, told.values[axis], atol=2.0 * WORST_CHANGE)
    # that of the design wavelength alone is another one
    alone = optics.mtf((0.0, 0.0), frequency).values[0]
    assert np.max(np.abs(alone - told.values[0])) > 0.05


@pytest.mark.second
def test_images_take_it_from_tables(seen) -> None:
    """Of every wavelength one, right to 1e-5; two are enough to see their shares."""
    light = seen[0].views({})["centre"].light
    few = replace(light, pupils=light.pupils[::8], wavelengths=light.wavelengths[::8], weights=light.weights[::8])
    tilted = np.array([[0.3, 0.4], [-0.2, 0.5], [0.7, 0.1]]) * seen[0].ccd.band.nyquist
    np.testing.assert_allclose(few.table()(*tilted.T), few.transfer(tilted, np.zeros(1))[0], atol=2e-5)


@pytest.mark.second
def test_a_knife_edge_measures_it(seen) -> None:
    """The MTF that a noise-free image of the edge gives is that of the view."""
    place = seen[0].views({})["left"]
    imager = place.edge(ALONG, np.radians(5.0))
    mean = place.edge_image(imager) * 1000.0
    reading = read_edge(place, ALONG, imager.optics.normal, mean, 1)
    assert reading.measured is not None
    # what is asked of a knife edge against the traced pupil, see test_target_images
    below = CURVE <= 0.5
    np.testing.assert_allclose(reading.measured.mtf[below], reading.true[below], atol=0.01)


def test_light_of_one_wavelength_has_its_own_rays(backend) -> None:
    """Also where it is not the design's."""
    camera, optics = target_camera(backend, ["486.1327 nm", "486.1327 nm"])
    place = camera.views({})["centre"]
    frequency = np.array([0.5, 1.0]) * place.band.nyquist
    told = optics.at(486.1327e-9).mtf((0.0, 0.0), frequency).values[0]
    found = np.abs(place.light.transfer(frequency[:, None] * np.eye(2)[0], np.zeros(1))[0])
    np.testing.assert_allclose(found, told, atol=1e-6)
