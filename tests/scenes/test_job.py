"""Jobs: what is read, and that every mistake is told with file, line, key and what was meant."""

from pathlib import Path

import pytest

from scenes.specs.course import noll
from scenes.specs.job import checked_nodes
from scenes.specs.load import EXAMPLES, load_job
from scenes.specs.perturbation import NodeInfo
from scenes.yaml.errors import InputError
from scenes.yaml.yaml_file import dump_yaml

ARCSEC = 4.84813681109536e-06
NODES = {
    "base/backward/focal_plane": NodeInfo(("origin", "rear_node"), frozenset({"rotate", "shift", "scale"})),
    "base/forward/M1": NodeInfo(allows=frozenset({"rotate", "shift", "figure"})),
    "base/forward/M2": NodeInfo(allows=frozenset({"rotate", "shift", "figure"})),
}
HEAD = "instrument: gf7_pair\nperturb:\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "perturb.yaml"
    path.write_text(text, "utf-8")
    return path


def test_the_example() -> None:
    job = load_job(EXAMPLES / "perturb.yaml")
    assert job.instrument == "gf7_pair"
    assert job.perturb["base/backward/focal_plane"].rotate == pytest.approx(
        (2 * ARCSEC, -1.5 * ARCSEC, 10 * ARCSEC), rel=1e-15
    )
    assert job.perturb["base/backward/focal_plane"].pivot == "rear_node"
    assert job.perturb["base/forward/M2"].shift == (0.0, 0.0, 3e-6)
    assert (job.render.images, job.render.frames, job.render.seed) == (("spots",), 9, 1)
    assert job.analysis.centroid == "ml"
    checked_nodes(job, NODES)


@pytest.mark.parametrize(
    ("text", "kelvin"),
    [
        ("100 K", 100.0),
        ("+250 K", 250.0),
        (" +250 K", 250.0),
        ("-250 K", -250.0),
        ("250 mK", 0.25),
        ("+1000 K", 1000.0),
    ],
)
def test_changes_of_temperature(text: str, kelvin: float, tmp_path: Path) -> None:
    path = write(tmp_path, f"{HEAD}  base: {{temperature: '{text}'}}\n")
    job = load_job(path)
    assert job.perturb["base"].temperature.change == kelvin
    # what is written is read again
    again = write(tmp_path, dump_yaml(job.plain()))
    assert load_job(again).perturb["base"].temperature.change == kelvin


@pytest.mark.parametrize("text", ["250 K", "100.001 K", "300000 mK"])
def test_an_absolute_temperature_is_not_taken_for_a_change(text: str, tmp_path: Path) -> None:
    path = write(tmp_path, f"{HEAD}  base:\n    temperature: {{change: {text}}}\n")
    with pytest.raises(InputError) as caught:
        load_job(path)
    said = f"{path}:4: perturb.base.temperature.change: hardly meant as a temperature difference"
    assert str(caught.value).startswith(f"{said}; found '{text}', allowed: +{text} if it is meant")


@pytest.mark.parametrize(
    "text", ["instrument: gf7_pair", "instrument: gf7_pair\nperturb: {}", "instrument: gf7_pair\nperturb:\nrender:\n"]
)
def test_nothing_perturbed(text: str, tmp_path: Path) -> None:
    job = load_job(write(tmp_path, text))
    assert job.perturb == {}
    assert job.render.frames is None
    checked_nodes(job, {})


def test_everything_that_a_node_may_have(tmp_path: Path) -> None:
    node = (
        "  base/forward/M1: {figure: {Z5: 20 nm, Z11: -3 nm}, scale: 10 ppm, rotate: [1 arcsec, 0 arcsec, 0 arcsec]}\n"
    )
    what = load_job(write(tmp_path, HEAD + node)).perturb["base/forward/M1"]
    assert dict(what.figure) == {"Z5": 20e-9, "Z11": -3e-9}
    assert what.scale == 10e-6
    assert what.uses() == ("rotate", "figure", "scale")
    assert [noll(term) for term in what.figure] == [5, 11]


