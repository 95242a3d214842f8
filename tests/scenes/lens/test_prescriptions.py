"""Foreign prescriptions: where surfaces stand and what they are shaped like, in numbers worked out by hand here."""

import math
from pathlib import Path

import numpy as np
import pytest

from optics.geometry.aperture import Circle, Rectangle
from optics.geometry.surface import Surface, ZernikeFigure
from optics.materials.glass import ABBE_LINES, GLASSES, common_glasses
from optics.raytrace.assembly import Interaction
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.lens.__main__ import app
from scenes.lens.batoid_reader import read_batoid
from scenes.lens.camera_reader import camera_of, unfolded, with_flat_image
from scenes.lens.codev_reader import read_codev
from scenes.lens.prescription import SEQUENCE, Prescription, polynomial_of
from scenes.lens.statements import glass_key, own_glasses, read_catalogue, read_catalogues
from scenes.lens.zemax_reader import read_zemax
from scenes.models.camera_model import derive_camera
from scenes.specs.camera import LensGlassSpec
from scenes.yaml.errors import InputError
from tests.scenes.lens.files import AGF, BATOID, CODEV, SINGLET, TMA
from tests.tiers import quick
from tests.twin.commands import invoke

ENCODINGS = {
    "UTF-16 with a mark": TMA.encode("utf-16"),
    "UTF-16 LE": TMA.encode("utf-16-le"),
    "UTF-16 BE": TMA.encode("utf-16-be"),
    "UTF-16 BE with a mark": b"\xfe\xff" + TMA.encode("utf-16-be"),
    "UTF-8 with a mark": TMA.encode("utf-8-sig"),
    "DOS lines": TMA.replace("\n", "\r\n").encode(),
    "ASCII": TMA.encode("ascii"),
}


