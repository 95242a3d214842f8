"""Files as they are published: turned and curved images, heights for fields, far objects, glasses by their names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from optics.materials.dispersion import ABBE_LINES, common_glasses
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.lens.__main__ import app
from scenes.lens.camera_reader import camera_of
from scenes.lens.codev_reader import read_codev
from scenes.lens.glass_catalogue import own_glasses
from scenes.lens.prescription import SEQUENCE
from scenes.lens.unfolding import unfolded, with_flat_image
from scenes.lens.zemax_reader import read_zemax
from scenes.models.camera_model import derive_camera
from scenes.specs.glass import LensGlassSpec
from scenes.yaml.errors import InputError
from tests.scenes.lens.files import SINGLET
from tests.twin.commands import invoke

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
    path = tmp_path / "newton.zmx"
    path.write_text(newton(turn), "utf-8")
    folded = read_zemax(path)
    made = camera_of(folded, "newton", backend)
    assert list(made.camera.mirrors) == ["M1"]
    assert made.camera.image.z == pytest.approx(-1.0, abs=1e-15)
    assert "its errors are not carried, nor its shadow" in str(made.notes)
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
    path = tmp_path / "newton.zmx"
    path.write_text(newton("3", "CLAP 0 15 0"), "utf-8")
    made = camera_of(read_zemax(path), "newton", backend)
    (name,) = (name for name, one in made.camera.mirrors.items() if one.light == "passes")
    assert made.camera.mirrors[name].edges is not None
    assert made.camera.mirrors[name].z == pytest.approx(-0.8)


def paraboloid(field: str, distance: str = "INFINITY", image: str = "CURV 0") -> str:
    return HEAD + field + "".join(
        [
            surface(0, f"DISZ {distance}"),
            surface(1, "STOP", f"CURV {-1.0 / 2000.0}", "CONI -1", "DISZ -1000", MIRROR),
            surface(2, image, "DISZ 0"),
        ]
    )  # fmt: skip


@pytest.mark.parametrize("kind", [2, 3])
def test_fields_as_heights_on_the_image(tmp_path: Path, backend, kind: int) -> None:
    """Of a paraboloid that is its own stop the chief ray of tan w meets the focal plane at f tan w, to all orders."""
    path = tmp_path / "heights.zmx"
    path.write_text(paraboloid(f"FTYP {kind} 0 3 1 0 0 0\nXFLN 0 10 -10\nYFLN 0 20 -20\n"), "utf-8")
    camera = camera_of(read_zemax(path), "heights", backend).camera
    assert (camera.field.x, camera.field.y) == pytest.approx((np.arctan(0.01), np.arctan(0.02)), rel=1e-12)


def test_a_height_with_distortion(tmp_path: Path, backend) -> None:
    """The chief ray of the camera's largest direction meets the height that the file has for it."""
    text = SINGLET.replace("FTYP 0", "FTYP 3").replace("YFLN 0 2", "YFLN 0 3")
    path = tmp_path / "singlet.zmx"
    path.write_text(text, "utf-8")
    spec = camera_of(read_zemax(path, own_glasses()), "singlet", backend).camera
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
    path = tmp_path / "heights.seq"
    path.write_text(text, "utf-8")
    camera = camera_of(read_codev(path), "heights", backend).camera
    assert camera.field.y == pytest.approx(np.arctan(0.02), rel=1e-6)


def test_an_object_far_away_is_at_infinity(tmp_path: Path, backend) -> None:
    """With f = 1 m its image stands 1 / 2e6 m behind the focus; heights of 2000 m there are 1 mrad."""
    path = tmp_path / "far.zmx"
    path.write_text(paraboloid("FTYP 1 0 3 1 0 0 0\nXFLN 0 2e6 0\nYFLN 0 0 2e6\n", "2e9"), "utf-8")
    made = camera_of(read_zemax(path), "far", backend)
    assert (made.camera.field.x, made.camera.field.y) == pytest.approx((1e-3, 0.5e-3), rel=1e-3)
    assert "2e+06 m away is taken for infinity, whose image is 0.5 um nearer" in " ".join(map(str, made.notes))
    path.write_text(paraboloid(ANGLES, "9e8"), "utf-8")
    with pytest.raises(InputError, match="finite distance"):
        camera_of(read_zemax(path), "near", backend)


def test_a_curved_image_has_a_plane_that_touches_it(tmp_path: Path, backend) -> None:
    path, out = tmp_path / "curved.zmx", tmp_path / "out.yaml"
    path.write_text(paraboloid(ANGLES, image=f"CURV {1.0 / 500.0}"), "utf-8")
    refused = invoke(app, "read", path, "--out", out)
    assert refused.exit_code == 2
    assert "a plane: --flat-image takes the one that touches it" in refused.stderr.replace("\n", " ")
    taken = invoke(app, "read", path, "--out", out, "--flat-image")
    assert taken.exit_code == 0, taken.stderr
    # the sag h^2 / 2 R at 1 m for R = 0.5 m
    assert "1e+03 mm x (h / 1 m)^2" in taken.stdout
    assert with_flat_image(read_zemax(path)).image.surface.is_plane


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
    path = tmp_path / "flint.zmx"
    path.write_text(SINGLET.replace("N-BK7", "F2"), "utf-8")
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
