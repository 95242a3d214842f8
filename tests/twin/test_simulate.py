"""A simulated pass as a user runs it, and what its files say to other software."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import twin.orbit.__main__ as command
from scenes.specs.load import ORBIT, SCENES
from tests.twin.commands import edited_copy, invoke, refused
from tests.twin.study_bench import REFUSED

run = partial(invoke, command.app)
EXAMPLE = SCENES / ORBIT / "simulate.yaml"
SIZE = "lines: 1000, pixels: 1000}"
SMALL = "lines: 64, pixels: 80}"
# such small images have no room for templates
POINTS = "points: {control: 200, check: 100, tie: 200, reach: 40, template: 31}"
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
    assert "turning Earth" in path["reference_frames"]["velocity_m_per_s"]
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