def file(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def same(a: Prescription, b: Prescription) -> bool:
    return a.fields == b.fields and all(
        x.pose == y.pose and x.surface == y.surface and x.interaction is y.interaction and x.aperture == y.aperture
        for x, y in zip(a.surfaces, b.surfaces, strict=True)
    )


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_encoding_does_not_matter(tmp_path: Path, encoding: str) -> None:
    plain = read_zemax(file(tmp_path, "plain.zmx", TMA))
    assert same(read_zemax(file(tmp_path, "other.zmx", ENCODINGS[encoding])), plain)


def test_a_zemax_file(tmp_path: Path) -> None:
    lens = read_zemax(file(tmp_path, "tma.zmx", TMA))
    m1, m2, m3, image = lens.surfaces
    assert lens.name == "three mirrors"
    assert lens.stop == 1
    assert lens.wavelength == 650e-9
    assert lens.fields[1] == pytest.approx((math.radians(1.0), math.radians(6.1)))
    assert m1.surface.curvature == pytest.approx(-1.0 / 0.674535927468851, rel=1e-12)
    assert m1.surface.even == pytest.approx((-4.917e-2,))
    assert m1.aperture == Rectangle(0.070, 0.065, (0.0, -0.054))
    assert m2.pose.translation == pytest.approx([0.0, 0.0, -0.201593])
    # +0.25 deg about x turns +z toward -y
    tilt = math.radians(0.25)
    assert m3.pose.rotation[:, 2] == pytest.approx([0.0, -math.sin(tilt), math.cos(tilt)])
    assert m3.pose.translation == pytest.approx([0.0, 0.0005, 0.2162998 - 0.201593])
    # the second coordinate break undoes the first: order flag 1 turns first and shifts then
    assert image.pose.translation == pytest.approx([0.0, 0.0, 0.2162998 - 0.201593 - 0.22608], abs=1e-15)
    assert np.allclose(image.pose.rotation, np.eye(3), rtol=0, atol=1e-15)
    assert [s.interaction for s in lens.surfaces] == [Interaction.REFLECT] * 3 + [Interaction.PASS]
    assert [(n.line, n.statement) for n in lens.notes] == [(TMA.count("\n"), "XYZZY 1 2 3")]


def test_turns_of_a_coordinate_break_follow_one_another(tmp_path: Path) -> None:
    """A unit vector along z under turns of 10, 20 and 30 deg, by hand; and the reverse order is the reverse."""
    turned = TMA.replace(
        "PARM 2 0.5\n  PARM 3 0.25\n  PARM 4 0\n  PARM 5 0", "PARM 2 0\n  PARM 3 10\n  PARM 4 20\n  PARM 5 30"
    )
    rotation = read_zemax(file(tmp_path, "a.zmx", turned)).surfaces[2].pose.rotation
    a, b, c = (math.radians(v) for v in (10.0, 20.0, 30.0))
    along = [math.sin(b), -math.sin(a) * math.cos(b), math.cos(a) * math.cos(b)]
    assert rotation[:, 2] == pytest.approx(along)
    assert rotation[0, 0] == pytest.approx(math.cos(b) * math.cos(c))
    backward = turned.replace(
        "PARM 3 10\n  PARM 4 20\n  PARM 5 30\n  PARM 6 0", "PARM 3 10\n  PARM 4 20\n  PARM 5 30\n  PARM 6 1"
    )
    other = read_zemax(file(tmp_path, "b.zmx", backward)).surfaces[2].pose.rotation
    assert other[2, 2] == pytest.approx(math.cos(a) * math.cos(b))
    assert other[2, 0] == pytest.approx(-math.sin(b))


def shaped(tmp_path: Path, kind: str, *lines: str) -> Prescription:
    """The three mirrors, the second of which has another shape."""
    old = '  TYPE STANDARD\n  CURV -3.7703604697192816E-03 0 0 0 0 ""\n  CONI -1.78965940473169\n'
    assert old in TMA
    new = "\n".join((f"  TYPE {kind}", "  CURV -0.004 0 0 0 0", *(f"  {line}" for line in lines))) + "\n"
    return read_zemax(file(tmp_path, "shaped.zmx", TMA.replace(old, new)))


def test_shapes_by_their_sag(tmp_path: Path) -> None:
    """Sags of every kind of surface in millimetres, by the formulas of the program's manual."""
    x, y = 13.0, -7.0
    r2 = x * x + y * y
    base = -0.004 * r2 / (1.0 + math.sqrt(1.0 - 0.004**2 * r2))
    cases = {
        "STANDARD": ("", 0.0),
        "EVENASPH": ("PARM 1 1e-4; PARM 2 2e-7; PARM 3 3e-10", 1e-4 * r2 + 2e-7 * r2**2 + 3e-10 * r2**3),
        "ODDASPHE": ("PARM 2 1e-4; PARM 4 2e-7", 1e-4 * r2 + 2e-7 * r2**2),
        "XPOLYNOM": (
            "XDAT 1 9 0 0 1; XDAT 2 20 0 0 1; XDAT 5 0.01 0 0 1; XDAT 6 0.02 0 0 1; XDAT 11 0.03 0 0 1",
            0.01 * x**2 / 20**2 + 0.02 * x * y / 20**2 + 0.03 * y**3 / 20**3,
        ),
        "SZERNSAG": (
            "PARM 2 2e-7; PARM 9 1; PARM 10 -2; XDAT 1 5 0 0 1; XDAT 2 25 0 0 1; XDAT 6 0.01; XDAT 7 0.02",
            2e-7 * r2**2
            + 0.01 * math.sqrt(3.0) * (2.0 * ((x - 1) ** 2 + (y + 2) ** 2) / 25**2 - 1.0)
            + 0.02 * math.sqrt(6.0) * 2.0 * (x - 1) * (y + 2) / 25**2,
        ),
    }
    for kind, (lines, more) in cases.items():
        surface = shaped(tmp_path, kind, *filter(None, lines.split("; "))).surfaces[1].surface
        assert 1e3 * float(surface.sag(x * 1e-3, y * 1e-3)) == pytest.approx(base + more, rel=1e-12), kind


def test_a_polynomial_of_high_order_keeps_its_sag(tmp_path: Path) -> None:
    """x^5 y and a tilt along x, which the trace knows as Zernike terms alone."""
    numbers = {1: 0.004, 24: 0.02}  # x, and x^5 y: the second of order 6
    pairs = [(n - b, b) for n in range(1, 7) for b in range(n + 1)]
    at = pairs.index((5, 1)) + 1
    lines = ["XDAT 1 27 0 0 1", "XDAT 2 20 0 0 1", f"XDAT 3 {numbers[1]} 0 0 1", f"XDAT {at + 2} 0.02 0 0 1"]
    surface = shaped(tmp_path, "XPOLYNOM", *lines).surfaces[1].surface
    assert isinstance(surface.figure, ZernikeFigure)
    x, y = 11.0, 9.0
    base = -0.004 * (x * x + y * y) / (1.0 + math.sqrt(1.0 - 0.004**2 * (x * x + y * y)))
    wanted = base + 0.004 * x / 20.0 + 0.02 * (x / 20.0) ** 5 * y / 20.0
    assert 1e3 * float(surface.sag(x * 1e-3, y * 1e-3)) == pytest.approx(wanted, rel=1e-12)


def test_the_polynomial_of_even_powers_has_their_sag() -> None:
    even, x, y = Surface(even=(2.0, -300.0)), 0.2, 0.3
    powers = sum(c * x**a * y**b for (a, b), c in polynomial_of(even).items())
    assert powers == pytest.approx(float(even.sag(x, y)), rel=1e-12)


def test_a_codev_file(tmp_path: Path) -> None:
    lens = read_codev(file(tmp_path, "folded.seq", CODEV))
    stop, m1, m2, image = lens.surfaces
    assert (lens.stop, lens.name, lens.wavelength) == (0, "folded", 650e-9)
    assert stop.interaction is Interaction.PASS
    assert math.isinf(lens.object_distance)
    assert np.allclose(lens.fields, [(0.0, 0.0), (math.radians(1.0), math.radians(-1.0))], rtol=1e-15)
    # ADE > 0 turns +z toward +y; DAR: what follows stands as if nothing had been turned
    tilt = math.radians(2.0)
    assert m1.pose.rotation[:, 2] == pytest.approx([0.0, math.sin(tilt), math.cos(tilt)])
    assert m1.pose.translation == pytest.approx([0.0, 0.005, 0.1])
    assert m2.pose.translation == pytest.approx([0.0, 0.0, 0.1 - 0.3])
    assert m2.surface.even == pytest.approx((1.0, 2.0))
    assert m2.aperture == Circle(0.06)
    # BEN: the axis behind the mirror is the reflected one; the image's thickness lies along it, before its own turn
    axis = np.array([0.0, math.sin(math.radians(6.0)), math.cos(math.radians(6.0))])
    assert image.pose.translation == pytest.approx([0.0, 0.0, -0.2] + 0.40025 * axis)
    assert image.pose.rotation[:, 2] == pytest.approx([0.0, math.sin(math.radians(7.5)), math.cos(math.radians(7.5))])
    assert [(n.line, n.statement) for n in lens.notes] == [(CODEV[: CODEV.index("FROB")].count("\n") + 1, "FROB 7")]


def test_a_reversed_decentre_undoes_one(tmp_path: Path) -> None:
    there = "S 0.0 10.0\n  XDE 1.0; YDE 2.0; ADE 10.0; BDE 20.0; CDE 30.0\n"
    back = "S 0.0 0.0\n  XDE 1.0; YDE 2.0; ADE 10.0; BDE 20.0; CDE 30.0\n  REV\n"
    text = CODEV.replace("S -1000.0 -300.0 REFL", f"{there.replace('10.0', '0.0', 1)}{back}S -1000.0 -300.0 REFL", 1)
    plain, moved = (read_codev(file(tmp_path, f"{k}.seq", t)) for k, t in enumerate((CODEV, text)))
    for a, b in zip(plain.surfaces, moved.surfaces, strict=True):
        assert np.allclose(a.pose.translation, b.pose.translation, rtol=0, atol=1e-15)
        assert np.allclose(a.pose.rotation, b.pose.rotation, rtol=0, atol=1e-15)


def test_radii_and_curvatures_and_units_are_the_same_camera(tmp_path: Path) -> None:
    curved = CODEV.replace("RDM Y", "RDM N").replace("-1000.0", "-0.001")
    inches = CODEV.replace("DIM M", "DIM C").replace("-1000.0", "-100.0").replace("EPD 50.0", "EPD 5.0")
    first = read_codev(file(tmp_path, "a.seq", CODEV)).surfaces
    assert [s.surface.curvature for s in first] == [
        s.surface.curvature for s in read_codev(file(tmp_path, "b.seq", curved)).surfaces
    ]
    metres = [s.surface.curvature for s in read_codev(file(tmp_path, "c.seq", inches)).surfaces]
    assert metres == pytest.approx([s.surface.curvature for s in first])


def test_a_polynomial_of_codev(tmp_path: Path) -> None:
    """C4 is x^2, C8 is x^2 y, C15 is y^4: j = ((m + n)^2 + m + 3 n) / 2 + 1."""
    text = CODEV.replace(
        "  CON\n  K -1.0\n", "  SPS XYP\n  SCO K -1.0\n  SCO C4 1.0E-5; SCO C8 2.0E-8; SCO C15 3.0E-10\n"
    )
    surface = read_codev(file(tmp_path, "xyp.seq", text)).surfaces[1].surface
    x, y = 20.0, -15.0
    wanted = -0.001 * (x * x + y * y) / 2.0 + 1e-5 * x * x + 2e-8 * x * x * y + 3e-10 * y**4
    assert 1e3 * float(surface.sag(x * 1e-3, y * 1e-3)) == pytest.approx(wanted, rel=1e-12)


def test_a_batoid_file(tmp_path: Path) -> None:
    lens = read_batoid(file(tmp_path, "two.yaml", BATOID), 650e-9)
    m1, m2, front, back, image = lens.surfaces
    # light comes down there and enters toward +z here: z and y change their signs
    assert m1.surface.curvature == pytest.approx(-1.0 / 20.0)
    assert m1.aperture == Circle(1.2, (0.0, -0.0), 0.3)
    assert m2.pose.translation == pytest.approx([0.0, 0.0, -7.5])
    assert m2.surface.even == pytest.approx((-1e-5,))
    assert (front.index, back.index) == (1.46, 1.0)
    assert front.pose.rotation[:, 2] == pytest.approx([0.0, -math.sin(0.01), math.cos(0.01)])
    assert back.pose.translation == pytest.approx([0.0, -0.02 * math.sin(0.01), 0.2 + 0.02 * math.cos(0.01)])
    assert image.pose.translation == pytest.approx([0.0, 0.0, 1.5])


def test_glasses(tmp_path: Path) -> None:
    glassy, old = read_catalogue(file(tmp_path, "two.agf", AGF))
    for wavelength in (0.4e-6, 0.5875618e-6, 1.0e-6):
        assert glassy(wavelength) == pytest.approx(GLASSES["N-BK7"].index(wavelength), rel=1e-14)
    # BK7 of Schott's catalogue of 1967, index at the d line
    assert old(0.5875618e-6) == pytest.approx(1.5168, abs=2e-5)
    known = read_catalogues([tmp_path / "two.agf"])
    assert known[glass_key("GLASSY_MAKER")](0.6e-6) == glassy(0.6e-6)
    assert own_glasses()[glass_key("NBK7_SCHOTT")](0.6e-6) == GLASSES["N-BK7"].index(0.6e-6)
    with pytest.raises(ValueError, match="outside the range"):
        old(2e-6)


def test_the_same_lens_in_glass(tmp_path: Path) -> None:
    lens = read_zemax(file(tmp_path, "singlet.zmx", SINGLET), own_glasses())
    assert [s.interaction for s in lens.surfaces[:2]] == [Interaction.REFRACT] * 2
    assert lens.surfaces[0].index == GLASSES["N-BK7"].index(587.5618e-9)
    assert lens.surfaces[1].index == 1.0


def test_the_power_of_batoids_first_coefficient(tmp_path: Path) -> None:
    """``imin: 1`` makes it that of r^2."""
    text = BATOID.replace("coefs: [1.0e-5]", "coefs: [1.0e-3, 1.0e-5], imin: 1")
    plain, more = (
        read_batoid(file(tmp_path, f"{k}.yaml", t), 650e-9).surfaces[1].surface for k, t in enumerate((BATOID, text))
    )
    assert float(more.sag(0.3, 0.4)) - float(plain.sag(0.3, 0.4)) == pytest.approx(-1e-3 * 0.25)


HEAD = "MODE SEQ\nUNIT MM X W X CM MR CPMM\nENPD 200\nWAVM 1 0.55 1\n"
ANGLES = "FTYP 0 0 2 1 0 0 0\nXFLN 0 0\nYFLN 0 0.3\n"
MIRROR = "GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0"


def surface(number: int, *lines: str) -> str:
    return "\n  ".join([f"SURF {number}", *lines]) + "\n"


def newton(turn: str, extra: str = "") -> str:
    """A paraboloid of f = 1 m, a flat 0.8 m before it and the image 0.2 m aside; turned about x (3) or y (4)."""
    return HEAD + ANGLES + "".join(
        [
            surface(0, "DISZ INFINITY"),
            surface(1, "STOP", f"CURV {-1.0 / 2000.0}", "CONI -1", "DISZ -800", MIRROR),
            surface(2, "TYPE COORDBRK", f"PARM {turn} 45", "DISZ 0"),
            surface(3, "CURV 0", "DISZ 0", MIRROR, *([extra] if extra else [])),
            surface(4, "TYPE COORDBRK", f"PARM {turn} 45", "DISZ 200"),
            surface(5, "CURV 0", "DISZ 0"),
        ]
    )  # fmt: skip


@pytest.mark.parametrize("turn", ["3", "4"])
def test_a_newtonian_is_a_paraboloid_with_its_image_at_the_focus(tmp_path: Path, backend, turn: str) -> None:
    folded = read_zemax(file(tmp_path, "newton.zmx", newton(turn)))
    made = camera_of(folded, "newton", backend)
    assert list(made.camera.mirrors) == ["M1"]
    assert made.camera.image.z == pytest.approx(-1.0, abs=1e-15)
    assert "its errors and its shadow are omitted" in str(made.notes)
    # rays through the folded file and through the unfolded one: the same paths, the same distances from the middle
    rng = np.random.default_rng(2)
    start = np.concatenate([rng.uniform(-0.07, 0.07, (50, 2)), np.full((50, 1), -2.0)], axis=1)
    light = np.concatenate([rng.uniform(-0.005, 0.005, (50, 2)), np.ones((50, 1))], axis=1)
    rays = make_rays(backend, start, light / np.linalg.norm(light, axis=1, keepdims=True))
    both = [trace(backend, assemble(lens.assembly(), [SEQUENCE]), rays).numpy() for lens in (folded, unfolded(folded))]
    places, paths = [one[0][0] for one in both], [one[2][0] for one in both]
    assert paths[1] == pytest.approx(paths[0], abs=1e-14)
    assert np.hypot(*places[1].T[:2]) == pytest.approx(np.hypot(*places[0].T[:2]), abs=1e-14)


def test_what_a_fold_leaves(tmp_path: Path, backend) -> None:
    """The edge of a flat that cuts light stays where it cuts it."""
    made = camera_of(read_zemax(file(tmp_path, "newton.zmx", newton("3", "CLAP 0 15 0"))), "newton", backend)
    (name,) = (name for name, one in made.camera.mirrors.items() if one.light == "passes")
    assert made.camera.mirrors[name].edges is not None
    assert made.camera.mirrors[name].z == pytest.approx(-0.8)


def test_a_fold_before_a_freeform_cannot_be_unfolded(tmp_path: Path, backend) -> None:
    freeform = "TYPE XPOLYNOM\n  XDAT 1 9 0 0 1\n  XDAT 2 20 0 0 1\n  XDAT 5 0.01 0 0 1"
    fold = surface(5, freeform, "CURV 0", "DISZ -10", MIRROR) + surface(6, "CURV 0", "DISZ 0")
    text = newton("3").partition("SURF 5")[0] + fold
    with pytest.raises(InputError, match="a fold before a surface that is not a surface of revolution"):
        unfolded(read_zemax(file(tmp_path, "a.zmx", text)))


def paraboloid(field: str, distance: str = "INFINITY", image: str = "CURV 0") -> str:
    return HEAD + field + "".join(
        [
            surface(0, f"DISZ {distance}"),
            surface(1, "STOP", f"CURV {-1.0 / 2000.0}", "CONI -1", "DISZ -1000", MIRROR),
            surface(2, image, "DISZ 0"),
        ]
    )  # fmt: skip


@pytest.mark.second
@pytest.mark.parametrize("kind", [2, 3])
def test_fields_as_heights_on_the_image(tmp_path: Path, backend, kind: int) -> None:
    """Of a paraboloid that is its own stop the chief ray of tan w meets the focal plane at f tan w, to all orders."""
    text = paraboloid(f"FTYP {kind} 0 3 1 0 0 0\nXFLN 0 10 -10\nYFLN 0 20 -20\n")
    camera = camera_of(read_zemax(file(tmp_path, "heights.zmx", text)), "heights", backend).camera
    assert (camera.field.x, camera.field.y) == pytest.approx((np.arctan(0.01), np.arctan(0.02)), rel=1e-12)


@pytest.mark.second
def test_a_height_with_distortion(tmp_path: Path, backend) -> None:
    """The chief ray of the camera's largest direction meets the height that the file has for it."""
    text = SINGLET.replace("FTYP 0", "FTYP 3").replace("YFLN 0 2", "YFLN 0 3")
    spec = camera_of(read_zemax(file(tmp_path, "singlet.zmx", text), own_glasses()), "singlet", backend).camera
    model = derive_camera(spec, backend)
    bare = model.bare_assembly(apertures=False)
    # the stop is the first surface, whose vertex is the frame's origin
    assert spec.stop == next(iter(spec.mirrors))
    light = np.array([[0.0, np.sin(spec.field.y), np.cos(spec.field.y)]])
    rays = make_rays(backend, -0.1 * light, light)
    height = trace(backend, assemble(bare, ["imaging"]), rays).numpy()[0][0, 0, 1]
    assert height == pytest.approx(3e-3, abs=1e-12) or height == pytest.approx(-3e-3, abs=1e-12)


def test_heights_of_codev(tmp_path: Path, backend) -> None:
    text = (
        "LEN NEW\nRDM Y; DIM M\nEPD 200\nWL 550\nYIM 0 20\nSO 0.0 1e13\nS -2000.0 -1000.0 REFL\n  STO; K -1.0\n"
        "SI 0.0 0.0\nGO\n"
    )
    camera = camera_of(read_codev(file(tmp_path, "heights.seq", text)), "heights", backend).camera
    assert camera.field.y == pytest.approx(np.arctan(0.02), rel=1e-6)


def test_an_object_far_away_is_at_infinity(tmp_path: Path, backend) -> None:
    """With f = 1 m its image stands 1 / 2e6 m behind the focus; heights of 2000 m there are 1 mrad."""
    path = file(tmp_path, "far.zmx", paraboloid("FTYP 1 0 3 1 0 0 0\nXFLN 0 2e6 0\nYFLN 0 0 2e6\n", "2e9"))
    made = camera_of(read_zemax(path), "far", backend)
    assert (made.camera.field.x, made.camera.field.y) == pytest.approx((1e-3, 0.5e-3), rel=1e-3)
    assert "2e+06 m away, treated as infinity, whose image is 0.5 um nearer" in " ".join(map(str, made.notes))
    path.write_text(paraboloid(ANGLES, "9e8"), "utf-8")
    with pytest.raises(InputError, match="finite distance"):
        camera_of(read_zemax(path), "near", backend)


def test_a_curved_image_has_a_plane_that_touches_it(tmp_path: Path, backend) -> None:
    path, out = tmp_path / "curved.zmx", tmp_path / "out.yaml"
    path.write_text(paraboloid(ANGLES, image=f"CURV {1.0 / 500.0}"), "utf-8")
    refused = invoke(app, "read", path, "--out", out)
    assert refused.exit_code == 2
    assert "a plane: --flat-image uses the tangent plane" in refused.stderr.replace("\n", " ")
    taken = invoke(app, "read", path, "--out", out, "--flat-image")
    assert taken.exit_code == 0, taken.stderr
    # the sag h^2 / 2 R at 1 m for R = 0.5 m
    assert "1e+03 mm x (h / 1 m)^2" in taken.stdout
    assert with_flat_image(read_zemax(path)).image.surface.is_plane


DEEP = "opticalSystem:\n" + "".join(
    f"{'  ' * (2 * k + 1)}type: CompoundOptic\n{'  ' * (2 * k + 1)}items:\n{'  ' * (2 * k + 2)}-\n" for k in range(22)
)
ENDLESS = {
    "too many surfaces": ("a.seq", CODEV.replace("S 0.0 100.0\n", "S 0.0 100.0\n" * 2001)),
    "the line is too long": ("b.seq", CODEV.replace("TITLE 'folded'", "TITLE '" + "x" * 100_000 + "'")),
    "not UTF-16 text": ("c.zmx", TMA.encode("utf-16")[:-1]),
    "optics are nested too deeply": ("e.yaml", DEEP + " " * 90 + "{type: Detector}\n"),
    "too many surfaces; allowed": (
        "d.yaml",
        BATOID.replace("  items:\n", "  items:\n" + "    - {type: Mirror, surface: {type: Plane}}\n" * 2001, 1),
    ),
}


@pytest.mark.parametrize("problem", quick(4, ENDLESS))
def test_files_without_end_or_with_half_a_character_are_refused(tmp_path: Path, problem: str) -> None:
    name, text = ENDLESS[problem]
    path = file(tmp_path, name, text)
    with pytest.raises(InputError, match=problem):
        {".seq": read_codev, ".zmx": read_zemax, ".yaml": lambda one: read_batoid(one, 650e-9)}[path.suffix](path)


MAKERS = {
    "N-K5": (1.52249, 59.48), "N-BAK4": (1.56883, 55.98), "N-BAF10": (1.67003, 47.11), "N-SK2": (1.60738, 56.65),
    "N-SK16": (1.62041, 60.32), "N-SSK8": (1.61773, 49.83), "F2": (1.62004, 36.37), "SF2": (1.64769, 33.85),
    "SF6": (1.80518, 25.43), "SF10": (1.72825, 28.41), "N-SF5": (1.67271, 32.25), "N-SF6": (1.80518, 25.36),
    "N-SF11": (1.78472, 25.68), "N-LAK22": (1.65113, 55.89), "N-KZFS4": (1.61336, 44.49), "N-FK51A": (1.48656, 84.47),
    "S-BSL7": (1.51633, 64.14), "S-FPL51": (1.49700, 81.55), "S-FPL53": (1.43875, 94.95), "S-TIH6": (1.80518, 25.43),
    "BSC7": (1.51680, 64.20), "FCD1": (1.49700, 81.61), "FCD100": (1.43700, 95.10), "E-FD1": (1.71736, 29.50),
    "H-K9L": (1.51680, 64.20), "H-ZF52": (1.84666, 23.78), "H-FK61": (1.49700, 81.61), "CaF2": (1.43385, 95.00),
}  # fmt: skip
"""Index at the d line and Abbe number, as the makers print them on their sheets: rounded to 1e-5 and 0.01."""


def test_common_glasses_have_the_numbers_of_their_sheets() -> None:
    assert set(MAKERS) == set(common_glasses())
    for name, glass in common_glasses().items():
        at_d, at_f, at_c = (glass(line) for line in ABBE_LINES)
        assert (at_d, (at_d - 1.0) / (at_f - at_c)) == (
            pytest.approx(MAKERS[name][0], abs=0.6e-5),
            pytest.approx(MAKERS[name][1], abs=0.0051),
        ), name


def test_a_common_glass_by_its_name(tmp_path: Path, backend) -> None:
    """In a prescription without a catalogue, with its source; in a camera's file; not that of another maker."""
    path = file(tmp_path, "flint.zmx", SINGLET.replace("N-BK7", "F2"))
    made = camera_of(read_zemax(path, own_glasses()), "flint", backend)
    assert "F2: the glass of Schott's Zemax catalogue of 2017-01-20" in " ".join(map(str, made.notes))
    path.write_text("GCAT CDGM\n" + SINGLET.replace("N-BK7", "F2"), "utf-8")
    with pytest.raises(InputError, match="unknown glass"):
        read_zemax(path, own_glasses())
    named = LensGlassSpec(name="N-SF11")
    assert named.index(ABBE_LINES[0], "air") == common_glasses()["N-SF11"](ABBE_LINES[0])
    # Schott's sheet: dn/dT absolute at the d line, 20 to 40 C, -0.7e-6 1/K, and 8.52e-6 1/K of expansion
    warm = named.warm(ABBE_LINES[0], "air")
    assert warm.expansion == pytest.approx(8.52e-6)
    assert warm.change(293.15, 313.15) / 20.0 == pytest.approx(-0.7e-6, abs=1e-6)
