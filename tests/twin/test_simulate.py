"""A simulated pass as a user runs it, what its files say to other software, and its lines as models of such."""

import json
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import twin.orbit.__main__ as command
from analysis.orbit.rational_polynomial import RationalPolynomial
from scenes.specs.load import ORBIT, SCENES
from scenes.specs.orbit.setup import SimulateSetup
from tests.twin.commands import edited_copy, invoke, refused
from tests.twin.line_scanner_model import LineScannerModel
from tests.twin.study_bench import REFUSED
from twin.framework.data_files import FrameFacts, tiff
from twin.orbit.export import line_scanner as line_scanning
from twin.orbit.export.line_scanner import line_scanner
from twin.orbit.export.rational_polynomial import sensor_polynomial
from twin.orbit.flight.sensor import NO_EFFECTS, LightEffects, Sensor
from twin.orbit.images.simulate_run import fly_simulation

run = partial(invoke, command.app)
EXAMPLE = SCENES / ORBIT / "simulate.yaml"
SIZE = "lines: 1000, pixels: 1000}"
SMALL = "lines: 64, pixels: 80}"
# such small images have no room for templates
POINTS = "points: {control: 200, check: 100, tie: 200, search_radius: 40, template: 31}"
LINES = ("forward", "nadir", "backward")


