"""What a series says of jumps: in its numbers, in the text of the reports, and in the warnings."""

import json
from dataclasses import replace

import numpy as np
import pytest

from analysis.monitor.disturbances import Consistency
from analysis.monitor.jump_detection import Jump
from tests.twin.commands import invoke
from twin.main_job.assumptions import course_agrees
from twin.monitor.reading_table import ReadingTable
from twin.monitor.time_series import SmoothedCourse, jump_text
from twin.render import app

JUMP = Jump(
    "base/M2",
    (3, 4),
    ("base/M2 shift x", "base/M2 shift y"),
    ("um", "um"),
    (3.21, -0.5),
    (0.42, 0.4),
    3600.0,
    7200.0,
    ((3600.0, 0.0), (7200.0, 1.0)),
    31.4,
    2e-9,
    {"base/M1": 31.0, "base/M3": 12.0},
    1.5,
)
JOB = """instrument: gf7_pair
disturbances:
  file: orbit
  causes:
    jolts: {bodies: "base/*/focal_plane", rotate: 1 arcsec, pivot: rear_node, time: jump, reason: release of a mount}
course:
  times: [0 h, 24 h, 48 h, 72 h]
  detail: 0 h
  motion:
    base/backward/focal_plane:
      pivot: rear_node
      rotate:
        - [0 arcsec, 0 arcsec, 0 arcsec]
        - [0 arcsec, 0 arcsec, 0 arcsec]
        - [4 arcsec, -2 arcsec, 0 arcsec]
        - [4 arcsec, -2 arcsec, 0 arcsec]
render: {frames: 2, seed: 7}
"""


def course(jumps: tuple[Jump, ...] | None) -> SmoothedCourse:
    """Of two times; its changes are not looked at."""
    empty = ReadingTable((), {})
    agrees = Consistency(3.0, 4, 18.0)
    return SmoothedCourse("some", empty, np.zeros(0), empty, np.array([1.0, 2.0]), 2, agrees, jumps, 0.01)


def test_a_jump_in_words() -> None:
    assert jump_text(JUMP) == (
        "base/M2 jumped between 1 h and 2 h: shift x +3.21 ± 0.42 um, shift y -0.5 ± 0.4 um, log ratio 31.4; sigmas "
        "are wide there, and smoothed changes take it for an event; base/M1 would explain it nearly as well"
    )
    assert "nearly" not in jump_text(replace(JUMP, rivals={"base/M3": 12.0}))


def test_what_a_course_says() -> None:
    """Where nothing may jump nothing is said of it; where nothing did, that it was looked for; else what did."""
    times = np.array([0.0, 3600.0])
    none, nothing, one = course(None), course(()), course((JUMP,))
    assert "jumps" not in none.to_dict()
    assert "jump" not in course_agrees(none, times)
    assert nothing.to_dict()["jumps"] == {"false_alarm": 0.01, "found": []}
    assert course_agrees(nothing, times).endswith("No jump was found (a false one with a chance of at most 0.01).")
    assert course_agrees(one, times).endswith(f"The series says that {jump_text(JUMP)}.")
    (found,) = json.loads(json.dumps(one.to_dict()))["jumps"]["found"]
    assert found["sizes"][0] == {"name": "base/M2 shift x", "unit": "um", "size": 3.21, "sigma": 0.42}
    assert found["rivals"] == [{"body": "base/M1", "log_ratio": 31.0}, {"body": "base/M3", "log_ratio": 12.0}]


@pytest.mark.slow
def test_a_rendered_jump_is_named_with_its_size(tmp_path) -> None:
    """From frames of a step of 4 and -2 arcsec to the number, the warning and the report."""
    (tmp_path / "job.yaml").write_text(JOB, "utf-8")
    result = invoke(app, tmp_path / "job.yaml", "--out", tmp_path / "run")
    assert result.exit_code == 0, result.stderr
    (found,) = json.loads((tmp_path / "run/course.json").read_text())["disturbances"]["jumps"]["found"]
    assert found["body"] == "base/backward/focal_plane"
    assert (found["after_s"], found["until_s"]) == (86_400.0, 172_800.0)
    assert found["log_ratio"] > 20.0
    for one, true in zip(found["sizes"], (4.0, -2.0, 0.0), strict=True):
        assert abs(one["size"] - true) < 4.0 * one["sigma"]
        assert one["sigma"] < 1.5
    text = "base/backward/focal_plane jumped between 24 h and 48 h: rotate x +"
    (warning,) = [w for w in json.loads((tmp_path / "run/recovered.json").read_text())["warnings"] if "jumped" in w]
    assert warning.startswith(f"course: {text}")
    assert (tmp_path / "run/report.html").read_text().count(text) >= 2
