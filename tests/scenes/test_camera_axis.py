"""The axis of a camera: the stop that its entrance pupil asks for, a stated stop, and systems without focus."""

from __future__ import annotations

import numpy as np
import pytest
from rich.console import Console
from typer import Exit

from optics.geometry.tree import Motion
from optics.numerics.array_math import UnphysicalError
from optics.raytrace.aim import AimError
from scenes.models.camera_model import AfocalError, CameraModel, check_entrance_pupil, derive_camera
from scenes.specs.camera import CameraSpec
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.own_trace import OwnCamera
from twin.camera.camera_optics import CameraOptics
from twin.camera.first_order_data import FIRST_ORDER, first_order_data
from twin.framework import cli

PETZVAL = """
  A: {z: 0 m, radius: 61 mm, light: refracts, index: 1.52}
  B: {z: 9 mm, radius: -240 mm, light: refracts, index: 1}
  STOP: {z: 30 mm, radius: flat, light: passes}
  C: {z: 46 mm, radius: 48 mm, light: refracts, index: 1.52}
  D: {z: 52 mm, radius: -160 mm, light: refracts, index: 1}
"""
CASSEGRAIN = """
  M1: {z: 0 m, radius: -3 m, conic: -1}
  M2: {z: -1.1 m, radius: -1 m, conic: -2.6}
"""


def text_of(
    mirrors: str, stop: str, focal: float, pupil: str, image: float, more: str = "", bias: str = "0 deg"
) -> str:
    return f"""
name: drawn
focal_length: {focal!r} m
entrance_pupil: {pupil}
field_bias: {bias}
field: {{x: 0.05 deg, y: 0.05 deg}}
wavelength: 600 nm
stop: {stop}
{more}
mirrors:{mirrors}
image: {{z: {image!r} m}}
line: {{pixels: 20, pitch: 7 um}}
edge_margin: 1 mm
"""


def camera(backend, *given: object, stated: bool = True, **named: object) -> CameraModel:
    return derive_camera(validate(CameraSpec, parse_yaml(text_of(*given, **named))), backend, stated)  # type: ignore[arg-type]


def own_radius(model: CameraModel, pupil: float) -> float:
    """Where the marginal ray of a beam along the axis meets the stop, by NumPy alone."""
    ray = OwnCamera(model.spec).trace(np.array([[0.0, 0.5 * pupil, -2.0]]), np.array([0.0, 0.0, 1.0]))
    return float(np.hypot(*ray.stop[0]))


@pytest.mark.second
def test_the_stop_is_as_large_as_the_marginal_ray_makes_it(backend) -> None:
    """Behind power that is not where a paraxial ray goes: the beam before the first surface has the stated width."""
    model = camera(backend, PETZVAL, "STOP", 0.055, "26 mm", 0.0797)
    radius = model.apertures["STOP"].bounds[1]
    assert radius == pytest.approx(own_radius(model, 0.026), rel=1e-9)
    near = own_radius(model, 1e-6) * 0.026 / 1e-6
    assert abs(radius / near - 1.0) > 5e-4
    data = FIRST_ORDER(first_order_data(CameraOptics.alone(model, backend)))
    assert data["entrance_pupil_m"] == pytest.approx(0.026, rel=1e-9)


def test_a_stated_stop_decides(backend) -> None:
    """Its entrance pupil is traced, and the stated one nominal, if both are not far apart."""
    more = "stop_diameter: 17 mm"
    model = camera(backend, PETZVAL, "STOP", 0.055, "26 mm", 0.0797, more)
    assert model.apertures["STOP"].bounds[1] == 0.0085
    assert own_radius(model, model.entrance_pupil) == pytest.approx(0.0085, rel=1e-8)
    assert abs(model.entrance_pupil / 0.026 - 1.0) > 0.01
    # its radius in place of its diameter
    with pytest.raises(InputError, match="a stop of this size has an entrance pupil of") as error:
        camera(backend, PETZVAL, "STOP", 0.055, "26 mm", 0.0797, "stop_diameter: 8.5 mm")
    assert error.value.key == ("stop_diameter",)


AFOCAL = {
    "Mersenne": ("\n  M1: {z: 0 m, radius: -4 m, conic: -1}\n  M2: {z: -1.6 m, radius: -0.8 m, conic: -1}", 5.0),
    "Mersenne, 20 um off": (
        "\n  M1: {z: 0 m, radius: -4 m, conic: -1}\n  M2: {z: -1.60002 m, radius: -0.8 m, conic: -1}", 5.0,
    ),
    "Gregory": ("\n  M1: {z: 0 m, radius: -4 m, conic: -1}\n  M2: {z: -2.5 m, radius: 1 m, conic: -1}", 4.0),
    "flat": ("\n  M1: {z: 0 m, radius: flat}", 1.0),
    "window": (
        "\n  M1: {z: 0 m, radius: flat, light: refracts, index: 1.5}"
        "\n  B: {z: 1 cm, radius: flat, light: refracts, index: 1}", 1.0,
    ),
}  # fmt: skip


@pytest.mark.second
@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("name", AFOCAL)
def test_afocal_systems_are_no_cameras(backend, name: str, stated: bool) -> None:
    """Also where a stated focal length is that of the image plane's distance, and while a file is made."""
    mirrors, magnification = AFOCAL[name]
    with pytest.raises(InputError, match="the system is afocal, with an angular magnification of") as error:
        camera(backend, mirrors, "M1", 5.0, "0.2 m", 0.5 if name != "flat" else -0.5, stated=stated)
    assert error.value.key == ("mirrors",)
    told = float(str(error.value).partition("magnification of ")[2].partition(":")[0])
    assert told == pytest.approx(magnification, rel=1e-4)


