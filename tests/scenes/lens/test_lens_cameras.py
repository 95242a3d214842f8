"""Cameras made of foreign prescriptions and prescriptions made of cameras: both trace the same."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from optics.geometry.aperture import Circle, Edge
from optics.geometry.sag_terms import XYPolynomial, ZernikeSag
from optics.geometry.surface import GridFigure, SummedFigure, Surface, ZernikeFigure
from optics.geometry.tree import Motion
from optics.materials.glass import GLASSES
from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.lens.__main__ import app
from scenes.lens.batoid_reader import read_batoid
from scenes.lens.camera_reader import Width, camera_of, camera_text
from scenes.lens.camera_writer import batoid_text, perturbed_prescription, prescription_of, zemax_text
from scenes.lens.prescription import SEQUENCE, Prescription, joined
from scenes.lens.statements import Glasses, own_glasses, read_catalogues
from scenes.lens.zemax_reader import read_zemax
from scenes.models.camera_model import collimated, derive_camera, field_direction
from scenes.models.instrument_builder import build_instrument
from scenes.specs.camera import CameraSpec
from scenes.specs.load import EXAMPLES, SCENES, load_camera, load_instrument
from scenes.yaml.errors import InputError
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import parse_yaml
from tests.scenes.lens.files import BATOID, SINGLET, TMA
from tests.scenes.refusals.tables import changed
from tests.tiers import quick
from tests.twin.study_bench import REFUSED

ROUNDING = 1e-12
"""Metres: some ten metres of path in float64, with a lever arm of mirrors."""


def rays_of(model, backend) -> tuple[np.ndarray, np.ndarray]:
    """Rays of nine fields through the stop of a camera: launch points and directions (N, 3)."""
    spec, bare = model.spec, model.bare_assembly(apertures=False)
    to_stop = assemble(bare, [model.mirrors[: model.mirrors.index(spec.stop) + 1]])
    fields = [(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]
    directions = np.array([field_direction(spec, x * spec.field.x, y * spec.field.y) for x, y in fields])
    rng = np.random.default_rng(4)
    radius, angle = (
        model.apertures[spec.stop].bounds[1] * np.sqrt(rng.uniform(size=20)),
        rng.uniform(0.0, 2 * np.pi, 20),
    )
    launch = collimated(
        backend, to_stop, directions, np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    )
    return launch.reshape(-1, 3), np.repeat(directions, 20, axis=0)


def at_image(backend, assembly, sequence, launch, direction, state=None) -> np.ndarray:
    """Place, direction and path of rays at a sequence's end, (N, 7)."""
    traced = trace(backend, assemble(assembly, [sequence], [state or {}]), make_rays(backend, launch, direction))
    position, leaving, path, valid = (a[0] for a in traced.numpy())
    assert valid.all()
    return np.concatenate([position, leaving, path[:, None]], axis=-1)


def singlet(folder: Path, text: str = SINGLET, glasses: Glasses | None = None) -> Prescription:
    """Return a lens of a file."""
    (folder / "singlet.zmx").write_text(text, "utf-8")
    return read_zemax(folder / "singlet.zmx", own_glasses() if glasses is None else glasses)


def read_back(lens: Prescription, path: Path) -> Prescription:
    """Write a prescription and return what is read of it."""
    path.write_text(zemax_text(lens) if path.suffix == ".zmx" else batoid_text(lens)[0], "utf-8")
    return read_zemax(path) if path.suffix == ".zmx" else read_batoid(path, 650e-9)


