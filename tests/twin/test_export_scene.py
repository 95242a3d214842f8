"""``twin.orbit export`` of scenes: DIMAP in, models, corrections and maps out; what is refused."""

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import twin.orbit.__main__ as command
from analysis.orbit.rational_polynomial import fit_rpc
from tests.twin.commands import files, invoke
from tests.twin.dimap_bench import Scene, rpc, write
from tests.twin.study_bench import REFUSED
from twin.framework.data_files import FrameFacts, tiff
from twin.orbit.export import ground_accuracy, line_scanner
from twin.orbit.export.export_report import _warnings as export_warnings
from twin.orbit.export.export_report import quality_warnings
from twin.orbit.export.export_run import ControlledPolynomial, Quality
from twin.orbit.export.rational_polynomial import read_rpc, sensor_polynomial
from twin.orbit.measured.platform_files import read_scene

run = partial(invoke, command.app)
SCENE = Scene(lines=4000, pixels=6000)
TRUE = np.array([12.0, -31.0])
NOISE = 0.2
COUNT = 14


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with its polynomials and control points, one of which is wrong by 20 pixels."""
    place = tmp_path_factory.mktemp("scene")
    sensor = read_scene(write(place, SCENE)).sensor
    (place / "RPC_SCENE.XML").write_text(rpc(sensor_polynomial(sensor, 0, SCENE.pixels, (0.0, 2000.0))))
    (place / "points.gcp").write_text(gcp(sensor, "SCENE_P.tif"))
    return place


def gcp(sensor, image: str, count: int = COUNT, wrong: int = 3) -> str:
    """Control points as the Ames Stereo Pipeline has them: name, place, sigmas, image, column, row, sigmas."""
    random = np.random.default_rng(11)
    row, column = random.uniform(50.0, SCENE.lines - 50.0, count), random.uniform(50.0, SCENE.pixels - 50.0, count)
    longitude, latitude, height = sensor.earth.geodetic(sensor.ground(row, column, random.uniform(0.0, 1500.0, count)))
    seen = np.stack([row, column], axis=-1) + TRUE + NOISE * random.standard_normal((count, 2))
    seen[wrong] += 20.0
    values = np.degrees(latitude), np.degrees(longitude), height, seen[:, 1], seen[:, 0]
    lines = [
        f"{k} {a!r} {b!r} {h!r} 0.05 0.05 0.05 {image} {c!r} {r!r} {NOISE} {NOISE}"
        for k, (a, b, h, c, r) in enumerate(zip(*(v.tolist() for v in values), strict=True))
    ]
    return "# WGS 84\n" + "\n".join(lines) + "\n"


@pytest.mark.second
def test_a_scene_becomes_models(folder: Path, tmp_path: Path) -> None:
    """ISD and RPC agree with the sensor of the file; the file's own polynomials are compared."""
    result = run("export", folder / "DIM_SCENE.XML", "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.stderr
    assert {"models/SCENE_P.json", "models/SCENE_P_RPC.TXT"} <= files(tmp_path / "out")
    numbers = json.loads((tmp_path / "out" / "export.json").read_text())
    assert numbers["product_rpc"]["SCENE_P"]["largest_px"] < 1e-4  # both are fits of one sensor
    assert "accuracy" not in numbers
    assert "control" not in numbers
    sensor = read_scene(folder / "DIM_SCENE.XML").sensor
    random = np.random.default_rng(1)
    row, column = random.uniform(0.0, SCENE.lines - 1.0, 50), random.uniform(0.0, SCENE.pixels - 1.0, 50)
    ground = sensor.ground(row, column, 1000.0)
    (errors,) = [numbers["lines"]["SCENE_P"]["isd_errors"]]
    assert max(one[key] for one in errors for key in ("line_px", "sample_px")) < 2e-5
    longitude, latitude, height = sensor.earth.geodetic(ground)
    there = read_rpc(tmp_path / "out" / "models" / "SCENE_P_RPC.TXT").image(
        np.degrees(latitude), np.degrees(longitude), height
    )
    np.testing.assert_allclose(there, (row, column), rtol=0, atol=1e-5)


@pytest.mark.second
@pytest.mark.parametrize("kind", ["shift", "affine"])
def test_control_points_correct_the_polynomials(folder: Path, tmp_path: Path, kind: str) -> None:
    arguments = ("--control", folder / "points.gcp", "--correction", kind)
    result = run("export", folder / "DIM_SCENE.XML", *arguments, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    told = json.loads((tmp_path / "out" / "export.json").read_text())["control"]["SCENE_P"]
    assert (told["kind"], told["points"], told["rejected_points"]) == (kind, COUNT, ["3"])
    found = read_rpc(tmp_path / "out" / "models" / "SCENE_P_RPC.TXT")
    assert found.bias_m == pytest.approx(told["err_bias_m"])
    assert 0.02 < found.bias_m < 0.4  # 0.2 px of 0.7 m, of 13 points; at the corners of an affine function more
    sensor = read_scene(folder / "DIM_SCENE.XML").sensor
    row, column = np.array([500.0, 3500.0, 2000.0]), np.array([500.0, 3000.0, 5500.0])
    longitude, latitude, height = sensor.earth.geodetic(sensor.ground(row, column, 700.0))
    off = np.stack(found.image(np.degrees(latitude), np.degrees(longitude), height)) - (row, column) - TRUE[:, None]
    assert np.abs(off).max() < 4.0 * NOISE * (0.3 if kind == "shift" else 1.0)


@pytest.mark.second
def test_a_map_of_the_accuracy(folder: Path, tmp_path: Path) -> None:
    """By hand for a look near the vertical: the attitude's turn times the distance, and the position, on each axis."""
    sigmas = "--attitude-sigma,2 arcsec,--position-sigma,1 m,--image-sigma,0.5,--height-sigma,3 m".split(",")
    result = run("export", folder / "DIM_SCENE.XML", *sigmas, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    numbers = json.loads((tmp_path / "out" / "export.json").read_text())["accuracy"]["SCENE_P"]
    sensor = read_scene(folder / "DIM_SCENE.XML").sensor
    middle = np.array([2000.0]), np.array([3000.0])
    ground = sensor.ground(*middle, 1000.0)[0]
    station = sensor.trajectory.position(sensor.time(middle[0]))[0]
    distance = np.linalg.norm(station - ground)
    sigma = np.hypot(2.0 / 206264.8 * distance, 1.0)
    # a look 13 deg from the vertical draws the ground by 1 / cos^2 at most
    assert 2.146 * sigma < numbers["ce90_median_m"] < 2.146 * sigma * 1.08
    assert numbers["le90_largest_m"] == pytest.approx(1.6449 * 3.0, rel=1e-4)
    found = read_rpc(tmp_path / "out" / "models" / "SCENE_P_RPC.TXT")
    assert (found.bias_m, found.random_m) == pytest.approx((numbers["common_m"], numbers["random_m"]))


def refused(scene: Path, out: Path, arguments, message: str) -> None:
    result = run("export", scene, *arguments, "--out", out)
    assert result.exit_code == 2, message
    assert message in re.sub(r"\s+", " ", result.stderr), message
    assert not out.exists(), message


def test_what_is_refused(folder: Path, tmp_path: Path) -> None:
    known = {one: folder / one for one in ("none.gcp", "RPC_SCENE.XML")}
    for arguments, message in REFUSED["scene_arguments"].values():
        refused(folder / "DIM_SCENE.XML", tmp_path / "out", [known.get(a, a) for a in arguments], message)
    points = (folder / "points.gcp").read_text()
    rows = points.splitlines()
    for text, message in (
        ("\n".join(" ".join(row.split()[:7]) for row in rows[1:]), "without image positions"),
        ("\n".join(rows[:3]), "3 or more"),
        (points.replace("SCENE_P.tif", "a.tif", 2).replace("SCENE_P", "b"), "in any of the images"),
    ):
        (tmp_path / "p.gcp").write_text(text)
        refused(folder / "DIM_SCENE.XML", tmp_path / "out", ("--control", tmp_path / "p.gcp"), message)
    (tmp_path / "a.ntf").write_bytes(b"NITF")
    (tmp_path / "other.gcp").write_text(points.replace("SCENE_P", "b", 2).replace("SCENE_P", "c"))
    model, other = folder / "RPC_SCENE.XML", ("--control", tmp_path / "other.gcp")
    refused(tmp_path / "a.ntf", tmp_path / "out", (), "a NITF file, which is not read")
    refused(Path("simulate"), tmp_path / "out", ("--band", "B1"), "only the scene of a DIMAP file has bands")
    refused(model, tmp_path / "out", other, "no control point lies in the image of these polynomials")


@pytest.mark.second
@pytest.mark.parametrize("form", ["a_RPC.TXT", "RPC_SCENE.XML", "a.tif"])
def test_polynomials_alone_are_corrected(folder: Path, tmp_path: Path, form: str) -> None:
    """The same polynomials from three formats take the same correction, as the scene's own do."""
    model = read_rpc(folder / "RPC_SCENE.XML")
    (tmp_path / "a_RPC.TXT").write_text(model.text())
    (tmp_path / "a.tif").write_bytes(tiff(np.zeros((1, 32, 32), np.uint16), FrameFacts(georeference=model)))
    (tmp_path / "RPC_SCENE.XML").write_bytes((folder / "RPC_SCENE.XML").read_bytes())
    points = ("--control", folder / "points.gcp")
    result = run("export", tmp_path / form, *points, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    name = form.partition(".")[0].removesuffix("_RPC")
    told = json.loads((tmp_path / "out" / "export.json").read_text())["control"][name]
    whole = run("export", folder / "DIM_SCENE.XML", *points, "--out", tmp_path / "whole", "--quiet")
    assert whole.exit_code == 0
    scene = json.loads((tmp_path / "whole" / "export.json").read_text())["control"]["SCENE_P"]
    # offsets of DIMAP 2 have lost 1e-12 by the 1 that was added
    np.testing.assert_allclose(told["coefficients_px"], scene["coefficients_px"], rtol=0, atol=1e-6)
    assert told["rejected_points"] == ["3"]
    found, other = (
        read_rpc(tmp_path / place / "models" / f"{one}_RPC.TXT") for place, one in (("out", name), ("whole", "SCENE_P"))
    )
    latitude, longitude = model.ground([100.0, 3900.0], [5000.0, 30.0], [0.0, 2000.0])
    np.testing.assert_allclose(
        found.image(latitude, longitude, [0.0, 2000.0]), other.image(latitude, longitude, [0.0, 2000.0]), atol=1e-5
    )
    assert "ISD" not in result.output
    for options, message in (
        ((), "need control points"),
        ((*points, "--attitude-sigma", "1 arcsec"), "uncertainties need a rigorous model"),
    ):
        refused(tmp_path / form, tmp_path / "bad", options, message)


@pytest.mark.second
def test_the_speed_of_light_is_not_passed_over(folder: Path, tmp_path: Path) -> None:
    """Nobody knows what the setting does to the geometry: the model leaves it out and says so."""
    scene = replace(SCENE, settings={"LIGHT_SPEED_SETTING": "true", "ATMOSPHERIC_REFRACTION_SETTING": "true"})
    result = run("export", write(tmp_path, scene), "--out", tmp_path / "out")
    assert result.exit_code == 0
    assert "LIGHT_SPEED_SETTING is true" in result.output.replace("\n", " ")
    # and refraction, which straight sensor models carry at one height only, is in the numbers: 1e-8 px without
    errors = json.loads((tmp_path / "out" / "export.json").read_text())["lines"]["SCENE_P"]["isd_errors"]
    assert max(one["line_px"] for one in errors) > 0.05


def test_doubts_of_polynomials_and_control_points_are_told() -> None:
    """Each sentence beyond its limit, and none below all limits."""

    def control(used=True, probability=2e-3, freedom=1) -> Any:
        correction = SimpleNamespace(used=np.array([True, used]), probability=probability, factor=9.0, freedom=freedom)
        return Quality(control={"A": ControlledPolynomial(np.array(["1", "2"], object), correction, None)})

    stands = "the correction by control points is in the polynomials, not in the ISD"
    assert quality_warnings(Quality()) == ()
    assert quality_warnings(SimpleNamespace(products={"A": SimpleNamespace(largest=0.99)}, control={})) == ()
    assert quality_warnings(control()) == (stands,)
    off = SimpleNamespace(products={"A": SimpleNamespace(largest=1.2)}, control={})
    for found, words in (
        (off, "the polynomials of the product differ from the rigorous model of A by up to 1.2 pixels"),
        (control(used=False), "control points of A lie beyond their covariances and are rejected: 2"),
        (control(probability=9e-4), "control points of A scatter by 3.0 times their sigmas: "),
        (control(freedom=0), "no redundant control point of A checks its correction"),
    ):
        assert quality_warnings(found)[0].startswith(words), words
    smooth, rough = (SimpleNamespace(error_px=(0.01, error)) for error in (0.09, 0.2))
    for line, words in (
        (SimpleNamespace(polynomial=smooth), []),
        (SimpleNamespace(polynomial=rough), ["the rational polynomials of A are off by up to 0.20 pixels"]),
        (SimpleNamespace(polynomial=None, refused="they bend"), ["A has no rational polynomials: they bend"]),
    ):
        texts = export_warnings(SimpleNamespace(source=None, lines={"A": line}))
        assert [text[: len(word)] for text, word in zip(texts, words, strict=True)] == words


def test_looks_that_miss_the_earth_and_ground_on_the_180th_meridian_are_refused() -> None:
    """A camera that looks into space is refused wherever its ground is needed."""
    none = SimpleNamespace(
        lines=4, camera=SimpleNamespace(pixels=4), ground=lambda at, *_: np.full((len(at), 3), np.nan)
    )
    with pytest.raises(ValueError, match="no line of sight meets the Earth"):
        ground_accuracy._ground_positions(none, np.zeros(2), np.zeros(2), 0.0)
    with pytest.raises(ValueError, match="a line of sight misses the Earth"):
        line_scanner._error(none, None, 0.0, (0, 4))
    with pytest.raises(ValueError, match="a line of sight misses the Earth"):
        sensor_polynomial(none, 0, 4, (0.0, 1000.0))
    across = np.array([[0.0, 0.0, 0.0, -179.9, 0.0], [9.0, 9.0, 0.1, 179.9, 100.0]])
    with pytest.raises(ValueError, match="the ground lies on the 180th meridian or a pole"):
        fit_rpc(across[:, :2], across[:, 2:], check=(across[:, :2], across[:, 2:]))
