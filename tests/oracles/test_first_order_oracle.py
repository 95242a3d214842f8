"""First-order data of lenses and telescopes whose stop stands before, in and behind the power, against rays of
batoid near the axis.

Colours of cameras with lenses against batoid, optiland and NumPy: lateral and axial colour, MTF, point images.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from optics.numerics.quadrature import disk
from scenes.lens.batoid_reader import read_batoid
from scenes.models.camera_model import CameraModel, derive_camera, field_direction
from scenes.models.camera_sharpness import FieldBeams, FocalPlane
from scenes.specs.camera import CameraSpec
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.oracles.peers import LENSES, batoid_camera, batoid_rays, optiland_camera
from tests.scenes.lens.colour_cameras import KINDS, colour_camera
from tests.tiers import quick
from twin.camera.camera_optics import CameraOptics
from twin.camera.colour import FOCUS_RINGS, axial_colour, lateral_colour
from twin.camera.first_order_data import FIRST_ORDER, first_order_data, ray_paths

pytestmark = pytest.mark.oracle

WAVE = 587.5618e-9
KEYS = {
    "efl": "focal_length_m",
    "bfl": "back_focal_length_m",
    "entrance": "entrance_pupil_before_first_mirror_m",
    "diameter": "entrance_pupil_m",
    "exit": "exit_pupil_before_image_m",
    "exit_diameter": "exit_pupil_m",
    "f_number": "f_number",
}
DISTANCES = ("bfl", "entrance", "exit")
SAME = 1e-6
"""Largest difference of lengths, relative; of distances, to the focal length."""


class Face(NamedTuple):
    """A surface: vertex and radius, metres, conic, and the index behind it, 0 for a mirror, -1 for a bare stop."""

    z: float
    radius: float
    index: float
    conic: float = 0.0


class System(NamedTuple):
    """Surfaces in the order of the light, which of them is the stop, entrance pupil and image, metres."""

    faces: tuple[Face, ...]
    stop: int
    pupil: float
    image: float


INF = np.inf
LENS = (Face(0.0, 0.052, 1.5168), Face(0.006, -0.31, 1.0))
TRIPLET = (
    Face(0.0, 0.0218, 1.6204), Face(0.0033, -0.41, 1.0), Face(0.0091, -0.0224, 1.6200),
    Face(0.0101, 0.0201, 1.0), Face(0.0149, 0.0798, 1.6204), Face(0.0178, -0.0183, 1.0),
)  # fmt: skip
TELE = (Face(0.0, 0.11, 1.5168), Face(0.012, -0.28, 1.0), Face(0.11, -0.062, 1.62), Face(0.115, 0.21, 1.0))
CASSEGRAIN = (Face(0.0, -2.6, 0.0, -1.0), Face(-0.93, -1.02, 0.0, -2.9))
GREGORY = (Face(0.0, -2.0, 0.0, -1.0), Face(-1.25, 0.44, 0.0, -0.5))
KORSCH = (Face(0.0, -2.5, 0.0, -0.93), Face(-0.94, -0.83, 0.0, -2.2), Face(1.45, -1.24, 0.0, -0.42))
STOP = -1.0
SYSTEMS = {
    "lens, stop in front": System((Face(-0.02, INF, STOP), *LENS), 0, 0.012, 0.085),
    "lens, stop behind": System((*LENS, Face(0.025, INF, STOP)), 2, 0.012, 0.09),
    "triplet, stop inside": System(TRIPLET, 3, 0.009, 0.0602),
    "triplet, plane stop": System((*TRIPLET[:4], Face(0.0125, INF, STOP), *TRIPLET[4:]), 4, 0.009, 0.0598),
    "telephoto, stop inside": System((*TELE[:2], Face(0.07, INF, STOP), *TELE[2:]), 2, 0.04, 0.19),
    "telephoto, stop behind": System((*TELE, Face(0.13, INF, STOP)), 4, 0.03, 0.2),
    "Cassegrain, stop on M1": System(CASSEGRAIN, 0, 0.4, 0.4),
    "Cassegrain, stop on M2": System(CASSEGRAIN, 1, 0.4, 0.41),
    "Cassegrain, stop in front": System((Face(-1.4, INF, STOP), *CASSEGRAIN), 0, 0.4, 0.4),
    "Gregory, stop on M2": System(GREGORY, 1, 0.3, 0.3),
    "Korsch, stop behind M3": System((*KORSCH, Face(0.9, INF, STOP)), 3, 0.4, 0.1),
    "Schmidt": System((Face(-1.0, INF, 1.5168), Face(-0.99, -40.0, 1.0), Face(0.0, -1.0, 0.0)), 0, 0.2, -0.5),
    "lens and mirrors": System((Face(-0.9, 3.0, 1.5168), Face(-0.88, 3.4, 1.0), *CASSEGRAIN), 3, 0.3, 0.3),
}


def camera(system: System, backend: Any, image: float | None = None) -> CameraModel:
    """The system as a camera of the twin; its stated focal length is not looked at."""
    rows = []
    for k, face in enumerate(system.faces):
        light = {0.0: "", STOP: ", light: passes"}.get(face.index, f", light: refracts, index: {face.index}")
        radius = "flat" if np.isinf(face.radius) else f"{face.radius!r} m"
        rows.append(f"  S{k}: {{z: {face.z!r} m, radius: {radius}, conic: {face.conic}{light}}}")
    text = f"""
