"""Files of instruments as built: what they say, what is refused with file, line and key, and how a state is written."""

from pathlib import Path

import numpy as np
import pytest

from optics.geometry.tree import Motion
from scenes.models.camera_model import build_camera_under_test
from scenes.models.disturbances import disturbance_prior
from scenes.models.instrument_builder import build_instrument
from scenes.models.job_state import LIKELY, beyond_prior
from scenes.specs.instrument import as_built_file
from scenes.specs.load import INSTRUMENTS, LIBRARY, load_cameras, load_instrument
from scenes.specs.resolved import FocusSetup, resolve, resolve_camera
from scenes.yaml.errors import InputError

HEAD = "name: own\ndesign: gf7_pair\nas_built:\n"


def read(folder, text: str, name: str = "own.yaml"):
    (folder / name).write_text(text)
    return load_instrument(folder / name)


def built(spec, backend):
    return build_instrument(spec, load_cameras(spec), backend).as_built


@pytest.mark.second
def test_a_file_that_says_how_another_instrument_was_built(backend, tmp_path) -> None:
    text = HEAD + "  forward/M2: {shift: 0 0 3 um, pivot: centre}\n  base/central_prism: {rotate: 1 0 2 arcsec}\n"
    spec = read(tmp_path, text + "description: mine\n")
    design = load_instrument("gf7_pair")
    assert (spec.name, spec.description, spec.disturbances) == ("own", "mine", "orbit")
    assert spec.model_copy(update={"as_built": None, "name": design.name, "description": design.description}) == design
    state = built(spec, backend)
    assert list(state) == ["base/forward/M2", "base/central_prism"]
    assert state["base/forward/M2"] == Motion(shift=(0.0, 0.0, 3e-6), pivot="centre")


@pytest.mark.second
def test_the_key_in_an_instruments_own_file_says_the_same(backend, tmp_path) -> None:
    words = "[forward/M2 shift z 3 um, forward/M2 rotate x 2 arcsec about centre]"
    own = (LIBRARY / INSTRUMENTS / "gf7_pair.yaml").read_text() + f"as_built: {words}\n"
    other = (
        "name: own\ndesign: gf7_pair\nas_built:\n  forward/M2: {shift: 0 0 3 um, rotate: 2 0 0 arcsec, pivot: centre}\n"
    )
    one, two = read(tmp_path, own), read(tmp_path, other)
    assert one.as_built == two.as_built
    assert built(one, backend) == built(two, backend)


def test_paths_are_those_of_the_file_that_names_them(tmp_path) -> None:
    """Of the camera from the design's folder, of the disturbances from the folder of the file as built."""
    drawn, made = tmp_path / "drawn", tmp_path / "made"
    drawn.mkdir()
    made.mkdir()
    text = (LIBRARY / "cameras" / "gf7.yaml").read_text()
    (drawn / "my_camera.yaml").write_text(text)
    (drawn / "pair.yaml").write_text(
        (LIBRARY / INSTRUMENTS / "gf7_pair.yaml").read_text().replace("camera: gf7,", "camera: ./my_camera.yaml,")
    )
    (made / "known.yaml").write_text((LIBRARY / "disturbances" / "launch.yaml").read_text())
    said = "name: own\ndesign: ../drawn/pair.yaml\nas_built: {}\ndisturbances: ./known.yaml\n"
    (made / "own.yaml").write_text(said)
    (tmp_path / "job.yaml").write_text("instrument: made/own.yaml\n")
    found = resolve(tmp_path / "job.yaml")
    assert found.disturbances.name == "launch"
    assert list(found.cameras) == ["./my_camera.yaml"]


def test_a_camera_is_a_design_as_well(backend, tmp_path) -> None:
    for design in ("gf7", "{camera: gf7}"):
        spec = read(tmp_path, f"name: own\ndesign: {design}\nas_built: [M2 shift z 3 um]\ndisturbances: assembled\n")
        assert list(built(spec, backend)) == ["base/gf7/M2"]
    setup = resolve_camera(tmp_path / "own.yaml")
    assert (setup.mounted, setup.instrument.name) == ("gf7", "own")


def test_a_camera_as_built_in_the_laboratory(backend, tmp_path) -> None:
    """What its file says and what the test says of other bodies; one body is said once."""
    lab = (LIBRARY.parent / "lab" / "focus.yaml").read_text().replace("camera: gf7\n", "camera: ./own.yaml\n")
    (tmp_path / "focus.yaml").write_text(lab)
    read(tmp_path, "name: own\ndesign: gf7\nas_built: [focal_plane shift z 30 um, gf7 rotate x 1 arcmin]\n")
    setup = FocusSetup.read(tmp_path / "focus.yaml")
    assert list(setup.test.as_built) == ["M1", "M2", "M3", "focal_plane"]
    state = build_camera_under_test(setup.test, setup.camera, backend).as_built
    assert state["camera/focal_plane"].shift == (0.0, 0.0, 30e-6)
    read(tmp_path, "name: own\ndesign: gf7\nas_built: [base/gf7/M2 shift z 30 um]\n")
    with pytest.raises(InputError, match=r"focus.yaml:\d+: as_built.M2: .*own.yaml already has this body"):
        FocusSetup.read(tmp_path / "focus.yaml")
    read(tmp_path, HEAD + "  forward/M2: {shift: 0 0 3 um}\n")
    with pytest.raises(
        InputError, match=r"focus.yaml:\d+: camera: the test needs a single camera, but own has forward, backward"
    ):
        FocusSetup.read(tmp_path / "focus.yaml")