NODE = "  base/forward/M2: "


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (
            HEAD + NODE + "{rotate: [2 arcsek, 0 deg, 0 deg]}",
            3,
            ["unknown unit 'arcsek'", "rotate[0]", "did you mean 'arcsec'?"],
        ),
        (
            HEAD + NODE + "{rotate: [0 deg, 2, 0 deg]}",
            3,
            ["a number without a unit; found 2", "rotate[1]", "'2 arcsec'"],
        ),
        (HEAD + NODE + "{shift: [0 um, 0 um, 0]}", 3, ["a number without a unit; found 0", "shift[2]"]),
        (HEAD + NODE + "{shift: [0 um, 0 um, 3 arcsec]}", 3, ["'arcsec' is a unit of an angle, not of a length"]),
        (HEAD + NODE + "{shift: [.nan, 0 um, 0 um]}", 3, ["not a finite number; found nan"]),
        (HEAD + NODE + "{shift: [nan um, 0 um, 0 um]}", 3, ["not a finite number; found 'nan um'"]),
        (HEAD + NODE + "{shift: [inf um, 0 um, 0 um]}", 3, ["not a finite number"]),
        (HEAD + NODE + "{shift: [1e999 um, 0 um, 0 um]}", 3, ["not a finite number"]),
        (
            HEAD + NODE + "{shift: [10 m, 0 um, 0 um]}",
            3,
            ["outside the limits; found '10 m', allowed: at most 100 mm in size"],
        ),
        (HEAD + NODE + "{rotate: [0 deg, -6 deg, 0 deg]}", 3, ["found '-6 deg', allowed: at most 5 deg in size"]),
        (HEAD + NODE + "{figure: {Z5: 1 mm}}", 3, ["figure.Z5", "at most 100 um in size"]),
        (HEAD + NODE + "{figure: {Q5: 1 um}}", 3, ["figure.Q5: not a Zernike term", "Z1 .. Z66"]),
        (HEAD + NODE + "{scale: 2 %}", 3, ["at most 1 percent in size"]),
        (HEAD + NODE + "{scale: 10}", 3, ["a number without a unit", "ppm"]),
        (HEAD + NODE + "{rotate: [1 deg, 1 deg]}", 3, ["not a list of 3 quantities; found 2 of them"]),
        (HEAD + NODE + "{rotate: 2 arcsec}", 3, ["not a list of 3 quantities; found '2 arcsec'"]),
        (HEAD + NODE + "{rotat: [1 deg, 1 deg, 1 deg]}", 3, ["rotat: unknown key", "did you mean 'rotate'?"]),
        (HEAD + NODE + "2 um", 3, ["not a mapping", "rotate, shift, pivot, figure, scale"]),
        (HEAD + NODE + "{pivot: 3}", 3, ["pivot: not text"]),
        (
            HEAD + "  x:\n    shift: [0 um, 0 um, 0 um]\n    shift: [0 um, 0 um, 0 um]\n",
            5,
            ["duplicate key 'shift', first on line 4"],
        ),
        ("perturb: {}", 1, ["'instrument' is missing"]),
        ("instrument: gf7_pear", 1, ["instrument: no such name in instruments", "did you mean 'gf7_pair'?"]),
        # a camera is an instrument, by its name as well
        (
            "instrument: ritchey_cretien",
            1,
            ["no such name in instruments or cameras", "did you mean 'ritchey_chretien'?"],
        ),
        ("instrument: {camera: korsh}", 1, ["cameras: cassegrain, ", "did you mean 'korsch'?"]),
        ("\ninstrument: own/camera.yaml", 2, ["instrument: no such file", "own/camera.yaml"]),
        ("instrument: 3", 1, ["instrument: not text"]),
        ("instrument: gf7_pair\nperturbe: {}", 2, ["perturbe: unknown key", "did you mean 'perturb'?"]),
        ("instrument: gf7_pair\nperturb: [1]", 2, ["perturb: not a mapping; found a list of 1"]),
        ("instrument: gf7_pair\nrender: {frames: 0}", 2, ["render.frames", "found 0, allowed: at least 1"]),
        ("instrument: gf7_pair\nrender: {frames: 10001}", 2, ["allowed: at most 10000"]),
        ("instrument: gf7_pair\nrender: {frames: 1.5}", 2, ["not a whole number"]),
        ("instrument: gf7_pair\nrender: {frames: true}", 2, ["not a whole number"]),
        ("instrument: gf7_pair\nrender: {seed: -1}", 2, ["render.seed", "found -1, allowed: at least 0"]),
        ("instrument: gf7_pair\nrender: {images: [spot]}", 2, ["render.images[0]", "did you mean 'spots'?"]),
        ("instrument: gf7_pair\nrender: {images: []}", 2, ["render.images"]),
        ("instrument: gf7_pair\nrender: {images: spots}", 2, ["render.images", "list"]),
        (
            "instrument: gf7_pair\nanalysis: {centroid: gauss}",
            2,
            ["not one of the choices", "did you mean 'gaussian'?"],
        ),
        ("- 1", 1, ["not a mapping", "instrument, perturb, course, disturbances, render, analysis"]),
        ("just text", 1, ["not a mapping"]),
    ],
)
def test_mistakes(text: str, line: int, words: list[str], tmp_path: Path) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_job(path)
    message = str(caught.value)
    assert message.startswith(f"{path}:{line}: ")
    assert (caught.value.file, caught.value.line) == (str(path), line)
    for word in words:
        assert word in message
    assert len(message.splitlines()) == 1
    assert "pydantic" not in message.lower()