name: drawn
focal_length: 1 m
entrance_pupil: {system.pupil!r} m
field_bias: 0 deg
field: {{x: 0.05 deg, y: 0.05 deg}}
wavelength: {WAVE * 1e9!r} nm
stop: S{system.stop}
mirrors:
{chr(10).join(rows)}
image: {{z: {system.image if image is None else image!r} m}}
line: {{pixels: 100, pitch: 7 um}}
edge_margin: 1 mm
"""
    return derive_camera(validate(CameraSpec, parse_yaml(text)), backend, check_stated=False)


def travels(system: System) -> list[float]:
    """Direction of the light along z behind each surface, 1 or -1."""
    return [(-1.0) ** sum(f.index == 0.0 for f in system.faces[: k + 1]) for k in range(len(system.faces))]


def ends(system: System) -> tuple[int, int]:
    """The first and the last surface that reflect or refract."""
    used = [k for k, face in enumerate(system.faces) if face.index != STOP]
    return used[0], used[-1]


def by_batoid(system: System) -> dict[str, float]:
    """Rays of batoid near the axis: one beside it and one inclined to it, combined to chief and marginal rays; and the
    marginal ray itself at the stop.
    """
    import batoid

    height, angle = 1e-5 * system.pupil, 1e-6
    air, inside = batoid.ConstMedium(1.0), batoid.ConstMedium(1.0)
    start = min(face.z for face in system.faces) - 0.5
    x = np.array([height, 0.0, 0.5 * system.pupil])
    slope = np.array([0.0, angle, 0.0])
    rays = batoid.RayVector(x, np.zeros(3), np.full(3, start), slope, np.zeros(3), np.sqrt(1.0 - slope**2),
                            np.zeros(3), np.full(3, WAVE))  # fmt: skip
    lateral = []
    for face in system.faces:
        # a quadric that is a paraboloid has no answer for rays along its axis
        quadric = batoid.Paraboloid(face.radius) if face.conic == -1.0 else batoid.Quadric(face.radius, face.conic)
        shape = batoid.Plane() if np.isinf(face.radius) else quadric
        stand, item = {"coordSys": batoid.CoordSys(origin=[0.0, 0.0, face.z])}, None
        if face.index == 0.0:
            item = batoid.Mirror(shape, **stand)
        elif face.index == STOP:
            item = batoid.Detector(shape, **stand)
        else:
            behind = air if face.index == 1.0 else batoid.ConstMedium(face.index)
            item = batoid.RefractiveInterface(shape, inMedium=inside, outMedium=behind, **stand)
            inside = behind
        item.trace(rays)
        rays.toCoordSys(batoid.CoordSys())
        lateral.append(np.array(rays.x))
    batoid.Detector(batoid.Plane(), coordSys=batoid.CoordSys(origin=[0.0, 0.0, system.image])).trace(rays)
    place, way = np.array(rays.x), np.array(rays.vx / np.abs(rays.vz))
    at_stop = lateral[system.stop]
    share = -at_stop[1] / at_stop[0]  # of the ray beside the axis, in the chief ray
    chief, turned = place[1] + share * place[0], way[1] + share * way[0]
    away = chief / turned
    first, last = ends(system)
    toward = travels(system)[-1]
    return {
        "efl": abs(height / way[0]),
        "bfl": toward * (system.image - system.faces[last].z) - place[0] / way[0],
        "entrance": share * height / angle + system.faces[first].z - start,
        "exit": away,
        "exit_diameter": system.pupil * abs(place[0] - away * way[0]) / height,
        "stop": abs(at_stop[2]),
        "f_number": abs(height / way[0]) / system.pupil,
    }


@pytest.mark.second
@pytest.mark.parametrize("name", quick(5, SYSTEMS))
def test_first_order_data(backend, name: str) -> None:
    pytest.importorskip("batoid")
    model = camera(SYSTEMS[name], backend)
    data = FIRST_ORDER(first_order_data(CameraOptics.alone(model, backend)))
    ours = {key: data[name] for key, name in KEYS.items()} | {"stop": model.apertures[model.spec.stop].radius}
    for key, value in by_batoid(SYSTEMS[name]).items():
        # distances are as right as the lengths of the system are
        assert value == pytest.approx(ours[key], rel=SAME, abs=SAME * ours["efl"] * (key in DISTANCES)), key
    assert ours["diameter"] == pytest.approx(SYSTEMS[name].pupil, rel=SAME)


@pytest.mark.second
@pytest.mark.parametrize("name", ["lens, stop behind", "Cassegrain, stop on M2"])
def test_the_focal_length_does_not_move_with_the_image_plane(backend, name: str) -> None:
    """The principal distance does, and so did what was called the focal length."""
    system = SYSTEMS[name]
    near, far = (
        FIRST_ORDER(first_order_data(CameraOptics.alone(camera(system, backend, image), backend)))
        for image in (system.image, 1.1 * system.image)
    )
    for key in ("focal_length_m", "back_focal_length_m", "entrance_pupil_m", "f_number", "exit_pupil_m"):
        assert far[key] == pytest.approx(near[key], rel=1e-9), key
    assert abs(far["principal_distance_along_line_m"] / near["principal_distance_along_line_m"] - 1.0) > 0.02


NAMES = quick(1, ["gf7", "monitor", "gf7_conic"])


@pytest.mark.second
@pytest.mark.parametrize("name", NAMES)
def test_paraxial_data_of_optiland(backend, camera, name: str) -> None:
    """About the axis, which the field stands beside; the rays that are traced there are those of the twin."""
    pytest.importorskip("optiland")
    model = camera(name)
    data = first_order_data(CameraOptics.alone(model, backend))
    told = FIRST_ORDER(data)
    optic = optiland_camera(model)
    optic.set_aperture("EPD", data.entrance_pupil)
    optic.fields.set_type("angle")
    optic.fields.add(y=0.0)
    paraxial = optic.paraxial
    assert told["focal_length_m"] == pytest.approx(abs(float(paraxial.f2())), rel=1e-9)
    assert told["f_number"] == pytest.approx(abs(float(paraxial.FNO())), rel=1e-9)
    # measured from the first surface, positive behind it
    assert told["entrance_pupil_before_first_mirror_m"] == pytest.approx(-float(paraxial.EPL()), rel=1e-9)
    # from the image, along the light, which travels toward -z
    away = float(np.ravel(paraxial.XPL())[0])
    assert told["exit_pupil_before_image_m"] == pytest.approx(away, rel=1e-9)
    assert told["exit_pupil_m"] == pytest.approx(abs(float(np.ravel(paraxial.XPD())[0])), rel=1e-9)


@pytest.mark.second
@pytest.mark.parametrize("name", NAMES)
def test_wavefronts_of_batoids_rays(backend, camera, name: str) -> None:
    """batoid traces; its paths to the reference sphere are found by the quadratic, and poppy's Zernike terms fitted."""
    pytest.importorskip("batoid")
    zernike1 = pytest.importorskip("poppy").zernike.zernike1
    model = camera(name)
    optics = CameraOptics.alone(model, backend)
    fields = [(0.0, 0.0), (1.0, 0.0), (0.4, -1.0)]
    rng = np.random.default_rng(1)
    r, angle = np.sqrt(rng.uniform(size=2000)), rng.uniform(0.0, 2.0 * np.pi, 2000)
    stop = np.concatenate([np.zeros((1, 2)), 0.999999 * np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)])
    starts = ray_paths(model, backend, fields, stop).points[:2]
    basis = np.stack([zernike1(j, rho=r, theta=angle, outside=None, noll_normalize=True) for j in range(1, 38)], -1)
    peer = batoid_camera(model)
    radius = float(model.first_order.exit_pupil_distance[0])
    for k, wave in enumerate(optics.wavefronts(fields)):
        launch = starts[0, k]
        way = starts[1, k] - launch
        direction = way / np.linalg.norm(way, axis=-1, keepdims=True)
        rays = batoid_rays(launch, direction[0])
        peer.trace(rays)
        rays.toCoordSys(peer.items[-1].coordSys)
        # from the sphere about the chief ray's image back along each ray: |p + t v - c| = |radius|
        offset = rays.r - rays.r[0]
        along = np.sum(offset * rays.v, axis=-1)
        root = np.sqrt(along**2 - np.sum(offset**2, axis=-1) + radius**2)
        to_sphere = rays.t + (-along - np.sign(radius) * root)
        error = (to_sphere[0] - to_sphere)[1:] / model.spec.wavelength
        terms = np.linalg.lstsq(basis, error, rcond=None)[0]
        # 37 terms follow these wavefronts to 1e-6 waves
        np.testing.assert_allclose(wave.coefficients[3:], terms[3:], atol=3e-6)
        assert wave.rms == pytest.approx(np.sqrt(np.sum(terms[3:] ** 2)), abs=3e-6)
        left = error - basis[:, :3] @ terms[:3]
        assert np.ptp(left) <= wave.peak_to_valley * (1.0 + 1e-6) + 1e-5
        assert np.ptp(left) > 0.9 * wave.peak_to_valley
        # and where the chief ray falls
        place = peer.items[-1].coordSys.origin + rays.r[0] - model.focal_plane.translation
        np.testing.assert_allclose(wave.position, place[:2], atol=1e-12)


