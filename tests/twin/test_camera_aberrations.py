"""Seidel sums, ray fans, energies and ghosts of a camera, against the library, each other and analytic images."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.text import Annotation
from scipy.integrate import quad
from scipy.special import j1

import optics
from optics import Camera, OpticalSurface
from scenes.lens.prescription import first_camera
from scenes.specs.camera import CameraSpec
from scenes.specs.load import load_camera
from scenes.specs.resolved import CameraSetup
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from twin.camera.aberrations import IMAGE_FIELDS, RayFans, camera_ghosts, point_images, ray_fans, third_order
from twin.camera.camera_optics import CameraOptics
from twin.camera.camera_plots import images_figure
from twin.camera.camera_report import first_order_table
from twin.camera.camera_run import FAN_FIELDS, run_camera
from twin.camera.camera_view import layout_figure, section_lines
from twin.camera.first_order_data import FIRST_ORDER


@pytest.fixture(scope="module")
def gf7(backend) -> CameraOptics:
    return CameraOptics.alone(load_camera("gf7"), backend)


def test_third_order_of_a_camera_is_that_of_its_numbers(backend, gf7: CameraOptics) -> None:
    """Typed from the file; the field is the corner of the biased field that is farthest from the axis."""
    spec = gf7.model.spec
    z = [*(mirror.z for mirror in spec.mirrors.values()), spec.image.z]
    surfaces = []
    for mirror, gap in zip(spec.mirrors.values(), np.diff(z), strict=True):
        asphere = [mirror.aspheric.get(f"A{order}", 0.0) for order in (4, 6, 8)]
        surfaces.append(OpticalSurface(mirror.radius, gap, mirror.conic, "mirror", asphere=asphere))
    surfaces[1] = replace(surfaces[1], diameter=spec.stop_diameter)
    field = np.arctan(np.hypot(np.tan(spec.field.x), np.tan(spec.field_bias + spec.field.y)))
    expected = optics.seidel(Camera(surfaces, spec.wavelength, stop=1), field)
    found = third_order(gf7.model)
    assert found is not None
    np.testing.assert_allclose(found.sums.sums, expected.sums, rtol=1e-9, atol=1e-9 * np.abs(expected.sums).max())


def test_a_camera_with_a_tilted_mirror_has_no_third_order(backend) -> None:
    spec = load_camera("ritchey_chretien")
    mirror = spec.mirrors["M2"].model_copy(update={"rotate": (1e-4, 0.0, 0.0)})
    tilted = spec.model_copy(update={"mirrors": {**spec.mirrors, "M2": mirror}})
    assert third_order(CameraOptics.alone(spec, backend).model) is not None
    assert third_order(CameraOptics.alone(tilted, backend).model) is None


def test_rays_of_a_fan_are_the_slopes_of_its_path(gf7: CameraOptics) -> None:
    """A ray leaves the image of its chief ray by the slope of the path in direction cosines, to first order."""
    fans = ray_fans(gf7, FAN_FIELDS)
    stop = np.concatenate([[[0.0, 0.0]], np.stack([fans.pupil, 0.0 * fans.pupil], -1)])
    for f in range(len(FAN_FIELDS)):
        rays = gf7.rays(FAN_FIELDS[f : f + 1], stop)
        cosine = rays.direction[0, 1:, 1]
        slope = np.gradient(gf7.wavelength * fans.path[f, 0], cosine)[2:-2]
        transverse = fans.transverse[f, 0, 0, 2:-2]
        assert np.max(np.abs(np.abs(slope) - np.abs(transverse))) < 0.03 * np.max(np.abs(transverse)) + 2e-8


def test_fans_along_the_vanes_of_a_spider_are_drawn(backend) -> None:
    """As those of the same camera without edges; a fan beside the vanes keeps its gaps."""
    spec = load_camera("ritchey_chretien")
    whole = spec.mirrors["spider"].edges
    assert whole is not None
    bare = spec.model_copy(
        update={"mirrors": {name: face.model_copy(update={"edges": None}) for name, face in spec.mirrors.items()}}
    )

    def fans(camera: CameraSpec, turns: tuple[float, ...]) -> RayFans:
        edges = (whole[0], *(whole[1].model_copy(update={"rotation": np.radians(turn)}) for turn in turns))
        spider = camera.mirrors["spider"].model_copy(update={"edges": edges})
        mirrors = {**camera.mirrors, "spider": spider} if camera is spec else camera.mirrors
        return ray_fans(CameraOptics.alone(camera.model_copy(update={"mirrors": mirrors}), backend), [(0.0, 0.0)])

    free = fans(bare, ())
    for turns, drawn in (((0.0, 90.0, 180.0, 270.0), (True, True)), ((0.0, 180.0), (True, False))):
        found = fans(spec, turns)
        assert tuple(np.all(np.isfinite(found.path[0]), axis=-1)) == drawn
        seen = np.isfinite(found.path)
        np.testing.assert_allclose(found.path[seen], free.path[seen], atol=1e-9)


def test_point_images_are_as_wide_as_their_light(backend) -> None:
    """Images of a fast triplet fill a quarter of the picture and more, not a twentieth."""
    camera = validate(CameraSpec, parse_yaml(first_camera("triplet", "cooke", 0.05, 5.0, 650e-9)))
    run = run_camera(CameraSetup.model_construct(camera=camera), backend)
    assert run.images is not None
    radii = [radius or 0.0 for radius in run.images.radius_of(0.9)]
    panels = images_figure(run).axes[:4]
    assert {round(panel.get_xlim()[1], 6) for panel in panels} == {round(1.5e6 * max(radii), 6)}
    assert FIRST_ORDER(run.first_order)["airy_radius_um"] > 0.25e6 * 1.5 * max(radii)
    # the labels of its six faces stand clear of each other
    figure = layout_figure(run.optics.model, backend)
    for axes in figure.axes:
        boxes = [text.get_window_extent() for text in axes.texts if isinstance(text, Annotation) and text.get_text()]
        assert len(boxes) == 7
        assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    rows = {str(row[0]): str(row[1]) for row in first_order_table(run).rows}
    assert rows["entrance pupil"].endswith("behind L1_front")


def test_energy_of_a_ring_is_the_analytic_one(backend) -> None:
    """A paraboloid at F/40 with a central hole, on its axis: the image of an annular pupil."""
    share = 0.3

    def irradiance(v: float) -> float:
        amplitude = 2.0 * j1(v) / v - share**2 * 2.0 * j1(share * v) / (share * v)
        return float(v * amplitude**2)

    camera = Camera(
        [OpticalSurface(-16.0, -8.0, -1.0, "mirror", diameter=0.2, inner_diameter=share * 0.2)], wavelength=500e-9
    )
    step = 0.25 * camera.wavelength * camera.f_number
    image = optics.psf(camera, step, 129)
    radius = np.array([0.7, 1.5, 3.0, 6.0]) * camera.wavelength * camera.f_number
    whole = 2.0 * (1.0 - share**2)
    expected = [
        quad(irradiance, 1e-9, np.pi * r / (camera.wavelength * camera.f_number), limit=400)[0] / whole for r in radius
    ]
    assert optics.encircled_energy(image, step, radius) == pytest.approx(expected, abs=1e-4)


def test_energy_of_a_square_is_the_sum_of_its_samples() -> None:
    """Of an image that is fine in its samples: trapezoids over the square."""
    n, step = 801, 0.05
    x = step * (np.arange(n) - n // 2)
    image = np.exp(-0.5 * (x**2 + (x[:, None] - 0.4) ** 2) / 1.5**2) / (2.0 * np.pi * 1.5**2)
    inside = np.abs(x) <= 2.0 + 1e-9
    weight = np.where(inside, step, 0.0)
    weight[np.flatnonzero(inside)[[0, -1]]] *= 0.5
    (found,) = optics.ensquared_energy(image, step, 2.0, (0.0, 0.4))
    around = np.roll(image, -8, axis=0)
    assert found == pytest.approx(float(weight @ around @ weight), abs=1e-4)
    with pytest.raises(ValueError, match="half widths"):
        optics.ensquared_energy(image, step, 30.0)


@pytest.mark.parametrize("step", [0.5, 0.3])
def test_ensquared_energy_of_an_airy_pattern_is_its_integral(step: float) -> None:
    """Gauss-Legendre's rule over (2 J1(v) / v)^2; an F/100 paraboloid's working F-number differs by 6e-6."""
    camera = optics.Camera([optics.OpticalSurface(-40.0, -20.0, -1.0, "mirror", diameter=0.2)], 500e-9)
    unit, halves = 500e-9 * camera.f_number, np.array([0.25, 0.5, 1.0, 2.0, 4.0])
    node, weight = np.polynomial.legendre.leggauss(100)
    expected = []
    for half in halves:
        x, w = 0.5 * half * (node + 1.0), 0.5 * half * weight
        v = np.pi * np.hypot(x, x[:, None])
        expected.append(float(4.0 * w @ (np.pi / 4.0 * (2.0 * j1(v) / v) ** 2) @ w))
    found = optics.ensquared_energy(optics.psf(camera, step * unit, 65), step * unit, halves * unit)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_point_images_of_a_camera_have_the_energy_of_its_pupil(gf7: CameraOptics) -> None:
    images = point_images(gf7)
    assert [psf.field for psf in images.psfs] == list(IMAGE_FIELDS)
    assert np.all(np.diff(images.encircled, axis=1) > -1e-9)
    assert np.all(images.encircled <= images.limit + 1e-3)
    assert np.all(images.ensquared[:, 1:] > images.encircled[:, 1:])
    half, most = images.radius_of(0.5)[0], images.radius_of(0.8)[0]
    assert half is not None
    assert most is not None
    assert half < most
    assert images.radius_of(0.999) == [None, None]
    # a pixel of 7 um contains what the square of 3.5 um does; the curve is interpolated linearly between its points
    at = np.interp(3.5e-6, images.radius, images.ensquared[0])
    assert images.pixel[0] == pytest.approx(at, abs=4e-3)


WINDOWED = """
name: windowed
focal_length: 2 m
entrance_pupil: 100 mm
field: {{x: 0.2 deg, y: 0.1 deg}}
wavelength: 550 nm
stop: M1
mirrors:
  M1: {{z: 0 m, radius: -4 m, conic: -1 {mirror}}}
  W1: {{z: -1.8 m, radius: flat, light: refracts, index: 1.5, reflectance: 1 percent}}
  W2: {{z: -1.806 m, radius: flat, light: refracts, index: 1}}