@pytest.mark.second
@pytest.mark.parametrize("kind", [".zmx", ".yaml"])
@pytest.mark.parametrize("name", quick(1, ["gf7_conic", "gf7", "monitor"]))
def test_out_and_in_again(tmp_path: Path, backend, camera, name: str, kind: str) -> None:
    model = camera(name)
    back = read_back(prescription_of(model), tmp_path / f"{name}{kind}")
    launch, direction = rays_of(model, backend)
    first = at_image(backend, model.bare_assembly(apertures=False), "imaging", launch, direction)
    # what a file says of the edges of mirrors stops the same rays: none of these
    second = at_image(backend, back.assembly(apertures=True), SEQUENCE, launch, direction)
    np.testing.assert_allclose(second, first, rtol=0, atol=ROUNDING)
    if kind == ".zmx":
        made = camera_of(back, name, backend)
        spec = made.camera
        third = at_image(backend, derive_camera(spec, backend).bare_assembly(False), "imaging", launch, direction)
        np.testing.assert_allclose(third, first, rtol=0, atol=ROUNDING)
        for ours, theirs in ((spec.stop_diameter, model.spec.stop_diameter), (spec.field.x, model.spec.field.x)):
            assert ours == pytest.approx(theirs, rel=1e-12)
        # to the digits that the file has of it
        assert spec.entrance_pupil == pytest.approx(model.entrance_pupil, rel=1e-8)
        assert (spec.stop, spec.field_bias) == (model.spec.stop, pytest.approx(model.spec.field_bias, rel=1e-12))


@pytest.mark.second
def test_the_camera_file_is_read_and_traces_the_same(tmp_path: Path, backend) -> None:
    path = tmp_path / "tma.zmx"
    path.write_text(TMA, "utf-16")
    lens = read_zemax(path)
    made = camera_of(lens, "tma", backend)
    text = camera_text(made, lens)
    spec = validate(CameraSpec, parse_yaml(text))
    assert spec == made.camera
    model = derive_camera(spec, backend)
    launch, direction = rays_of(model, backend)
    first = at_image(backend, lens.assembly(False), SEQUENCE, launch, direction)
    second = at_image(backend, model.bare_assembly(False), "imaging", launch, direction)
    np.testing.assert_allclose(second, first, rtol=0, atol=ROUNDING)
    assert "# line" in text
    assert "XYZZY 1 2 3: not understood" in text


def test_a_lens_is_a_lens_either_way(tmp_path: Path, backend) -> None:
    """Focal length by the lensmaker's formula; backward rays come out along those that went in."""
    n, c, t = GLASSES["N-BK7"].index(587.5618e-9), 1.0 / 0.05, 0.004
    power = (n - 1.0) * (2.0 * c - (n - 1.0) * t * c * c / n)
    focus = (1.0 - (n - 1.0) * t * c / n) / power
    f_number = SINGLET.replace("ENPD 10", "FNUM 20 0")
    # the pupil of an F-number is that of the focal length, wherever the image stands
    made = camera_of(singlet(tmp_path, f_number), "singlet", backend)
    assert made.camera.entrance_pupil == pytest.approx(1.0 / power / 20.0, rel=1e-8)
    made = camera_of(singlet(tmp_path, f_number.replace("DISZ 47.5", f"DISZ {1e3 * focus!r}")), "singlet", backend)
    model = derive_camera(made.camera, backend)
    assert float(model.first_order.principal_distance[0]) == pytest.approx(1.0 / power, rel=1e-9)
    bare = model.bare_assembly(False)
    launch, direction = rays_of(model, backend)
    there = trace(backend, assemble(bare, ["imaging"]), make_rays(backend, launch, direction), world=True)
    place, leaving, _, _ = (a[0] for a in there.numpy(there.world))
    back = trace(backend, assemble(bare, [model.mirrors[::-1]]), make_rays(backend, place, -leaving), world=True)
    _, again, _, valid = (a[0] for a in back.numpy(back.world))
    assert valid.all()
    np.testing.assert_allclose(again, -direction, rtol=0, atol=ROUNDING)