# --- colour oracle ----------------------------------------------------------------------------------------------------

FIELDS = [(0.0, 0.0), (1.0, 0.0), (0.6, -1.0)]
COLOURS = np.array([486.1327e-9, 540e-9, 656.2725e-9])


def traced(model: CameraModel, peer: Any, field: tuple[float, float], stop: np.ndarray, wavelength: float) -> Any:
    """A peer's rays of a field through points (N, 2) of the stop in units of its radius, in the prescription frame.

    The stop is the first surface, so no aiming is needed: rays start before the points where they meet it.
    """
    spec = model.spec
    assert spec.stop == model.mirrors[0]
    direction = field_direction(spec, field[0] * spec.field.x, field[1] * spec.field.y)
    x, y = (model.apertures[spec.stop].bounds[1] * stop).T
    met = np.stack([x, y, model.surfaces[spec.stop].sag(x, y)], axis=-1) + model.vertex(spec.stop)
    # a plane wavefront a metre before the vertex
    way = 1.0 + (met - model.vertex(spec.stop)) @ direction
    return peer(met - way[:, None] * direction, direction, wavelength)


CASES = sorted(product(KINDS, LENSES), key=lambda case: case not in list(zip(KINDS, LENSES, strict=False)))
"""Every lens by every program, those first that have each once."""


