"""Looks of line cameras: ideal projections against the collinearity equation, traced lines against the trace."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optics.geometry.tree import Motion
from optics.raytrace.assembly import points_to_world
from optics.raytrace.first_order import chief_rays
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.specs.orbit.setup import load_three_line_camera
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import dump_yaml, parse_yaml
from twin.monitor.truth import LineSight
from twin.orbit.flight.line_camera import (
    LinePiece,
    along_track_angle,
    dihedral_angle,
    line_cameras,
    line_normal,
    look_angle,
    traced_line_cameras,
)

ARCSEC = math.radians(1.0 / 3600.0)
TH1 = load_three_line_camera("th1")


def payload(**lines) -> ThreeLineCameraSpec:
    """Lines of 650 mm, otherwise as given in YAML."""
    text = {name: {"principal_distance": "650 mm", **line} for name, line in lines.items()}
    return ThreeLineCameraSpec.model_validate({"name": "own", "pixels": 12000, "pitch": "6.5 um", "lines": text})


def test_a_wrong_file_is_told_by_line() -> None:
    with pytest.raises(InputError, match="th1"):
        load_three_line_camera("th2")
    text = dump_yaml({**TH1.plain(), "lines": {}})
    with pytest.raises(InputError, match="no lines"):
        validate(ThreeLineCameraSpec, parse_yaml(text))
    text = dump_yaml(TH1.plain()).replace("650 mm", "650 s", 1)
    with pytest.raises(InputError, match="length"):
        validate(ThreeLineCameraSpec, parse_yaml(text))


@pytest.mark.parametrize("name", list(TH1.lines))
def test_ideal_lines_obey_collinearity(name: str) -> None:
    """The look, projected through the lens onto the real image plane, and the image corrected for distortion agree."""
    line, camera = TH1.lines[name], line_cameras(TH1)[name]
    last, pitch = TH1.pixels_of(name) - 1.0, TH1.pitch_of(name)
    pixel = np.array([-0.5, 0.0, 17.3, 0.5 * last, 0.75 * last, last + 0.5])
    mounted = Rotation.from_euler("Y", line.look) * Rotation.from_rotvec(line.rotate)
    x, y, z = mounted.inv().apply(camera.look(pixel)).T
    assert np.all(z > 0.99)
    place = np.stack([np.zeros_like(pixel), (pixel - 0.5 * last) * pitch], axis=-1) - np.array(line.principal_point)
    corrected = place * (1.0 + line.k1 * np.sum(place**2, axis=-1, keepdims=True))
    # rounding of a length of 0.65 to 1.6 m
    np.testing.assert_allclose(
        -line.principal_distance * np.stack([x / z, y / z], axis=-1), corrected, rtol=0, atol=3e-15
    )


def test_first_pixel_sees_the_right_and_forward_is_ahead() -> None:
    cameras = line_cameras(TH1)
    for camera in cameras.values():
        ends = camera.look(np.array([0.0, camera.pixels - 1.0]))
        assert ends[0, 1] > 0.05
        assert ends[1, 1] < -0.05
    assert cameras["forward"].look(np.array([6000.0]))[0, 0] > 0.42
    assert cameras["backward"].look(np.array([6000.0]))[0, 0] < -0.42


def test_fifth_order_distortion_and_slope() -> None:
    camera = line_cameras(payload(nadir={"look": "3 deg", "k1": "0.2 1/m^2", "k2": "40 1/m^4"}))["nadir"]
    pixel = np.array([0.0, 3000.0, 5999.5, 11500.0])
    y = (pixel - 5999.5) * 6.5e-6
    tangent = y * (1 + 0.2 * y**2 + 40 * y**4) / 0.65
    x, yy, z = Rotation.from_euler("Y", -3, degrees=True).apply(camera.look(pixel)).T
    np.testing.assert_allclose(-yy / z, tangent, rtol=0, atol=1e-15)
    np.testing.assert_allclose(x, 0.0, atol=1e-15)
    look, slope = camera.look_and_slope(pixel)
    difference = (camera.look(pixel + 0.25) - camera.look(pixel - 0.25)) / 0.5
    np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-14)  # rounding of unit vectors over half a pixel
    np.testing.assert_allclose(np.sum(look * slope, axis=-1), 0.0, atol=1e-19)


def test_looks_of_chips_have_the_slopes_of_their_own_polynomials() -> None:
    """Two halves that bend differently: a look's derivative, and each half's look at its own pixels."""
    first, second = (
        np.array([[0.0, y, 1.0], [0.0, -0.02, 0.0], [x, 1e-3, 0.0]]) for x, y in ((1e-3, 0.02), (-2e-3, -0.02))
    )
    whole = line_cameras(TH1)["nadir"]
    chips = replace(whole, pieces=(LinePiece(0, 5999, first), LinePiece(6000, 11999, second)))
    pixel = np.array([100.0, 3000.0, 6100.0, 11000.0])
    look, slope = chips.look_and_slope(pixel)
    difference = (chips.look(pixel + 0.25) - chips.look(pixel - 0.25)) / 0.5
    np.testing.assert_allclose(slope, difference, rtol=0, atol=1e-14)
    for k, terms in enumerate((first, first, second, second)):
        at = (pixel[k] - (0.0 if k < 2 else 6000.0) + 0.5) / 3000.0 - 1.0
        vector = terms[0] + terms[1] * at + terms[2] * (2.0 * at**2 - 1.0)
        np.testing.assert_allclose(look[k], vector / np.linalg.norm(vector), rtol=0, atol=1e-15)


@pytest.mark.parametrize("pixel", [-0.51, 11999.51, np.nan])
def test_no_look_beyond_the_line(pixel: float) -> None:
    camera = line_cameras(TH1)["nadir"]
    for function in (camera.look, camera.look_and_slope, camera.origin):
        with pytest.raises(ValueError, match="outside the line 'nadir'"):
            function(np.array([5.0, pixel]))


PERTURBED = {
    "base/forward/M1": Motion(rotate=(8 * ARCSEC, -5 * ARCSEC, 0.0), figure={7: 40e-9, 11: 30e-9}),
    "base/forward/focal_plane": Motion(rotate=(0.0, 0.0, 60 * ARCSEC), shift=(20e-6, -35e-6, 10e-6)),
    "base/backward/M3": Motion(figure={5: 50e-9, 16: 20e-9}),
}


@pytest.mark.second
@pytest.mark.parametrize("state", [{}, PERTURBED], ids=["nominal", "perturbed"])
def test_traced_lines_between_the_traced_points(gf7_pair, backend, state) -> None:
    """Pixels that were not traced: directions below 1e-6 pixel; and light sent in along the ray arrives at the pixel,
    which tests the ray's origin as well.
    """
    cameras = traced_line_cameras(gf7_pair, backend, state)
    assembly = gf7_pair.assembly
    placed = assembly.place([state])
    rng = np.random.default_rng(4)
    sight = LineSight(gf7_pair, backend).trace([state])[:, 0]
    for ends, (name, camera) in zip(sight, cameras.items(), strict=True):
        # what tells the truth of a camera sees the whole line, too
        edges = camera.look(np.array([-0.5, camera.pixels - 0.5]))
        np.testing.assert_allclose(ends[[0, -1]], edges, rtol=0, atol=1e-12)
        pixel = np.concatenate([[-0.5, 0.0, camera.pixels - 0.5], rng.uniform(-0.5, camera.pixels - 0.5, 120)])
        y = (pixel - 0.5 * (camera.pixels - 1)) * gf7_pair.cameras[name].spec.line.pitch
        line = np.stack([0 * y, y, 0 * y], axis=-1)
        image = points_to_world(placed, f"base/{name}/focal_plane/line", line)
        batches = [
            assemble(assembly, [f"{name}/{way}"], [state], placed=placed)
            for way in ("image_to_stop", "image_to_object")
        ]
        guess = gf7_pair.toward_optics(placed, name)[:, None]
        traced = chief_rays(backend, *batches, image, guess, np.array([0.0, 1.0, 0.0]))[1][0]
        look, slope = camera.look_and_slope(pixel)
        error = np.linalg.norm(look - traced, axis=-1) / np.linalg.norm(slope, axis=-1)
        assert np.max(error) < 1e-6
        # back through the camera; 5 m before its origin no mirror is in the way of a sequential trace
        imaging = assemble(assembly, [f"{name}/imaging"], [state], placed=placed)
        start = camera.origin(pixel) + 5.0 * look
        hit = trace(backend, imaging, make_rays(backend, start, -look)).numpy()[0][0]
        np.testing.assert_allclose(hit[:, 1], y, rtol=0, atol=1e-6 * 7e-6)
        np.testing.assert_allclose(hit[:, 0], 0.0, rtol=0, atol=1e-6 * 7e-6)


def test_turns_of_a_camera_change_the_angles_of_looks_and_of_planes() -> None:
    """At looks 0 and a: turned by g about its look, the planes have cos = cos a cos g exactly; rolled by w about its
    own X, a camera keeps its plane and the looks have cos = cos a cos w; along the track the turn about Y counts,
    with its sign, whatever the roll and the turn about the look: to second order, the roll squared times the angle.
    """
    a, g, w = math.radians(25.0), math.radians(2.0), math.radians(1.5)
    nadir, turned, rolled, ahead = line_cameras(
        payload(
            nadir={"look": "0 deg"},
            turned={"look": "25 deg", "rotate": ["0 deg", "0 deg", "2 deg"]},
            rolled={"look": "-25 deg", "rotate": ["1.5 deg", "0 deg", "0 deg"]},
            ahead={"look": "2 deg", "rotate": ["5 arcmin", "0 deg", "10 arcmin"]},
        )
    ).values()
    assert look_angle(turned, nadir) == pytest.approx(a, abs=1e-15)
    assert dihedral_angle(turned, nadir) == pytest.approx(math.acos(math.cos(a) * math.cos(g)), abs=1e-13)
    assert dihedral_angle(nadir, turned) == pytest.approx(dihedral_angle(turned, nadir), abs=1e-13)
    assert dihedral_angle(nadir, rolled) == pytest.approx(a, abs=1e-13)
    assert look_angle(nadir, rolled) == pytest.approx(math.acos(math.cos(a) * math.cos(w)), abs=1e-14)
    assert along_track_angle(ahead, nadir) == pytest.approx(g, rel=5e-6)
    assert along_track_angle(nadir, ahead) == -along_track_angle(ahead, nadir)
    assert look_angle(ahead, nadir) > 1.0008 * g
    assert dihedral_angle(ahead, nadir) > 1.003 * g


def test_normals_point_forward_and_a_bent_line_has_a_best_plane() -> None:
    """A principal point beside the line bends its cone; the best plane then lies amid the looks."""
    cameras = line_cameras(payload(nadir={"look": "0 deg", "principal_point": ["0 um", "0 um"]}, bent={"look": "0 deg",
                           "principal_point": ["2 mm", "0 mm"], "k1": "1 1/m^2"}))  # fmt: skip
    np.testing.assert_allclose(line_normal(cameras["nadir"]), [1.0, 0.0, 0.0], atol=1e-15)
    normal, looks = line_normal(cameras["bent"]), cameras["bent"].look(np.linspace(0.0, 11999.0, 1001))
    residual = looks @ normal
    assert normal[0] > 0.0
    assert np.ptp(residual) > 1e-7
    rng = np.random.default_rng(3)
    for other in normal + 1e-6 * rng.normal(size=(20, 3)):
        assert np.sum((looks @ (other / np.linalg.norm(other))) ** 2) > np.sum(residual**2)