@pytest.mark.second
def test_glasses_come_along_with_their_dispersion(tmp_path: Path, backend) -> None:
    """By name or by the catalogue's formula; a glass whose dispersion nobody knows keeps its index."""
    agf = tmp_path / "own.agf"
    front = camera_of(singlet(tmp_path), "singlet", backend, Width(pupil=1e-4)).camera
    assert front.medium == "air"
    assert front.plain()["mirrors"]["L1"]["glass"] == "N-BK7"
    assert front.index_behind("L1", 500e-9) == GLASSES["N-BK7"].index(500e-9)
    numbers = "1.34533359 0.00997743871 0.209073176 0.0470450767 0.937357162 111.886764"
    heat = "ED 8.2 9.2 3.6 0 0\nTD 1.51e-6 1.56e-8 -2.78e-11 9.34e-7 1.04e-9 0.25 20"
    agf.write_text(f"NM F2 2 0 1.62 36.37\nCD {numbers} 0 0 0 0\n{heat}\nLD 0.32 2.5\n", "utf-8")
    lens = singlet(tmp_path, SINGLET.replace("N-BK7", "F2"), read_catalogues([agf]))
    made = camera_of(lens, "singlet", backend, Width(pupil=1e-4)).camera
    again = validate(CameraSpec, parse_yaml(made.file_text("")))
    assert again == made
    assert again.mirrors["L1"].glass.expansion == pytest.approx(8.2e-6, rel=1e-15)
    n = again.index_behind("L1")
    slope = (n * n - 1.0) / (2.0 * n) * (1.51e-6 + 9.34e-7 / ((again.wavelength * 1e6) ** 2 - 0.25**2))
    assert again.warm_glass("L1").slope(293.15) == pytest.approx(slope, rel=1e-12)
    # Schott's data sheet
    for wavelength, index in ((486.1327e-9, 1.63208), (587.5618e-9, 1.62004), (656.2725e-9, 1.61503)):
        assert again.index_behind("L1", wavelength) == pytest.approx(index, abs=1e-5)


GRID = GridFigure(np.zeros((5, 5)), (-1.0, 1.0, -1.0, 1.0))
ERROR = ZernikeFigure(0.1, (0.0, 0.0), {5: 1e-7})
SAG = ZernikeSag(radius=0.1, Z5=1e-7)
CURVE = XYPolynomial(x2=1e-3)


@pytest.mark.parametrize(
    ("shape", "zemax", "batoid", "camera_file"),
    [
        *(
            (
                Surface(-0.1, figure=figure),
                "a figure on a grid",
                "cannot represent this: a figure on a grid",
                "a camera's file cannot represent a figure on a grid",
            )
            for figure in (GRID, SummedFigure(ERROR, GRID))
        ),
        (Surface(-0.1, terms=(CURVE,), figure=ERROR), "with other sag terms", "", ""),
        (Surface(-0.1, even=(0.0,) * 7 + (1e-9,)), "even powers beyond r^16", "", ""),
        (Surface(-0.1, terms=(SAG,)), "sag terms that the format does not have", "is not a polynomial", ""),
        (Surface(-0.1, even=(0.0,) * 9 + (1e-9,), terms=(CURVE,)), "a polynomial beyond order 20", "", ""),
        (Surface(even=(0.0,) * 9 + (1e-9,)), "even powers beyond", "a polynomial of so high an order", ""),
    ],
)
def test_shapes_that_a_format_has_no_place_for(backend, camera, shape, zemax, batoid, camera_file) -> None:
    lens = prescription_of(camera("gf7"))
    bent = replace(lens, surfaces=(replace(lens.surfaces[0], surface=shape), *lens.surfaces[1:]))
    for write, problem in (
        (zemax_text, zemax),
        (batoid_text, batoid),
        (lambda one: camera_of(one, "bent", backend), camera_file),
    ):
        if problem:
            with pytest.raises(InputError, match=re.escape(problem)):
                write(bent)