@pytest.fixture(scope="module", params=quick(1, [pytest.param(case) for case in CASES]), ids="-".join)
def case(request: pytest.FixtureRequest, backend) -> tuple[CameraOptics, Any]:
    kind, peer = request.param
    if peer != "numpy":
        pytest.importorskip(peer)
    optics = CameraOptics.alone(colour_camera(kind), backend)
    return optics, LENSES[peer](optics.model)


def test_lateral_colour_of_batoids_chief_rays(case) -> None:
    optics, peer = case
    model, middle, reference = optics.model, np.zeros((1, 2)), optics.model.spec.wavelength
    own = lateral_colour(optics, FIELDS, COLOURS, reference)
    for f, field in enumerate(FIELDS):
        start = traced(model, peer, field, middle, reference).r[0, :2]
        for k, colour in enumerate(COLOURS):
            place = traced(model, peer, field, middle, colour).r[0, :2]
            np.testing.assert_allclose(own[f, k], place - start, rtol=0.0, atol=1e-14)
    assert np.max(np.abs(own[1:])) > 1e-10  # there is some


@pytest.mark.second
def test_axial_colour_of_batoids_beams(case, backend) -> None:
    """Through the same search for the best plane, and against the defocus that is left on it by Zernike terms."""
    optics, peer = case
    model, nodes = optics.model, disk(FOCUS_RINGS)
    stop = np.concatenate([np.zeros((1, 2)), np.stack([nodes.x, nodes.y], axis=-1)])
    own = axial_colour(optics, FIELDS, COLOURS)
    plane = FocalPlane.of(model.spec)
    for f, field in enumerate(FIELDS):
        for k, colour in enumerate(COLOURS):
            beams = FieldBeams.trace(model, backend, (field,), FOCUS_RINGS, wavelength=colour)
            rays = traced(model, peer, field, stop, colour)
            theirs = replace(beams, position=rays.r[None], direction=_unit(rays.v)[None], path=rays.t[None])
            np.testing.assert_allclose(beams.position, theirs.position, rtol=0.0, atol=1e-13)
            downstream = np.sign(rays.v[0, 2])
            there = theirs.best_plane()
            assert own[f, k] == pytest.approx(downstream * (there.z - plane.z), abs=1e-10)
            # no other defocus than what the least mean square leaves to spherical aberration: none to first order
            left = theirs.wavefronts(there)[0]
            reach = 1e-6
            less, more = (theirs.errors(FocalPlane(there.z + dz, there.tilt))[0] for dz in (-reach, reach))
            assert more == pytest.approx(less, rel=1e-4)
            assert less >= float(np.sqrt(nodes.share @ left**2)) * (1.0 - 1e-12)
    assert np.ptp(own[0]) > 1e-6


def test_the_glass_of_batoids_lsst_comes_along() -> None:
    batoid = pytest.importorskip("batoid")
    lens = read_batoid(Path(batoid.__file__).parent / "data/LSST/LSST_r.yaml", 620e-9)
    face = batoid.Optic.fromYaml("LSST_r.yaml")["L1_entrance"]
    own = next(surface for surface in lens.surfaces if surface.name == "L1_entrance")
    for wavelength in (450e-9, 620e-9, 900e-9):
        assert lens.glasses[own.glass](wavelength) == pytest.approx(face.outMedium.getN(wavelength), rel=1e-15)


def _unit(velocity: np.ndarray) -> np.ndarray:
    return np.asarray(velocity / np.linalg.norm(velocity, axis=-1, keepdims=True))