@pytest.mark.second
def test_the_data_are_those_of_one_state(backend) -> None:
    """Two mirrors by hand, M2 a millimetre nearer to M1 and the image plane 5 mm farther out."""
    f1, f2, apart, place = 1.5, -0.5, 1.1, 0.63
    focal = f1 * f2 / (f1 + f2 - apart)
    model = camera(backend, CASSEGRAIN, "M1", focal, "0.3 m", place)
    optics = CameraOptics.alone(model, backend)
    moved = {"camera/M2": Motion(shift=(0.0, 0.0, 1e-3)), "camera/focal_plane": Motion(shift=(0.0, 0.0, -5e-3))}
    for one, d, image in ((optics, apart, place), (optics.in_state(moved), apart - 1e-3, place + 5e-3)):
        told = FIRST_ORDER(first_order_data(one))
        # a chief ray of slope 1 through M1's vertex, and a ray at height 1
        slope, away = 1.0 + d / -f2, d + image
        power = -1.0 / f1 + (1.0 - d / f1) / -f2
        distance = d + away * slope
        assert told["focal_length_m"] == pytest.approx(-1.0 / power, rel=1e-9)
        assert told["back_focal_length_m"] == pytest.approx(-(1.0 - d / f1) / power, rel=1e-9)
        assert told["f_number"] == pytest.approx(-1.0 / power / 0.3, rel=1e-9)
        assert told["principal_distance_along_line_m"] == pytest.approx(distance, rel=1e-9)
        assert told["plate_scale_arcsec_per_mm"] == pytest.approx(np.degrees(3.6) / distance, rel=1e-9)
        assert told["pixel_arcsec"] == pytest.approx(np.degrees(3600.0) * 7e-6 / distance, rel=1e-9)
        assert told["exit_pupil_before_image_m"] == pytest.approx(distance / slope, rel=1e-9)
        assert told["exit_pupil_m"] == pytest.approx(0.3 / slope, rel=1e-9)
        assert told["image_mm"][0] == pytest.approx(2e3 * distance * np.tan(np.radians(0.05)), rel=1e-4)
        assert told["working_f_number"] == pytest.approx(told["f_number"], rel=5e-3)
        assert told["length_m"] == pytest.approx(d + image, rel=1e-9)


def test_a_state_without_focus_is_said(backend, capsys) -> None:
    """Near afocal as designed, afocal when M2 has moved: one sentence and exit code 2."""
    mirrors = "\n  M1: {z: 0 m, radius: -4 m, conic: -1}\n  M2: {z: -1.61 m, radius: -0.8 m, conic: -1}"
    model = camera(backend, mirrors, "M1", 80.0, "0.2 m", 14.0)
    moved = CameraOptics.alone(model, backend, {"camera/M2": Motion(shift=(0.0, 0.0, 0.01))})
    with pytest.raises(Exit) as left, cli.explained(Console(stderr=True)):
        first_order_data(moved)
    assert left.value.exit_code == 2
    assert "the system is afocal" in capsys.readouterr().err
    with pytest.raises(AfocalError):
        first_order_data(moved)
    for kind, code in ((AimError("the beam is lost"), 2), (UnphysicalError("an MTF of 2"), None)):
        with pytest.raises(Exit if code else UnphysicalError) as left, cli.explained(Console(stderr=True)):
            raise kind
        assert code is None or left.value.exit_code == code


def test_a_stop_whose_rim_other_rays_meet_is_refused() -> None:
    spec = validate(CameraSpec, parse_yaml(text_of(CASSEGRAIN, "M1", 4.0, "300 mm", 0.5)))
    check_entrance_pupil(spec, 0.2975)
    with pytest.raises(InputError, match="stop: rays of other heights than the stated beam's meet the rim of the stop"):
        check_entrance_pupil(spec, 0.2965)


def test_a_telecentric_image_has_no_place_of_its_pupil(backend) -> None:
    """The stop in the front focus of a lens: no number of a rounding's size is told, and none that is no number."""
    n, r, t = 1.5, 0.1, 0.01
    power = (n - 1.0) * (2.0 / r - (n - 1.0) * t / (n * r * r))
    front = (1.0 - (n - 1.0) * t / (n * r)) / power
    lens = f"""
  STOP: {{z: {-front!r} m, radius: flat, light: passes}}
  A: {{z: 0 m, radius: {r} m, light: refracts, index: {n}}}
  B: {{z: {t} m, radius: {-r} m, light: refracts, index: 1}}
"""
    model = camera(backend, lens, "STOP", 1.0 / power, "8 mm", t + front)
    told = FIRST_ORDER(first_order_data(CameraOptics.alone(model, backend)))
    assert told["exit_pupil_before_image_m"] is None
    assert told["exit_pupil_m"] is None
    assert told["focal_length_m"] == pytest.approx(1.0 / power, rel=1e-9)


def test_where_no_light_comes_along_the_axis(backend) -> None:
    """A flat, and 3 m farther a sphere that light of the axis passes by: about the field's middle, where the powers of
    an oblique mirror, 2 / (R cos i) and 2 cos i / R, have the mean 2 / R.
    """
    mirrors = f"""
  M1: {{z: 0 m, radius: flat}}
  M2: {{z: -3 m, decentre: [0 m, {float(3.0 * np.tan(np.radians(10.0)))!r} m], radius: 0.4 m}}
"""
    model = camera(backend, mirrors, "M1", 0.2, "10 mm", -2.8, bias="10 deg")
    assert not model.axis.on_axis
    assert model.paraxial.focal_length == pytest.approx(0.2, rel=1e-9)
    # a beam that is square to the light and 10 mm wide lights a flat at 10 deg as an ellipse
    assert model.apertures["M1"].bounds[1] == pytest.approx(0.005 / np.sqrt(np.cos(np.radians(10.0))), rel=1e-9)