image: {{z: -2.002 m, reflectance: 10 percent}}
line: {{pixels: 1000, pitch: 7 um}}
"""


def windowed(mirror: str = "") -> CameraSpec:
    return validate(CameraSpec, parse_yaml(WINDOWED.format(mirror=mirror), "windowed.yaml"))


def test_ghosts_of_a_camera_file_are_those_of_its_numbers(backend, gf7: CameraOptics) -> None:
    """Coating and detector of the file; the focal plane is at the paraxial focus, t (1 - 1 / n) behind the mirror's."""
    model = CameraOptics.alone(windowed(), backend).model
    surfaces = [
        OpticalSurface(-4.0, -1.8, -1.0, "mirror", diameter=0.1),
        OpticalSurface(thickness=-0.006, material=1.5),
        OpticalSurface(thickness=-0.196),
    ]
    camera = Camera(surfaces, 550e-9)
    names = {"s1": "W1", "s2": "W2", "image": "image"}
    field = (0.5 * model.spec.field.x, 0.0)
    expected = optics.ghosts(camera, field, detector=0.1, coatings={1: 0.01})
    found = camera_ghosts(model, backend, (0.5, 0.0))
    assert [(g.back, g.forward) for g in found] == [(names[g.back], names[g.forward]) for g in expected]
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.focus == pytest.approx(theirs.focus, rel=1e-6)
        assert ours.energy == pytest.approx(theirs.energy, rel=1e-9)
        assert (ours.diameter, ours.irradiance) == pytest.approx((theirs.diameter, theirs.irradiance), rel=1e-6)
    assert camera_ghosts(gf7.model, backend) == ()


def test_a_mirror_has_no_reflectance() -> None:
    with pytest.raises(InputError, match="a reflectance is that of a face of a lens"):
        windowed(", reflectance: 98 percent")


def test_the_hole_of_a_mirror_is_drawn_open(backend) -> None:
    """Within its blocking circle of 60 mm no point is drawn; without `holes` the whole section is."""
    model = CameraOptics.alone(load_camera("ritchey_chretien"), backend).model
    (hole,) = [edge.shape.radius for edge in model.edges["M1"] if edge.blocks]
    whole, drawn = (section_lines(model, 1, 401, holes)["M1"] for holes in (False, True))
    assert np.all(np.isfinite(whole))
    assert np.array_equal(np.isnan(drawn).any(axis=1), np.abs(whole[:, 1]) < hole)
    assert np.all(np.isfinite(section_lines(model, 1, 401, True)["M2"]))