def test_a_hole_in_an_obscuration_is_no_edge_of_a_zemax_file(camera) -> None:
    lens = prescription_of(camera("gf7"))
    bent = replace(lens.surfaces[0], aperture=None, edges=(Edge(Circle(0.1, inner=0.05), True),))
    with pytest.raises(InputError, match="an obscuration with a hole"):
        zemax_text(replace(lens, surfaces=(bent, *lens.surfaces[1:])))


def test_zernike_terms_that_cannot_be_joined() -> None:
    for figure, problem in ((GRID, "with a figure on a grid"), (replace(ERROR, terms={70: 1e-9}), "outside 1..66")):
        with pytest.raises(ValueError, match=problem):
            joined(Surface(-0.1, terms=(SAG,), figure=figure))


def test_an_instrument_takes_no_lenses(tmp_path: Path, backend) -> None:
    made = camera_of(singlet(tmp_path), "singlet", backend, Width(pupil=1e-4))
    with pytest.raises(InputError, match="a camera with a monitor must consist of mirrors only"):
        build_instrument(load_instrument("gf7_pair"), {"gf7": made.camera}, backend)


ZERNIKE = (
    "TYPE SZERNSAG\n  PARM 9 2\n  PARM 10 -50\n  XDAT 1 7\n  XDAT 2 80\n  XDAT 6 1e-4\n  XDAT 8 2e-4\n  XDAT 9 -1e-4"
)


@pytest.mark.second
def test_a_freeform_of_zernike_terms_goes_in_and_out(tmp_path: Path, backend) -> None:
    """As a camera's own sag, and out again with a figure error about another middle on top of it."""
    path = tmp_path / "freeform.zmx"
    path.write_text(TMA.replace("TYPE EVENASPH", ZERNIKE), "utf-8")
    lens = read_zemax(path)
    made = camera_of(lens, "freeform", backend)
    spec = validate(CameraSpec, parse_yaml(camera_text(made, lens)))
    model = derive_camera(spec, backend)
    launch, direction = rays_of(model, backend)
    first = at_image(backend, lens.assembly(False), SEQUENCE, launch, direction)
    np.testing.assert_allclose(
        at_image(backend, model.bare_assembly(False), "imaging", launch, direction), first, rtol=0, atol=ROUNDING
    )
    path.write_text(TMA, "utf-8")
    plain = read_zemax(path)
    assert np.max(np.abs(at_image(backend, plain.assembly(False), SEQUENCE, launch, direction) - first)) > 1e-6
    for kind in (".zmx", ".yaml"):
        again = prescription_of(model)
        mirror = again.surfaces[0]
        error = ZernikeFigure(0.1, (0.01, -0.05), {5: 1e-7, 7: 2e-7})
        shape = joined(replace(model.surfaces["M1"], figure=error))
        bent = replace(again, surfaces=(replace(mirror, surface=shape), *again.surfaces[1:]))
        back = read_back(bent, tmp_path / f"bent{kind}")
        x, y = np.array([0.01, -0.02]), np.array([-0.03, -0.06])
        wanted = model.surfaces["M1"].sag(x, y) + error.sag(x, y)
        np.testing.assert_allclose(back.surfaces[0].surface.sag(x, y), wanted, rtol=0, atol=1e-16)


STATE = {
    "base/forward": Motion(rotate=(1e-4, -2e-4, 3e-4), shift=(1e-4, 0.0, -2e-4)),
    "base/forward/M1": Motion(rotate=(1e-4, 2e-4, -1e-4), shift=(2e-5, -3e-5, 4e-5), pivot="centre"),
    "base/forward/M2": Motion(shift=(1e-5, 0.0, 2e-5), scale=3e-5),
    "base/forward/M3": Motion(figure={5: 2e-8, 8: -1e-8, 11: 1e-8}),
    "base/forward/focal_plane": Motion(rotate=(5e-5, 1e-5, 2e-4), shift=(0.0, 1e-5, 2e-5)),
}