def write(folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the example with small images."""
    return edited_copy(EXAMPLE, folder, (SIZE, SMALL), (POINTS, ""), *changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("simulate")
    result = run("simulate", write(place), "--out", place / "run", "--seed", 5, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout) == read(place / "run" / "simulate.json")
    return place / "run"


def read(path: Path):
    return json.loads(path.read_text("utf-8"))


def test_trajectory_says_which_velocity_it_has(folder: Path) -> None:
    """The velocity is the derivative of the position in the turning frame; against the stars the Earth's rotation comes
    to it, 0.4 km/s at 40 deg, which taken for the other would turn an aberration of 5 arcsec by 0.27 arcsec."""
    path = read(folder / "artefacts" / "trajectory.json")
    assert path["schema"] == "trajectory 2"
    assert "rotating Earth" in path["reference_frames"]["velocity_m_per_s"]
    assert "stars" in path["reference_frames"]["inertial_velocity_m_per_s"]
    time, place, fixed, inertial = (
        np.array(path[k]) for k in ("orbit_s", "position_m", "velocity_m_per_s", "inertial_velocity_m_per_s")
    )
    slope = CubicSpline(time, place)(time, 1)[5:-5]
    # measured positions of 0.05 m every second; rotation about the pole, good to its motion and nutation
    assert np.abs(slope - fixed[5:-5]).max() < 0.5
    assert np.abs(inertial - fixed - np.cross([0.0, 0.0, 7.292115e-5], place)).max() < 0.1
    assert np.linalg.norm(inertial - fixed, axis=1).min() > 300.0


def test_only_the_truth_knows_the_true_camera(folder: Path) -> None:
    # nothing that only the truth knows
    known = "".join((folder / "artefacts" / f"{n}.json").read_text("utf-8") for n in ("camera", "trajectory"))
    assert "0.65009" not in known
    assert (
        read(folder / "artefacts" / "truth.json")["camera"]["lines"]["forward"]["principal_distance_m"] == 0.65 + 90e-6
    )


def test_other_software_finds_the_ground(folder: Path) -> None:
    """Camera, orbit and attitude from truth.json alone, a straight look: places to 20 m, which light time, aberration
    and refraction are (13 m along the track by aberration)."""
    truth, data = read(folder / "artefacts" / "truth.json"), read(folder / "simulate.json")
    way, checked = truth["trajectory"], 0
    position = CubicSpline(way["orbit_s"], way["position_m"])
    turn = CubicSpline(way["attitude_s"], way["quaternion"])
    for name in LINES:
        line, points = truth["camera"]["lines"][name], truth["ground_points"][name]
        said = data["lines"][name]
        seconds = said["first_line_time_s"] + (np.array(points["line"]) - said["first_line"]) * said["line_time_s"]
        x0, y0 = line["principal_point_m"]
        y = (np.array(points["pixel"]) - 0.5 * (line["pixels"] - 1)) * line["pitch_m"] - y0
        grown = 1.0 + line["k1_per_m2"] * (x0**2 + y**2)
        look = np.stack([x0 * grown, -y * grown, np.full_like(y, line["principal_distance_m"])], axis=-1)
        look = look @ np.array(line["camera_to_body"]).T
        look = Rotation.from_quat(turn(seconds)).apply(look / np.linalg.norm(look, axis=-1, keepdims=True))
        arm = np.array(points["itrs_m"]) - position(seconds)
        beside = np.linalg.norm(np.cross(arm, look), axis=-1)
        assert beside.max() < 20.0
        checked += len(beside)
    assert checked == 3 * 441


# what is wrong, key, what to do about it
BAD = REFUSED["simulated_files"]


@pytest.mark.second
@pytest.mark.parametrize("case", BAD)
def test_bad_input(case: str, tmp_path: Path) -> None:
    old, new, key, words = BAD[case]
    refused(run, "simulate", write(tmp_path, (old, new)), key, words)


# --- lines in orbit as models of other software -----------------------------------------------------------------------


CSM = Path(__file__).parent / "csm"
HEIGHTS = (0.0, 1000.0, 2000.0)


@pytest.fixture(scope="module")
def flight():
    return fly_simulation(SimulateSetup.read(SCENES / ORBIT / "simulate.yaml"), 1)


def _sensor(flight, name: str, effects: LightEffects, measured: bool = False, lines: int = 4000) -> Sensor:
    sensor = (flight.users if measured else flight.sensors)[name]
    # in the middle of the pass, where the line sees the patch
    first = float(sensor.time(np.array([0.5 * (sensor.lines - lines)]))[0])
    return replace(sensor, first_line_time=first, lines=lines, effects=effects)


def _isd(sensor: Sensor, window: tuple[int, int] | None = None):
    scanner = line_scanner(sensor, "line", "2011-03-05T03:05:00Z", 6.5e-6, HEIGHTS, window)
    return scanner, LineScannerModel(json.loads(json.dumps(dict(scanner.isd))))


def _places(sensor: Sensor, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    return random.uniform(0.0, sensor.lines - 1.0, count), random.uniform(0.0, sensor.camera.pixels - 1.0, count)


@pytest.mark.second
def test_a_trajectory_that_no_number_of_nodes_follows_is_refused(flight, monkeypatch) -> None:
    """Followed to no error at all."""
    sensor = _sensor(flight, "nadir", NO_EFFECTS)
    _isd(sensor)
    monkeypatch.setattr(line_scanning, "_FOLLOWED", 0.0)
    monkeypatch.setattr(line_scanning, "_MOST", 128)
    with pytest.raises(ValueError, match="128 nodes of the orbit and the attitude do not follow the trajectory"):
        _isd(sensor)


@pytest.mark.second
@pytest.mark.parametrize("name", ["gf7_forward_fx", "th1_nadir_nofx"])
def test_the_reader_agrees_with_the_communitys_model(name: str) -> None:
    table = np.loadtxt(CSM / f"{name}.csv", delimiter=",", skiprows=1)
    line, sample = LineScannerModel(json.loads((CSM / f"{name}.json").read_text())).image(table[:, :3])
    # the table has nine decimals of a pixel, and metres to a micrometre of 0.7 m and more
    assert np.abs(line - table[:, 3]).max() < 1e-5
    assert np.abs(sample - table[:, 4]).max() < 1e-5


@pytest.mark.second
@pytest.mark.parametrize("name", ["forward", "nadir"])
@pytest.mark.parametrize(
    ("effects", "height", "allowed"),
    [
        # the distortion's cubic cannot be turned round exactly: 3 k1^2 y^5, 6e-6 pixels at the line's ends
        (NO_EFFECTS, 0.0, 2e-5),
        # aberration and light time are alike at all heights, but for the turn of the Earth under way
        (LightEffects(refraction=False), 2000.0, 1e-4),
        (LightEffects(), HEIGHTS[1], 2e-5),
    ],
)
def test_a_sensor_model_sees_what_the_rigorous_sensor_sees(flight, name, effects, height, allowed) -> None:
    sensor = _sensor(flight, name, effects)
    scanner, model = _isd(sensor)
    line, pixel = _places(sensor)
    there = model.image(sensor.ground(line, pixel, height))
    assert np.abs(there[0] - 0.5 - line).max() < allowed
    assert np.abs(there[1] - 0.5 - pixel).max() < allowed
    assert all(max(e.sample_px, e.line_px) < allowed for e in scanner.errors if e.height_m == height)


@pytest.mark.second
def test_a_trajectory_that_jitters_takes_more_nodes(flight) -> None:
    smooth, rough = (_sensor(flight, "nadir", NO_EFFECTS, measured) for measured in (False, True))
    one, (two, model) = _isd(smooth)[0], _isd(rough)
    assert len(two.camera.seconds) > len(one.camera.seconds)
    line, pixel = _places(rough)
    there = model.image(rough.ground(line, pixel, 500.0))
    assert np.abs(there[0] - 0.5 - line).max() < 0.01
    assert np.abs(there[1] - 0.5 - pixel).max() < 0.01


@pytest.mark.second
def test_a_window_is_a_part_of_the_line(flight) -> None:
    sensor = _sensor(flight, "backward", LightEffects())
    part = replace(sensor, first_line_time=float(sensor.time(np.array([500.0]))[0]), lines=300)
    _, model = _isd(part, (7000, 400))
    line, pixel = np.array([0.0, 120.0, 299.0]), np.array([0.0, 399.0, 250.0])
    ground = sensor.ground(500.0 + line, 7000.0 + pixel, HEIGHTS[1])
    there = model.image(ground)
    np.testing.assert_allclose(there[0] - 0.5, line, atol=2e-5)
    np.testing.assert_allclose(there[1] - 0.5, pixel, atol=2e-5)
    rpc = sensor_polynomial(part, 7000, 400, (0.0, 2000.0))
    longitude, latitude, height = part.earth.geodetic(ground)
    there = rpc.image(np.degrees(latitude), np.degrees(longitude), height)
    np.testing.assert_allclose(there[0], line, atol=1e-3)
    np.testing.assert_allclose(there[1], pixel, atol=1e-3)


def _gdal(rpc: RationalPolynomial, shape: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Lines and pixels (N, 2) by GDAL of a written file, the first pixel's centre being 0, 0."""
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import MemoryFile
    from rasterio.transform import RPCTransformer

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with (
            MemoryFile(tiff(np.zeros((1, *shape), np.uint16), FrameFacts(georeference=rpc))) as memory,
            memory.open() as file,
        ):
            assert file.shape == shape
            with RPCTransformer(file.rpcs) as transformer:
                rows = transformer.rowcol(*points.T, op=lambda value: value)
    return np.stack(rows, axis=-1) - 0.5


@pytest.mark.second
@pytest.mark.parametrize("name", ["forward", "nadir"])
def test_gdal_finds_what_the_rigorous_sensor_finds(flight, name: str) -> None:
    sensor = _sensor(flight, name, LightEffects(), lines=1000)
    rpc = sensor_polynomial(sensor, 0, sensor.camera.pixels, (0.0, 2000.0))
    line, pixel = _places(sensor, 300)
    height = np.random.default_rng(4).uniform(0.0, 2000.0, 300)
    longitude, latitude, _ = sensor.earth.geodetic(sensor.ground(line, pixel, height))
    points = np.stack([np.degrees(longitude), np.degrees(latitude), height], axis=-1)
    there = _gdal(rpc, (1000, 12000), points)
    # the issue of such files: 0.01 pixels; measured 1e-6
    assert np.abs(there - np.stack([line, pixel], axis=-1)).max() < 1e-4
    assert max(rpc.error_px) < 1e-4


@pytest.mark.second
def test_polynomials_say_how_far_jitter_is_from_them(flight) -> None:
    sensor = _sensor(flight, "nadir", LightEffects(), measured=True)
    rpc = sensor_polynomial(sensor, 0, sensor.camera.pixels, (0.0, 2000.0))
    line, pixel = _places(sensor, 400)
    longitude, latitude, height = sensor.earth.geodetic(sensor.ground(line, pixel, 800.0))
    there = np.stack(rpc.image(np.degrees(latitude), np.degrees(longitude), height), axis=-1)
    away = there - np.stack([line, pixel], axis=-1)
    # half an arcsecond of jitter is a quarter of a pixel; a mean square of 400 places of a few dozen readings
    for rms, stated in zip(np.sqrt(np.mean(away**2, axis=0)), rpc.rms_px, strict=True):
        assert 0.6 * stated < rms < 1.6 * stated
    assert 0.05 < max(rpc.rms_px) < 0.5


@pytest.mark.second
def test_command(tmp_path: Path) -> None:
    """Polynomials as text and as a tag of the TIFF, and the sensor model of a window; the truth is another camera's."""
    path = write(tmp_path, ("lines: [forward, nadir, backward]", "lines: [nadir]"))
    assert run("simulate", path, "--out", tmp_path / "run", "--seed", 5, "--quiet").exit_code == 0
    result = run("export", tmp_path / "run", "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.stderr
    import tifffile
    from rasterio.io import MemoryFile

    models = tmp_path / "out" / "models"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # out of its folder: GDAL prefers the text beside it to the tag
        with MemoryFile((models / "nadir.tif").read_bytes()) as memory, memory.open() as file:
            image, rpcs = file.read(1), file.rpcs
    assert np.array_equal(image, np.squeeze(tifffile.imread(tmp_path / "run" / "images" / "nadir.tiff")))
    told = dict(row.split(": ", 1) for row in (models / "nadir_RPC.TXT").read_text().splitlines())
    # all 90 numbers of both places; GDAL hands on 15 digits of those in the tag
    for key, values in rpcs.to_gdal().items():
        if not key.startswith("ERR"):
            own = [told.pop(key)] if key in told else [told.pop(f"{key}_{k}") for k in range(1, 21)]
            numbers = [float(value.split()[0]) for value in own]
            assert [float(v) for v in values.split()] == pytest.approx(numbers, rel=1e-14, abs=0.0), key
    assert not told
    # nobody states errors
    assert (rpcs.err_bias, rpcs.err_rand) == (-1.0, -1.0)
    isd = json.loads((models / "nadir.json").read_text())
    assert (isd["image_lines"], isd["image_samples"]) == image.shape
    assert isd["starting_detector_sample"] == json.loads(result.stdout)["lines"]["nadir"]["first_pixel"] > 0
    assert run("export", tmp_path / "run", "--truth", "--out", tmp_path / "truth", "--quiet").exit_code == 0
    assert (tmp_path / "truth" / "models" / "nadir.json").read_text() != (models / "nadir.json").read_text()


@pytest.mark.parametrize(("arguments", "words"), REFUSED["scene_exports"])
def test_exports_that_are_refused(tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    known = {
        "payload": SCENES / "library" / "payloads" / "th1.yaml",
        "calibrate": SCENES / ORBIT / "calibrate.yaml",
        "simulate": SCENES / ORBIT / "simulate.yaml",
        "folder": tmp_path,
    }
    result = run("export", *(known.get(word, word) for word in arguments), "--out", tmp_path / "out")
    assert result.exit_code == 2
    for word in words:
        assert word in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.second
def test_a_spoilt_run_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, ("lines: [forward, nadir, backward]", "lines: [nadir]"))
    assert run("simulate", path, "--out", tmp_path / "run", "--seed", 5, "--quiet").exit_code == 0
    image = tmp_path / "run" / "images" / "nadir.tiff"
    content = image.read_bytes()
    image.write_bytes(content[: len(content) // 3])
    assert _told(tmp_path, "nadir.tiff")
    import tifffile

    tifffile.imwrite(image, np.zeros((10, 10), np.uint16))
    assert _told(tmp_path, "10 lines of 10 pixels")
    image.unlink()
    assert _told(tmp_path, "nadir.tiff")
    (tmp_path / "run" / "simulate.json").write_text('{"lines": []}')
    assert _told(tmp_path, "the positions of the images are missing")


def _told(folder: Path, word: str) -> bool:
    result = run("export", folder / "run", "--out", folder / "out")
    assert result.exit_code == 2
    assert not (folder / "out").exists()
    return word in result.stderr