def test_all_mistakes_are_told_at_once(tmp_path: Path) -> None:
    path = write(tmp_path, HEAD + NODE + "{rotate: [1, 2 m, 0 deg]}\nrender:\n  seed: x\n  frame: 2\n")
    with pytest.raises(InputError) as caught:
        load_job(path)
    assert [issue.line for issue in caught.value.issues] == [3, 3, 5, 6]
    assert len(str(caught.value).splitlines()) == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "base/backward/focalplane: {}",
            ["perturb.base/backward/focalplane: no such node", "did you mean 'base/backward/focal_plane'?"],
        ),
        ("base/forward/m2: {}", ["did you mean 'base/forward/M2'?"]),
        ("somewhere/else: {}", ["no such node", "allowed: base/backward/focal_plane, base/forward/M1"]),
        (
            "base/backward/focal_plane: {pivot: rear_nod}",
            ["no such pivot", "origin, rear_node", "did you mean 'rear_node'?"],
        ),
        ("base/forward/M1: {scale: 1 ppm}", ["does not allow scale", "figure, rotate, shift"]),
        ("base/backward/focal_plane: {figure: {Z4: 1 um}}", ["does not allow figure"]),
    ],
)
def test_nodes(text: str, words: list[str], tmp_path: Path) -> None:
    path = write(tmp_path, HEAD + "  # nothing\n  " + text)
    job = load_job(path)
    with pytest.raises(InputError) as caught:
        checked_nodes(job, NODES)
    assert str(caught.value).startswith(f"{path}:4: ")
    for word in words:
        assert word in str(caught.value)


def test_all_nodes_are_told_at_once(tmp_path: Path) -> None:
    job = load_job(write(tmp_path, HEAD + "  a: {}\n  base/forward/M1: {pivot: b}\n  c: {}\n"))
    with pytest.raises(InputError) as caught:
        checked_nodes(job, NODES)
    assert [issue.line for issue in caught.value.issues] == [3, 4, 5]


def test_a_missing_job() -> None:
    with pytest.raises(InputError, match=r"no_such\.yaml: no such file"):
        load_job("no_such.yaml")