def random_state(rng: np.random.Generator) -> dict[str, Motion]:
    """Motions of one to six bodies, within the limits of files, of sizes from 1e-12 on."""

    def size(largest: float) -> float:
        return float(rng.choice([-1.0, 1.0]) * largest * 10.0 ** rng.uniform(-9.0, 0.0))

    paths = [
        f"base/{camera}/{body}" for camera in ("forward", "backward") for body in ("M1", "M2", "M3", "focal_plane")
    ]
    out = {}
    for path in rng.choice(paths, rng.integers(1, 7), replace=False).tolist():
        mirror = "/M" in path
        turn, move = (tuple(size(largest) for _ in range(3)) for largest in (0.05, 0.05))
        out[path] = Motion(
            turn,
            move,
            str(rng.choice(["origin", "centre" if mirror else "rear_node"])),
            figure={int(j): size(1e-5) for j in rng.integers(4, 37, 3)} if mirror else {},
            radius=size(0.05) if mirror and rng.random() < 0.5 else 0.0,
            conic=size(0.5) if mirror and rng.random() < 0.5 else 0.0,
        )
    return out


def test_a_written_state_is_read_back_to_the_last_bit(tmp_path) -> None:
    rng = np.random.default_rng(35)
    for _ in range(15):
        state = random_state(rng)
        spec = read(tmp_path, as_built_file("own", "gf7_pair", state, "launch", "made", "two lines\nof remarks"))
        assert {path: what.motion() for path, what in spec.as_built.items()} == state
        assert spec.disturbances == "launch"


def test_what_no_file_can_say_is_not_written() -> None:
    for motion in (Motion(scale=1e-6), Motion(expansion=1e-6), Motion(index_gradient=(1e-6, 0.0, 0.0))):
        with pytest.raises(ValueError, match="base/forward: only rigid motions"):
            as_built_file("own", "gf7_pair", {"base/forward": motion})


@pytest.fixture
def beyond(tmp_path: Path, gf7_pair):
    """Function: perturbation and statement as YAML -> texts of what is beyond it."""

    def texts(perturb: str, disturbances: str = "launch") -> list[str]:
        job = tmp_path / "job.yaml"
        job.write_text(f"instrument: gf7_pair\nperturb: {perturb}\ndisturbances: {disturbances}\n", "utf-8")
        resolved = resolve(job)
        return [e.text for e in beyond_prior(resolved, disturbance_prior(resolved, gf7_pair))]

    return texts


def test_amounts_are_held_against_those_stated(beyond) -> None:
    # launch states 1.5 um and 5 nm of a mirror, 2 K of the base, nothing of a line and of Z22
    assert (
        beyond("{base/forward/M2: {shift: [0 um, -6 um, 5.9 um], figure: {Z7: 19 nm}}, base: {temperature: 8 K}}") == []
    )
    assert beyond("{base/forward/M2: {shift: [0 um, -6.1 um, 3 um], figure: {Z22: 1 nm}}}") == [
        "base/forward/M2 shift y (-6.1 um, prior sigma 1.5 um)",
        "base/forward/M2 figure Z22 (1 nm, not in the prior)",
    ]
    assert beyond(
        "{base/forward/focal_plane/line: {rotate: [0 arcsec, 0 arcsec, 1 arcsec]}, base/forward: {scale: 1 ppm}}"
    ) == ["base/forward/focal_plane/line rotate z (1 arcsec, not in the prior)"]
    assert beyond("{base/forward/M2: {temperature: 1 K}}") == ["base/forward/M2 temperature (1 K, not in the prior)"]


def test_causes_of_one_component_add_up(beyond) -> None:
    more = "{file: launch, causes: {shock: {bodies: base/*/M2, shift: 8 um, time: constant, reason: a test}}}"
    sigma = (1.5**2 + 8.0**2) ** 0.5
    for times, count in ((0.99, 0), (1.01, 1)):
        assert len(beyond(f"{{base/forward/M2: {{shift: [{times * LIKELY * sigma} um, 0 um, 0 um]}}}}", more)) == count


def test_without_a_statement_everything_is_beyond(beyond) -> None:
    assert beyond("{base/forward/M2: {shift: [0 um, 0 um, 1 nm]}}", "none") == [
        "base/forward/M2 shift z (0.001 um, not in the prior)"
    ]