@pytest.mark.parametrize("kind", [".zmx", ".yaml"])
def test_a_perturbed_camera_traces_as_the_instrument_does(tmp_path: Path, backend, instrument, kind: str) -> None:
    """Rays of the scene through the instrument in that state, and through the file that was written of it."""
    model, pair = instrument("gf7_pair").cameras["forward"], instrument("gf7_pair")
    lens = perturbed_prescription(pair, "forward", STATE)
    back = read_back(lens, tmp_path / f"perturbed{kind}")
    launch, direction = rays_of(model, backend)
    design = pair.assembly.nominal_pose("base/forward") @ model.camera_frame.inverse()
    first = at_image(
        backend, pair.assembly, "forward/imaging", design.apply(launch), direction @ design.rotation.T, STATE
    )
    second = at_image(backend, back.assembly(False), SEQUENCE, launch, direction)
    # the image's frame stands on the parent axis, the line CCD's in the line's middle, with its z toward the scene
    own = model.focal_plane.inverse() @ model.image_body
    np.testing.assert_allclose(own.apply(second[:, :3]), first[:, :3], rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(second[:, 3:6] @ own.rotation.T, first[:, 3:6], rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(second[:, 6], first[:, 6], rtol=0, atol=10.0 * ROUNDING)
    nominal = at_image(backend, prescription_of(model).assembly(False), SEQUENCE, launch, direction)
    assert np.min(np.linalg.norm(nominal[:, :2] - second[:, :2], axis=-1)) > 1e-3


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


@pytest.mark.second
def test_the_example_of_a_zemax_file_is_what_is_read_of_it(tmp_path: Path, backend) -> None:
    """The camera beside it, which a tolerance budget names."""
    out = tmp_path / "cassegrain_zmx.yaml"
    code, said = run("read", EXAMPLES / "cassegrain.zmx", "--out", out)
    assert code == 0, said
    assert load_camera(out).plain() == load_camera(EXAMPLES / "cassegrain_zmx.yaml").plain()


JOB = "instrument: gf7_pair\nperturb: {base/forward/M2: {shift: 0 0 30 um, figure: {Z5: 20 nm}}}\n"


@pytest.mark.second
def test_the_command(tmp_path: Path, backend) -> None:
    (tmp_path / "tma.zmx").write_text(TMA, "utf-16")
    (tmp_path / "two.yaml").write_text(BATOID, "utf-8")
    camera = tmp_path / "camera.yaml"
    code, said = run("read", tmp_path / "tma.zmx", "--out", camera)
    assert code == 0, said
    assert "3 mirrors" in said
    assert "XYZZY 1 2 3: not understood" in said
    assert load_camera(camera).name == "camera"
    assert run("read", tmp_path / "tma.zmx", "--out", camera)[0] == 2
    assert "exists" in run("read", tmp_path / "tma.zmx", "--out", camera)[1]
    code, said = run("read", tmp_path / "two.yaml", "--out", camera, "--force", "--wavelength", "650 nm", "--field",
                     "0.1 deg", "--pupil", "2 m", "--pitch", "15 um")  # fmt: skip
    assert code == 0, said
    assert load_camera(camera).line.pitch == pytest.approx(15e-6)
    (tmp_path / "job.yaml").write_text(JOB, "utf-8")
    (tmp_path / "what.doc").touch()
    for words, problem in REFUSED["lens_commands"]:
        code, said = run(
            *(tmp_path / one if "." in one or "/" in one else one.replace("_", " ") for one in words.split())
        )
        assert (code, problem in " ".join(said.split())) == (2, True), (words, said)
        assert not (tmp_path / "a.yaml").exists()
        assert not (tmp_path / "a.zmx").exists()


@pytest.mark.second
def test_the_command_writes_a_perturbed_camera(tmp_path: Path, instrument) -> None:
    job = tmp_path / "job.yaml"
    job.write_text(JOB, "utf-8")
    for name in ("a.zmx", "a.yaml"):
        code, said = run("write", "gf7", "--perturbed", job, "--camera", "forward", "--out", tmp_path / name)
        assert code == 0, said
    moved = read_zemax(tmp_path / "a.zmx")
    assert moved.surfaces[1].pose.translation[2] == pytest.approx(-2.01593047747168 + 30e-6, abs=1e-14)
    # nodes bend a mirror by Zernike terms and a grid
    mirror = instrument("gf7_pair").assembly.elements["forward/M1"]
    x0, x1, y0, y1 = mirror.aperture.bounds
    x, y = map(np.ravel, np.meshgrid(np.linspace(x0 - 0.01, x1 + 0.01, 24), np.linspace(y0 - 0.01, y1 + 0.01, 20)))
    nodes = np.stack([x, y, mirror.surface.sag(x, y), 0.0 * x, 0.0 * x, 2e-8 * np.sin(9.0 * x) * np.cos(7.0 * y)], -1)
    head = "x [m],y [m],z [m],dx [m],dy [m],dz [m]"
    np.savetxt(tmp_path / "m1.csv", nodes, delimiter=",", header=head, comments="")
    own = "@mirrors.M1.sag => {zernike: {radius: 400 mm, Z5: 1 nm}}"
    for name, file, change in (
        ("camera", "cameras/gf7", own),
        ("pair", "instruments/gf7_pair", "@cameras.forward.camera => ./camera.yaml"),
    ):
        text = (SCENES / f"library/{file}.yaml").read_text("utf-8")
        (tmp_path / f"{name}.yaml").write_text(changed(text, change), "utf-8")
    for name, camera, problem in (
        ("gf7_pair", "gf7", "a figure on a grid"),
        ("./pair.yaml", tmp_path / "camera.yaml", "Zernike sag terms with a figure on a grid cannot be merged"),
    ):
        job.write_text(f"instrument: {name}\nperturb: {{base/forward/M1: {{deformation: m1.csv}}}}\n", "utf-8")
        code, said = run("write", camera, "--perturbed", job, "--camera", "forward", "--out", tmp_path / "b.zmx")
        assert (code, problem in " ".join(said.split())) == (2, True), said


def test_what_a_zemax_file_cannot_hold_is_refused(tmp_path: Path, backend) -> None:
    made = camera_of(singlet(tmp_path), "singlet", backend, Width(pupil=1e-4))
    lens: Prescription = prescription_of(derive_camera(made.camera, backend))
    with pytest.raises(InputError, match="a face of a lens"):
        zemax_text(lens)
    back = read_back(lens, tmp_path / "singlet.yaml")
    assert [s.index for s in back.surfaces] == [s.index for s in lens.surfaces]


def test_fields_are_those_of_the_file(tmp_path: Path, backend) -> None:
    """0 and 2 deg on one axis are the middle and the end of the camera's field; what it adds is told."""
    lens = singlet(tmp_path)
    made = camera_of(lens, "singlet", backend)
    assert (made.camera.field_bias, made.camera.field.x, made.camera.field.y) == (0.0, math.radians(2), math.radians(2))
    notes = [str(note) for note in made.notes if note.statement == "field"]
    assert len(notes) == 1
    assert "one axis alone, to 2 deg" in notes[0]
    assert "with corners at 2.828 deg" in notes[0]
    assert "--field '2 deg'" in notes[0]
    # a single direction gets a small field about it
    made = camera_of(replace(lens, fields=((0.0, 0.0),)), "singlet", backend)
    assert made.camera.field.x == made.camera.field.y == pytest.approx(math.radians(0.05))
    # a round field is asked for in words, and has the square in it
    made = camera_of(replace(lens, round_field=True), "singlet", backend)
    assert made.camera.field.x == pytest.approx(math.radians(2) / math.sqrt(2.0), rel=1e-14)
